"""The loss of one view and its gradient by the scene's parameters: traced anew, or recorded as a frozen function.

A loss whose derivative is linear in each pixel can be back-propagated while its image is rendered, see `pixel_sweep`;
for the others an image is rendered first, and paths of their own are differentiated. Where Dr.Jit can record all that
as a frozen function, later calls launch its kernels without tracing them again.
"""

from __future__ import annotations

import gc
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from pathreplay.integrators.pass_state import PassState
from pathreplay.integrators.scene_facts import facts_of
from pathreplay.integrators.stateful import StatefulIntegrator
from pathreplay.inverse.losses.pixelwise import Loss, mean_loss
from pathreplay.inverse.objective.pixel_batches import Batch
from pathreplay.inverse.parameters.exposures import derivative
from pathreplay.scenes.parameters import keep_only

# What Dr.Jit says, whatever the cause, where a function cannot be frozen. Plugins do not show beforehand whether they
# can: the arrays of some (Mitsuba 3.9.1: `orthographic`, `thinlens`) are hidden from it.
_RECORDING = "while recording a frozen function"


MOST_RECORDINGS = 8
"""Of a view: where what kernels take for constants changes more often, recording is not worth its time."""
_OTHER = 0x5EED
"""Makes another seed of one."""


class NotRecordable(Exception):
    """A plugin of the scene keeps Dr.Jit from recording a pass."""


def is_recordable(integrator: StatefulIntegrator, has_media: bool) -> bool:
    """Whether passes of the integrator can be recorded in a scene with or without media, as far as that is known."""
    # Spectral variants look up the eye's response in tables of Mitsuba's library: no input of ours, as a recorded
    # function must have them, leads there.
    return not mi.is_spectral and integrator.is_recordable(has_media)


class Recordings:
    """Frozen functions for `differentiate`, by view, shapes of the parameters, and what kernels take for constants."""

    def __init__(self) -> None:
        self._frozen: dict[Any, Callable[..., Any]] = {}
        self._made: Counter[Any] = Counter()  # of each view with such shapes

    def differentiate(
        self, params: mi.SceneParameters, scene: mi.Scene, sensor: int, integrator: StatefulIntegrator, *args: Any
    ) -> tuple[Any, PassState, Any]:
        """As the function of that name. Raises NotRecordable; a part of the gradient may be there, then."""
        keys = list(params.keys())
        # By view, since Dr.Jit thinks that something is wrong with a function that it has to record often.
        view = (sensor, *(dr.shape(params[key]) for key in keys))
        which = view, facts_of(scene).constants()
        if which not in self._frozen:
            self._made[view] += 1
            if self._made[view] > MOST_RECORDINGS:
                raise NotRecordable
            gc.collect()  # scenes of the past would be traced, too
            self._frozen[which] = _recording(keys)
        try:
            return self._frozen[which](scene, integrator.begin(scene).to_record(), sensor, integrator, *args)
        except RuntimeError as error:
            if _RECORDING not in str(error):
                raise
            raise NotRecordable from error


def _recording(keys: list[str]) -> Callable[..., Any]:
    """`differentiate` as a frozen function, which holds neither scene nor problem when the run is over."""

    def frozen(scene: Any, *args: Any) -> tuple[Any, PassState, Any]:
        params = mi.traverse(scene)
        keep_only(params, keys)
        return _differentiate(params, scene, *args)

    return dr.freeze(frozen)


def differentiate(
    params: mi.SceneParameters, scene: mi.Scene, sensor: int, integrator: StatefulIntegrator, *args: Any
) -> tuple[Any, PassState, Any]:
    """The loss of a view and its gradient, traced anew: see `_differentiate`."""
    return _differentiate(params, scene, integrator.begin(scene), sensor, integrator, *args)


def _differentiate(
    params: mi.SceneParameters,
    scene: mi.Scene,
    state: PassState,
    sensor: int,
    integrator: StatefulIntegrator,
    target: mi.TensorXf,
    weight: mi.TensorXf | None,
    seed: int | mi.UInt32,
    spp: int,
    loss: Loss,
    share: float,
    sweeps: bool,
    factor: mi.TensorXf | None = None,
    batch: Batch | None = None,
) -> tuple[Any, PassState, Any]:
    """``share`` times the loss of a view, whose gradient is added to the parameters; ``sweeps``: in one pass.

    With a ``batch``, which only sweeps take, target and weight are its rows, and so is the loss an estimate by them.
    Also returns the ``state`` after it, and the derivative by the logarithm of the ``factor`` on the picture (see
    `exposures`) for each channel, if there is one.
    """
    view = integrator.pass_of(scene, sensor, seed, spp)
    share *= 1 if batch is None else batch.share

    def shared(image: mi.TensorXf) -> mi.Float:
        return mean_loss(loss, _times(image, factor), target, weight).array * share

    if sweeps:
        offset, slope = (term * share for term in linear_derivative(loss, target, weight))
        # By the chain rule, of what is linear in the factor times the image.
        wanted = _times(offset, factor), _times(_times(slope, factor), factor)
        image, state = integrator.pixel_pass(view, wanted, None if batch is None else batch.pixels, state)
        value = shared(image)
    else:
        image = integrator.image_pass(view, state)
        if dr.grad_enabled(dict(params)):
            dr.enable_grad(image)
        value = shared(image)
        if dr.grad_enabled(value):
            dr.backward(value)
            apart = replace(view, seed=mi.sample_tea_32(seed, 1)[0])  # as `mi.render` has it
            state = integrator.gradient_pass(apart, dr.grad(image), state)
    by_factor = None
    if factor is not None:
        other: Any = mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(_OTHER))[0]
        again = integrator.image_pass(replace(view, seed=other), state)
        by_factor = derivative(loss, image, again, factor, target, weight) * share
    return dr.detach(value), state, by_factor


def _times(tensor: Any, factor: Any) -> Any:
    return tensor if factor is None else tensor * factor


def linear_derivative(loss: Loss, target: Any, weight: Any = None) -> tuple[Any, Any]:
    """Offset and slope of the derivative of a quadratic loss by the image, from two images far apart."""
    bright = 1 + dr.abs(target)
    offset = _derivative(loss, dr.zeros(mi.TensorXf, target.shape), target, weight)
    return offset, (_derivative(loss, mi.TensorXf(bright), target, weight) - offset) / bright


def _derivative(loss: Loss, image: Any, target: Any, weight: Any) -> Any:
    """Derivative of a loss by the image, a tensor like it."""
    dr.enable_grad(image)
    dr.backward(mean_loss(loss, image, target, weight))
    return dr.grad(image)
