"""A scene that is ready for gradients, the integrators that are compared on it, and a stopwatch."""

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
    """What most measures begin with: the scene of a job, with gradients of its parameters; see `job.Measure`."""

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
        """Give the parameters leaves of their own, with gradients."""
        for key in keys:
            value = dr.detach(self.params[key])
            self.leaves[key] = type(value)(value)
            dr.enable_grad(self.leaves[key])  # first: the scene takes a copy
            self.params[key] = self.leaves[key]
        self.params.update()

    def renew(self) -> None:
        """Leave no gradients of earlier passes behind."""
        self.put(self.derived)
        for leaf in self.leaves.values():
            dr.clear_grad(leaf)

    def integrator(self, name: str) -> Any:
        """The integrator of that name, made when it is first asked for; what it raises is raised each time."""
        if name not in self.integrators:
            self.integrators[name] = mi.load_dict(METHODS[name] | self.job.limits)
        return self.integrators[name]

    def forget(self) -> None:
        """Make all integrators anew: what they have learned is gone."""
        self.integrators.clear()


def _ad(value: Any) -> int | None:
    """What Dr.Jit counts the variable of an array or a tensor as, None for other things."""
    return getattr(getattr(value, "array", value), "index_ad", None)


def stopwatch(run: Callable[[], Any], clock: Callable[[], float] = time.perf_counter) -> tuple[float, Any]:
    """Seconds until what ``run`` returns is evaluated, by that clock, and what it is."""
    gc.collect()  # not in the middle of the measurement
    dr.sync_thread()
    start = clock()
    result = run()
    dr.eval(result)  # so far the kernel has only been recorded
    dr.sync_thread()
    return clock() - start, result
