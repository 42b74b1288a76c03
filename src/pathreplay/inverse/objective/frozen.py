"""The loss of one view and its gradient by the scene's parameters: traced anew, or recorded as a frozen function.

A loss whose derivative is linear in each pixel can be back-propagated while its image is rendered, see `pixel_sweep`;
for the others an image is rendered first, and paths of their own are differentiated. Where Dr.Jit can record all that
as a frozen function, later calls launch its kernels without tracing them again.
"""

from __future__ import annotations

import gc
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from pathreplay.integrators.pass_state import PassState
from pathreplay.integrators.scene_facts import facts_of
from pathreplay.integrators.stateful import StatefulIntegrator
from pathreplay.inverse.losses.pixelwise import Loss, mean_loss
from pathreplay.inverse.objective.pixel_batches import Batch
from pathreplay.inverse.parameters.exposures import derivative
from pathreplay.samplers.streams import Stream
from pathreplay.scenes.parameters import keep_only

# What Dr.Jit says, whatever the cause, where a function cannot be frozen. Plugins do not show beforehand whether they
# can: the arrays of some (Mitsuba 3.9.1: `orthographic`, `thinlens`) are hidden from it.
_RECORDING = "while recording a frozen function"


MOST_RECORDINGS = 8
"""Of a view: where what kernels take for constants changes more often, recording is not worth its time."""


@dataclass(frozen=True)
class ViewTarget:
    """Target of a view, as tensors."""

    target: mi.TensorXf
    weight: mi.TensorXf | None = None
    """Weights of the pixels, see `mean_loss`."""
    factor: mi.TensorXf | None = None
    """Factor on the rendered image, see `exposures`."""

    def compared(self, loss: Loss, image: mi.TensorXf) -> mi.Float:
        """Return the mean loss of an image as rendered."""
        return mean_loss(loss, _times(image, self.factor), self.target, self.weight).array


@dataclass(frozen=True)
class RenderRequest:
    """Sampling of a view."""

    sensor: int
    seed: int | mi.UInt32
    spp: int
    batch: Batch | None = None
    """Pixels that are rendered, which are the rows of the target (None: all). Requires ``ViewLoss.swept``."""


@dataclass(frozen=True)
class ViewLoss:
    """Loss of a view: ``share`` times the mean ``loss``."""

    loss: Loss
    share: float
    swept: bool
    """Whether image and gradient come from one pixel sweep; the loss is quadratic then."""


@dataclass(frozen=True)
class ViewResult:
    """Loss of a view, and the state of the integrator after the passes."""

    loss: mi.Float
    state: PassState
    by_factor: mi.TensorXf | None
    """Derivative by the logarithm of the target's factor, per channel."""


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
        self,
        params: mi.SceneParameters,
        scene: mi.Scene,
        integrator: StatefulIntegrator,
        request: RenderRequest,
        target: ViewTarget,
        loss: ViewLoss,
    ) -> ViewResult:
        """As the function of that name. Raises NotRecordable; a part of the gradient may be there, then."""
        keys = list(params.keys())
        # By view, since Dr.Jit thinks that something is wrong with a function that it has to record often.
        view = (request.sensor, *(dr.shape(params[key]) for key in keys))
        which = view, facts_of(scene).constants()
        if which not in self._frozen:
            self._made[view] += 1
            if self._made[view] > MOST_RECORDINGS:
                raise NotRecordable
            gc.collect()  # scenes of the past would be traced, too
            self._frozen[which] = _recording(keys)
        try:
            return self._frozen[which](scene, integrator, integrator.begin(scene).to_record(), request, target, loss)
        except RuntimeError as error:
            if _RECORDING not in str(error):
                raise
            raise NotRecordable from error


def _recording(keys: list[str]) -> Callable[..., Any]:
    """`differentiate` as a frozen function, which holds neither scene nor problem when the run is over."""

    def frozen(scene: mi.Scene, *args: Any) -> ViewResult:
        params = mi.traverse(scene)
        keep_only(params, keys)
        return _differentiate(params, scene, *args)

    return dr.freeze(frozen)


def differentiate(
    params: mi.SceneParameters,
    scene: mi.Scene,
    integrator: StatefulIntegrator,
    request: RenderRequest,
    target: ViewTarget,
    loss: ViewLoss,
) -> ViewResult:
    """Compute the loss of a view, and add its gradient to the parameters."""
    return _differentiate(params, scene, integrator, integrator.begin(scene), request, target, loss)


def _differentiate(
    params: mi.SceneParameters,
    scene: mi.Scene,
    integrator: StatefulIntegrator,
    state: PassState,
    request: RenderRequest,
    target: ViewTarget,
    loss: ViewLoss,
) -> ViewResult:
    """Compute loss and gradient by passes that begin with the ``state``: see `differentiate`."""
    view = integrator.pass_of(scene, request.sensor, request.seed, request.spp)
    batch, factor = request.batch, target.factor
    share = loss.share if batch is None else loss.share * batch.share
    if loss.swept:
        offset, slope = (term * share for term in linear_derivative(loss.loss, target.target, target.weight))
        # The exposed image is factor * image: by the chain rule, offset takes one factor, and slope two.
        wanted = _times(offset, factor), _times(_times(slope, factor), factor)
        image, state = integrator.pixel_pass(view, wanted, None if batch is None else batch.pixels, state)
        value = target.compared(loss.loss, image) * share
    else:
        image = integrator.image_pass(view, state)
        if dr.grad_enabled(dict(params)):
            dr.enable_grad(image)
        value = target.compared(loss.loss, image) * share
        if dr.grad_enabled(value):
            dr.backward(value)
            apart = replace(view, seed=mi.sample_tea_32(view.seed, 1)[0])  # as `mi.render` has it
            state = integrator.gradient_pass(apart, dr.grad(image), state)
    by_factor = None
    if factor is not None:
        other: Any = mi.sample_tea_32(mi.UInt32(view.seed), mi.UInt32(int(Stream.SECOND_IMAGE)))[0]
        again = integrator.image_pass(replace(view, seed=other), state)
        by_factor = derivative(loss.loss, image, again, factor, target.target, target.weight) * share
    return ViewResult(dr.detach(value), state, by_factor)


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
