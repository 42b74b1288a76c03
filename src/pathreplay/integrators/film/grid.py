"""A grid of nodes on the film: averages of values that probe rays measure, and their interpolation between nodes.

A node averages the values x of the probe rays with the weights K w, where w is given with the values, and

    K = max(1 - (r / REACH)², 0)² / (r² + NEAR²)²

depends on the distance r between probe ray and node on the film.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import TypeVar

import drjit as dr
import mitsuba as mi

PROBES, CELLS = 32, 16
"""Number of probe rays and number of grid cells per row and column of the film."""
MARGIN = 2
"""Number of nodes outside each border of the film, where filters still have support."""
NODES = CELLS + 1 + 2 * MARGIN
"""Number of nodes per row and column."""
REACH, NEAR, WIDE = 0.25, 0.03, 0.5
"""In film widths."""

Value = TypeVar("Value", "mi.Float", "mi.Vector2f")


def probe_position(i: mi.UInt32) -> mi.Point2f:
    """Return the film position of a probe ray by its index. The rays form a regular grid, row by row."""
    return (mi.Point2f(i % PROBES, i // PROBES) + 0.5) / PROBES


def peaked(r2: mi.Float) -> mi.Float:
    """Return K for the squared distance ``r2``: see the module."""
    return dr.square(dr.maximum(1 - r2 / REACH**2, 0) / (r2 + NEAR**2))


def wide(r2: mi.Float) -> mi.Float:
    """Return a kernel without a peak, which reaches further: max(1 - (r / WIDE)², 0)²."""
    return dr.square(dr.maximum(1 - r2 / WIDE**2, 0))


@dataclass(frozen=True)
class NodeSums:
    """Sums over all probe rays, for each node, with the weights K w."""

    K: mi.Float  # K w, for each pair of a node and a probe ray
    i: mi.UInt32  # probe ray of each pair

    @staticmethod
    def of(weights: mi.Float, kernel: Callable[[mi.Float], mi.Float] = peaked) -> NodeSums:
        """Compute the weights; ``weights`` are the w of the probe rays, and ``kernel`` computes K from r²."""
        index = dr.arange(mi.UInt32, NODES * NODES * PROBES * PROBES)
        node, i = index // (PROBES * PROBES), index % (PROBES * PROBES)
        r2 = dr.squared_norm(mi.Point2f(_cell_of(node)) / CELLS - probe_position(i))
        return NodeSums(kernel(r2) * dr.gather(mi.Float, weights, i), i)

    def total(self) -> mi.Float:
        return self._sum(self.K)

    def of_values(self, values: mi.Float) -> mi.Float:
        return self._sum(dr.select(self.K > 0, self.K * dr.gather(mi.Float, values, self.i), 0))

    def _sum(self, values: mi.Float) -> mi.Float:
        return dr.block_sum(values, PROBES * PROBES)


def distance_to(positions: mi.Point2f, valid: mi.Bool) -> mi.Float:
    """Return the distance between each node and the nearest ``valid`` position; infinite without such a position."""
    n = dr.width(positions)
    index = dr.arange(mi.UInt32, NODES * NODES * n)
    node, i = index // n, index % n
    away = dr.norm(mi.Point2f(_cell_of(node)) / CELLS - dr.gather(mi.Point2f, positions, i))
    return dr.block_reduce(dr.ReduceOp.Min, dr.select(dr.gather(mi.Bool, valid, i), away, dr.inf), n)


@dataclass(frozen=True)
class Cell:
    """The cell of a film position, and the coordinates of the position in the cell.

    Beyond the grid, ``f`` is that of the nearest point of the grid, and ``inside`` is 0 along the axis.
    """

    first: mi.Point2i
    f: mi.Point2f
    inside: mi.Vector2f

    @staticmethod
    def at(position: mi.Point2f) -> Cell:
        at = mi.Point2f(dr.detach(position)) * CELLS
        clipped = dr.clip(at, -MARGIN, CELLS + MARGIN)
        first = dr.minimum(mi.Point2i(dr.floor(clipped)), CELLS + MARGIN - 1)
        inside = dr.select(dr.abs(at - CELLS / 2) < CELLS / 2 + MARGIN, mi.Vector2f(1), 0)
        return Cell(first, clipped - mi.Point2f(first), inside)

    def corners(self, nodes: Value) -> list[Value]:
        """Return the values at the four corners of the cell."""
        return [dr.gather(type(nodes), nodes, node_at(self.first, x, y)) for y in (0, 1) for x in (0, 1)]

    def slopes(self, corners: list[Value]) -> tuple[Value, Value]:
        """Return the derivatives of interpolated values along both axes of the film; 0 beyond the grid."""
        (a, b, c, d), f = corners, self.f
        along_x, along_y = dr.lerp(b - a, d - c, f.y), dr.lerp(c - a, d - b, f.x)
        return along_x * (CELLS * self.inside.x), along_y * (CELLS * self.inside.y)

    def first_node(self) -> mi.UInt32:
        return node_at(self.first, 0, 0)


def interpolated(corners: list[Value], f: mi.Point2f) -> Value:
    """Interpolate linearly between the values at the corners of a cell."""
    a, b, c, d = corners
    return dr.lerp(dr.lerp(a, b, f.x), dr.lerp(c, d, f.x), f.y)


def is_near(flags: mi.Bool) -> mi.Bool:
    """Return, for each node, whether a flag is set in or next to the cell of which the node is the first corner."""
    cell, near = _cell_of(dr.arange(mi.UInt32, NODES * NODES)), mi.Bool(False)
    for x, y in product(range(-1, 3), repeat=2):
        near |= dr.gather(mi.Bool, flags, node_at(cell, x, y))
    return near


def node_at(cell: mi.Point2i, x: int, y: int) -> mi.UInt32:
    """Return the row-major index of the node at (x, y) relative to the first node of a cell, clamped to the grid."""
    at = dr.clip(cell + mi.Point2i(x + MARGIN, y + MARGIN), 0, NODES - 1)
    return mi.UInt32(at.x + at.y * NODES)


def _cell_of(node: mi.UInt32) -> mi.Point2i:
    """Return the cell whose first corner is a node."""
    return mi.Point2i(node % NODES, node // NODES) - MARGIN
