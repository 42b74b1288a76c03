"""What a job adds to the loss for values alone: of textures and volumes, of meshes, of anything by a user's function.

Each is a function of the values v, as people see them, that gives a number and its derivative by v.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.user_functions import Imported
from pathreplay.inverse.parameters.grids import resampled
from pathreplay.inverse.parameters.neighbours import neighbours
from pathreplay.inverse.parameters.values import Array

ROUND = 1e-3
"""Differences of neighbours below which total variation is a parabola."""

Term = Callable[[Array], tuple[float, NDArray[np.floating]]]
"""Of values: what is added to the loss, and its derivative, in their shape."""


@dataclass(frozen=True)
class Penalty:
    """The sum of its terms."""

    terms: tuple[Term, ...]

    def of(self, values: Array) -> tuple[float, Array]:
        """The penalty of values, and its gradient."""
        penalty, gradient = 0.0, np.zeros(values.shape)
        for term in self.terms:
            more, slope = term(values)
            penalty += more
            gradient += slope
        return penalty, gradient.astype(np.float32)


@dataclass(frozen=True)
class TotalVariation:
    """w · mean √(Δv² + r²) - r, with all differences Δv of neighbours along an axis of a grid.

    r is `ROUND`. The last axis, the channels, is none of them.
    """

    weight: float

    def __call__(self, values: Array) -> tuple[float, NDArray[np.floating]]:
        """See `Term`."""
        v = values.astype(np.float64)
        penalty, gradient = 0.0, np.zeros_like(v)
        for axis in range(v.ndim - 1):
            Δ = np.diff(v, axis=axis)
            if Δ.size:
                length = np.sqrt(Δ * Δ + ROUND**2)
                penalty += self.weight * float(np.mean(length - ROUND))
                slope = self.weight * Δ / length / Δ.size
                gradient += np.pad(slope, _ends(v.ndim, axis, 1, 0)) - np.pad(slope, _ends(v.ndim, axis, 0, 1))
        return penalty, gradient


@dataclass(frozen=True)
class Prior:
    """w · mean (v - start)²; the start of a grid in another resolution is interpolated."""

    weight: float
    start: Array

    def __call__(self, values: Array) -> tuple[float, NDArray[np.floating]]:
        """See `Term`."""
        start = self.start if self.start.shape == values.shape else resampled(self.start, values.shape)
        off = values.astype(np.float64) - start
        return self.weight * float(np.mean(off * off)), self.weight * 2 * off / off.size


class Laplacian:
    """w · mean |v - mean of its neighbours|² over the vertices v of a mesh, so that its surface has no bumps.

    In squared units of the scene, whatever the mesh is; the finer it is, the less there is of it. Vertices that were in
    one place at first count as one, in the middle of where they are now.
    """

    def __init__(self, weight: float, positions: Array, faces: NDArray[np.integer]) -> None:
        places, adjacent = neighbours(positions, faces)
        n, counts = adjacent.shape[0], np.asarray(adjacent.sum(axis=1)).ravel()
        alone = counts == 0
        away = scipy.sparse.diags((~alone).astype(float)) - scipy.sparse.diags(1 / np.maximum(counts, 1)) @ adjacent
        each = np.arange(len(places))
        middle = scipy.sparse.coo_matrix((1 / np.bincount(places, minlength=n)[places], (places, each))).tocsr()
        self.weight, self._away = weight, (away @ middle).tocsr()

    def __call__(self, values: Array) -> tuple[float, NDArray[np.floating]]:
        """See `Term`."""
        δ = self._away @ values.reshape(-1, 3).astype(np.float64)
        gradient = self.weight * 2 / len(δ) * (self._away.T @ δ)
        return self.weight * float(np.sum(δ * δ)) / len(δ), gradient.reshape(values.shape)


@dataclass(frozen=True)
class Own:
    """A user's function of the values, a tensor in their shape, to one number; its derivative is Dr.Jit's.

    Where that does not depend on them, as a plain 0 where nothing is wrong, it is zero.
    """

    function: Imported

    def __call__(self, values: Array) -> tuple[float, NDArray[np.floating]]:
        """See `Term`. Raises PathreplayError for what is no number."""
        v: Any = mi.TensorXf(np.ascontiguousarray(values))
        dr.enable_grad(v)
        value = self.function(_flat, mi.TensorXf(v))  # which it may change
        if dr.width(value) != 1:
            raise PathreplayError(f"{self.function} gives {dr.width(value)} numbers; return one, such as a mean")
        if dr.grad_enabled(value):
            dr.backward(value)
        found, gradient = float(value[0]), np.array(dr.grad(v))
        if not (np.isfinite(found) and np.isfinite(gradient).all()):
            raise PathreplayError(
                f"{self.function} is {found:g}, or has a derivative that is no finite number, where its parameter is "
                "now; mend it (lengths have no derivative at 0), or bound the parameter"
            )
        return found, gradient


def _flat(value: Any) -> Any:
    return mi.TensorXf(value).array


def _ends(axes: int, axis: int, before: int, after: int) -> list[tuple[int, int]]:
    return [(before, after) if k == axis else (0, 0) for k in range(axes)]
