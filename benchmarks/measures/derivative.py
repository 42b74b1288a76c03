"""Samples of one derivative, by finite differences and by several gradient methods, for the task `truth`."""

from __future__ import annotations

import gc
import time
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.scenes.parameters import get_array
from pathreplay.testing.direction import choose_line
from pathreplay.testing.objective import Mode, Objective, alone
from pathreplay.testing.reference import reference_integrator

from ..scenes.truth import TRUTH_SCENES
from ..tasks.truth import CELLS, STEPS, Cell
from .job import Job
from .methods import METHODS

# Of random numbers: the picture of a gradient, its derivative, the reference, the weights.
PICTURE, DERIVATIVE, REFERENCE, SCALE = range(4)


class Derivative:
    """The derivative of a cell. Each call takes one sample, with seeds that no other call or method uses."""

    def __init__(self, job: Job) -> None:
        self.job, self.cell = job, CELLS[job.scene]
        self.limits = {"max_depth": job.max_depth, "rr_depth": job.rr_depth}
        self.scene = mi.load_dict(TRUTH_SCENES[self.cell.scene](), optimize=False)
        params = mi.traverse(self.scene)
        value = get_array(params[self.cell.key]).astype(np.float64)
        self.line = choose_line(self.cell.key, value, _direction(self.cell, value), self.cell.step)
        ours = mi.load_dict({"type": "pathreplay"} | self.limits)
        self.plain = reference_integrator(None, self.scene, ours)
        self.held = alone(params, self.cell.key)  # for as long as this process lives
        self.held.__enter__()
        self.objective = Objective(self.scene, params, self.cell.key, self.line.move)
        self.objective.weigh_by(None, self.plain, _seed(0, SCALE), job.spp)
        self.integrators: dict[str, Any] = {}

    def forget(self) -> None:
        """Discard all integrators, so that the next pass creates new ones."""
        self.integrators.clear()

    def __call__(self, method: str, seed: int) -> tuple[float, np.ndarray]:
        """Return seconds and a sample: a difference of images with common random numbers, or one gradient pass."""
        gc.collect()
        dr.sync_thread()
        start = time.perf_counter()
        if method in STEPS:
            value = self._difference(method, _seed(seed, REFERENCE))
        else:
            mode: Mode = "forward" if method == "forward" else "backward"
            seeds = _seed(seed, PICTURE), _seed(seed, DERIVATIVE)
            value = self.objective.derivative(self._integrator(method), mode, *seeds, self.job.spp)
        return time.perf_counter() - start, np.array([value])

    def _integrator(self, method: str) -> Any:
        if method not in self.integrators:
            plugin = METHODS["auto" if method == "forward" else method]
            self.integrators[method] = mi.load_dict(plugin | self.limits)
        return self.integrators[method]

    def _difference(self, method: str, seed: int) -> float:
        stencil = self.line.stencil if method == STEPS[0] else self.line.stencil.halved()
        difference = self.objective.difference(self.plain, stencil, self.line.step, seed, self.cell.reference_spp)
        return self.objective.dot(difference)

    def conclude(self, kept: dict[str, list[np.ndarray]]) -> dict[str, dict[str, Any]]:
        """Return the samples of each method, and the verdict on the method: see pathreplay.testing.verdict."""
        samples = {name: np.concatenate(rows) for name, rows in kept.items() if rows}
        facts: dict[str, dict[str, Any]] = {
            name: {"values": values.tolist(), "mean": float(values.mean())} for name, values in samples.items()
        }
        if not all(name in samples and len(samples[name]) > 1 for name in STEPS):
            return facts
        for name, values in samples.items():
            if name not in STEPS and len(values) > 1:
                verdict = self.objective.judge(self.line, values, *(samples[step] for step in STEPS))
                facts[name] |= {"z": verdict.z if np.isfinite(verdict.z) else None, "verdict": verdict.verdict}
        return facts


def _direction(cell: Cell, value: np.ndarray) -> np.ndarray | None:
    if cell.where == "everywhere":
        return None
    entries = np.random.default_rng(0).uniform(0.5, 1.0, value.shape)
    return np.where((value == 0) == (cell.where == "empty"), entries, 0)


def _seed(seed: int, stream: int) -> int:
    return int(np.random.SeedSequence([seed, stream]).generate_state(1)[0])
