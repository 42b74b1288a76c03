"""Times gradient passes and images of a scene, for most tasks."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from . import counting
from .job import Job
from .scene import SceneMeasure, stopwatch
from .spread import spreads

PIXEL_CHANNELS = 3


class Pass(SceneMeasure):
    """Each call times one gradient pass of the weighted image, or one primal pass."""

    def __init__(self, job: Job) -> None:
        self.counter: Any = counting.register()
        super().__init__(job)
        shape = (job.resolution, job.resolution, PIXEL_CHANNELS)
        self.adjoint = _wave(shape) if job.weights == "wave" else dr.full(mi.TensorXf, 1 / np.prod(shape), shape)
        self.grid = getattr(self.params[job.parameters[0]], "shape", ()) if len(job.parameters) == 1 else ()

    def __call__(self, method: str, seed: int) -> tuple[float, np.ndarray]:
        """Run one pass; return seconds, and the gradients (or the image, or the event count) as one flat array.

        Errors of the method are raised.
        """
        integrator = self.integrator(method)
        self.renew()
        self.counter.count = dr.zeros(mi.UInt32, 1)
        seconds, results = stopwatch(lambda: self._results(integrator, seed))
        if self.job.measure == "events":
            return seconds, np.array(self.counter.count) / (self.job.resolution**2 * self.job.spp)
        flat = [np.ravel(np.array(getattr(result, "matrix", result))) for result in results]
        return seconds, np.concatenate(flat)

    def _results(self, integrator: Any, seed: int) -> list[Any]:
        job = self.job
        if job.update:
            for key in job.parameters:
                self.params.set_dirty(key)
            self.params.update()
        if job.measure not in ("gradient", "sum"):
            return [integrator.render(self.scene, seed=seed, spp=job.spp)]
        integrator.render_backward(self.scene, self.params, self.adjoint, seed=seed, spp=job.spp)
        dr.enqueue(dr.ADMode.Backward, [self.params[key] for key in job.parameters])
        dr.traverse(dr.ADMode.Backward)
        return [dr.grad(leaf) for leaf in self.leaves.values()]

    def conclude(self, kept: dict[str, list[np.ndarray]]) -> dict[str, dict[str, Any]]:
        """Return statistics of the gradients over all seeds, by method: see `spread`."""
        return spreads(kept, self.job.reference, self.grid)


def _wave(shape: tuple[int, int, int]) -> Any:
    # Imported here: it brings scipy along, 60 MiB that belong to no method's peak.
    from pathreplay.testing.objective import smooth_weights

    return mi.TensorXf(smooth_weights(shape, alpha=False).astype(np.float32))
