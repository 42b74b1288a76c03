"""Signal-to-noise ratio of gradients, and the adaptation of samples per pixel to it.

Let a and b be gradients from two independent halves of the samples. The optimiser steps by the mean G = (a + b)/2, and
n = |a - b|/2 estimates the norm of its noise: E[n²] = E|G - E G|², hence E[|G|² - n²] = |E G|². A single iteration says
little (a scalar parameter has one degree of freedom), so the estimates are summed over a window of iterations.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from pathreplay.inverse.config.noise_options import AdaptiveSpp
from pathreplay.inverse.loop.checkpoint import Entry

WINDOW = 16
"""Number of iterations in the window; the ratio of a scalar parameter is then known to about 20 %."""

FAINT = 0.1
"""Ratio below which a parameter is reported; about a hundred steps must be averaged to reach a ratio of 1."""


def ratios(history: Sequence[Entry]) -> dict[str, float]:
    """Compute √(Σ (|G|² - n²) / Σ n²) over the last `WINDOW` iterations, by variable.

    The result is empty unless all of these iterations exist and have equal numbers of samples.
    """
    last = history[-WINDOW:]
    if len(last) < WINDOW or len({entry.spp for entry in last}) > 1:
        return {}
    result = {}
    for key in last[-1].noise_norms:
        if any(key not in entry.noise_norms for entry in last):
            continue
        noise = sum(entry.noise_norms[key] ** 2 for entry in last)
        signal = sum(entry.gradient_norms[key] ** 2 for entry in last) - noise
        if noise > 0 and math.isfinite(signal):
            result[key] = math.sqrt(max(signal, 0.0) / noise)
    return result


def next_spp(auto: AdaptiveSpp, history: Sequence[Entry]) -> int:
    """Return the samples per pixel of the next iteration, which depend on the history alone.

    After every `WINDOW` iterations with equal samples, the number is doubled if a variable is below the target ratio,
    and halved if all are above twice the target (halving the samples at most halves the ratio).
    """
    if not history:
        return auto.min
    spp = min(max(history[-1].spp, auto.min), auto.max)
    streak = next((n for n, entry in enumerate(reversed(history)) if entry.spp != spp), len(history))
    measured = ratios(history) if streak and streak % WINDOW == 0 else {}
    if not measured:
        return spp
    least = min(measured.values())
    if least < auto.target_snr:
        return min(2 * spp, auto.max)
    return max(spp // 2, auto.min) if least > 2 * auto.target_snr else spp
