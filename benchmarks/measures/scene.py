"""A scene whose parameters have gradients, the integrators compared on this scene, and a stopwatch."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from ..scenes import SCENES
from .job import Job
from .methods import METHODS


class SceneMeasure:
    """Base of most measures (see `job.Measure`): the scene of a job, with gradients enabled for its parameters."""

    def __init__(self, job: Job) -> None:
        self.job = job
        self.scene = mi.load_dict(SCENES[job.scene](job.resolution), optimize=False)
        self.params = mi.traverse(self.scene)
        self.leaves: dict[str, Any] = {}
        self.put(job.parameters)
        # A scene computes the pixels of an environment from those that it is given: such a value is no leaf, and what
        # leads back to the leaf is gone after a pass.
        self.derived = [key for key in job.parameters if _ad(self.params[key]) != _ad(self.leaves[key])]
        self.integrators: dict[str, Any] = {}

    def put(self, keys: Sequence[str]) -> None:
        """Set the parameters to new leaf variables with gradients."""
        for key in keys:
            value = dr.detach(self.params[key])
            self.leaves[key] = type(value)(value)
            dr.enable_grad(self.leaves[key])  # first: the scene takes a copy
            self.params[key] = self.leaves[key]
        self.params.update()

    def renew(self) -> None:
        """Clear the gradients of earlier passes."""
        self.put(self.derived)
        for leaf in self.leaves.values():
            dr.clear_grad(leaf)

    def integrator(self, name: str) -> Any:
        """Return the integrator of this name, created at its first use. An error is raised again at every use."""
        if name not in self.integrators:
            self.integrators[name] = mi.load_dict(METHODS[name] | self.job.limits)
        return self.integrators[name]

    def forget(self) -> None:
        """Discard all integrators, and with them everything that they have learned."""
        self.integrators.clear()


def _ad(value: Any) -> int | None:
    """Return Dr.Jit's AD index of an array or a tensor; None for other values."""
    return getattr(getattr(value, "array", value), "index_ad", None)


def stopwatch(run: Callable[[], Any], clock: Callable[[], float] = time.perf_counter) -> tuple[float, Any]:
    """Call ``run`` and evaluate its result; return the seconds by ``clock``, and the result."""
    gc.collect()  # not in the middle of the measurement
    dr.sync_thread()
    start = clock()
    result = run()
    dr.eval(result)  # so far the kernel has only been recorded
    dr.sync_thread()
    return clock() - start, result
