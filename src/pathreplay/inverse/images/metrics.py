"""Image quality metrics on displayed images: PSNR, SSIM and FLIP."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass

import numpy as np
import scipy.ndimage

from pathreplay.inverse.images.io import Image, displayed

# SSIM (Wang et al. 2004): standard deviation and radius of the Gaussian window in pixels, and stabilising constants.
SIGMA, CUT = 1.5, 5
C1, C2 = 0.01**2, 0.03**2
MOST_DB = 100.0
"""Upper limit of the PSNR in decibels, reached by images that differ by rounding errors at most."""


@dataclass(frozen=True)
class Likeness:
    """Similarity of an image to its target: PSNR in decibels, SSIM (1 if equal), and optionally FLIP (0 if equal)."""

    psnr: float
    ssim: float
    flip: float | None = None

    @staticmethod
    def of(
        image: Image, target: Image, exposure: float, weight: Image | None = None, *, flip: bool = False
    ) -> Likeness:
        """Compare an image with its target, as displayed (see `displayed`).

        PSNR = -10 log10 (mean square error). SSIM is the mean over pixels and colour channels. The windows of SSIM
        weight their pixels, too, so that pixels of weight zero do not affect PSNR and SSIM. FLIP takes the values of
        the target there.

        Args:
            image: rendered image, shape (height, width, channels).
            target: image to compare with, of the same shape.
            exposure: factor on both images.
            weight: weights of the pixels with mean 1, shape (height, width, 1); None weights all equally.
            flip: whether to compute FLIP (Andersson et al. 2020, 67 pixels per degree) with NVIDIA's package
                flip-evaluator. The FLIP value is None if the package is not installed.
        """
        a, b = (displayed(picture, exposure) for picture in (image, target))
        w = np.ones((*a.shape[:2], 1)) if weight is None else weight.astype(np.float64)
        error = float(np.mean(w * (a - b) ** 2))
        psnr = MOST_DB if error <= 10 ** (-MOST_DB / 10) else -10 * float(np.log10(error))
        flip_map = _flip(np.where(w > 0, a, b), b) if flip else None
        perceived = None if flip_map is None else float(np.mean(w * flip_map))
        return Likeness(psnr, float(np.mean(w * _similarity(a, b, w))), perceived)


def has_flip() -> bool:
    """Return whether the package flip-evaluator is installed."""
    return importlib.util.find_spec("flip_evaluator") is not None


def _flip(a: np.ndarray, b: np.ndarray) -> np.ndarray | None:
    """Compute the FLIP map (height x width x 1), or return None without flip-evaluator."""
    if not has_flip():
        return None
    from flip_evaluator import evaluate

    test, reference = (np.ascontiguousarray(np.broadcast_to(x, (*x.shape[:2], 3)), np.float32) for x in (a, b))
    flip_map, _, _ = evaluate(reference, test, "LDR", True, False, False, {})
    return np.asarray(flip_map, np.float64)


def _similarity(a: np.ndarray, b: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Compute SSIM for each pixel and channel. Pixels of the windows have weights ``w`` (height x width x 1)."""

    def blurred(x: np.ndarray) -> np.ndarray:
        return scipy.ndimage.gaussian_filter(x, (SIGMA, SIGMA, 0), truncate=CUT / SIGMA)

    total = blurred(w)
    per_weight = np.divide(1, total, where=total > 0, out=np.zeros_like(total))

    def mean(x: np.ndarray) -> np.ndarray:
        return blurred(w * x) * per_weight

    μ, ν = mean(a), mean(b)
    σ, τ, covariance = mean(a * a) - μ * μ, mean(b * b) - ν * ν, mean(a * b) - μ * ν
    return (2 * μ * ν + C1) * (2 * covariance + C2) / ((μ * μ + ν * ν + C1) * (σ + τ + C2))
