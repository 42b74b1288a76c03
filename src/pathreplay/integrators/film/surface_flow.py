"""Seen flow: places of the film follow what is seen there, so that little slides under a pixel.

A few rays glance at the scene. A point p that one of them hits, glued to its surface, moves over the film by

    u = (∂(o + t d)/∂s)⁺ ∂p/∂π,

where o + t d is the point at its distance t on the ray through the place s. If places stand still, surfaces slide
under them by u / cos, with the angle between normal and ray, which has no bounds at an outline. So points that are seen
aslant count most: the velocity at a node of a grid is the mean of those around it,

    v = Σ K W u / (K_0 + Σ K (W + S)),     W = 1 / (cos² + GRAZING²),     K = max(1 - (r / REACH)², 0)² / (r² + NEAR²)²,

with r their distance on the film; between nodes it is interpolated. Points that stand still have u = 0 and count, too.
On a film that sees a narrow part of the world, u is large, and following it costs more noise than sliding: there S
holds places where they are. Any v gives the same derivative (see `FilmFlow`). This one leaves little to the interior
and to edges.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import tangents
from pathreplay.integrators.film.camera_flow import (
    CAMERAS,
    Sample,
    followed,
    glanced_at,
    glances_of,
    move_with_place,
    slopes_of,
)
from pathreplay.transport.facts.nodes import with_gradients
from pathreplay.transport.meet import meet
from pathreplay.transport.motion import may_move
from pathreplay.transport.vertex import TraceConfig

GLANCES, CELLS = 32, 16
"""Rays in a row and a column, and cells of the grid."""
MARGIN = 2
"""Nodes beyond the border of the film: filters reach there."""
NODES = CELLS + 1 + 2 * MARGIN
REACH, NEAR, K_0 = 0.25, 0.03, 1e3
"""In widths of the film; and how much it counts that a place would rather stand still."""
GRAZING, NARROW = 0.1, 0.004
"""Least slope that counts; and S, over the square of the film's width in radians: see there."""


@dataclass(frozen=True)
class SeenFlow:
    """The flow of a sensor that stands still: see `FilmFlow`."""

    sensor: mi.Sensor
    nodes: mi.Vector2f  # velocities: zeros, attached to what moves
    flows: mi.Bool  # by node: whether something that moves is seen around its cell, or one beside that
    is_all: bool = False
    samples: int = 5

    @staticmethod
    def of(sensor: mi.Sensor, trace: TraceConfig) -> SeenFlow | None:
        """The flow of a sensor, in a ``trace`` that knows what moves; None where nothing that it might see does."""
        sample = glances_of(sensor, GLANCES)
        ray = mi.Ray3f(sample.ray(sensor)[0])
        hit = meet(trace, ray, mi.Bool(True), coherent=True)
        seen, t = hit.is_valid(), dr.select(hit.is_valid(), hit.t, 1)
        with dr.resume_grad():
            flags = mi.RayFlags.Minimal | mi.RayFlags.FollowShape
            si = hit.compute_surface_interaction(ray, flags, seen)
            if not dr.grad_enabled(si.p):
                return None
            slopes = slopes_of(sensor, sample)
            cos, wide = dr.dot(dr.detach(si.n), ray.d), dr.squared_norm(slopes[0][0] + t * slopes[1][0])
            aslant, S = dr.rcp(cos * cos + GRAZING * GRAZING), NARROW * t * t / wide
            W = dr.select(seen, aslant + S, 0)
            u = followed(si.p - dr.detach(si.p), slopes, t) * aslant / (aslant + S)
            moves = seen & may_move(trace, hit)
            dr.eval(u, W, moves)  # before all nodes read them

            pair = dr.arange(mi.UInt32, NODES * NODES * GLANCES * GLANCES)
            node, i = pair // (GLANCES * GLANCES), pair % (GLANCES * GLANCES)
            r2 = dr.squared_norm(mi.Point2f(_cell_of(node)) / CELLS - glanced_at(i, GLANCES))
            K = dr.square(dr.maximum(1 - r2 / REACH**2, 0) / (r2 + NEAR**2)) * dr.gather(mi.Float, W, i)
            total = K_0 + _sums(K)
            nodes = mi.Vector2f(*(_sums(dr.select(K > 0, K * dr.gather(mi.Float, u[k], i), 0)) / total for k in (0, 1)))
        moved = _sums(dr.select(dr.gather(mi.Bool, moves, i), K, 0))
        dr.eval(nodes, moved)
        cell, flows = _cell_of(dr.arange(mi.UInt32, NODES * NODES)), mi.Bool(False)
        for x, y in product(range(-1, 3), repeat=2):
            flows |= dr.gather(mi.Float, moved, _node(cell, x, y)) > 0
        dr.eval(flows)
        return SeenFlow(sensor, nodes, flows)

    def ray(self, sample: Sample) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
        """See `FilmFlow`."""
        ray, weight = sample.ray(self.sensor)
        if not dr.grad_enabled(sample.place) and dr.grad_enabled(self.nodes):
            move_with_place(ray, slopes_of(self.sensor, sample), self.velocity(sample))
        return ray, weight

    def velocity(self, sample: Sample) -> mi.Vector2f:
        """See `FilmFlow`."""
        (a, b, c, d), f = self._corners(sample.place)
        return dr.lerp(dr.lerp(a, b, f.x), dr.lerp(c, d, f.x), f.y)

    def divergence(self, sample: Sample) -> mi.Float:
        """See `FilmFlow`."""
        (a, b, c, d), f = self._corners(sample.place)
        return CELLS * (dr.lerp(b.x - a.x, d.x - c.x, f.y) + dr.lerp(c.y - a.y, d.y - b.y, f.x))

    def moves_at(self, place: mi.Point2f) -> mi.Bool:
        """Where something that moves is seen not far away."""
        return dr.gather(mi.Bool, self.flows, _node(_cell_at(place)[0], 0, 0))

    def leaves_rest_at(self, place: mi.Point2f) -> mi.Bool:
        """Where places move."""
        return self.moves_at(place)

    def carry_tangents(self) -> None:
        """To the nodes."""
        with dr.resume_grad():
            tangents(self.nodes)

    def _corners(self, place: mi.Point2f) -> tuple[list[mi.Vector2f], mi.Point2f]:
        """The velocities at the corners of a place's cell, row by row, and where it is in there."""
        cell, f = _cell_at(place)
        return [dr.gather(mi.Vector2f, self.nodes, _node(cell, x, y)) for y in (0, 1) for x in (0, 1)], f


def can_follow(trace: TraceConfig, sensor: mi.Sensor) -> bool:
    """Whether places may follow what is seen: then all else slides under them, and all of its edges have to be found.

    Those behind mirrors, glass and sheets and on bent curves are not, and media are not asked. (Nor are those in
    textures: see `has_seams`.)
    """
    traits = trace.traits
    hidden = traits.mirrors or traits.veils or traits.splines
    return trace.media is None and not hidden and sensor.class_name() in CAMERAS and not with_gradients(sensor)


def _sums(values: mi.Float) -> mi.Float:
    """Of each node, over all glances."""
    return dr.block_sum(values, GLANCES * GLANCES)


def _cell_at(place: mi.Point2f) -> tuple[mi.Point2i, mi.Point2f]:
    """The cell that a place is in, and where in there; beyond the grid, at its border."""
    at = dr.clip(dr.detach(place) * CELLS, -MARGIN, CELLS + MARGIN)
    cell = dr.minimum(mi.Point2i(dr.floor(at)), CELLS + MARGIN - 1)
    return cell, at - mi.Point2f(cell)


def _cell_of(node: mi.UInt32) -> mi.Point2i:
    """The cell that begins at a node."""
    return mi.Point2i(node % NODES, node // NODES) - MARGIN


def _node(cell: mi.Point2i, x: int, y: int) -> mi.UInt32:
    """The node that is x columns and y rows after the first node of a cell, or the nearest one of the grid."""
    at = dr.clip(cell + mi.Point2i(x + MARGIN, y + MARGIN), 0, NODES - 1)
    return mi.UInt32(at.x + at.y * NODES)
