"""Times one derivative with respect to a motion, by term or beside finite differences, for the task `edges`.

`EdgePass` measures seconds of kernels from Dr.Jit's kernel history, and wall-clock seconds for `recorded` methods.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.integrators.boundary_term import Boundary
from pathreplay.integrators.stateful import stateful
from pathreplay.integrators.term import TermResult
from pathreplay.inverse.losses.pixelwise import l2
from pathreplay.inverse.objective.frozen import Recordings, RenderRequest, ViewLoss, ViewTarget, differentiate
from pathreplay.testing.objective import Objective, smooth_weights
from pathreplay.testing.stencil import CENTRAL

from ..scenes import SCENES
from ..scenes.movers import MOVERS
from .job import Job
from .methods import DIFFERENCE, METHODS, RECORDED, TRACED, parts
from .scene import stopwatch
from .spread import spreads

#: Parts of our boundary alone, by method; and all that edges add, the film's flow included.
PARTS = {"primary boundary": {"inner": False}, "secondary boundary": {"film": False}}
ALL = "boundary alone"
#: Around which axis vertices turn, by scene.
AXES = {"shadow": (0, 0, 1)}
UPRIGHT = (0, 1, 0)


class Nothing:
    """A term of the gradient that is zero, in place of the interior term."""

    def forward(self, *_: Any) -> TermResult:
        return TermResult()

    def backward(self, *_: Any) -> TermResult:
        return TermResult()

    def note(self, *_: Any) -> str:
        return ""


class EdgePass:
    """Each call differentiates a weighted image with respect to an angle, in one gradient pass: see `job.Measure`."""

    def __init__(self, job: Job) -> None:
        self.job = job
        self.scene = mi.load_dict(SCENES[job.scene](job.resolution), optimize=False)
        self.params = mi.traverse(self.scene)
        (key,) = job.parameters
        self.params.keep([key])
        axis = mi.Vector3f(AXES.get(job.scene, UPRIGHT))

        def turned(value: Any, t: mi.Float) -> Any:
            return dr.ravel(mi.Transform4f().rotate(axis, dr.rad2deg(t)) @ dr.unravel(mi.Point3f, value))

        self.objective = Objective(self.scene, self.params, key, turned)
        shape = (job.resolution, job.resolution, 3)
        self.objective.weigh(smooth_weights(shape, alpha=False))
        self.target = dr.full(mi.TensorXf, 0.2, shape)
        self.forget()

    def forget(self) -> None:
        """Discard all integrators and recordings."""
        self.integrators: dict[str, Any] = {}
        self.recordings = {name: Recordings() for name in self.job.methods}
        self.passes = dict.fromkeys(self.job.methods, 0)

    def __call__(self, method: str, seed: int) -> tuple[float, np.ndarray]:
        """Return seconds and the derivative."""
        name, way = parts(method)
        integrator = self._integrator(name)
        t = dr.opaque(mi.Float, 0)
        dr.enable_grad(t)
        self.objective.put(t)
        if way == RECORDED:
            seconds, _ = stopwatch(lambda: self._step(method, integrator, seed))
        else:
            run = self._step if way == TRACED else self._gradient
            seconds = kernel_seconds(lambda: run(method, integrator, seed))
        return seconds, np.array([self.objective.collect(t)])

    def _gradient(self, method: str, integrator: Any, seed: int) -> None:
        adjoint = self.objective.adjoint
        integrator.render_backward(self.scene, self.params, adjoint, seed=seed, spp=self.job.spp)

    def _step(self, method: str, integrator: Any, seed: int) -> Any:
        """Compute image, loss and gradient, as an optimiser does.

        For a `recorded` method, the second pass is recorded, and later passes launch the recorded kernels.
        """
        records = parts(method)[1] == RECORDED and self.passes[method] > 0
        self.passes[method] += 1
        run = self.recordings[method].differentiate if records else differentiate
        number = dr.opaque(mi.UInt32, seed)
        request, loss = RenderRequest(0, number, self.job.spp), ViewLoss(l2, 1.0, False)
        return run(self.params, self.scene, stateful(integrator), request, ViewTarget(self.target), loss).loss

    def _integrator(self, name: str) -> Any:
        if name not in self.integrators:
            alone = name in PARTS or name == ALL  # something takes the interior's place
            plugin = METHODS["auto" if alone else name]
            edges = {"boundary": "all" if name == ALL else "none"} if alone else {}
            self.integrators[name] = mi.load_dict(plugin | self.job.limits | edges)
            if alone:
                self.integrators[name].interior = Nothing() if name == ALL else Boundary(**PARTS[name])
        return self.integrators[name]

    def conclude(self, kept: dict[str, list[np.ndarray]]) -> dict[str, dict[str, Any]]:
        """Return statistics of the derivatives of all seeds, by method: see `spread`."""
        return spreads(kept, None, ())


class NumberPass:
    """Each call differentiates a weighted image with respect to one number: see `job.Measure`.

    A gradient pass has ``job.spp`` samples per pixel. A central difference uses two images with ``job.spp`` samples per
    pixel each and common random numbers. Both methods use their usual settings: `pathreplay` its own samples, and the
    images Mitsuba's `path`, or `volpath` in fog.
    """

    def __init__(self, job: Job) -> None:
        self.job, self.mover = job, MOVERS[job.scene]
        scene = mi.load_dict(self.mover.scene(job.resolution), optimize=False)
        (key,) = job.parameters
        self.objective = Objective(scene, mi.traverse(scene), key, self.mover.move)
        fog = any(shape.is_medium_transition() for shape in scene.shapes())
        self.pictures = {"type": "volpath" if fog else "path"}
        self.objective.weigh(smooth_weights((job.resolution, job.resolution, 3), alpha=False))
        self.forget()

    def forget(self) -> None:
        """Replace all integrators by new ones."""
        self.integrators: dict[str, Any] = {
            name: mi.load_dict((self.pictures if name == DIFFERENCE else METHODS[name]) | self.job.limits)
            for name in self.job.methods
        }

    def __call__(self, method: str, seed: int) -> tuple[float, np.ndarray]:
        """Return wall-clock seconds and the derivative."""
        run = self._difference if method == DIFFERENCE else self.objective.backward
        seconds, value = stopwatch(lambda: run(self.integrators[method], seed, self.job.spp))
        return seconds, np.array([value])

    def _difference(self, integrator: Any, seed: int, spp: int) -> float:
        objective = self.objective
        return objective.dot(objective.difference(integrator, CENTRAL, self.mover.step, seed, spp))

    def conclude(self, kept: dict[str, list[np.ndarray]]) -> dict[str, dict[str, Any]]:
        """Return statistics of the derivatives of all seeds, by method: see `spread`."""
        return spreads(kept, None, ())


def kernel_seconds(run: Callable[[], Any]) -> float:
    """Return the seconds of all kernels that ``run`` launches."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.sync_thread()
        dr.kernel_history_clear()
        result = run()
        dr.eval(result)
        dr.sync_thread()
        return sum(entry["execution_time"] for entry in dr.kernel_history()) / 1000
