"""Times optimisation steps for the task `iteration`: rendering, loss, gradient, Adam, bounds and scene update."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import drjit as dr
import drjit.opt
import mitsuba as mi
import numpy as np

from pathreplay.inverse.config.schema import make_config
from pathreplay.inverse.dataset.views import View
from pathreplay.inverse.loop.checkpoint import Run
from pathreplay.inverse.loop.loop import take_step
from pathreplay.inverse.losses.pixelwise import l2
from pathreplay.inverse.objective.evaluate import Evaluator, Local
from pathreplay.inverse.optim.adaptive import DrJitOptimiser
from pathreplay.inverse.parameters.variables import Variable
from pathreplay.inverse.problem.problem import Problem
from pathreplay.scenes.parameters import get_array

from ..scenes import SCENES
from .job import Job
from .methods import METHODS, OWN, parts
from .scene import stopwatch
from .spread import spreads

# Where steps begin. Textures are grey, so that some texels are too bright and some too dark, as in most problems: with
# one set of paths for image and gradient the variance depends on that. Densities are half of what they should be.
GREY = 0.5
HALF = 0.5
RATE = 0.02
TARGET_SPP = 256


class Watched(DrJitOptimiser):
    """Adam optimiser that stores the gradients of its last step."""

    seen: Mapping[str, np.ndarray]

    def step(self, values: Any, gradients: Any, rates: Any, loss: float = 0.0) -> dict[str, np.ndarray]:
        """Store the gradients, and take a step of Adam."""
        self.seen = gradients
        return super().step(values, gradients, rates)


class Step:
    """A scene, its target image, and an optimiser for each method. Each call times one step from the initial values."""

    def __init__(self, job: Job) -> None:
        self.job, (self.key,) = job, job.parameters
        self.scene = mi.load_dict(SCENES[job.scene](job.resolution), optimize=False)
        self.params = mi.traverse(self.scene)
        self.params.keep([self.key])
        judge = mi.load_dict({"type": "volpath", "max_depth": job.max_depth})
        target = mi.render(self.scene, integrator=judge, spp=TARGET_SPP, seed=1)
        truth = self.params[self.key]
        texture = len(truth.shape) == 3
        self.start = dr.full(type(truth), GREY, truth.shape) if texture else dr.detach(truth * HALF)
        self.upper = 1.0 if texture else None  # a density has no upper bound
        self.target = mi.TensorXf(target)
        like, array = type(truth)(truth), get_array(self.start)
        variable = Variable(self.key, like, (0.0, np.inf if self.upper is None else self.upper), RATE, array, None)
        view = View("camera", 0, np.array(target))
        self.problem = Problem(
            self.scene, self.params, judge, None, judge, (variable,), (), (view,), l2, ()
        )  # fmt: skip
        self.config = make_config(
            {
                "scene": "cornell-box",  # not loaded: the problem has its scene
                "parameters": [{"key": self.key}],
                "target": {"values": {self.key: 0.5}},
                "spp": job.spp,
            }
        )
        self.runs: dict[str, Run] = {}
        self.usual: dict[str, tuple[mi.Integrator, drjit.opt.Adam]] = {}

    def forget(self) -> None:
        """Discard all integrators and optimisers."""
        self.runs.clear()
        self.usual.clear()

    def __call__(self, method: str, seed: int) -> tuple[float, np.ndarray]:
        """Return the seconds and the gradient of a step."""
        name, loop = parts(method)
        if method not in self.runs and method not in self.usual:
            integrator = mi.load_dict(METHODS[name] | self.job.limits)
            if loop == OWN:
                self.runs[method] = Run(Local(Evaluator(self.problem, integrator)), Watched({}), {})
            else:
                self.usual[method] = integrator, drjit.opt.Adam(lr=RATE)
        return self._own(self.runs[method]) if loop == OWN else self._usual(*self.usual[method], seed)

    def _own(self, run: Run) -> tuple[float, np.ndarray]:
        run.values = {self.key: get_array(self.start)}
        seconds, _ = stopwatch(lambda: take_step(self.problem, run, len(run.history)))
        return seconds, np.ravel(run.optimiser.seen[self.key])  # type: ignore[attr-defined]

    def _usual(self, integrator: mi.Integrator, adam: drjit.opt.Adam, seed: int) -> tuple[float, np.ndarray]:
        """Time one step of the loop of Mitsuba's tutorials."""
        adam[self.key] = type(self.start)(self.start)
        self.params.update(adam)

        def step() -> Any:
            image = mi.render(self.scene, self.params, integrator=integrator, spp=self.job.spp, seed=seed)
            loss = dr.mean(dr.square(image - self.target), axis=None)
            dr.backward(loss)
            gradient = dr.grad(adam[self.key])
            adam.step()
            value = dr.maximum(adam[self.key], 0.0)
            adam[self.key] = value if self.upper is None else dr.minimum(value, self.upper)
            self.params.update(adam)
            return adam[self.key], gradient

        seconds, (_, gradient) = stopwatch(step)
        return seconds, np.ravel(np.array(gradient))

    def conclude(self, kept: dict[str, list[np.ndarray]]) -> dict[str, dict[str, Any]]:
        """Return statistics of the gradients of all steps: see `spread`."""
        return spreads(kept, None, ())
