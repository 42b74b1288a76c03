"""Medians, ratios with intervals, and the exponent of a growth law."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import bootstrap

from .job import Point

# Enough that the ends of a 95 % interval move by less than the last digit that the tables print.
RESAMPLES = 4000


@dataclass(frozen=True)
class Estimate:
    """A value with a 95 % interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.2f} [{self.low:.2f}, {self.high:.2f}]"


def interval(statistic: Callable[..., np.ndarray], *samples: Sequence[float] | np.ndarray, paired: bool) -> Estimate:
    """Return a statistic with its bootstrap interval. If ``paired``, all samples are resampled at the same indices."""
    found = bootstrap(
        samples, statistic, paired=paired, n_resamples=RESAMPLES, method="percentile", vectorized=True, random_state=0
    ).confidence_interval
    return Estimate(float(statistic(*map(np.asarray, samples), axis=-1)), float(found.low), float(found.high))


def mean_ratio(ours: Sequence[float], theirs: Sequence[float]) -> Estimate:
    """Return the ratio of the means of samples from the same rounds."""
    return interval(lambda a, b, axis: a.mean(axis) / b.mean(axis), ours, theirs, paired=True)


def unpaired_ratio(
    above: Sequence[float] | np.ndarray, below: Sequence[float] | np.ndarray, centre: Callable[..., np.ndarray]
) -> Estimate:
    """Return the ratio of the medians (or means) of samples that were not taken in the same rounds."""
    return interval(lambda a, b, axis: centre(a, axis=axis) / centre(b, axis=axis), above, below, paired=False)


@dataclass(frozen=True)
class Versus:
    """A method relative to a baseline that was measured in alternation with it."""

    ours: Point
    baseline: Point

    def time(self) -> Estimate:
        """Return the median over rounds of our seconds / the baseline's seconds in the same round."""
        return interval(np.median, np.divide(self.ours.seconds, self.baseline.seconds), paired=True)

    def variance(self) -> Estimate:
        """Return the ratio of the mean squared errors."""
        return mean_ratio(self.ours.squared_errors, self.baseline.squared_errors)

    def cost(self) -> Estimate:
        """Return time ratio x variance ratio, the time ratio at equal variance."""

        def cost(times: np.ndarray, a: np.ndarray, b: np.ndarray, axis: int) -> np.ndarray:
            return np.median(times, axis) * a.mean(axis) / b.mean(axis)

        times = np.divide(self.ours.seconds, self.baseline.seconds)
        return interval(cost, times, self.ours.squared_errors, self.baseline.squared_errors, paired=True)

    def efficiency(self) -> Estimate:
        """Return (time x variance) of the baseline over (time x variance) of our method.

        Uses sums over all rounds instead of medians, so that a method that learns is charged for its first passes.
        """

        def gain(t: np.ndarray, a: np.ndarray, u: np.ndarray, b: np.ndarray, axis: int) -> np.ndarray:
            return (u.sum(axis) * b.sum(axis)) / (t.sum(axis) * a.sum(axis))

        return interval(
            gain, *(s for p in (self.ours, self.baseline) for s in (p.seconds, p.squared_errors)), paired=True
        )


def bias_share(bias_products: Sequence[float], squared_errors: Sequence[float]) -> Estimate:
    """Return |bias|² / variance of one pass. The inverse is the number of passes after which bias exceeds noise.

    The interval is +- 1.96 standard errors of a U-statistic of order two (2 s / sqrt(n)). It is too wide where there is
    no bias.
    """
    products, variance = np.asarray(bias_products), float(np.mean(squared_errors))
    value = float(products.mean()) / variance
    half = 1.96 * 2 * float(products.std(ddof=1)) / np.sqrt(len(products)) / variance
    return Estimate(value, value - half, value + half)


def growth(sizes: Sequence[float], seconds: Sequence[float]) -> Estimate:
    """Fit  seconds = a + b sizes^p,  a, b >= 0, and return the exponent p with +- 1.96 standard errors.

    The fit minimises the squares of the differences of logarithms. The offset a is the cost of tracing and launching
    the kernel, which does not depend on path length. Separating both terms requires at least five sizes.
    """
    n, t = np.asarray(sizes, dtype=float), np.asarray(seconds, dtype=float)
    if len(n) < 5:
        raise ValueError(f"{len(n)} sizes are too few for an exponent: use at least 5")
    n = n / n[-1]

    def residual(x: np.ndarray) -> np.ndarray:
        return np.log(x[0] + x[1] * n ** x[2]) - np.log(t)

    bounds = ([0, 0, 0.1], [t[0], np.inf, 4])
    fit = least_squares(residual, (0.5 * t[0], t[-1], 1.0), bounds=bounds, x_scale=(t[0], t[-1], 1.0), xtol=1e-12)
    covariance = np.linalg.pinv(fit.jac.T @ fit.jac) * (2 * fit.cost / (len(n) - 3))
    p, spread = float(fit.x[2]), 1.96 * float(np.sqrt(covariance[2, 2]))
    return Estimate(p, p - spread, p + spread)
