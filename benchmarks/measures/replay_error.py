"""The error of a replayed gradient by regularisation, precision and Jacobian noise, for the task `noise`."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.adjoint.ray_jacobian import Recovery

from .job import Job
from .methods import METHODS
from .recoveries import OtherRecovery
from .scene import SceneMeasure, stopwatch

SWEEP = "sweep"
NOISES = (0.1, 0.01, 0.001)
#: Where the noise is put, and whether the books are kept in float64, by the name that the table gives them.
KINDS = {
    "everywhere, float32": ("everywhere", False),
    "everywhere, float64": ("everywhere", True),
    "directions, float64": ("directions", True),
}
#: Arguments of `OtherRecovery` by method.
RECOVERIES = {f"{kind}, {noise:g}": (noise, *how) for kind, how in KINDS.items() for noise in (*NOISES, 0)}


class ReplayError(SceneMeasure):
    """The relative error |g - g_sweep| / |g_sweep| of a replay for one seed; for the sweep, its Monte Carlo error."""

    def __init__(self, job: Job) -> None:
        super().__init__(job)
        shape = (job.resolution, job.resolution, 3)
        self.weights = mi.TensorXf(np.random.default_rng(0).uniform(0.5, 1.5, shape).astype(np.float32))
        mi.set_log_level(mi.LogLevel.Error)  # not the warning that recommends the sweep
        self.swept = lru_cache(maxsize=4)(lambda seed: self._gradient(SWEEP, Recovery(), seed)[1])

    def __call__(self, method: str, seed: int) -> tuple[float, np.ndarray]:
        """Return the seconds of the gradient pass, and the relative error."""
        right = self.swept(seed)
        if method == SWEEP:
            seconds, found = self._gradient(SWEEP, Recovery(), self.job.rounds + seed)
            error = np.linalg.norm(found - right) / np.sqrt(2)  # of one pass, from the difference of two
        else:
            seconds, found = self._gradient("replay", OtherRecovery(*RECOVERIES[method]), seed)
            error = np.linalg.norm(found - right)
        return seconds, np.array([error / np.linalg.norm(right)])

    def conclude(self, kept: dict[str, list[np.ndarray]]) -> dict[str, dict[str, Any]]:
        """Return the errors of all seeds, by method."""
        return {name: {"values": np.concatenate(rows).tolist()} for name, rows in kept.items() if rows}

    def _gradient(self, driver: str, recovery: Recovery, seed: int) -> tuple[float, np.ndarray]:
        job, (key,) = self.job, self.job.parameters
        integrator = mi.load_dict(METHODS[driver] | job.limits)
        integrator.interior = replace(integrator.interior, recovery=recovery)
        dr.clear_grad(self.params[key])

        def run() -> Any:
            integrator.render_backward(self.scene, self.params, self.weights, seed=seed % 2**32, spp=job.spp)
            return dr.grad(self.params[key])

        seconds, gradient = stopwatch(run)
        return seconds, np.array(gradient, dtype=np.float64)
