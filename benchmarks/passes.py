"""Gradient passes and images of a scene, timed: what most tasks measure."""

from __future__ import annotations

import gc
import time
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from . import counting
from .job import METHODS, Job
from .scenes import SCENES
from .spread import spread

PIXEL_CHANNELS = 3


class Pass:
    """A scene, ready for gradients: each call times one gradient pass of the weighted image, or one primal pass."""

    def __init__(self, job: Job) -> None:
        self.job = job
        self.counter: Any = counting.register()
        self.scene = mi.load_dict(SCENES[job.scene](job.resolution), optimize=False)
        self.params = mi.traverse(self.scene)
        for key in job.parameters:
            dr.enable_grad(self.params[key])
        self.params.update()
        shape = (job.resolution, job.resolution, PIXEL_CHANNELS)
        self.adjoint = _wave(shape) if job.weights == "wave" else dr.full(mi.TensorXf, 1 / np.prod(shape), shape)
        self.grid = getattr(self.params[job.parameters[0]], "shape", ()) if len(job.parameters) == 1 else ()
        self.integrators: dict[str, Any] = {}

    def forget(self) -> None:
        """Make all integrators anew: what they have learned is gone."""
        self.integrators.clear()

    def __call__(self, method: str, seed: int) -> tuple[float, np.ndarray]:
        """Seconds, and the gradients of all parameters (or image, or event count) as one flat array.

        Raises what the method raises.
        """
        if method not in self.integrators:
            depths = {"max_depth": self.job.max_depth, "rr_depth": self.job.rr_depth}
            self.integrators[method] = mi.load_dict(METHODS[method] | depths)
        for key in self.job.parameters:
            dr.clear_grad(self.params[key])
        self.counter.count = dr.zeros(mi.UInt32, 1)
        gc.collect()  # not in the middle of the measurement
        dr.sync_thread()
        start = time.perf_counter()
        if self.job.update:
            for key in self.job.parameters:
                self.params.set_dirty(key)
            self.params.update()
        if self.job.measure != "gradient":
            results = [self.integrators[method].render(self.scene, seed=seed, spp=self.job.spp)]
        else:
            self.integrators[method].render_backward(self.scene, self.params, self.adjoint, seed=seed, spp=self.job.spp)
            results = [dr.grad(self.params[key]) for key in self.job.parameters]
        dr.eval(results)  # so far the kernel has only been recorded
        dr.sync_thread()
        seconds = time.perf_counter() - start
        if self.job.measure == "events":
            return seconds, np.array(self.counter.count) / (self.job.resolution**2 * self.job.spp)
        flat = [np.ravel(np.array(getattr(result, "matrix", result))) for result in results]
        return seconds, np.concatenate(flat)

    def conclude(self, kept: dict[str, list[np.ndarray]]) -> dict[str, dict[str, Any]]:
        """What the gradients of all seeds say, by method: see `spread`."""
        return spreads(kept, self.job.reference, self.grid)


def _wave(shape: tuple[int, int, int]) -> Any:
    # Imported here: it brings scipy along, 60 MiB that belong to no method's peak.
    from pathreplay.check.objective import smooth_weights

    return mi.TensorXf(smooth_weights(shape, alpha=False).astype(np.float32))


def spreads(
    kept: dict[str, list[np.ndarray]], reference: str | None, grid: tuple[int, ...]
) -> dict[str, dict[str, Any]]:
    """`spread` of every method with at least two rows, all of them finite."""
    others = kept.get(reference or "")
    fit = {name: rows for name, rows in kept.items() if len(rows) > 1 and np.isfinite(rows).all()}
    return {name: spread(rows, others, grid) for name, rows in fit.items()}
