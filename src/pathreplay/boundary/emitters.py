"""Emitter samples: the light of an emitter, or what hides it, as a vertex sees it at a place of the unit square.

Of most emitters it is the square of their samples. Samples of balls go around the middle of what is seen of them: there
straight edges would be bent without bounds, and segments too long to tell; so these are mapped to a disk first, evenly.
Samples of meshes jump in theirs from triangle to triangle; so for these it is mapped, evenly, to the cone of directions
around a ball that holds the mesh. What follows the emitter, the point that is glued to it, is the same in both.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from pathreplay.boundary.observer import ObserverVertex
from pathreplay.transport.surface import held_point
from pathreplay.transport.vertex import TraceConfig


@dataclass
class Lamp:
    """An emitter, and a ball around it: its radius is 0 where it is no mesh."""

    emitter: mi.EmitterPtr
    centre: mi.Point3f
    radius: mi.Float
    around: mi.Bool  # its samples go around: see `sample_at`

    @staticmethod
    def of(trace: TraceConfig, index: mi.UInt32, active: mi.Bool) -> Lamp:
        """The emitter of an index."""
        emitter = dr.gather(mi.EmitterPtr, trace.scene.emitters_dr(), index, active)
        around = mi.Bool(False)
        if trace.traits.ball_lights:
            around = emitter.get_shape().shape_type() == int(mi.ShapeType.Sphere)
        if not trace.traits.mesh_lights:
            return Lamp(emitter, mi.Point3f(0), mi.Float(0), around)
        ball = dr.gather(mi.Vector4f, trace.traits.tables.lamp_balls, index, active)
        return Lamp(emitter, mi.Point3f(ball.x, ball.y, ball.z), ball.w, around)


@dataclass
class Glimpse:
    """Of a lamp, at a place of its square."""

    light: mi.DirectionSample3f
    Le: mi.Spectrum  # over the density of the place
    density: mi.Float  # with which samples of the emitter have its direction
    ray: mi.Ray3f
    hit: mi.PreliminaryIntersection3f  # what it meets: of a mesh that is seen, that
    hidden: mi.Bool


def glimpse(trace: TraceConfig, observer: ObserverVertex, lamp: Lamp, u: mi.Point2f, active: mi.Bool) -> Glimpse:
    """Look at a place of a lamp's square. Detached."""
    in_cone = active & (lamp.radius > 0)
    light, Le = lamp.emitter.sample_direction(observer.origin, sample_at(trace, lamp, u), active & ~in_cone)
    ray = observer.origin.spawn_ray_to(light.p)
    looks = active & (light.pdf != 0)
    if not trace.traits.mesh_lights:
        hit = observer.behind(ray, observer.hit(ray, looks), looks)
        return Glimpse(light, Le, light.pdf, ray, hit, _hides(hit, light.emitter, looks))
    d, Ω = direction(lamp, observer.origin.p, u)
    ray = dr.select(in_cone, observer.origin.spawn_ray(d), ray)
    looks |= in_cone
    first = observer.hit(ray, looks)
    at_lamp = in_cone & first.is_valid() & (first.shape.emitter() == lamp.emitter)  # also if light goes through it
    hit = dr.select(at_lamp, first, observer.behind(ray, first, looks & ~at_lamp))
    seen = in_cone & hit.is_valid() & (hit.shape.emitter() == lamp.emitter)
    si = hit.compute_surface_interaction(ray, mi.RayFlags.All, seen)
    there = mi.DirectionSample3f(trace.scene, si=si, ref=observer.origin)
    there.d = d
    light, density = dr.select(in_cone, there, light), dr.select(in_cone, 0, light.pdf)
    Le = dr.select(in_cone, dr.select(seen, lamp.emitter.eval(si, seen) * Ω, 0), Le)
    density = dr.select(seen, lamp.emitter.pdf_direction(observer.origin, there, seen), density)
    # What is behind the ball does not hide it.
    near = ~in_cone | (hit.t < dr.norm(lamp.centre - observer.origin.p) + lamp.radius)
    return Glimpse(light, Le, density, ray, hit, _hides(hit, lamp.emitter, looks) & near)


def _hides(hit: mi.PreliminaryIntersection3f, emitter: mi.EmitterPtr, active: mi.Bool) -> mi.Bool:
    # A lamp's own limb hides it by rounding only.
    return active & hit.is_valid() & (hit.shape.emitter() != emitter)


def sample_at(trace: TraceConfig, lamp: Lamp, u: mi.Point2f) -> mi.Point2f:
    """The sample of an emitter at a place; of a ball that at the place's distance and angle on the disk, as evenly."""
    if not trace.traits.ball_lights:
        return u
    p = mi.warp.square_to_uniform_disk_concentric(u)
    turn = dr.inv_two_pi * dr.atan2(p.y, p.x)
    return dr.select(lamp.around, mi.Point2f(dr.squared_norm(p), turn - dr.floor(turn)), u)


def direction(lamp: Lamp, o: mi.Point3f, u: mi.Point2f) -> tuple[mi.Vector3f, mi.Float]:
    """A direction in the cone from o around the ball, and the solid angle of that; differentiable in u.

    All directions where o is in the ball.
    """
    to = dr.detach(lamp.centre - o)
    dist2, r2 = dr.squared_norm(to), dr.square(lamp.radius)
    # 1 - cos of the cone, without the difference.
    s = dr.select(dist2 > r2, r2 / (dist2 + dr.safe_sqrt(dist2 * (dist2 - r2))), 2)
    p = mi.warp.square_to_uniform_disk_concentric(u)
    n = dr.squared_norm(p)
    across = dr.safe_sqrt(s * (2 - s * n))
    frame = mi.Frame3f(dr.select(dist2 > 0, to * dr.rsqrt(dist2), mi.Vector3f(0, 0, 1)))
    return frame.to_world(mi.Vector3f(across * p.x, across * p.y, 1 - s * n)), dr.two_pi * s


def followed(
    trace: TraceConfig, lamp: Lamp, origin: mi.Interaction3f, u: mi.Point2f, glue: Glimpse, active: mi.Bool
) -> mi.Vector3f:
    """The direction to a place of a lamp, differentiable in it, and in the origin and the lamp.

    On a mesh the point that follows it is that which ``glue`` sees.
    """
    in_cone = active & (lamp.radius > 0)
    light, _ = lamp.emitter.sample_direction(origin, sample_at(trace, lamp, u), active & ~in_cone)
    if not trace.traits.mesh_lights:
        return light.d
    d, _ = direction(lamp, origin.p, u)
    y = held_point(glue.hit, dr.detach(glue.ray), in_cone & glue.hit.is_valid()).p
    to_y = dr.normalize(dr.select(in_cone, y - origin.p, mi.Vector3f(0, 0, 1)))
    return dr.select(in_cone, d + (to_y - dr.detach(to_y)), light.d)
