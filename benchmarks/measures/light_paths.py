"""Times gradient passes of light paths in processor seconds, for the task `particles`."""

from __future__ import annotations

import time
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .methods import PLAIN_AD
from .passes import Pass
from .scene import stopwatch


def backpropagate(
    method: str,
    integrator: mi.Integrator,
    scene: mi.Scene,
    params: mi.SceneParameters,
    adjoint: mi.TensorXf,
    seed: int,
    spp: int,
) -> None:
    """Add the gradient of the image, weighted by its adjoint, to parameters that are leaves.

    Plain AD in reverse mode requires that loops are unrolled to wavefronts.
    """
    if method in PLAIN_AD:
        with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, False):
            dr.backward(dr.sum(integrator.render(scene, seed=seed, spp=spp) * adjoint, axis=None))
    else:
        integrator.render_backward(scene, params, adjoint, seed=seed, spp=spp)


class LightPass(Pass):
    """Each call times one gradient pass of the weighted image in processor seconds of the whole process."""

    def __call__(self, method: str, seed: int) -> tuple[float, np.ndarray]:
        """Return seconds, and the gradients as one flat array."""
        integrator, job = self.integrator(method), self.job
        self.put(job.parameters)

        def run() -> list[Any]:
            backpropagate(method, integrator, self.scene, self.params, self.adjoint, seed, job.spp)
            return [dr.grad(leaf) for leaf in self.leaves.values()]

        seconds, results = stopwatch(run, time.process_time)
        return seconds, np.concatenate([np.ravel(np.array(result)) for result in results])
