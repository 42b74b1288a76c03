"""How alike two pictures look: PSNR and SSIM, as captures are judged by them, of pictures as a display shows them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.ndimage

from pathreplay.inverse.images import Image, displayed

# Of the structural similarity of Wang et al. 2004: the window's width in pixels, cut at 5, and what keeps it stable.
SIGMA, CUT = 1.5, 5
C1, C2 = 0.01**2, 0.03**2
MOST_DB = 100.0
"""PSNR of pictures that are the same, to single precision."""


@dataclass(frozen=True)
class Likeness:
    """Of a picture to its target: PSNR in decibels, and SSIM (1: the same)."""

    psnr: float
    ssim: float

    @staticmethod
    def of(image: Image, target: Image, exposure: float, weight: Image | None = None) -> Likeness:
        """Of colours times ``exposure``, cut off at white and sRGB encoded; ``weight`` is that of pixels, with mean 1.

        PSNR = -10 log10 (mean square difference); SSIM is the mean over pixels and channels, alpha left out.
        """
        a, b = (displayed(picture, exposure) for picture in (image, target))
        w = np.ones((1, 1, 1)) if weight is None else weight.astype(np.float64)
        error = float(np.mean(w * (a - b) ** 2))
        psnr = MOST_DB if error <= 10 ** (-MOST_DB / 10) else -10 * float(np.log10(error))
        return Likeness(psnr, float(np.mean(w * _similarity(a, b))))


def _similarity(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """SSIM of every pixel and channel."""

    def mean(x: np.ndarray) -> np.ndarray:
        return scipy.ndimage.gaussian_filter(x, (SIGMA, SIGMA, 0), truncate=CUT / SIGMA)

    μ, ν = mean(a), mean(b)
    σ, τ, covariance = mean(a * a) - μ * μ, mean(b * b) - ν * ν, mean(a * b) - μ * ν
    return (2 * μ * ν + C1) * (2 * covariance + C2) / ((μ * μ + ν * ν + C1) * (σ + τ + C2))
