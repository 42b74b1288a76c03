"""Where shadows of what moves fall on the film: they decide where a first look is taken, and nothing else.

The shadow of something small covers few pixels, which few segments would find. Light tells where it falls: a point of a
shape that moves, and a direction from which light arrives there, give a ray that goes on to what the shape may shade.
Whether the camera sees that is not asked.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from pathreplay.boundary.edges import FilmDomain
from pathreplay.samplers.counter_sampler import CounterSampler, key_of
from pathreplay.transport.meet import meet
from pathreplay.transport.vertex import TraceConfig

SAMPLED = frozenset(map(int, (mi.ShapeType.Sphere, mi.ShapeType.Rectangle, mi.ShapeType.Disk, mi.ShapeType.Cylinder)))
RAYS = 1024
THROUGH = 4
"""Surfaces of the shape itself that a ray passes at most."""


def casters(trace: TraceConfig) -> list[mi.Shape]:
    """The shapes that are known to move, and of which points can be drawn."""
    return [shape for shape in trace.traits.moving or () if shape.is_mesh() or int(shape.shape_type()) in SAMPLED]


@dr.syntax
def cast_shadows(
    trace: TraceConfig, shapes: list[mi.Shape], places: FilmDomain, seed: mi.UInt32
) -> tuple[mi.Point2f, mi.Bool]:
    """Film positions, and whether a shadow of one of the shapes may fall there."""
    numbers = CounterSampler.of(key_of(dr.arange(mi.UInt32, RAYS), seed))
    number, u = dr.minimum(mi.UInt32(numbers.next_1d() * len(shapes)), len(shapes) - 1), numbers.next_2d()
    which = numbers.next_1d()
    shape, at = mi.ShapePtr(shapes[0]), dr.zeros(mi.Interaction3f)
    for k in range(len(shapes)):
        there = number == k
        shape = dr.select(there, mi.ShapePtr(shapes[k]), shape)
        at.p = dr.select(there, _point(shapes[k], which, u), at.p)
    light, _ = trace.scene.sample_emitter_direction(at, numbers.next_2d(), False, True)
    active = light.pdf > 0
    ray = mi.Ray3f(at.p, -light.d)
    hit = meet(trace, ray, active)
    n = mi.UInt32(0)
    while dr.hint(active & (hit.shape == shape) & (n < THROUGH), exclude=[trace], label="pathreplay: cast a shadow"):
        ray = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal, mi.Bool(True)).spawn_ray(ray.d)
        hit = meet(trace, ray, mi.Bool(True))
        n += 1
    s, inside = places.of_point(ray.o + hit.t * ray.d)
    return s, active & hit.is_valid() & inside


def _point(shape: mi.Shape, which: mi.Float, u: mi.Point2f) -> mi.Point3f:
    """A point of a shape; of a mesh in a triangle, each of which is as likely."""
    if not shape.is_mesh():
        return shape.sample_position(0, u).p
    n = shape.face_count()
    corners = shape.face_indices(dr.minimum(mi.UInt32(which * n), n - 1))
    a, b, c = (shape.vertex_position(corners[k]) for k in range(3))
    x, y = mi.warp.square_to_uniform_triangle(u)
    return a + x * (b - a) + y * (c - a)
