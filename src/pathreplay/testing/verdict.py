"""The verdict on a gradient, computed from two sets of independent samples.

The inputs are n samples of the gradient under test and n samples of the reference, all from independent seeds. For each
seed, the reference consists of two finite differences, D(h) and D(h/2), with the steps h and h/2. A finite difference
has an error of O(h²). The Richardson extrapolation (4 D(h/2) - D(h)) / 3 removes this error term. The change from D(h)
to D(h/2), as far as it exceeds the noise, bounds the remaining error. This bound, combined with the rounding error of
the reference, is step_error.

    σ² = se(gradient)² + se(reference)² + step_error² + summation²,      z = (mean gradient - mean reference) / σ

Here summation, the error of float32 sums, is `SUMMATION` times the larger absolute value of the two means.

``z`` is converted to a normal deviate, independent of the number of samples: see :mod:`pathreplay.testing.statistics`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pathreplay.testing.statistics import mean_and_error, welch, welch_limit

Verdict = Literal["pass", "zero", "fail", "inconclusive"]

Z_LIMIT = 4.0
"""A correct gradient exceeds this |z| once in 16 000 checks, so that hundreds of checks rarely raise a false alarm."""

RESOLUTION = 0.1
"""Largest σ, as a fraction of the larger of the two means, at which agreement is meaningful."""

NEGLIGIBLE = 1e-3
"""A gradient counts as zero if moving the parameter by its own size changes the objective by less than this fraction.
"""

SUMMATION = 1e-4
"""Relative error allowed for a float32 gradient: sums of 10⁶ atomic additions round by about 10³ · 2⁻²⁴ = 6e-5."""


@dataclass(frozen=True)
class Judgement:
    """The result of the comparison of a gradient with finite differences.

    All numbers except z and resolution are derivatives of the objective along the checked direction, or their errors.
    """

    gradient: float
    gradient_se: float
    reference: float
    reference_se: float
    step_error: float
    """Bound on the systematic error of the reference: rounding, and truncation as far as it exceeds the noise."""
    z: float
    resolution: float
    """σ / max(|gradient|, |reference|); infinite if both are zero."""
    verdict: Verdict
    reason: str


def judge(
    gradient: np.ndarray, full_step: np.ndarray, half_step: np.ndarray, *, rounding: float = 0, negligible: float = 0
) -> Judgement:
    """Compare n gradient samples with n finite differences of step h and n finite differences of step h/2.

    All arrays have the shape (n,), with n >= 2. The finite differences of both steps have the same seeds.
    ``rounding`` bounds the error of floating-point arithmetic in the reference. ``negligible`` is the size below which
    a derivative counts as zero.

    The gradient *fails* if |z| >= 4 or if it is not finite. Otherwise it *passes* if σ is at most a tenth of the
    larger mean, and the means differ by at most four tenths of it: with few samples, |z| may be below 4 although they
    differ by many σ. Otherwise it passes as *zero* if both means are within 4 σ of zero and 4 σ is at most
    ``negligible``. Otherwise the noise is too large and the check is *inconclusive*.
    """
    with np.errstate(invalid="ignore"):  # samples that are NaN or infinite are handled below
        reference = (4 * half_step - full_step) / 3
        # The error of D(h/2) is a third of the change caused by halving the step. This error is a conservative bound
        # for the extrapolation, which is more accurate.
        change, change_se = mean_and_error((half_step - full_step) / 3)
        g, g_se, r, r_se = map(float, (*mean_and_error(gradient), *mean_and_error(reference)))
    truncation = math.sqrt(max(0.0, change**2 - change_se**2))
    scale, step_error = max(abs(g), abs(r)), math.hypot(truncation, rounding)
    known = Judgement(g, g_se, r, r_se, step_error, math.nan, math.inf, "inconclusive", "")
    if not np.isfinite(gradient).all():
        bad = int(np.count_nonzero(~np.isfinite(gradient)))
        return replace(known, verdict="fail", reason=f"{bad} of {gradient.size} gradient samples are NaN or infinite")
    if not (np.isfinite(full_step).all() and np.isfinite(half_step).all()):
        return replace(known, reason="the reference is NaN or infinite: look at the image, or choose a smaller step")

    σ = math.sqrt(g_se**2 + r_se**2 + step_error**2 + (SUMMATION * scale) ** 2)
    parts = (g_se, gradient.size), (r_se, reference.size)
    z = float(welch(g - r, σ, *parts))
    resolution = σ / scale if scale > 0 else math.inf
    verdict: Verdict
    if abs(z) >= Z_LIMIT:
        ratio = "differs from a reference of zero" if r == 0 else f"differs: {g / r:.4g} times the reference"
        verdict, reason = "fail", ratio
    elif resolution <= RESOLUTION and abs(g - r) > Z_LIMIT * RESOLUTION * scale:
        verdict, reason = "inconclusive", f"{gradient.size} seeds are too few for this difference; use more --seeds"
    elif resolution <= RESOLUTION:
        least = min(welch_limit(Z_LIMIT, σ, *parts) / scale, Z_LIMIT * RESOLUTION)
        verdict, reason = "pass", f"agrees; an error above {100 * least:.2g} % would have shown"
    elif scale <= Z_LIMIT * σ <= negligible or scale == σ == 0:
        verdict, reason = "zero", f"both are zero to within {Z_LIMIT * σ:.1g}, which is negligible in the image"
    else:
        verdict, reason = "inconclusive", _unresolved(resolution, step_error, σ)
    return replace(known, z=z, resolution=resolution, verdict=verdict, reason=reason)


def _unresolved(resolution: float, step_error: float, σ: float) -> str:
    if step_error > 0.5 * σ:
        return "the finite differences depend on the step; change --step"
    if not math.isfinite(resolution):
        return "nothing was resolved; use more --spp or --seeds"
    # The factor 2 is a margin, because the noise and the size of the gradient are themselves uncertain.
    factor = 2 * (resolution / RESOLUTION) ** 2
    if factor > 1000:
        return "the noise hides everything; use another direction or objective, or very many more samples"
    return f"the noise hides it; use about {math.ceil(factor)} times the --seeds or --spp"
