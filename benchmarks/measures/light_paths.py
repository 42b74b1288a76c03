"""Times gradient passes of light paths in processor seconds, for the task `particles`."""

from __future__ import annotations

import time
from typing import Any

import drjit as dr
import numpy as np

from .methods import PLAIN_AD
from .passes import Pass
from .scene import stopwatch


class LightPass(Pass):
    """Each call times one gradient pass of the weighted image in processor seconds of the whole process."""

    def __call__(self, method: str, seed: int) -> tuple[float, np.ndarray]:
        """Return seconds, and the gradients as one flat array."""
        integrator = self.integrator(method)
        self.put(self.job.parameters)
        run = self._plain if method in PLAIN_AD else self._results
        seconds, results = stopwatch(lambda: run(integrator, seed), time.process_time)
        return seconds, np.concatenate([np.ravel(np.array(result)) for result in results])

    def _plain(self, integrator: Any, seed: int) -> list[Any]:
        """Differentiate an image by plain AD, which in reverse mode requires that loops are unrolled to wavefronts."""
        with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, False):
            image = integrator.render(self.scene, seed=seed, spp=self.job.spp)
            dr.backward(dr.sum(image * self.adjoint, axis=None))
        return [dr.grad(leaf) for leaf in self.leaves.values()]
