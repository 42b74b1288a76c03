"""How much of a gradient is signal: from two halves of its samples, over the last iterations; and what it takes.

Of halves a and b, each the gradient by half of the samples, the mean G = (a + b)/2 is stepped by, and n = |a - b|/2 is
the length of its noise: E[n²] = E|G - E G|², and so E[|G|² - n²] = |E G|². Of single iterations that says next to
nothing (of a parameter of one number it has one degree of freedom); sums over a window do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from pathreplay.inverse.config.noise_options import AdaptiveSpp
from pathreplay.inverse.loop.checkpoint import Entry

WINDOW = 16
"""Iterations that are looked at together: the ratio of one number is then known to about a fifth."""

FAINT = 0.1
"""Below this ratio, which a hundred steps would have to be averaged to make up for, a parameter is told of."""


def ratios(history: Sequence[Entry]) -> dict[str, float]:
    """√(Σ (|G|² - n²) / Σ n²) by variable, over the last `WINDOW` iterations, if all had as many samples; else none."""
    last = history[-WINDOW:]
    if len(last) < WINDOW or len({entry.spp for entry in last}) > 1:
        return {}
    found = {}
    for key in last[-1].noise_norms:
        if any(key not in entry.noise_norms for entry in last):
            continue
        noise = sum(entry.noise_norms[key] ** 2 for entry in last)
        signal = sum(entry.gradient_norms[key] ** 2 for entry in last) - noise
        if noise > 0 and math.isfinite(signal):
            found[key] = math.sqrt(max(signal, 0.0) / noise)
    return found


def next_spp(auto: AdaptiveSpp, history: Sequence[Entry]) -> int:
    """Samples per pixel of the next iteration: a function of the history alone.

    After every `WINDOW` iterations with as many: twice, where a variable has less than the wanted ratio; half, where
    all have more than twice of it (half the samples cost the ratio a half at most).
    """
    if not history:
        return auto.min
    spp = min(max(history[-1].spp, auto.min), auto.max)
    row = next((n for n, entry in enumerate(reversed(history)) if entry.spp != spp), len(history))
    found = ratios(history) if row and row % WINDOW == 0 else {}
    if not found:
        return spp
    least = min(found.values())
    if least < auto.target_snr:
        return min(2 * spp, auto.max)
    return max(spp // 2, auto.min) if least > 2 * auto.target_snr else spp
