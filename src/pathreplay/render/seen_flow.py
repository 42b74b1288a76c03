"""Seen flow: a velocity of places on the film that follows what is seen there, so that little slides under a pixel.

A few rays glance at the scene. A point p that one of them hits at a distance t, glued to its surface, moves over the
film by

    u = (∂(o + t d)/∂s)⁺ ∂(p - (o + t d))/∂π,

where o + t d is the point at the distance t on the ray through the place s. Where places stand still and surfaces do
not, what is seen there slides over its surface by u / cos, with the angle between normal and ray, which has no bounds
at an outline; so points that are seen aslant count most. The velocity at a node of a grid is the mean of those around it,

    v = Σ K W u / (K_0 + Σ K W),        W = 1 / (cos² + GRAZING²),        K = max(1 - (r / REACH)², 0)² / (r² + NEAR²)²,

with r their distance on the film. Between nodes it is interpolated. Points that stand still have u = 0, and count as
much. Any v will do (see `FilmFlow`): this one leaves little to the interior and to edges.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import drjit as dr
import mitsuba as mi

from ..transport.meet import meet
from ..transport.motion import may_move
from ..transport.vertex import Walk

GLANCES, CELLS = 32, 16
"""Rays in a row and a column, and cells of the grid."""
MARGIN = 2
"""Nodes beyond the border of the film: filters reach there."""
REACH, NEAR, K_0 = 0.25, 0.03, 1e3
"""In widths of the film; and the weight of standing still, of which a point counts half as much at a tenth of a width."""
GRAZING = 0.1

Slopes: TypeAlias = "tuple[list[mi.Vector3f], list[mi.Vector3f]]"
"""∂o/∂s and ∂d/∂s, along both axes."""


@dataclass(frozen=True)
class SeenFlow:
    """A velocity of places, by its nodes."""

    nodes: mi.Vector2f  # attached to what moves; their values are zero
    flows: mi.Bool  # whether anything that moves is seen around the corners of a node's cell, or of those beside it

    @staticmethod
    def of(walk: Walk, glance: Callable[[mi.Point2f], tuple[mi.Ray3f, Slopes]], all_moves: bool) -> SeenFlow:
        """By rays through places, attached as paths have them; ``all_moves``: beyond the shapes that `may_move`."""
        side = CELLS + 1 + 2 * MARGIN
        i = dr.arange(mi.UInt32, GLANCES * GLANCES)
        with dr.resume_grad():
            ray, (o, d) = glance(_glanced_at(i))
            still = dr.detach(ray)
            hit = meet(walk, still, mi.Bool(True), coherent=True)
            seen = hit.is_valid()
            p = hit.compute_surface_interaction(still, mi.RayFlags.Minimal | mi.RayFlags.FollowShape, seen)
            t = dr.select(seen, hit.t, 1)
            δ = p.p - (ray.o + t * ray.d)
            u = followed(δ - dr.detach(δ), o, d, t)
            u = dr.select(seen & dr.all(dr.isfinite(dr.detach(u))), u, 0)
            cos = dr.dot(dr.detach(p.n), still.d)
            W = dr.select(seen, dr.rcp(cos * cos + GRAZING * GRAZING), 0)
            moves = seen & (mi.Bool(all_moves) | may_move(walk, hit))
            dr.eval(u, W, moves)

            j = dr.arange(mi.UInt32, side * side * GLANCES * GLANCES)
            node, i = j // (GLANCES * GLANCES), j % (GLANCES * GLANCES)
            at = (mi.Point2f(node % side, node // side) - MARGIN) / CELLS
            r2 = dr.squared_norm(at - _glanced_at(i))
            K = dr.square(dr.maximum(1 - r2 / REACH**2, 0) / (r2 + NEAR**2)) * dr.gather(mi.Float, W, i)
            total = K_0 + dr.block_sum(K, GLANCES * GLANCES)
            v = [dr.block_sum(K * dr.gather(mi.Float, u[axis], i), GLANCES * GLANCES) / total for axis in range(2)]
            nodes = mi.Vector2f(*v)
        moved = dr.block_sum(dr.select(dr.gather(mi.Bool, moves, i), K, 0), GLANCES * GLANCES)
        dr.eval(nodes, moved)
        n = dr.arange(mi.UInt32, side * side)
        cell, flows = mi.Point2i(n % side, n // side) - MARGIN, mi.Bool(False)
        for x in range(-1, 3):
            for y in range(-1, 3):
                flows |= dr.gather(mi.Float, moved, _node(cell, x, y)) > 0
        dr.eval(flows)
        return SeenFlow(nodes, flows)

    def velocity(self, place: mi.Point2f) -> mi.Vector2f:
        """At a place in widths and heights of the film; attached as the nodes are, its value is zero."""
        at, f = _cell(place)
        corners = [[dr.gather(mi.Vector2f, self.nodes, _node(at, x, y)) for x in range(2)] for y in range(2)]
        below, above = (dr.lerp(left, right, f.x) for left, right in corners)
        return dr.lerp(below, above, f.y)

    def is_at(self, place: mi.Point2f) -> mi.Bool:
        """Whether there may be a velocity at a place, or within a cell of it."""
        return dr.gather(mi.Bool, self.flows, _node(_cell(place)[0], 0, 0))


def followed(δp: mi.Vector3f, o: list[mi.Vector3f], d: list[mi.Vector3f], t: mi.Float) -> mi.Vector2f:
    """How places on the film move if points at a distance t on their rays move by δp, by least squares."""
    x, y = (o_k + t * d_k for o_k, d_k in zip(o, d, strict=True))
    xx, xy, yy = dr.dot(x, x), dr.dot(x, y), dr.dot(y, y)
    a, b = dr.dot(x, δp), dr.dot(y, δp)
    return mi.Vector2f(yy * a - xy * b, xx * b - xy * a) / (xx * yy - xy * xy)


def _glanced_at(i: mi.UInt32) -> mi.Point2f:
    return (mi.Point2f(i % GLANCES, i // GLANCES) + 0.5) / GLANCES


def _cell(place: mi.Point2f) -> tuple[mi.Point2i, mi.Point2f]:
    """The cell of the grid that a place is in, and where it is in there; beyond the grid at its border."""
    at = dr.clip(dr.detach(place) * CELLS, -MARGIN, CELLS + MARGIN - 1e-3)
    cell = dr.floor(at)
    return mi.Point2i(cell), mi.Point2f(at - cell)


def _node(cell: mi.Point2i, x: int, y: int) -> mi.UInt32:
    side = CELLS + 1 + 2 * MARGIN
    at = dr.clip(cell + mi.Point2i(x + MARGIN, y + MARGIN), 0, side - 1)
    return mi.UInt32(at.x + at.y * side)
