"""Computes loss and gradient of one view, by tracing kernels or by a frozen function that replays recorded kernels.

If the derivative of the loss is linear in each pixel, image and gradient come from one pass (see `pixel_sweep`). Other
losses need one pass for the image, and then a gradient pass with independent paths. If Dr.Jit can record the passes as
a frozen function, later calls launch the kernels without tracing them again.
"""

from __future__ import annotations

import gc
from collections import Counter
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from functools import reduce
from operator import add
from typing import Any

import drjit as dr
import mitsuba as mi

from pathreplay.integrators.camera_pass import Pass, Which
from pathreplay.integrators.pass_state import PassState
from pathreplay.integrators.scene_facts import facts_of
from pathreplay.integrators.stateful import StatefulIntegrator
from pathreplay.inverse.losses.pixelwise import Loss, mean_loss
from pathreplay.inverse.parameters.exposures import derivative
from pathreplay.samplers.streams import Stream
from pathreplay.scenes.parameters import keep_only

# Part of every error message of Dr.Jit about a function that cannot be frozen. Plugins that hide arrays from Dr.Jit
# prevent freezing, e.g. `orthographic` and `thinlens` of Mitsuba 3.9.1. Only an attempt shows which plugins do so.
_RECORDING = "while recording a frozen function"


MOST_RECORDINGS = 8
"""Maximum number of recordings per sensor. If constants of kernels change more often, recording does not pay off."""


@dataclass(frozen=True)
class ViewTarget:
    """Target of a view, as tensors."""

    target: mi.TensorXf
    weight: mi.TensorXf | None = None
    """Weights of the pixels, see `mean_loss`."""
    factor: mi.TensorXf | None = None
    """Factor on the rendered image, see `exposures`."""

    def compared(self, loss: Loss, image: mi.TensorXf) -> mi.Float:
        """Multiply a rendered image by the factor, and return the mean loss of the product."""
        return mean_loss(loss, _times(image, self.factor), self.target, self.weight).array


@dataclass(frozen=True)
class RenderRequest:
    """Sensor, seed, samples and pixels of a rendering."""

    sensor: Which
    seed: int | mi.UInt32
    spp: int
    pixels: mi.UInt32 | None = None
    """Pixels to render, one for each row of the target; None renders all. A subset requires ``ViewLoss.swept``."""


@dataclass(frozen=True)
class ViewLoss:
    """Loss of a view: ``share`` times the mean ``loss`` of the rendered pixels."""

    loss: Loss
    share: float | mi.Float
    swept: bool
    """Whether one pass computes image and gradient, which requires a quadratic loss."""
    by_factor: bool = True
    """Whether the derivative with respect to `ViewTarget.factor` is computed, which needs a second image."""
    by_target: bool = False
    """Whether the derivative with respect to the target is computed, for quadratic losses."""
    debias: bool = False
    """Whether the bias due to noise is removed to first order: see `_extrapolated`."""


@dataclass(frozen=True)
class ViewResult:
    """Loss of a view, and the state of the integrator after the passes."""

    loss: mi.Float
    state: PassState
    by_factor: mi.TensorXf | None
    """Derivative with respect to the logarithm of `ViewTarget.factor`, per channel."""
    by_target: mi.TensorXf | None = None
    """Derivative with respect to the target. The divisor of a relative loss is treated as a constant."""


class NotRecordable(Exception):
    """A plugin of the scene prevents Dr.Jit from recording a pass."""


def is_recordable(integrator: StatefulIntegrator, has_media: bool) -> bool:
    """Return whether passes of the integrator can be recorded. Some obstacles show only in the first recording."""
    # Spectral variants read Mitsuba's tables of colour matching functions, which are not inputs of frozen functions.
    return not mi.is_spectral and integrator.is_recordable(has_media)


class Recordings:
    """Frozen versions of a function, such as `differentiate`.

    There is one version for each combination of sensor, number of pixels, shapes of the parameters, and
    `SceneFacts.constants`.
    """

    def __init__(self) -> None:
        self._frozen: dict[Hashable, Callable[..., Any]] = {}
        self._made: Counter[Hashable] = Counter()  # number of recordings, by the key of `called`

    def differentiate(
        self,
        params: mi.SceneParameters,
        scene: mi.Scene,
        integrator: StatefulIntegrator,
        request: RenderRequest,
        target: ViewTarget,
        loss: ViewLoss,
    ) -> ViewResult:
        """See the function `differentiate`. Raises NotRecordable, possibly after adding a part of the gradient."""
        keys = list(params.keys())
        # Recorded passes contain the number of pixels. One function per sensor, because Dr.Jit warns about functions
        # that are recorded often.
        pixels = None if request.pixels is None else dr.width(request.pixels)
        which = (request.sensor, pixels, *(dr.shape(params[key]) for key in keys))
        state = integrator.begin(scene).to_record()
        return self.called(which, lambda: _recording(keys), scene, integrator, state, request, target, loss)

    def called(self, key: Hashable, make: Callable[[], Callable[..., Any]], scene: mi.Scene, *args: Any) -> Any:
        """Call a frozen function of a scene.

        Args:
            key: key of the function.
            make: creates the function; called once for each key and each value of `SceneFacts.constants`.
            scene: first argument of the function.
            *args: further arguments of the function.

        Raises:
            NotRecordable: a plugin of the scene prevents the recording, or the constants changed too often.
        """
        which = key, facts_of(scene).constants()
        if which not in self._frozen:
            self._made[key] += 1
            if self._made[key] > MOST_RECORDINGS:
                raise NotRecordable
            gc.collect()  # otherwise Dr.Jit also traces scenes that are no longer in use
            self._frozen[which] = make()
        try:
            return self._frozen[which](scene, *args)
        except RuntimeError as error:
            if _RECORDING not in str(error):
                raise
            raise NotRecordable from error


def _recording(keys: list[str]) -> Callable[..., ViewResult]:
    """Return `differentiate` as a frozen function that references neither scene nor problem."""

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
    """Compute loss and gradient as `differentiate` does, in passes that start from ``state``."""
    view = integrator.pass_of(scene, request.sensor, request.seed, request.spp)
    share, factor = loss.share, target.factor
    if loss.swept:
        offset, slope = (term * share for term in linear_derivative(loss.loss, target.target, target.weight))
        # Chain rule: the loss is evaluated at factor * image, so offset is multiplied by factor and slope by factor².
        wanted = _times(offset, factor), _times(_times(slope, factor), factor)
        image, state = integrator.pixel_pass(view, wanted, request.pixels, state)
        value = target.compared(loss.loss, image) * share
        terms = [(1.0, image)]
    else:
        views = _halves(view) if loss.debias else [view]
        images = [integrator.image_pass(each, state) for each in views]
        if dr.grad_enabled(dict(params)):
            dr.enable_grad(images)
        value, terms = _extrapolated(loss.loss, target, images, [each.spp / view.spp for each in views])
        value *= share
        if dr.grad_enabled(value):
            dr.backward(value)
            apart = replace(view, seed=mi.sample_tea_32(view.seed, 1)[0])  # `mi.render` derives the same seed
            state = integrator.gradient_pass(apart, reduce(add, map(dr.grad, images)), state)
    by_factor = None
    if factor is not None and loss.by_factor:
        other = mi.sample_tea_32(mi.UInt32(view.seed), mi.UInt32(int(Stream.SECOND_IMAGE)))[0]
        again = integrator.image_pass(replace(view, seed=other), state)
        slopes = [w * derivative(loss.loss, a, again, factor, target.target, target.weight) for w, a in terms]
        by_factor = reduce(add, slopes) * share
    by_target = None
    if loss.by_target:
        offset, slope = linear_derivative(loss.loss, target.target, target.weight)
        by_target = -share * (offset + slope * _times(dr.detach(terms[0][1]), factor))
    return ViewResult(dr.detach(value), state, by_factor, by_target)


def _halves(view: Pass) -> list[Pass]:
    """Split the samples of a pass into two passes with separate seeds."""
    first, second = (view.spp + 1) // 2, view.spp // 2
    other = mi.sample_tea_32(mi.UInt32(view.seed), mi.UInt32(int(Stream.SECOND_HALF)))[0]
    return [replace(view, spp=first), replace(view, seed=other, spp=second)]


def _extrapolated(
    loss: Loss, target: ViewTarget, images: list[mi.TensorXf], shares: list[float]
) -> tuple[mi.Float, list[tuple[float, mi.TensorXf]]]:
    """Extrapolate the loss to an image without noise. Returns this loss, and the factors and images of its terms.

    The bias of a smooth loss f at an image of N samples is c / N + O(1 / N²). Let the image I_i have the share s_i of
    the N samples. The bias of f(I_i) is then c / (s_i N) to first order. For two images, the terms c / N therefore
    cancel in 2 f(Σ s_i I_i) - Σ s_i f(I_i) (jackknife). All I_i have the same expected image. The derivative of the
    loss with respect to the expected image is therefore the sum of the derivatives with respect to the I_i.
    """
    if len(images) == 1:
        return target.compared(loss, images[0]), [(1.0, images[0])]
    mean = reduce(add, [share * image for share, image in zip(shares, images, strict=True)])
    value = 2 * target.compared(loss, mean)
    for share, image in zip(shares, images, strict=True):
        value -= share * target.compared(loss, image)
    return value, [(2.0, mean), *((-share, image) for share, image in zip(shares, images, strict=True))]


def _times(tensor: mi.TensorXf, factor: mi.TensorXf | None) -> mi.TensorXf:
    return tensor if factor is None else tensor * factor


def linear_derivative(
    loss: Loss, target: mi.TensorXf, weight: mi.TensorXf | None = None
) -> tuple[mi.TensorXf, mi.TensorXf]:
    """Return offset and slope of the derivative of a quadratic loss: offset + slope · image."""
    bright = 1 + dr.abs(target)
    offset = _derivative(loss, dr.zeros(mi.TensorXf, target.shape), target, weight)
    return offset, (_derivative(loss, mi.TensorXf(bright), target, weight) - offset) / bright


def _derivative(loss: Loss, image: mi.TensorXf, target: mi.TensorXf, weight: mi.TensorXf | None) -> mi.TensorXf:
    dr.enable_grad(image)
    dr.backward(mean_loss(loss, image, target, weight))
    return dr.grad(image)
