"""Optimisations of an inverse problem, with the best points of one grid for each loop: see task `quality`."""

from __future__ import annotations

import gc
import time
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from ..inverse.loops import ENTRIES
from ..inverse.problem import Task
from ..inverse.problems import PROBLEMS
from ..inverse.search import MARKS, MIDDLE, best, followed, reached, searched, warmed
from .job import Curve, Job, Measure


class Quality(Measure):
    """The first call of a method searches the grid; later calls run the best points for the marks with their seeds.

    The best point for the largest mark runs until that mark only, unless it is that for the other marks, too.
    """

    SEARCH_SEED = 1000
    """Seed of the search: no round has it, so that luck in the search does not repeat itself."""

    def __init__(self, job: Job) -> None:
        self.job = job
        self.task = Task(PROBLEMS[job.scene].build(job.resolution))
        self.curves: dict[str, list[Curve]] = {}

    def __call__(self, method: str, seed: int) -> tuple[float, np.ndarray]:
        """Seconds until the middle mark (all seconds of the optimisation, if it is not reached), and the last error."""
        if method in self.curves:
            main, first = (best(self.curves[method], mark) for mark in (MIDDLE, max(MARKS)))
            curve = self._run(method, main.rate, main.spp, seed, min(MARKS), self.job.budget)
            self.curves[method].append(curve)
            if (first.rate, first.spp) != (main.rate, main.spp):
                self.curves[method].append(self._run(method, first.rate, first.spp, seed, max(MARKS), self.job.budget))
            seconds = min(reached(curve, MIDDLE)[0], curve.seconds[-1])
            return seconds, np.array([curve.errors[-1]])
        start = time.process_time()
        self.curves[method] = list(
            searched(
                self.job.rates,
                self.job.samples,
                lambda rate, spp, budget: self._run(method, rate, spp, self.SEARCH_SEED, MIDDLE, budget),
                self.job.budget,
            )
        )
        return time.process_time() - start, np.array([best(self.curves[method], MIDDLE).errors[-1]])

    def conclude(self, kept: dict[str, list[np.ndarray]]) -> dict[str, dict[str, Any]]:
        """All curves; the curves of the search come first."""
        return {name: {"curves": [asdict(curve) for curve in self.curves[name]]} for name in kept}

    def _run(self, method: str, rate: float, spp: int, seed: int, goal: float, budget: float) -> Curve:
        try:
            return self._followed(method, rate, spp, seed, goal, budget)
        except Exception as error:
            while error.__cause__ is not None:  # Dr.Jit hides what was wrong in a loop
                error = error.__cause__
            raise RuntimeError(str(error)) from None

    def _followed(self, method: str, rate: float, spp: int, seed: int, goal: float, budget: float) -> Curve:
        gc.collect()  # scenes and recordings of earlier runs slow down tracing
        entry = ENTRIES[method]
        loop = entry.begin(self.task, rate, spp, seed)
        untimed = warmed(loop, entry.warm_up * len(self.task.problem.train))
        curve = followed(loop, self.task.error, goal, budget)
        return replace(curve, rate=rate, spp=spp, seed=seed, warm_up=untimed)
