"""Per-pixel losses, and the lookup of losses by name.

A loss f(I, T) compares the rendered image I with the target T. The optimiser minimises the weighted mean of f over
pixels and channels.

The gradient is the product of f'(I, T) and the derivative of I, which are estimated from independent samples (see
`frozen`). The gradient is therefore unbiased if f' is linear in I, as for ``l2``, ``relative-l2`` and ``display-l2``.
Noise in I biases the gradients of all other losses. More samples per pixel reduce the bias. The losses with biased
gradients are useful where outliers would dominate ``l2``. Losses that couple pixels are in `image_losses`.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import drjit as dr
import mitsuba as mi

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.user_functions import Imported, Modules
from pathreplay.inverse.losses.image_losses import lpips, scale_invariant, ssim

Loss: TypeAlias = "Callable[..., mi.TensorXf]"
"""loss(image, target), on tensors of shape (height, width, channels); returns a tensor of that shape or a scalar."""

# Floor (radiance) that is added to the denominators of relative losses: about 1 % of display white.
RELATIVE_FLOOR = 1e-2

# Radiance of the target, below which the factor s'(T) of `display_l2` is constant.
DISPLAY_FLOOR = 1e-2


def l1(image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
    """Compute ``|I - T|``. Noise in I biases the gradient."""
    return dr.abs(image - target)


def l2(image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
    """Compute (I - T)². The gradient is unbiased. The expected loss includes the variance of I."""
    return dr.square(image - target)


def relative_l2(image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
    """Compute ``((I - T) / (|T| + floor))²``, which emphasises dark regions. The gradient is unbiased."""
    return dr.square((image - target) / (dr.abs(target) + RELATIVE_FLOOR))


def display_l2(image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
    """Compute ((I - T) s'(T))², where s' is the derivative of the sRGB encoding.

    In s'(T), the target T is clamped to [0.01, 1]. To first order, the loss is the squared difference of the
    sRGB-encoded images. The gradient is unbiased, as for ``l2``.
    """
    slope = (1.055 / 2.4) * dr.power(dr.clip(target, DISPLAY_FLOOR, 1), 1 / 2.4 - 1)
    return dr.square((image - target) * slope)


def log(image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
    """Square the difference of the logarithms of 1 + I and 1 + T, for images with very bright spots.

    Noise in I biases the gradient.
    """
    positive = dr.select(image < 0, 0, image)  # unlike the derivative of `dr.maximum`, its derivative at 0 is 1
    return dr.square(dr.log(1 + positive) - dr.log(1 + dr.maximum(target, 0)))


def relative_l1(image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
    """Compute ``|I - T| / (|T| + floor)``. Noise in I biases the gradient."""
    return dr.abs(image - target) / (dr.abs(target) + RELATIVE_FLOOR)


def smape(image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
    """Compute ``|I - T| / (|I| + |T| + floor)``, which is always below 1. Noise in I biases the gradient."""
    return dr.abs(image - target) / (dr.abs(image) + dr.abs(target) + RELATIVE_FLOOR)


#: Losses whose derivative with respect to a pixel is a linear function of that pixel alone.
QUADRATIC = frozenset({l2, relative_l2, display_l2})

#: Losses that take the pixel weights of `mean_loss` as a third argument.
WEIGHTED = frozenset({scale_invariant})

#: Losses that compare each pixel together with its neighbours.
WITH_NEIGHBOURS = frozenset({ssim, lpips})

#: Losses that Dr.Jit cannot record, because another framework computes them.
ELSEWHERE = frozenset({lpips})

LOSSES: dict[str, Loss] = {
    "l1": l1,
    "l2": l2,
    "relative-l1": relative_l1,
    "relative-l2": relative_l2,
    "display-l2": display_l2,
    "smape": smape,
    "log": log,
    "scale-invariant": scale_invariant,
    "ssim": ssim,
    "lpips": lpips,
}


def mean_loss(loss: Loss, image: mi.TensorXf, target: mi.TensorXf, weight: mi.TensorXf | None = None) -> mi.TensorXf:
    """Average a loss over pixels and channels.

    Args:
        loss: the loss function.
        image: rendered image, shape (height, width, channels).
        target: target image, of the same shape.
        weight: weights of the pixels with mean 1, shape (height, width, 1); None weights all equally. Where the weight
            is zero, losses in `WITH_NEIGHBOURS` use the target in place of the image.

    Returns:
        A tensor with one entry.

    Raises:
        PathreplayError: the loss function returns one number, which cannot be weighted by pixels.
    """
    if weight is not None and loss in WITH_NEIGHBOURS:
        image = dr.select(weight > 0, image, target)
    values = loss(image, target, weight) if loss in WEIGHTED else loss(image, target)
    if weight is not None and values.shape in ((), (1,)):
        raise PathreplayError(
            f"{loss} returns one number, but masks or weights of pixels need a tensor of shape {image.shape}; return "
            "the loss of each pixel and channel, or leave the masks and weights out"
        )
    return dr.mean(values if weight is None else values * weight, axis=None)


def find_loss(name: str, modules: Modules | None = None) -> Loss:
    """Return the loss of this name, or import a user function ``module:function``.

    ``modules`` finds and imports user functions; by default, only installed modules are searched. Raises
    PathreplayError if the name is unknown or the import fails. For an unknown name, the message suggests a similar
    name.
    """
    if name in LOSSES:
        return LOSSES[name]
    if ":" in name:
        return Own((modules or Modules()).function("Loss", name, "image and target"))
    close = difflib.get_close_matches(name, LOSSES, n=1)
    hint = f"; did you mean '{close[0]}'?" if close else ""
    raise PathreplayError(f"No loss '{name}'{hint} (losses: {', '.join(LOSSES)}, or module:function)")


@dataclass(frozen=True)
class Own:
    """A loss that is a user function.

    Raises PathreplayError if the function fails, or returns neither a scalar nor a tensor in the shape of the image.
    """

    function: Imported

    def __str__(self) -> str:
        return str(self.function)

    def __call__(self, image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
        value = self.function(mi.TensorXf, image, target)
        if value.shape not in (image.shape, (), (1,)):
            raise PathreplayError(
                f"{self} returns the shape {value.shape} for images of shape {image.shape}; return a tensor of "
                "that shape, or one number"
            )
        return value
