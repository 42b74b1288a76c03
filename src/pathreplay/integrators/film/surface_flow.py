"""Flow of a static camera: film positions follow the visible surfaces.

The surfaces then move little relative to the film positions. A few probe rays sample the scene. Let p be the point at
which a probe ray hits a surface, and t the distance of p on the ray. The point p moves with the surface. The image of p
moves on the film with the velocity

    u = (∂(o + t d)/∂s)⁺ ∂p/∂π,

where o + t d is the point at the distance t on the ray through the film position s. If film positions are fixed,
the hit point of a ray slides over the surface with a speed proportional to u / cos, where cos is the cosine between
normal and ray. This speed is unbounded at silhouettes. Points at grazing angles therefore have the largest weights. The
velocity at a node of a grid is the mean

    v = Σ K A W u / (K_0 + Σ K A (W + S)),   W = 1 / (cos² + GRAZING²),   K = max(1 - (r / REACH)², 0)² / (r² + NEAR²)²

over nearby points, where r is their distance from the node on the film. Static points contribute with u = 0. The
radiance that leaves a shiny surface, which has a specular or glossy lobe, changes with the normal much more than that
of a diffuse surface, most of all at grazing angles. If a shiny surface moves, A is therefore `SHINY` on all shiny
surfaces. Elsewhere, A is 1. Between nodes, v is interpolated. The constant K_0 is the weight of the velocity zero. In a
narrow field of view, u is large, and film positions that follow u cause more noise than fixed film positions. S is
inversely proportional to the square of the field of view, so S reduces v in a narrow field of view. Finally, v is
multiplied by a share that is 0 near static lights (see `lights`) and where moving surfaces have no silhouettes.

The derivative of the image does not depend on the choice of v (see `camera_flow`). With the choice above, the interior
and boundary terms have to differentiate little motion near silhouettes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import tangents
from pathreplay.integrators.film.grid import Cell, NodeSums, interpolated, is_near, wide
from pathreplay.integrators.film.lights import SeenLights
from pathreplay.integrators.film.sample import (
    CAMERAS,
    Sample,
    film_velocity,
    move_with_position,
    probes_of,
    ray_derivatives,
)
from pathreplay.platform import compat
from pathreplay.transport.facts.nodes import with_gradients
from pathreplay.transport.facts.traits import is_shiny
from pathreplay.transport.meet import meet
from pathreplay.transport.motion import have_gradients, may_move, shapes_with_gradients
from pathreplay.transport.vertex import TraceConfig

K_0 = 1e3
"""Weight that favours fixed film positions."""
STEEP, ENOUGH = 0.5, 0.02
"""STEEP is the cosine below which an angle is grazing. ENOUGH is the fraction of grazing angles near a node, and the
variance of normals, at and above which the flow is kept in full."""
SHINY = 100.0
"""Weight A of surfaces with a specular or glossy lobe, if one of them moves."""
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
        sample = probes_of(sensor)
        if trace.traits.moving is None:  # `may_move` would return True in all lanes
            trace = replace(trace, traits=replace(trace.traits, moving=shapes_with_gradients(trace.scene)))
        ray = mi.Ray3f(sample.ray(sensor)[0])
        hit = meet(trace, ray, mi.Bool(True), coherent=True)
        visible, t = hit.is_valid(), dr.select(hit.is_valid(), hit.t, 1)
        with dr.resume_grad():
            flags = compat.minimal() | compat.follow_shape()
            si = hit.compute_surface_interaction(ray, flags, visible)
            if not (dr.grad_enabled(si.p) and have_gradients(trace.scene, mi.Shape)):
                return None
            derivatives = ray_derivatives(sensor, sample)
            cos, step = dr.dot(dr.detach(si.n), ray.d), derivatives[0][0] + t * derivatives[1][0]
            moves = visible & may_move(trace, hit)
            grazing, S = dr.rcp(cos * cos + GRAZING * GRAZING), NARROW * t * t / dr.squared_norm(step)
            W = dr.select(visible, grazing + S, 0)
            shiny = visible & is_shiny(si.bsdf())
            u = film_velocity((si.p - dr.detach(si.p)) / t, derivatives, dr.rcp(t)) * grazing / (grazing + S)
            dr.eval(u, W, moves, shiny)  # evaluate once: every node gathers from these arrays
            W *= dr.select(shiny & dr.any(shiny & moves), SHINY, mi.Float(1))  # the factor A
            dr.eval(W)

            share = _near_silhouettes(moves, mi.Vector3f(dr.detach(si.n)), cos) * _away_from_lights(trace, sensor)
            sums = NodeSums.of(W)
            total = K_0 + sums.total()
            nodes = mi.Vector2f(*(share * sums.of_values(u[k]) / total for k in (0, 1)))
        moved = (sums.of_values(dr.select(moves, mi.Float(1), 0)) > 0) & (share > 0)
        dr.eval(nodes, moved)
        flows = is_near(moved)
        dr.eval(flows)
        return SurfaceFlow(sensor, nodes, flows)

    def ray(self, sample: Sample) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
        ray, weight = sample.ray(self.sensor)
        if not dr.grad_enabled(sample.position) and dr.grad_enabled(self.nodes):
            move_with_position(ray, ray_derivatives(self.sensor, sample), self.velocity(sample))
        return ray, weight

    def velocity(self, sample: Sample) -> mi.Vector2f:
        cell = Cell.at(sample.position)
        return interpolated(cell.corners(self.nodes), cell.f)

    def divergence(self, sample: Sample) -> mi.Float:
        """Beyond the grid, the velocity does not change with the distance from the grid."""
        cell = Cell.at(sample.position)
        along_x, along_y = cell.slopes(cell.corners(self.nodes))
        return along_x.x + along_y.y

    def moves_at(self, position: mi.Point2f) -> mi.Bool:
        """Return whether a moving surface is visible near a film position."""
        return dr.gather(mi.Bool, self.flows, Cell.at(position).first_node())

    leaves_rest_at = moves_at  # the camera is static, so its rays move only with their film positions

    def carry_tangents(self) -> None:
        with dr.resume_grad():
            tangents(self.nodes)


def _near_silhouettes(moves: mi.Bool, n: mi.Vector3f, cos: mi.Float) -> mi.Float:
    """Return the share of the flow that is kept at each node: 1 near silhouettes of curved surfaces, 0 on flat ones.

    At a silhouette, moving surfaces are seen at grazing angles, and their normals vary. Following a surface that is
    flat near the node would only add noise. ``cos`` is the cosine between normal ``n`` and ray.
    """
    n = dr.select(cos > 0, -n, n)
    around = NodeSums.of(dr.select(moves, mi.Float(1), 0), wide)
    count = dr.maximum(around.total(), dr.smallest(mi.Float))
    mean = mi.Vector3f(*(around.of_values(n[k]) / count for k in range(3)))
    grazing = around.of_values(dr.select(dr.abs(cos) < STEEP, mi.Float(1), 0)) / count
    return dr.clip(grazing / ENOUGH, 0, 1) * dr.clip((1 - dr.squared_norm(mean)) / ENOUGH, 0, 1)


def _away_from_lights(trace: TraceConfig, sensor: mi.Sensor) -> mi.Float:
    """Return the share of the flow that is kept at each node: 0 near static lights that are visible, see `lights`."""
    if trace.hide_emitters:
        return mi.Float(1)
    seen = SeenLights.of(trace, sensor)
    return seen.share_kept(seen.sky | (seen.shape & ~may_move(trace, seen.hit)))


def can_follow(trace: TraceConfig, sensor: mi.Sensor) -> bool:
    """Return whether film positions may follow visible surfaces.

    Film positions that follow one surface move relative to all other surfaces. The edges of these surfaces must then be
    sampled, which is impossible behind thin sheets, for B-spline curves, and for the disc of a sun in mirrors or glass.
    In scenes with media, it is also impossible in mirrors and glass, behind hidden emitters, and for the borders of the
    light of projectors and spots. The caller must exclude textures and volumes with discontinuities (see `seams`),
    which cannot be sampled either. The borders of open null boundaries are not sampled, but not excluded.
    """
    traits = trace.traits
    hidden = traits.veils or traits.splines or traits.reflects_sun
    if trace.media is not None:
        hidden |= bool(traits.mirrors or traits.projectors or traits.spots)
        hidden |= trace.hide_emitters and traits.area_lights
    return not hidden and sensor.class_name() in CAMERAS and not with_gradients(sensor)
