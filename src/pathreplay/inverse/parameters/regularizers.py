"""Regularizers: terms of the loss that depend on the values of a parameter alone.

Each `Term` maps values v to a number and the gradient of this number with respect to v. The functions
`total_variation`, `l2_to` and `laplacian` compute the same terms from Dr.Jit tensors. A ``regularizer`` of a parameter
can be composed of these functions:

    Parameter(regularizer=lambda v: 0.1 * total_variation(v) + dr.mean(dr.square(v - 0.5), axis=None))
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.sparse
from numpy.typing import ArrayLike, NDArray

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.user_functions import Imported
from pathreplay.inverse.parameters.grids import resampled
from pathreplay.inverse.parameters.neighbours import neighbours
from pathreplay.inverse.parameters.values import Array
from pathreplay.platform.owned_arrays import with_space

ROUND = 1e-3
"""Smoothing length r of total variation, which is quadratic for differences much smaller than r."""

Term = Callable[[Array], tuple[float, NDArray[np.floating]]]
"""Maps values to a term of the loss and its gradient, which has the shape of the values."""


@dataclass(frozen=True)
class Penalty:
    """Sum of the regularizers of a parameter."""

    terms: tuple[Term, ...]

    def of(self, values: Array) -> tuple[float, Array]:
        """Return the penalty and its gradient."""
        penalty, gradient = 0.0, np.zeros(values.shape)
        for term in self.terms:
            more, slope = term(values)
            penalty += more
            gradient += slope
        return penalty, gradient.astype(np.float32)


@dataclass(frozen=True)
class TotalVariation:
    """Total variation w · Σ mean(√(Δv² + r²) - r) of a grid, with weight w.

    The sum is over the spatial axes. The mean is over the differences Δv of all neighbours along an axis. r is `ROUND`.
    """

    weight: float
    wraps: bool = False
    """Whether the first and the last column are neighbours, as in environment maps."""

    def __call__(self, values: Array) -> tuple[float, NDArray[np.floating]]:
        v = values.astype(np.float64)
        penalty, gradient = 0.0, np.zeros_like(v)
        for axis in range(v.ndim - 1):
            periodic = self.wraps and axis == v.ndim - 2
            Δ = np.roll(v, -1, axis) - v if periodic else np.diff(v, axis=axis)
            if Δ.size:
                length = np.sqrt(Δ * Δ + ROUND**2)
                penalty += self.weight * float(np.mean(length - ROUND))
                slope = self.weight * Δ / length / Δ.size
                gradient -= (
                    slope - np.roll(slope, 1, axis) if periodic else np.diff(slope, axis=axis, prepend=0, append=0)
                )
        return penalty, gradient


@dataclass(frozen=True)
class Prior:
    """Penalty w · mean (v - start)² with weight w. For grids, ``start`` is resampled to the resolution of values v."""

    weight: float
    start: Array
    wraps: bool = False
    """See `resampled`."""

    def __call__(self, values: Array) -> tuple[float, NDArray[np.floating]]:
        start = self.start if self.start.shape == values.shape else resampled(self.start, values.shape, self.wraps)
        off = values.astype(np.float64) - start
        return self.weight * float(np.mean(off * off)), self.weight * 2 * off / off.size


class Laplacian:
    """Laplacian penalty w · mean |v - mean of the neighbours of v|² over the vertices v of a mesh.

    The penalty smooths bumps. It is in squared scene units and normalised by the number of vertices. It decreases as
    the mesh is refined, because neighbours are then closer to each other. Vertices with equal initial positions are
    merged into one vertex at their current mean position.

    Args:
        weight: the weight w.
        positions: initial vertex positions, 3 n floats.
        faces: vertex indices, 3 m integers.
    """

    def __init__(self, weight: float, positions: Array, faces: NDArray[np.integer]) -> None:
        places, adjacent = neighbours(positions, faces)
        n, counts = adjacent.shape[0], np.asarray(adjacent.sum(axis=1)).ravel()
        isolated = counts == 0
        away = scipy.sparse.diags((~isolated).astype(float)) - scipy.sparse.diags(1 / np.maximum(counts, 1)) @ adjacent
        indices = np.arange(len(places))
        middle = scipy.sparse.coo_matrix((1 / np.bincount(places, minlength=n)[places], (places, indices))).tocsr()
        self.weight, self._away = weight, (away @ middle).tocsr()

    def __call__(self, values: Array) -> tuple[float, NDArray[np.floating]]:
        δ = self._away @ values.reshape(-1, 3).astype(np.float64)
        gradient = self.weight * 2 / len(δ) * (self._away.T @ δ)
        return self.weight * float(np.sum(δ * δ)) / len(δ), gradient.reshape(values.shape)


@dataclass(frozen=True)
class Own:
    """A user function that maps a tensor of values to one number, differentiated by Dr.Jit.

    The gradient is zero if the result does not depend on the values, e.g. if the function returns a constant 0.
    """

    function: Imported

    def __call__(self, values: Array) -> tuple[float, NDArray[np.floating]]:
        """See `Term`. Raises PathreplayError if the function fails, or its value or gradient is not finite."""
        v = mi.TensorXf(with_space(np.ascontiguousarray(values)))
        dr.enable_grad(v)
        copy = mi.TensorXf(v)  # which the function may modify
        value = self.function(lambda value: mi.TensorXf(value).array, copy)
        if dr.width(value) != 1:
            raise PathreplayError(f"{self.function} returns {dr.width(value)} numbers; return one, such as a mean")
        if dr.grad_enabled(value):
            dr.backward(value)
        penalty, gradient = float(value[0]), np.array(dr.grad(v))
        if not (np.isfinite(penalty) and np.isfinite(gradient).all()):
            raise PathreplayError(
                f"{self.function} is {penalty:g}, and it or its gradient is not finite at the current values; fix it "
                "(e.g. the derivative of a length is infinite at 0), or bound the parameter"
            )
        return penalty, gradient


def total_variation(values: mi.TensorXf) -> mi.TensorXf:
    """Compute the total variation Σ mean(√(Δv² + r²) - r) of a grid, where r is `ROUND`.

    The sum is over the spatial axes. The mean is over the differences Δv of all neighbours along an axis. The first and
    the last column are not neighbours, unlike in the ``total_variation`` of an environment map.

    Args:
        values: a texture (height, width, channels) or a volume (depth, height, width, channels).

    Returns:
        The total variation, differentiable with respect to the values.
    """
    return _differentiable(TotalVariation(1.0), values)


def l2_to(reference: ArrayLike) -> Callable[[mi.TensorXf], mi.TensorXf]:
    """Create the function that computes the mean squared difference from an array.

    Args:
        reference: array in the shape of the values. A grid is resampled to the resolution of the values.

    Returns:
        A differentiable function that maps the values to one number.
    """
    return partial(_differentiable, Prior(1.0, np.array(reference, np.float32)))


def laplacian(positions: ArrayLike, faces: ArrayLike) -> Callable[[mi.TensorXf], mi.TensorXf]:
    """Create the function that computes the mean squared distance of vertices from the mean of their neighbours.

    Args:
        positions: vertex positions, (n, 3) or flat. Vertices at the same position are merged.
        faces: vertex indices of the triangles, (m, 3) or flat.

    Returns:
        A differentiable function that maps vertex positions to one number, in squared scene units.
    """
    vertices, triangles = np.array(positions, np.float32).ravel(), np.array(faces).ravel()
    return partial(_differentiable, Laplacian(1.0, vertices, triangles))


def _differentiable(term: Term, values: mi.TensorXf) -> mi.TensorXf:
    """Evaluate a term as a Dr.Jit tensor that has first derivatives, but no second derivatives."""
    value, slope = term(np.array(dr.detach(values)))
    linear = dr.sum((values - dr.detach(values)) * mi.TensorXf(with_space(slope.astype(np.float32))), axis=None)
    return linear + value
