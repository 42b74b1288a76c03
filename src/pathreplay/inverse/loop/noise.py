"""Signal-to-noise ratio of gradients, and the adaptation of samples per pixel to this ratio.

Let a and b be gradients from two independent halves of the samples. The optimiser uses the mean G = (a + b)/2. The norm
of the noise of G is estimated by n = |a - b|/2, because E[n²] = E|G - E G|². The squared signal follows from
E[|G|² - n²] = |E G|². Estimates from a single iteration are imprecise, in particular for scalar parameters with their
single degree of freedom. The estimates are therefore summed over a window of iterations.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from pathreplay.inverse.config.noise_options import AdaptiveSpp
from pathreplay.inverse.loop.checkpoint import Entry

WINDOW = 16
"""Number of iterations in the window. For a scalar parameter, the error of the ratio is then about 20 %."""

FAINT = 0.1
"""Ratio below which a parameter is reported. About a hundred such gradients must be averaged to reach a ratio of 1."""


def ratios(history: Sequence[Entry]) -> dict[str, float]:
    """Compute the signal-to-noise ratio √(Σ (|G|² - n²) / Σ n²) over the last `WINDOW` iterations, by variable.

    The result is empty if there are fewer iterations, or if their numbers of samples per pixel differ.
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

    The number of samples can change only after it has been constant for a multiple of `WINDOW` iterations. The number
    is doubled if the signal-to-noise ratio of at least one variable is below the target. It is halved if the
    ratios of all variables are above twice the target. Half the samples give at least half the ratio, so the ratios
    then stay above the target.
    """
    if not history:
        return auto.min
    spp = min(max(history[-1].spp, auto.min), auto.max)
    spp = 1 << (spp.bit_length() - 1)  # a stage with its own number may precede
    streak = next((n for n, entry in enumerate(reversed(history)) if entry.spp != spp), len(history))
    measured = ratios(history) if streak and streak % WINDOW == 0 else {}
    if not measured:
        return spp
    least = min(measured.values())
    if least < auto.target_snr:
        return min(2 * spp, auto.max)
    return max(spp // 2, auto.min) if least > 2 * auto.target_snr else spp
