"""Loss functions: how far a rendered picture is from its target, with a derivative.

A loss is f(I, T), entry by entry, with I the rendered picture (noisy, differentiable) and T the target; what counts is
its mean over pixels and channels, or over those that a weight leaves. No path is judged by itself (see `frozen`),
hence a loss whose f' is linear in I has an unbiased gradient: ``l2`` and ``relative-l2``. The gradients of the others
are biased by the noise in I (less with more samples); they pay where outliers would rule ``l2``. Losses in which pixels
meet are in `picture_losses`.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.user_functions import Imported, Modules
from pathreplay.inverse.losses.image_losses import lpips, scale_invariant, ssim

Loss = Callable[..., Any]
"""loss(image, target) on tensors of one shape (height, width, channels) -> such a tensor (or one number)."""

# Radiance below which relative-l2 stops amplifying: about 1 % of a display's white.
RELATIVE_FLOOR = 1e-2


def l1(image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
    """|I - T|. Gradient biased by noise in I."""
    return dr.abs(image - target)


def l2(image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
    """(I - T)^2. Gradient unbiased; the value carries the variance of I on top."""
    return dr.square(image - target)


def relative_l2(image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
    """((I - T) / (T + floor))^2, so that dark parts count. Divides by the target, hence unbiased like ``l2``."""
    return dr.square((image - target) / (dr.abs(target) + RELATIVE_FLOOR))


def log(image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
    """Squared difference of logarithms of 1 + I and 1 + T, for very bright spots. Gradient biased by noise in I."""
    positive = dr.maximum(image, 0)
    return dr.square(dr.log(1 + positive) - dr.log(1 + dr.maximum(target, 0)))


def relative_l1(image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
    """|I - T| / (|T| + floor). Gradient biased by noise in I."""
    return dr.abs(image - target) / (dr.abs(target) + RELATIVE_FLOOR)


def smape(image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
    """|I - T| / (|I| + |T| + floor), which is below 1 however bright a pixel is. Gradient biased by noise in I."""
    return dr.abs(image - target) / (dr.abs(image) + dr.abs(target) + RELATIVE_FLOOR)


#: Losses whose derivative by a pixel is a linear function of that pixel alone.
QUADRATIC = frozenset({l2, relative_l2})

#: Losses that want to know how much pixels count: a third argument, as `mean_loss` has it.
WEIGHTED = frozenset({scale_invariant})

#: Losses that Dr.Jit cannot record: what is not its own computes them.
ELSEWHERE = frozenset({lpips})

LOSSES: dict[str, Loss] = {
    "l1": l1,
    "l2": l2,
    "relative-l1": relative_l1,
    "relative-l2": relative_l2,
    "smape": smape,
    "log": log,
    "scale-invariant": scale_invariant,
    "ssim": ssim,
    "lpips": lpips,
}


def mean_loss(loss: Loss, image: Any, target: Any, weight: Any = None) -> mi.TensorXf:
    """The mean of a loss over pixels and channels, as a tensor of one number.

    ``weight`` (height x width x 1, with mean 1) says how much pixels count; None: all the same.
    """
    found = loss(image, target, weight) if loss in WEIGHTED else loss(image, target)
    return dr.mean(found if weight is None else found * weight, axis=None)


def find_loss(name: str, modules: Modules | None = None) -> Loss:
    """The loss called ``name``, or ``module:function``, which ``modules`` have (default: installed ones).

    Raises PathreplayError with the nearest name and the list, or why there is no such function.
    """
    if name in LOSSES:
        return LOSSES[name]
    if ":" in name:
        return _imported(name, modules or Modules())
    close = difflib.get_close_matches(name, LOSSES, n=1)
    hint = f"; did you mean '{close[0]}'?" if close else ""
    raise PathreplayError(f"No loss '{name}'{hint} (losses: {', '.join(LOSSES)}, or module:function)")


def _imported(name: str, modules: Modules) -> Loss:
    return Own(modules.function("Loss", name, "image and target"))


@dataclass(frozen=True)
class Own:
    """A loss of the user's own. Raises PathreplayError where it fails, or gives neither an image nor a number."""

    function: Imported

    def __str__(self) -> str:
        return str(self.function)

    def __call__(self, image: Any, target: Any) -> Any:
        value = self.function(mi.TensorXf, image, target)
        if value.shape not in (image.shape, (), (1,)):
            raise PathreplayError(
                f"{self} gives the shape {value.shape} for pictures of {image.shape}; return a tensor like the image, "
                "or one number"
            )
        return value
