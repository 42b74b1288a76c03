"""Losses that couple pixels: scale-invariant, SSIM and LPIPS.

Rendering noise biases the gradients of these losses. More samples per pixel reduce the bias.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.inverse.images.metrics import C1, C2, CUT, SIGMA
from pathreplay.scenes.descriptions import one_line

if TYPE_CHECKING:
    import torch

# Fraction of Σ w T² that is added to the denominator of s in `scale_invariant`. Nearly black images get s ≈ 0.
_BLACK = 1e-9


def scale_invariant(image: mi.TensorXf, target: mi.TensorXf, weight: mi.TensorXf | None = None) -> mi.TensorXf:
    """Compute (s I - T)² with the least-squares scale s = Σ w I T / Σ w I² of the whole image.

    The scale s is detached, because it minimises the loss: the derivative of the loss with respect to s is zero. For a
    black image, s is 0.

    Args:
        image: rendered image I, shape (height, width, channels).
        target: target T, of the same shape.
        weight: weights w of the pixels, shape (height, width, 1); None weights all equally.
    """
    with dr.suspend_grad():
        w = mi.TensorXf(1) if weight is None else weight
        floor = _BLACK * dr.sum(w * dr.square(target), axis=None) + 1e-30
        s = dr.sum(w * image * target, axis=None) / (dr.sum(w * dr.square(image), axis=None) + floor)
    return dr.square(image * dr.detach(s) - target)


def ssim(image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
    """Compute 1 - SSIM for each pixel and channel, on sRGB-encoded colours that are not clipped at white.

    Window and constants follow Wang et al. 2004. The SSIM in reports (`Likeness`) uses the same window and constants.
    """
    # In double precision: the variance of a bright, even region is a small difference of large squares.
    double = dr.float64_array_t(mi.TensorXf)
    a, b = double(_encoded(image)), double(_encoded(target))
    μ, ν = _blurred(a), _blurred(b)
    σ, τ, covariance = _blurred(a * a) - μ * μ, _blurred(b * b) - ν * ν, _blurred(a * b) - μ * ν
    return mi.TensorXf(1 - (2 * μ * ν + C1) * (2 * covariance + C2) / ((μ * μ + ν * ν + C1) * (σ + τ + C2)))


def _encoded(image: mi.TensorXf) -> mi.TensorXf:
    """Apply the sRGB transfer function. Values above 1 are not clipped, but use the same formula."""
    bright = dr.maximum(image, 0.0031308)  # the unselected branch must have a finite derivative, too
    dark = dr.select(image < 0, 0, 12.92 * image)  # unlike `dr.maximum`, with a derivative at exactly 0
    return dr.select(image > 0.0031308, 1.055 * dr.power(bright, 1 / 2.4) - 0.055, dark)


def _blurred(image: mi.TensorXf) -> mi.TensorXf:
    """Convolve an image with the Gaussian window of SSIM, in the image's precision. Its borders are mirrored."""
    offsets = np.arange(-CUT, CUT + 1)
    window = np.exp(-0.5 * (offsets / SIGMA) ** 2)
    window /= window.sum()
    for axis in (0, 1):
        n, stride = image.shape[axis], int(np.prod(image.shape[axis + 1 :]))
        at = dr.arange(mi.UInt32, int(np.prod(image.shape)))
        position = at // stride % n
        values = image.array
        mean = type(values)(0)
        for offset, w in zip(offsets, window, strict=True):
            # Mirroring repeats the n pixels with period 2 n: first in their order, then in reverse order.
            tap = (position + int(offset % (2 * n))) % (2 * n)
            tap = dr.select(tap < n, tap, 2 * n - 1 - tap)
            mean += dr.gather(type(values), values, at + (tap - position) * stride) * float(w)
        image = type(image)(mean, image.shape)
    return image


def lpips(image: mi.TensorXf, target: mi.TensorXf) -> mi.TensorXf:
    """Compute the perceptual distance LPIPS (Zhang et al. 2018) with the package ``lpips`` on sRGB-encoded colours.

    Args:
        image: rendered image, shape (height, width, 3).
        target: target image, of the same shape.

    Returns:
        The distance at each pixel, shape (height, width, 1).

    Raises:
        PathreplayError: the package is not installed, its weights cannot be loaded, the images do not have three
            channels, or the images are too small for the network.
    """
    if image.shape[2] != 3:
        raise PathreplayError(
            f"Loss 'lpips' needs images of three channels, but these have {image.shape[2]}; use another loss"
        )
    network = _network()

    @dr.wrap(source="drjit", target="torch")
    def distance(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        a, b = (2 * x.permute(2, 0, 1)[None] - 1 for x in (a, b))
        return network.to(a.device)(a, b)[0].permute(1, 2, 0).contiguous()

    try:
        return distance(_encoded(image), _encoded(target))
    except RuntimeError as error:
        raise PathreplayError(f"Loss 'lpips' cannot be computed ({one_line(error)}); use larger images") from None


@lru_cache(maxsize=1)
def _network() -> torch.nn.Module:
    try:
        import lpips as module

        network = module.LPIPS(net="alex", spatial=True, verbose=False)
    except ImportError as error:
        raise PathreplayError(f"Loss 'lpips' needs a package ({error}); pip install 'pathreplay[lpips]'") from None
    except Exception as error:  # loading weights may fail in any way, e.g. without network access or disk space
        why = one_line(error) or type(error).__name__
        raise PathreplayError(
            f"Loss 'lpips' cannot load the weights of its network ({why}); put torchvision's AlexNet into its cache"
        ) from None
    return network.eval().requires_grad_(False)
