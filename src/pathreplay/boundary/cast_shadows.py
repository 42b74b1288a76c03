"""Find film positions at which moving shapes may cast shadows.

The pilot pass of `SecondarySearch` concentrates some of its boundary segments at these positions. The shadow of a small
object covers few pixels, and few uniformly distributed segments would cross its boundary. To find the shadow, rays are
traced from points on moving shapes, away from the light. Behind the shape, a ray hits the surface on which the shadow
may fall. Whether the camera sees this surface is not tested.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from pathreplay.boundary.edges import FilmDomain
from pathreplay.platform import compat
from pathreplay.samplers.counter_sampler import CounterSampler, key_of
from pathreplay.transport.facts.nodes import is_mesh
from pathreplay.transport.meet import meet
from pathreplay.transport.vertex import TraceConfig

SAMPLED = frozenset(map(int, (mi.ShapeType.Sphere, mi.ShapeType.Rectangle, mi.ShapeType.Disk, mi.ShapeType.Cylinder)))
RAYS = 1024
THROUGH = 4
"""Largest number of successive hits on the moving shape itself that a ray ignores."""


def casters(trace: TraceConfig) -> list[mi.Shape]:
    """Return the shapes that are known to move and can be sampled."""
    return [shape for shape in trace.traits.moving or () if shape.is_mesh() or int(shape.shape_type()) in SAMPLED]


@dr.syntax
def cast_shadows(
    trace: TraceConfig, shapes: list[mi.Shape], film: FilmDomain, seed: mi.UInt32
) -> tuple[mi.Point2f, mi.Bool]:
    """Return `RAYS` film positions, and for each position whether a shadow of one of the shapes may fall on it."""
    sampler = CounterSampler.of(key_of(dr.arange(mi.UInt32, RAYS), seed))
    index, u = dr.minimum(mi.UInt32(sampler.next_1d() * len(shapes)), len(shapes) - 1), sampler.next_2d()
    u_face = sampler.next_1d()
    shape, x = mi.ShapePtr(shapes[0]), dr.zeros(mi.Interaction3f)
    for k in range(len(shapes)):
        selected = index == k
        shape = dr.select(selected, mi.ShapePtr(shapes[k]), shape)
        x.p = dr.select(selected, _point(shapes[k], u_face, u), x.p)
    light, _ = trace.scene.sample_emitter_direction(x, sampler.next_2d(), False, True)
    active = light.pdf > 0
    ray = mi.Ray3f(x.p, -light.d)
    hit = meet(trace, ray, active)
    n = mi.UInt32(0)
    while dr.hint(active & (hit.shape == shape) & (n < THROUGH), exclude=[trace], label="pathreplay: cast a shadow"):
        ray = hit.compute_surface_interaction(ray, compat.minimal(), mi.Bool(True)).spawn_ray(ray.d)
        hit = meet(trace, ray, mi.Bool(True))
        n += 1
    s, inside = film.of_point(ray.o + hit.t * ray.d)
    return s, active & hit.is_valid() & inside


def _point(shape: mi.Shape, u_face: mi.Float, u: mi.Point2f) -> mi.Point3f:
    """Sample a point on a shape; on a mesh, all triangles are equally likely."""
    if not is_mesh(shape):
        return shape.sample_position(0, u).p
    n = shape.face_count()
    corners = shape.face_indices(dr.minimum(mi.UInt32(u_face * n), n - 1))
    a, b, c = (shape.vertex_position(corners[k]) for k in range(3))
    x, y = mi.warp.square_to_uniform_triangle(u)
    return a + x * (b - a) + y * (c - a)
