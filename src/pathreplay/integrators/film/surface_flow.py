"""Flow of a static camera: film positions follow the visible surfaces.

The surfaces then move little relative to the film positions. A few probe rays sample the scene. Let p be the point at
which a probe ray hits a surface, and t the distance of p on the ray. The point p moves with the surface. The image of p
moves on the film with the velocity

    u = (∂(o + t d)/∂s)⁺ ∂p/∂π,

where o + t d is the point at the distance t on the ray through the film position s. If film positions are fixed,
the hit point of a ray slides over the surface with a speed proportional to u / cos, where cos is the cosine between
normal and ray. This speed is unbounded at silhouettes. Points at grazing angles therefore have the largest weights. The
velocity at a node of a grid is the mean

    v = Σ K W u / (K_0 + Σ K (W + S)),     W = 1 / (cos² + GRAZING²),     K = max(1 - (r / REACH)², 0)² / (r² + NEAR²)²

over nearby points, where r is their distance from the node on the film. Static points contribute with u = 0. Between
nodes, v is interpolated. The constant K_0 is the weight of the velocity zero. In a narrow field of view, u is large,
and film positions that follow u cause more noise than fixed film positions. S is inversely proportional to the square
of the field of view, so S reduces v in a narrow field of view.

The derivative of the image does not depend on the choice of v (see `camera_flow`). With the choice above, the interior
and boundary terms have to differentiate little motion.
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
    film_velocity,
    move_with_position,
    probe_position,
    probes_of,
    ray_derivatives,
)
from pathreplay.platform import compat
from pathreplay.transport.facts.nodes import with_gradients
from pathreplay.transport.meet import meet
from pathreplay.transport.motion import may_move
from pathreplay.transport.vertex import TraceConfig

PROBES, CELLS = 32, 16
"""Number of probe rays and number of grid cells per row and column of the film."""
MARGIN = 2
"""Number of nodes outside each border of the film, where filters still have support."""
NODES = CELLS + 1 + 2 * MARGIN
REACH, NEAR, K_0 = 0.25, 0.03, 1e3
"""REACH and NEAR in film widths; K_0 is a weight that favours fixed film positions."""
GRAZING, NARROW = 0.1, 0.004
"""GRAZING is the cosine below which W levels off. NARROW is S times the square of the film's width in radians."""


@dataclass(frozen=True)
class SurfaceFlow:
    """The flow of a static sensor: see `FilmFlow`."""

    sensor: mi.Sensor
    nodes: mi.Vector2f  # AD variables of value zero; their derivatives are the velocities at the grid nodes
    flows: mi.Bool  # whether the velocity may be non-zero in or next to a cell; indexed by the cell's first node
    is_all: bool = False
    samples: int = 5

    @staticmethod
    def of(sensor: mi.Sensor, trace: TraceConfig) -> SurfaceFlow | None:
        """Create the flow of a sensor; None if no visible surface moves. ``trace`` contains the moving shapes."""
        sample = probes_of(sensor, PROBES)
        ray = mi.Ray3f(sample.ray(sensor)[0])
        hit = meet(trace, ray, mi.Bool(True), coherent=True)
        visible, t = hit.is_valid(), dr.select(hit.is_valid(), hit.t, 1)
        with dr.resume_grad():
            flags = compat.minimal() | compat.follow_shape()
            si = hit.compute_surface_interaction(ray, flags, visible)
            if not dr.grad_enabled(si.p):
                return None
            derivatives = ray_derivatives(sensor, sample)
            cos, wide = dr.dot(dr.detach(si.n), ray.d), dr.squared_norm(derivatives[0][0] + t * derivatives[1][0])
            grazing, S = dr.rcp(cos * cos + GRAZING * GRAZING), NARROW * t * t / wide
            W = dr.select(visible, grazing + S, 0)
            u = film_velocity(si.p - dr.detach(si.p), derivatives, t) * grazing / (grazing + S)
            moves = visible & may_move(trace, hit)
            dr.eval(u, W, moves)  # evaluate once: every node gathers from these arrays

            index = dr.arange(mi.UInt32, NODES * NODES * PROBES * PROBES)
            node, i = index // (PROBES * PROBES), index % (PROBES * PROBES)
            r2 = dr.squared_norm(mi.Point2f(_cell_of(node)) / CELLS - probe_position(i, PROBES))
            K = dr.square(dr.maximum(1 - r2 / REACH**2, 0) / (r2 + NEAR**2)) * dr.gather(mi.Float, W, i)
            total = K_0 + _sums(K)
            nodes = mi.Vector2f(*(_sums(dr.select(K > 0, K * dr.gather(mi.Float, u[k], i), 0)) / total for k in (0, 1)))
        moved = _sums(dr.select(dr.gather(mi.Bool, moves, i), K, 0))
        dr.eval(nodes, moved)
        cell, flows = _cell_of(dr.arange(mi.UInt32, NODES * NODES)), mi.Bool(False)
        for x, y in product(range(-1, 3), repeat=2):
            flows |= dr.gather(mi.Float, moved, _node(cell, x, y)) > 0
        dr.eval(flows)
        return SurfaceFlow(sensor, nodes, flows)

    def ray(self, sample: Sample) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
        ray, weight = sample.ray(self.sensor)
        if not dr.grad_enabled(sample.position) and dr.grad_enabled(self.nodes):
            move_with_position(ray, ray_derivatives(self.sensor, sample), self.velocity(sample))
        return ray, weight

    def velocity(self, sample: Sample) -> mi.Vector2f:
        (a, b, c, d), f = self._corners(sample.position)
        return dr.lerp(dr.lerp(a, b, f.x), dr.lerp(c, d, f.x), f.y)

    def divergence(self, sample: Sample) -> mi.Float:
        """Beyond the grid, the velocity does not change with the distance from the grid."""
        (a, b, c, d), f = self._corners(sample.position)
        along_x, along_y = dr.lerp(b.x - a.x, d.x - c.x, f.y), dr.lerp(c.y - a.y, d.y - b.y, f.x)
        at = mi.Point2f(dr.detach(sample.position) * CELLS)
        x_in, y_in = (dr.abs(x - CELLS / 2) < CELLS / 2 + MARGIN for x in (at.x, at.y))
        return CELLS * (dr.select(x_in, along_x, 0) + dr.select(y_in, along_y, 0))

    def moves_at(self, position: mi.Point2f) -> mi.Bool:
        """Return whether a moving surface is visible near a film position."""
        return dr.gather(mi.Bool, self.flows, _node(_cell_at(position)[0], 0, 0))

    def leaves_rest_at(self, position: mi.Point2f) -> mi.Bool:
        """Return whether the camera ray through a film position may move: see `FilmFlow`.

        The camera is static, so its rays move only with their film positions. The result therefore equals `moves_at`.
        """
        return self.moves_at(position)

    def carry_tangents(self) -> None:
        with dr.resume_grad():
            tangents(self.nodes)

    def _corners(self, position: mi.Point2f) -> tuple[list[mi.Vector2f], mi.Point2f]:
        """Return the velocities at the corners of the cell that contains a position, and the position in the cell."""
        cell, f = _cell_at(position)
        return [dr.gather(mi.Vector2f, self.nodes, _node(cell, x, y)) for y in (0, 1) for x in (0, 1)], f


def can_follow(trace: TraceConfig, sensor: mi.Sensor) -> bool:
    """Return whether film positions may follow visible surfaces.

    Film positions that follow one surface move relative to all other surfaces. The edges of these surfaces must then be
    sampled, which is impossible behind mirrors, glass and thin sheets, and for B-spline curves. Media are not
    supported. The caller must exclude textures with seams (see `has_seams`), which cannot be sampled either.
    """
    traits = trace.traits
    hidden = traits.mirrors or traits.veils or traits.splines
    return trace.media is None and not hidden and sensor.class_name() in CAMERAS and not with_gradients(sensor)


def _sums(values: mi.Float) -> mi.Float:
    """Sum over all probe rays, for each node."""
    return dr.block_sum(values, PROBES * PROBES)


def _cell_at(position: mi.Point2f) -> tuple[mi.Point2i, mi.Point2f]:
    """Return the cell of a film position and the coordinates in the cell, clamped to the grid."""
    at = dr.clip(dr.detach(position) * CELLS, -MARGIN, CELLS + MARGIN)
    cell = dr.minimum(mi.Point2i(dr.floor(at)), CELLS + MARGIN - 1)
    return cell, at - mi.Point2f(cell)


def _cell_of(node: mi.UInt32) -> mi.Point2i:
    """Return the cell whose first corner is a node."""
    return mi.Point2i(node % NODES, node // NODES) - MARGIN


def _node(cell: mi.Point2i, x: int, y: int) -> mi.UInt32:
    """Return the row-major index of the node at (x, y) relative to the first node of a cell, clamped to the grid."""
    at = dr.clip(cell + mi.Point2i(x + MARGIN, y + MARGIN), 0, NODES - 1)
    return mi.UInt32(at.x + at.y * NODES)
