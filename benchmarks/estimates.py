"""Medians, ratios with intervals, and the exponent of a growth law."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

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


def time_ratio(ours: Sequence[float], theirs: Sequence[float]) -> Estimate:
    """Median over rounds of (our seconds) / (their seconds of the same round); bootstrap over rounds."""
    ratios = np.asarray(ours) / np.asarray(theirs)
    return _bootstrap(len(ratios), lambda rounds: np.median(ratios[rounds], axis=-1))


def variance_ratio(ours: Sequence[float], theirs: Sequence[float]) -> Estimate:
    """Ratio of the means of squared errors; bootstrap over seeds, the same ones on both sides."""
    a, b = np.asarray(ours), np.asarray(theirs)
    return _bootstrap(len(a), lambda seeds: a[seeds].mean(axis=-1) / b[seeds].mean(axis=-1))


def cost_ratio(
    seconds: tuple[Sequence[float], Sequence[float]], squared_errors: tuple[Sequence[float], Sequence[float]]
) -> Estimate:
    """Time ratio x variance ratio: the time for equal variance. Each is (ours, theirs); bootstrap over rounds."""
    times = np.asarray(seconds[0]) / np.asarray(seconds[1])
    a, b = map(np.asarray, squared_errors)
    return _bootstrap(len(times), lambda k: np.median(times[k], axis=-1) * a[k].mean(axis=-1) / b[k].mean(axis=-1))


def efficiency(
    seconds: tuple[Sequence[float], Sequence[float]], squared_errors: tuple[Sequence[float], Sequence[float]]
) -> Estimate:
    """How many times less (time x variance) we need than they do. Each is (ours, theirs); bootstrap over rounds.

    Sums over all rounds on both sides, not medians: a method that learns pays for its first passes.
    """
    t, u, a, b = map(np.asarray, (*seconds, *squared_errors))
    return _bootstrap(len(t), lambda k: (u[k].sum(-1) * b[k].sum(-1)) / (t[k].sum(-1) * a[k].sum(-1)))


def unpaired_ratio(above: Sequence[float], below: Sequence[float], centre: Callable[..., np.ndarray]) -> Estimate:
    """Ratio of the medians (or means) of samples that were not taken in the same rounds; bootstrap of both."""
    a, b = np.asarray(above), np.asarray(below)
    random = np.random.default_rng(0)
    top = centre(a[random.integers(len(a), size=(RESAMPLES, len(a)))], axis=-1)
    bottom = centre(b[random.integers(len(b), size=(RESAMPLES, len(b)))], axis=-1)
    low, high = np.quantile(top / bottom, [0.025, 0.975])
    return Estimate(float(centre(a) / centre(b)), float(low), float(high))


def bias_share(bias_products: Sequence[float], squared_errors: Sequence[float]) -> Estimate:
    """|bias|² over the variance of one pass: its inverse is how many passes it takes until bias outweighs noise.

    +- 1.96 standard errors of a U-statistic of order two (2 s / sqrt(n)), which are too wide where there is no bias.
    """
    products, variance = np.asarray(bias_products), float(np.mean(squared_errors))
    value = float(products.mean()) / variance
    half = 1.96 * 2 * float(products.std(ddof=1)) / np.sqrt(len(products)) / variance
    return Estimate(value, value - half, value + half)


def _bootstrap(count: int, statistic: Callable[[np.ndarray], np.ndarray]) -> Estimate:
    draws = np.random.default_rng(0).integers(count, size=(RESAMPLES, count))
    low, high = np.quantile(statistic(draws), [0.025, 0.975])
    return Estimate(float(statistic(np.arange(count)[None])[0]), float(low), float(high))


def growth(sizes: Sequence[float], seconds: Sequence[float]) -> Estimate:
    """Exponent p of  seconds = a + b sizes^p,  a, b >= 0: least squares of the logarithms, +- 1.96 standard errors.

    The offset a is what a pass costs however short its paths are: tracing and launching the kernel. It takes at least
    five sizes to tell the two apart.
    """
    from scipy.optimize import least_squares

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
