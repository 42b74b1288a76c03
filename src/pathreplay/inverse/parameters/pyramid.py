"""Laplacian pyramid of a grid: the optimiser steps the levels, and the grid is the sum of their interpolations.

Let u_j be the entries of level j, and U_j the interpolation from level j to the resolution of the grid. The grid is

    v = Σ_j U_j u_j,        so that        ∂/∂u_j = U_jᵀ ∂/∂v.

An optimiser such as Adam normalises each entry by its own moments. If Adam steps the levels of a pyramid, the coarse
levels change low frequencies as fast as a coarse grid would. The gradient noise of a coarse level is also as low as
that of a coarse grid. Grid entries whose gradient is zero change along with their neighbours, because both depend on
the coarse levels (Weier et al. 2025).

A given v does not determine the levels. Before each step, v is assigned to the finest level, and all other levels are
set to zero. This choice does not matter, because the step depends on gradients only. The levels are discarded after the
step.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import prod

import numpy as np

from pathreplay.inverse.parameters.grids import interpolated
from pathreplay.inverse.parameters.reparameterization import Coordinates, Transform
from pathreplay.inverse.parameters.values import Array

Shape = tuple[int, ...]


class Pyramid(Coordinates):
    """Coordinates (`Coordinates`) of a grid: the levels of a pyramid, coarsest first, in one flat array.

    Each level has half as many entries along each axis as the next finer level, rounded up. The coarsest level has one
    entry per channel.

    Args:
        shapes: all shapes that the grid may have, with the channels last.
        wraps: whether the x axis (the one before the channels) is periodic, as in environment maps.
        inner: coordinates of the entries, such as logarithms. The pyramid then represents the latent variables.
    """

    def __init__(self, shapes: Sequence[Shape], wraps: bool, inner: Transform | None = None) -> None:
        self._wraps, self.inner = wraps, inner
        self._levels = {sum(map(prod, levels)): levels for levels in map(_levels, shapes)}

    def latent(self, values: Array) -> Array:
        """See `Coordinates`; all levels but the finest are zero."""
        entries = values if self.inner is None else self.inner.latent(values)
        latent = np.zeros(sum(map(prod, _levels(values.shape))), np.float32)
        latent[latent.size - entries.size :] = entries.ravel()
        return latent

    def gradient(self, values: Array, by_values: Array) -> Array:
        level = by_values if self.inner is None else self.inner.gradient(values, by_values)
        parts = [level.ravel()]
        for coarse in reversed(_levels(values.shape)[:-1]):
            level = interpolated(level, coarse, self._wraps, transposed=True)
            parts.append(level.ravel())
        return np.concatenate(parts[::-1])

    def values(self, latent: Array) -> Array:
        first, *finer = self._levels[latent.size]
        end = prod(first)
        level = latent[:end].reshape(first)
        for shape in finer:
            begin, end = end, end + prod(shape)
            level = interpolated(level, shape, self._wraps) + latent[begin:end].reshape(shape)
        return level if self.inner is None else self.inner.values(level)


def _levels(shape: Shape) -> list[Shape]:
    """Return the shapes of all levels, coarsest first."""
    *axes, channels = shape
    levels = [shape]
    while max(axes) > 1:
        axes = [-(-n // 2) for n in axes]
        levels.insert(0, (*axes, channels))
    return levels
