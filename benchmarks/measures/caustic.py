"""Runs whole caustic designs, with the best point of one grid for each method, for the task `particles`."""

from __future__ import annotations

import gc
import time
from dataclasses import asdict, replace
from itertools import product
from typing import Any

import numpy as np

from ..inverse.caustic import CELLS, Design, DesignLoop
from ..inverse.search import GROWTH, followed, warmed
from .job import Curve, Job, Measure
from .methods import parts

SEARCH = 1 / 8
"""Time of each point of the grid, as a fraction of that of a design."""
SEARCH_GROWTH = 8.0
"""Ratio of the iterations after which the error is measured in the search, which needs the last error only."""
SEARCH_SEED = 1000
"""Seed of the search, which no round has."""


class Caustic(Measure):
    """The first call of a method searches the grid; later calls run its best point with their seeds."""

    def __init__(self, job: Job) -> None:
        self.job, self.design = job, Design(CELLS[job.scene], job.resolution)
        self.curves: dict[str, list[Curve]] = {}

    def __call__(self, method: str, seed: int) -> tuple[float, np.ndarray]:
        """Return the processor seconds of the iterations, and the last error."""
        if method in self.curves:
            choice = chosen(self.curves[method])
            curve = self._run(method, choice.rate, choice.spp, seed, self.job.budget)
            self.curves[method].append(curve)
            return curve.seconds[-1], np.array([curve.errors[-1]])
        start = time.process_time()
        self.curves[method] = [
            replace(self._run(method, rate, spp, SEARCH_SEED, self.job.budget * SEARCH, SEARCH_GROWTH), searched=True)
            for spp, rate in product(self.job.samples, self.job.rates)
        ]
        return time.process_time() - start, np.array([chosen(self.curves[method]).errors[-1]])

    def conclude(self, kept: dict[str, list[np.ndarray]]) -> dict[str, dict[str, Any]]:
        """All curves; the curves of the search come first."""
        return {name: {"curves": [asdict(curve) for curve in self.curves[name]]} for name in kept}

    def _run(self, method: str, rate: float, spp: int, seed: int, budget: float, growth: float = GROWTH) -> Curve:
        gc.collect()
        loop = DesignLoop(self.design, *parts(method), rate, spp, seed)
        untimed = warmed(loop, 2)
        curve = followed(loop, lambda values: self.design.error(values["heights"]), 0, budget, growth=growth)
        return replace(curve, rate=rate, spp=spp, seed=seed, warm_up=untimed)


def chosen(curves: list[Curve]) -> Curve:
    """Return the curve of the search with the smallest last error."""
    return min((curve for curve in curves if curve.searched), key=lambda curve: curve.errors[-1])
