"""Convergence test: whether the mean of the last gradients of a variable differs significantly from zero.

The noise of gradients is independent between iterations. Its standard deviation σ is estimated from the
differences of successive gradients, in which slow changes of the expected gradient cancel. The standard error of the
mean gradient over n iterations is σ / √n. The expected gradient is zero at convergence and nonzero before convergence.
This holds for any step size, so small steps are not mistaken for convergence. An optimiser with momentum may overshoot.
Its gradients then change their sign, and their mean over all iterations may be zero. The means over quarters of the
iterations are therefore tested as well.

A variable also counts as converged if its gradient is small relative to the initial gradient. Near a minimum, the loss
is quadratic, so the remaining distance is proportional to the gradient.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from pathreplay.inverse.loop.checkpoint import Entry
from pathreplay.inverse.parameters.values import Array

MOST_PARTS = 8
"""Largest number of parts of a variable over which gradients are summed for the test."""
SHORTEST = 20
"""Smallest number of iterations that the test needs."""
BLOCKS = (1, 4)
"""Numbers of equal blocks of iterations over which gradients are averaged for the test."""
LEFT = 0.01
"""Fraction of the initial gradient below which a variable counts as converged."""
_FIRST = 5


def parts_of(array: Array, mean: bool = False) -> list[float]:
    """Split an array into up to `MOST_PARTS` contiguous parts, and return the sum of each part, or its ``mean``.

    In a sum, independent noise of the entries averages out, and a common signal adds up. Sums are rounded to six digits
    to keep checkpoints small. Means have nine digits, which distinguish all numbers in single precision. With fewer
    digits, small changes of a large value would be lost.
    """
    flat = np.ravel(array)
    if not flat.size:
        return []
    begins = np.linspace(0, flat.size, min(flat.size, MOST_PARTS) + 1).astype(np.int64)
    digits = 9 if mean else 6
    sums = np.add.reduceat(flat, begins[:-1], dtype=np.float64)
    return [float(f"{x:.{digits}g}") for x in (sums / np.diff(begins) if mean else sums)]


def still_moves(history: Sequence[Entry], key: str, begin: int = 0) -> bool | None:
    """Test whether a variable still moves. Returns None if there are too few iterations since ``begin``.

    Let g be the sum of the gradient over a part of the variable. The test statistic of the part is t = √n mean(g) / σ
    over a block of n iterations, with 2σ² = mean((g_{i+1} - g_i)²). One block contains the last third of the
    iterations, but at least `SHORTEST`, and further blocks divide it (see `BLOCKS`). If gradients are pure noise, the
    mean of t² over m parts of one block is about 1 ± √(2/m). The variable moves if the mean of t² over all parts and
    blocks of equal length exceeds 1 + 7 √(2/m), and the gradient exceeds `LEFT` times the initial gradient. Parts that
    stay constant, e.g. at a bound, are excluded.
    """
    since = history[begin:]
    window = [entry for entry in since[-max(len(since) // 3, SHORTEST) :] if key in entry.slopes]
    first = [entry for entry in since if key in entry.slopes][:_FIRST]
    if len(window) < SHORTEST or len({len(entry.slopes[key]) for entry in (*window, *first)}) > 1:
        return None
    g, x = (np.array([getattr(entry, name)[key] for entry in window]) for name in ("slopes", "means"))
    free = (np.ptp(x, axis=0) > 0) & (np.ptp(g, axis=0) > 0)
    if not free.any():
        return False
    g, initial = g[:, free], np.mean([entry.slopes[key] for entry in first], axis=0)[free]
    σ = np.sqrt(np.mean(np.square(np.diff(g, axis=0)), axis=0) / 2)
    for count in BLOCKS:
        means = np.array([block.mean(axis=0) for block in np.array_split(g, count)])
        t = math.sqrt(len(g) / count) * means / σ
        size = math.sqrt(np.mean(np.sum(np.square(means), axis=1)))
        if np.mean(np.square(t)) > 1 + 7 * math.sqrt(2 / free.sum()) and size > LEFT * np.linalg.norm(initial):
            return True
    return False
