"""Extracts the surface where a density on a grid crosses a level, as a mesh (surface nets).

A cell is a cube of 2 x 2 x 2 neighbouring voxel centres. Each cell whose corners lie on both sides of the level has one
vertex, the mean of the crossings on its twelve edges. Each edge of the lattice that crosses the level is surrounded by
four such cells, whose vertices form a quadrilateral.
"""

from __future__ import annotations

from itertools import combinations, product
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T", bound=np.generic)

_CORNERS = list(product((0, 1), repeat=3))
_EDGES = [(a, b) for a, b in combinations(range(8), 2) if np.abs(np.subtract(_CORNERS[a], _CORNERS[b])).sum() == 1]


def surface(density: NDArray[np.floating], level: float) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Extract the surface around the part of a grid whose density exceeds a level. The surface is closed.

    Args:
        density: samples at lattice points, shape (z, y, x). The density is 0 beyond the grid.
        level: the level, above 0.

    Returns:
        Vertices (n, 3) as (x, y, z) in units of lattice points of the grid, and triangles (m, 3), counter-clockwise
        seen from lower densities. Both are empty if nothing exceeds the level.
    """
    values = np.pad(density.astype(np.float64), 1) - level
    inside = values > 0
    cells = tuple(n - 1 for n in values.shape)

    def corner(array: NDArray[T], at: tuple[int, ...]) -> NDArray[T]:
        return array[tuple(slice(o, o + n) for o, n in zip(at, cells, strict=True))]

    count = np.sum([corner(inside, at) for at in _CORNERS], axis=0)
    mixed = (count > 0) & (count < 8)
    where = np.argwhere(mixed)
    number = np.full(cells, -1, np.int64)
    number[mixed] = np.arange(len(where))
    at_corners = np.stack([corner(values, at)[mixed] for at in _CORNERS], axis=1)
    vertices = where + _means_of_crossings(at_corners)
    triangles = [_quads(inside, number, axis) for axis in range(3)]
    return (vertices - 1)[:, ::-1], np.concatenate(triangles)


def _means_of_crossings(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean of the crossings on the edges of each cell, relative to the first corner of the cell.

    ``values`` are the values at the corners of the cells, minus the level.
    """
    total, count = np.zeros((len(values), 3)), np.zeros((len(values), 1))
    for a, b in _EDGES:
        va, vb = values[:, a], values[:, b]
        crosses = (va > 0) != (vb > 0)
        f = np.divide(va, va - vb, out=np.zeros_like(va), where=crosses)[:, None]
        point = np.array(_CORNERS[a]) * (1 - f) + np.array(_CORNERS[b]) * f
        total += np.where(crosses[:, None], point, 0)
        count += crosses[:, None]
    return total / np.maximum(count, 1)


def _quads(inside: NDArray[np.bool_], number: NDArray[np.int64], axis: int) -> NDArray[np.int64]:
    """Return two triangles for each lattice edge that is parallel to ``axis`` and crosses the level."""
    first = np.take(inside, range(inside.shape[axis] - 1), axis)
    second = np.take(inside, range(1, inside.shape[axis]), axis)
    at = np.argwhere(first != second)  # the padding keeps these edges away from the border
    u, v = (axis + 1) % 3, (axis + 2) % 3
    around = []
    for du, dv in ((0, 0), (-1, 0), (-1, -1), (0, -1)):
        cell = at.copy()
        cell[:, u] += du
        cell[:, v] += dv
        around.append(number[tuple(cell.T)])
    quad = np.stack(around, axis=1)
    # In world space, seen from the positive end of the axis, the four cells are in clockwise order, because the array
    # order (z, y, x) is a mirror image of (x, y, z). If the density falls along the axis, the order is reversed.
    falls = first[tuple(at.T)]
    quad[falls] = quad[falls][:, ::-1]
    return np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])
