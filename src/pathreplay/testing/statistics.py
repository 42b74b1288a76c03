"""Statistics of small samples: means with standard errors, and differences of means as normal deviates.

Standard errors are estimated from the samples. The ratio of a difference and its error therefore follows Student's
distribution. ``z`` is the normal deviate with the same tail probability as this ratio. The condition |z| < 4 is thus
equally strict for 3 and for 300 seeds. All functions take numbers or arrays; samples are along the first axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

Numbers: TypeAlias = "np.ndarray | float"


class Gap(NamedTuple):
    """A difference of means, its standard error, and its normal deviate."""

    value: Numbers
    error: Numbers
    z: Numbers


def mean_and_error(samples: ArrayLike) -> tuple[Numbers, Numbers]:
    """Return the mean of independent samples and its standard error."""
    samples = np.asarray(samples, np.float64)
    return samples.mean(axis=0), samples.std(axis=0, ddof=1) / np.sqrt(len(samples))


def gap(a: ArrayLike, b: ArrayLike = 0.0) -> Gap:
    """Compare the means of samples of shapes (n, ...) and (m, ...). If ``b`` has no sample axis, ``b`` is exact."""
    a, b = np.asarray(a), np.asarray(b)
    known = b.ndim < a.ndim
    (mean_a, error_a), (mean_b, error_b) = mean_and_error(a), (b, 0) if known else mean_and_error(b)
    difference, σ = mean_a - mean_b, np.hypot(error_a, error_b)
    return Gap(difference, σ, welch(difference, σ, (error_a, len(a)), *([] if known else [(error_b, len(b))])))


def welch(difference: Numbers, σ: Numbers, *parts: tuple[Numbers, int]) -> Numbers:
    """Convert difference/σ to the normal deviate z, for a σ that is partly estimated (Welch-Satterthwaite).

    ``parts`` are the estimated contributions to σ: pairs (standard error, number of samples). All other contributions
    to σ are known exactly.
    """
    difference, σ = np.asarray(difference, np.float64), np.asarray(σ, np.float64)
    freedom = _freedom(σ, parts)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(difference == 0, 0.0, np.abs(difference) / σ)
        z = np.where(freedom < np.inf, normal(t, freedom), t)
    return np.copysign(np.maximum(z, 0), difference)[()]


def welch_limit(z: float, σ: float, *parts: tuple[Numbers, int]) -> float:
    """Return the smallest difference whose normal deviate is at least z > 0: the inverse of `welch`."""
    freedom = float(_freedom(np.asarray(σ, np.float64), parts))
    return σ * (z if freedom == np.inf else float(stats.t.isf(stats.norm.sf(z), freedom)))


def _freedom(σ: np.ndarray, parts: Sequence[tuple[Numbers, int]]) -> np.ndarray:
    """Return the effective degrees of freedom of σ, which are infinite if no part of σ is estimated."""
    noise = np.asarray(sum(np.asarray(error, np.float64) ** 4 / (n - 1) for error, n in parts))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(noise > 0, σ**4 / noise, np.inf)


def normal(t: Numbers, freedom: Numbers) -> Numbers:
    """Return the normal deviate with the same tail probability as a ratio t >= 0 under Student's distribution."""
    return stats.norm.isf(np.maximum(stats.t.sf(t, freedom), 1e-300))
