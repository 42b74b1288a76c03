"""The loss of a problem and its gradient: one pass over the paths where that is possible, traced only once.

A loss whose derivative is linear in each pixel can be back-propagated while its image is rendered, see `pixel_sweep`;
for the others an image is rendered first, and paths of their own are differentiated. Where Dr.Jit can record all that
as a frozen function, later calls launch its kernels without tracing them again.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi

from pathreplay.errors import PathreplayError
from pathreplay.inverse.losses import QUADRATIC, Loss
from pathreplay.inverse.problem import Problem
from pathreplay.render.path_integrator import plain_errors
from pathreplay.scenes.parameters import keep_only
from pathreplay.transport.facts import SceneFacts
from pathreplay.transport.traits import Tables

#: Mitsuba's integrators that look at nothing on the host while they render, by class: they do not say. Ours do.
RECORDABLE = frozenset({"PRBIntegrator", "BasicPRBIntegrator"})


#: What Dr.Jit says, whatever the cause, where a function cannot be frozen. Plugins do not show beforehand whether they
#: can: the arrays of some (Mitsuba 3.9.1: `orthographic`, `thinlens`) are hidden from it.
RECORDING = "while recording a frozen function"


class NotRecordable(Exception):
    """A plugin of the scene keeps Dr.Jit from recording a pass."""


class Passes:
    """The mean over the views of the loss, by one integrator, and its gradient."""

    def __init__(self, problem: Problem, integrator: mi.Integrator, record: bool = True) -> None:
        self.problem, self.integrator = problem, integrator
        self.targets = [mi.TensorXf(view.target) for view in problem.views]
        # What an integrator learns of media from pass to pass is read and written between kernels.
        facts = SceneFacts(problem.scene)
        # Spectral variants look up the eye's response in tables of Mitsuba's library: no input of ours, as a recorded
        # function must have them, leads there. Recorded kernels are cut otherwise than traced ones, and round otherwise
        # in the last bit.
        recordable = getattr(integrator, "recordable", type(integrator).__name__ in RECORDABLE)
        recordable = recordable and not facts.has_media and not mi.is_spectral
        self.freezes = record and recordable
        self.swept: tuple[bool, ...] = ()  # views whose pixels can be swept; empty before the first call
        self.frozen: dict[Any, Callable[..., Any]] = {}  # recorded functions, by the shapes of the parameters
        self.tables = facts.traits().tables

    def __call__(self, seeds: list[int], spp: int) -> float:
        """The loss, with ``spp`` samples per pixel and a seed for every view; adds its gradient to the parameters.

        Unbiased for the losses in `QUADRATIC`; the value itself carries the variance of the pictures on top. Raises
        what the integrator raises; warns as it does. Raises NotRecordable when the pass could not be recorded, once:
        the parameters have to be put again, since a part of their gradient may be there, and the next call is traced.
        """
        sensors = tuple(view.sensor for view in self.problem.views)
        # Of recorded passes seeds are inputs; of others they are best numbers, which nobody has to read back.
        numbers = [dr.opaque(mi.UInt32, seed) for seed in seeds] if self.freezes else seeds
        # The first call is not recorded: scenes make some of their parts when they are first rendered.
        differentiate = self._recorded() if self.freezes and self.swept else self._traced
        if not self.swept:
            self.swept = tuple(self._sweeps(sensor, spp) for sensor in sensors)
        scene, loss = self.problem.scene, self.problem.loss
        try:
            with plain_errors():
                value, lost = differentiate(
                    scene, self.integrator, self.targets, numbers, sensors, self.swept, loss, spp, self.tables
                )
        except RuntimeError as error:
            if not self.freezes or RECORDING not in str(error):
                raise
            self.freezes = False
            raise NotRecordable from error
        if lost is not None:
            paths = sum(target.shape[0] * target.shape[1] for target in self.targets) * spp
            self.integrator.tell_lost(lost, paths)
        return float(value[0]) if dr.width(value) else float("nan")

    def learned(self) -> dict[str, Any]:
        """What the integrator has learned from its passes, as arrays by name, for a checkpoint."""
        return self.integrator.learned() if hasattr(self.integrator, "learned") else {}

    def restore_learned(self, learned: dict[str, Any]) -> None:
        """Go on with what `learned` told. Raises PathreplayError if it is none of this integrator's."""
        if not learned:
            return
        if not hasattr(self.integrator, "restore_learned"):
            raise PathreplayError(
                "The checkpoint holds what another integrator has learned of media; set the config's 'integrator' "
                "back, or start a new run"
            )
        self.integrator.restore_learned(self.problem.scene, learned)

    def _sweeps(self, sensor: int, spp: int) -> bool:
        if self.problem.loss not in QUADRATIC or not hasattr(self.integrator, "sweeps_pixels"):
            return False
        scene = self.problem.scene
        return bool(self.integrator.sweeps_pixels(scene, scene.sensors()[sensor], spp))

    def _traced(self, *args: Any) -> tuple[Any, Any]:
        return _differentiate(self.problem.params, *args)

    def _recorded(self) -> Callable[..., Any]:
        keys = list(self.problem.params.keys())
        shapes = tuple(dr.shape(self.problem.params[key]) for key in keys)
        if shapes not in self.frozen:
            gc.collect()  # scenes of the past would be traced, too
            self.frozen[shapes] = _recording(keys)
        return self.frozen[shapes]


def _recording(keys: list[str]) -> Callable[..., Any]:
    """`_differentiate` as a frozen function, which holds neither scene nor problem when the run is over."""

    def differentiate(scene: Any, *args: Any) -> tuple[Any, Any]:
        params = mi.traverse(scene)
        keep_only(params, keys)
        return _differentiate(params, scene, *args)

    return dr.freeze(differentiate)


def _differentiate(
    params: Any,
    scene: Any,
    integrator: Any,
    targets: list[Any],
    seeds: list[Any],
    sensors: tuple[int, ...],
    swept: tuple[bool, ...],
    loss: Loss,
    spp: int,
    tables: Tables,
) -> tuple[Any, Any]:
    """The loss, and how many paths lost a part of their gradient (None if nobody counts, or it has been told)."""
    total, attached = mi.Float(0), mi.Float(0)
    with _handed(integrator, tables):
        for index, sweeps, target, seed in zip(sensors, swept, targets, seeds, strict=True):
            if sweeps:
                offset, slope = (term / len(sensors) for term in _linear_derivative(loss, target))
                image = integrator.render_and_backward(scene, offset, slope, scene.sensors()[index], seed, spp)
                total += loss(image, target).array / len(sensors)
            else:
                image = mi.render(scene, params, sensor=index, integrator=integrator, spp=spp, seed=seed)
                attached += loss(image, target).array / len(sensors)
        if dr.grad_enabled(attached):
            dr.backward(attached)
    return total + dr.detach(attached), integrator.take_lost() if hasattr(integrator, "take_lost") else None


@contextmanager
def _handed(integrator: Any, tables: Tables) -> Iterator[None]:
    """Within this block an integrator of ours has the tables: inputs of a frozen function, which cannot make them."""
    if not hasattr(integrator, "tables"):
        yield
        return
    integrator.tables = tables
    try:
        yield
    finally:
        integrator.tables = None


def _linear_derivative(loss: Loss, target: Any) -> tuple[Any, Any]:
    """Offset and slope of the derivative of a quadratic loss by the image, from two images far apart."""
    bright = 1 + dr.abs(target)
    offset = _derivative(loss, dr.zeros(mi.TensorXf, target.shape), target)
    return offset, (_derivative(loss, mi.TensorXf(bright), target) - offset) / bright


def _derivative(loss: Loss, image: Any, target: Any) -> Any:
    """Derivative of a loss by the image, a tensor like it."""
    dr.enable_grad(image)
    dr.backward(loss(image, target))
    return dr.grad(image)
