"""Whether values still move at the end of a run: do the last gradients point somewhere, beyond their noise?

The noise of a gradient is new in each iteration, so that its mean over a window is known to a √window-th of its
scatter. Values that have arrived have a mean of zero; those that are on their way have not, however small the steps
have become. Where little is left of the gradient that a run began with, little is left of the way: a loss is a parabola
close to its end.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from pathreplay.inverse.loop.checkpoint import Entry
from pathreplay.inverse.parameters.values import Array

MOST_PARTS = 8
"""Of a variable, whose gradients are kept for this."""
SHORTEST = 20
"""Iterations without which nothing can be said."""
LEFT = 0.01
"""Of the first gradient: less is no way that is left."""
_FIRST = 5


def parts_of(array: Array, mean: bool = False) -> list[float]:
    """Sums over up to `MOST_PARTS` parts of an array, one after the other; or means. To six digits: a file keeps them.

    The noise of neighbours averages out in sums, and what they have in common adds up.
    """
    flat = np.ravel(array)
    if not flat.size:
        return []
    begins = np.linspace(0, flat.size, min(flat.size, MOST_PARTS) + 1).astype(np.int64)
    sums = np.add.reduceat(flat, begins[:-1], dtype=np.float64)
    return [float(f"{x:.6g}") for x in (sums / np.diff(begins) if mean else sums)]


def window_of(history: Sequence[Entry], begin: int = 0) -> Sequence[Entry]:
    """The last third of the iterations from ``begin`` on, or `SHORTEST` of them; empty where there are fewer."""
    found = len(history) - begin
    return history[-max(found // 3, SHORTEST) :] if found >= SHORTEST else ()


def still_moves(history: Sequence[Entry], key: str, begin: int = 0) -> bool | None:
    """Whether a variable still moves; None where too few iterations since ``begin`` say something of it.

    Of g, the sum of its gradient over each part, t = √n mean(g) / deviation(g) over the window. The mean of t² over m
    parts is about 1, give or take √(2/m), where there is nothing but noise. Parts that stand still, such as those held
    by a bound, are left out.
    """
    window = [entry for entry in window_of(history, begin) if key in entry.slopes]
    first = [entry for entry in history[begin:] if key in entry.slopes][:_FIRST]
    if len(window) < SHORTEST or len({len(entry.slopes[key]) for entry in (*window, *first)}) > 1:
        return None
    g, x = (np.array([getattr(entry, name)[key] for entry in window]) for name in ("slopes", "means"))
    free = (np.ptp(x, axis=0) > 0) & (np.ptp(g, axis=0) > 0)
    if not free.any():
        return False
    mean = g.mean(axis=0)
    t = math.sqrt(len(g)) * mean[free] / g.std(axis=0, ddof=1)[free]
    points = np.mean(np.square(t)) > 1 + 7 * math.sqrt(2 / free.sum())
    before = np.mean([entry.slopes[key] for entry in first], axis=0)
    return bool(points and np.linalg.norm(mean[free]) > LEFT * np.linalg.norm(before[free]))
