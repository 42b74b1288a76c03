"""Loss functions: how far a rendered picture is from its target, as one number with a derivative.

Every loss is the mean over pixels and channels of f(I, T), with I the rendered picture (noisy, differentiable) and T
the target. No path is judged by itself (see `recorded`), hence a loss whose f' is linear in I has an unbiased gradient:
``l2`` and ``relative-l2``. The gradients of ``l1`` and ``log`` are biased by the noise in I (less with more samples);
they pay where outliers would rule ``l2``.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

from pathreplay.errors import PathreplayError

Loss = Callable[[Any, Any], Any]
"""loss(image, target) on tensors of one shape (height, width, channels) -> tensor of one number."""

# Radiance below which relative-l2 stops amplifying: about 1 % of a display's white.
RELATIVE_FLOOR = 1e-2


def l1(image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
    """mean |I - T|. Gradient biased by noise in I."""
    return dr.mean(dr.abs(image - target), axis=None)


def l2(image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
    """mean (I - T)^2. Gradient unbiased; the value carries the variance of I on top."""
    return dr.mean(dr.square(image - target), axis=None)


def relative_l2(image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
    """mean ((I - T) / (T + floor))^2, so that dark parts count. Divides by the target, hence unbiased like ``l2``."""
    return dr.mean(dr.square((image - target) / (dr.abs(target) + RELATIVE_FLOOR)), axis=None)


def log(image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
    """mean (log(1 + I) - log(1 + T))^2, for pictures with very bright spots. Gradient biased by noise in I."""
    positive = dr.maximum(image, 0)
    return dr.mean(dr.square(dr.log(1 + positive) - dr.log(1 + dr.maximum(target, 0))), axis=None)


#: Losses whose derivative by a pixel is a linear function of that pixel alone.
QUADRATIC = frozenset({l2, relative_l2})

LOSSES: dict[str, Loss] = {"l1": l1, "l2": l2, "relative-l2": relative_l2, "log": log}


def find_loss(name: str) -> Loss:
    """The loss called ``name``; raises PathreplayError with the nearest name and the list."""
    if name in LOSSES:
        return LOSSES[name]
    close = difflib.get_close_matches(name, LOSSES, n=1)
    hint = f"; did you mean '{close[0]}'?" if close else ""
    raise PathreplayError(f"No loss '{name}'{hint} (losses: {', '.join(LOSSES)})")
