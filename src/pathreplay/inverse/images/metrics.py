"""How alike two pictures look: PSNR, SSIM and FLIP, as captures are judged by them, of what a display shows."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass

import numpy as np
import scipy.ndimage

from pathreplay.inverse.images.io import Image, displayed

# Of the structural similarity of Wang et al. 2004: the window's width in pixels, cut at 5, and what keeps it stable.
SIGMA, CUT = 1.5, 5
C1, C2 = 0.01**2, 0.03**2
MOST_DB = 100.0
"""PSNR of pictures that are the same, to single precision."""


@dataclass(frozen=True)
class Likeness:
    """Of a picture to its target: PSNR in decibels, SSIM (1: the same), and, if asked for, FLIP (0: the same)."""

    psnr: float
    ssim: float
    flip: float | None = None

    @staticmethod
    def of(
        image: Image, target: Image, exposure: float, weight: Image | None = None, *, flip: bool = False
    ) -> Likeness:
        """Of colours times ``exposure``, cut off at white and sRGB encoded; ``weight`` is that of pixels, with mean 1.

        PSNR = -10 log10 (mean square difference); SSIM is the mean over pixels and channels, alpha left out. ``flip``
        asks for FLIP (Andersson et al. 2020, NVIDIA's flip-evaluator, 67 pixels per degree), None where that is absent.
        """
        a, b = (displayed(picture, exposure) for picture in (image, target))
        w = np.ones((1, 1, 1)) if weight is None else weight.astype(np.float64)
        error = float(np.mean(w * (a - b) ** 2))
        psnr = MOST_DB if error <= 10 ** (-MOST_DB / 10) else -10 * float(np.log10(error))
        seen = _flip(a, b) if flip else None
        perceived = None if seen is None else float(np.mean(w * seen))
        return Likeness(psnr, float(np.mean(w * _similarity(a, b))), perceived)


def has_flip() -> bool:
    """Whether FLIP can be computed here."""
    return importlib.util.find_spec("flip_evaluator") is not None


def _flip(a: np.ndarray, b: np.ndarray) -> np.ndarray | None:
    """FLIP of every pixel (height x width x 1), or None where nobody computes it."""
    if not has_flip():
        return None
    from flip_evaluator import evaluate

    test, reference = (np.ascontiguousarray(np.broadcast_to(x, (*x.shape[:2], 3)), np.float32) for x in (a, b))
    found, _, _ = evaluate(reference, test, "LDR", True, False, False, {})
    return np.asarray(found, np.float64)


def _similarity(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """SSIM of every pixel and channel."""

    def mean(x: np.ndarray) -> np.ndarray:
        return scipy.ndimage.gaussian_filter(x, (SIGMA, SIGMA, 0), truncate=CUT / SIGMA)

    μ, ν = mean(a), mean(b)
    σ, τ, covariance = mean(a * a) - μ * μ, mean(b * b) - ν * ν, mean(a * b) - μ * ν
    return (2 * μ * ν + C1) * (2 * covariance + C2) / ((μ * μ + ν * ν + C1) * (σ + τ + C2))
