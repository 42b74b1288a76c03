"""Losses of whole pictures, where a pixel counts with others: up to a common factor, by structure, by a network.

Their gradients are biased by the noise of a rendering: give them samples.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.inverse.images.metrics import C1, C2, CUT, SIGMA
from pathreplay.scenes.descriptions import one_line

# Of the mean square of a target: below that a picture is black, and no factor makes it alike.
_BLACK = 1e-9


def scale_invariant(image: mi.TensorXf, target: mi.TensorXf, weight: Any = None) -> mi.TensorXf:
    """(s I - T)^2 with the factor s = Σ w I T / Σ w I² that makes it least, one for the whole picture.

    Since it is least there, s has no derivative that counts, and is held. Of a black picture s is 0.
    """
    with dr.suspend_grad():
        w = mi.TensorXf(1) if weight is None else weight
        floor = _BLACK * dr.sum(w * dr.square(target), axis=None) + 1e-30
        s = dr.sum(w * image * target, axis=None) / (dr.sum(w * dr.square(image), axis=None) + floor)
    return dr.square(image * dr.detach(s) - target)


def ssim(image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
    """1 - SSIM of each pixel and channel, of sRGB encoded colours that are not cut off at white.

    Windows and constants are those of Wang et al. 2004, and of `Likeness`, by which results are reported.
    """
    a, b = _encoded(image), _encoded(target)
    μ, ν = _blurred(a), _blurred(b)
    σ, τ, covariance = _blurred(a * a) - μ * μ, _blurred(b * b) - ν * ν, _blurred(a * b) - μ * ν
    return 1 - (2 * μ * ν + C1) * (2 * covariance + C2) / ((μ * μ + ν * ν + C1) * (σ + τ + C2))


def _encoded(image: mi.TensorXf) -> mi.TensorXf:
    """sRGB's curve, which goes on above white."""
    bright = dr.maximum(image, 0.0031308)  # also where it is not taken: powers of 0 have no derivative
    return dr.select(image > 0.0031308, 1.055 * dr.power(bright, 1 / 2.4) - 0.055, 12.92 * dr.maximum(image, 0))


def _blurred(image: mi.TensorXf) -> mi.TensorXf:
    """Mean under the window around each pixel; pictures are mirrored at their borders."""
    offsets = np.arange(-CUT, CUT + 1)
    window = np.exp(-0.5 * (offsets / SIGMA) ** 2)
    window /= window.sum()
    for axis in (0, 1):
        n, stride = image.shape[axis], int(np.prod(image.shape[axis + 1 :]))
        at = dr.arange(mi.UInt32, int(np.prod(image.shape)))
        place = at // stride % n
        values = image.array
        mean = mi.Float(0)
        for offset, share in zip(offsets, window, strict=True):
            # Modulo 2 n, where it goes there and back.
            there = (place + int(offset % (2 * n))) % (2 * n)
            there = dr.select(there < n, there, 2 * n - 1 - there)
            mean += dr.gather(mi.Float, values, at + (there - place) * stride) * float(share)
        image = mi.TensorXf(mean, image.shape)
    return image


def lpips(image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
    """The distance of "The Unreasonable Effectiveness of Deep Features" (2018), of each pixel (height x width x 1).

    By the module of that name, of sRGB encoded colours. Raises PathreplayError where there is none, it cannot load its
    weights, or the pictures have no three channels.
    """
    if image.shape[2] != 3:
        raise PathreplayError(f"Loss 'lpips' takes three channels, the pictures have {image.shape[2]}; take another")
    network = _network()

    @dr.wrap(source="drjit", target="torch")
    def distance(a: Any, b: Any) -> Any:
        a, b = (2 * x.permute(2, 0, 1)[None] - 1 for x in (a, b))
        return network.to(a.device)(a, b)[0].permute(1, 2, 0).contiguous()

    try:
        return distance(_encoded(image), _encoded(target))
    except RuntimeError as error:
        raise PathreplayError(f"Loss 'lpips' cannot be computed ({one_line(error)}); take larger pictures") from None


@lru_cache(maxsize=1)
def _network() -> Any:
    try:
        import lpips as module

        network = module.LPIPS(net="alex", spatial=True, verbose=False)
    except ImportError as error:
        raise PathreplayError(f"Loss 'lpips' needs a module ({error}): pip install 'pathreplay[lpips]'") from None
    except Exception as error:  # whatever loading weights does where there is no network, or no space
        why = one_line(error) or type(error).__name__
        raise PathreplayError(
            f"Loss 'lpips' cannot load the weights of its network ({why}); put torchvision's AlexNet into its cache"
        ) from None
    return network.eval().requires_grad_(False)
