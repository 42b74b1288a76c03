"""What a job adds to the loss for values alone: total variation of textures and volumes, a pull to the start."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pathreplay.inverse.grids import resampled
from pathreplay.inverse.values import Array

ROUND = 1e-3
"""Differences of neighbours below which total variation is a parabola."""


@dataclass(frozen=True)
class Penalty:
    """w_TV · mean √(Δv² + r²) - r  +  w_prior · mean (v - start)², with all differences Δv of neighbours along an axis.

    r is `ROUND`. Axes are those of a grid; its last one, the channels, is none of them.
    """

    total_variation: float
    prior: float
    start: Array

    def of(self, values: Array) -> tuple[float, Array]:
        """The penalty of values, and its gradient."""
        v = values.astype(np.float64)
        penalty, gradient = 0.0, np.zeros_like(v)
        if self.total_variation:
            for axis in range(v.ndim - 1):
                Δ = np.diff(v, axis=axis)
                if Δ.size:
                    length = np.sqrt(Δ * Δ + ROUND**2)
                    penalty += self.total_variation * float(np.mean(length - ROUND))
                    slope = self.total_variation * Δ / length / Δ.size
                    gradient += np.pad(slope, _ends(v.ndim, axis, 1, 0)) - np.pad(slope, _ends(v.ndim, axis, 0, 1))
        if self.prior:
            off = v - (self.start if self.start.shape == v.shape else resampled(self.start, v.shape))
            penalty += self.prior * float(np.mean(off * off))
            gradient += self.prior * 2 * off / off.size
        return penalty, gradient.astype(np.float32)


def _ends(axes: int, axis: int, before: int, after: int) -> list[tuple[int, int]]:
    return [(before, after) if k == axis else (0, 0) for k in range(axes)]
