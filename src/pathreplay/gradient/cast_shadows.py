"""Where shadows of what moves fall on the film: they decide where a first look is taken, and nothing else.

The shadow of something small covers few pixels, which few lines would find. Light tells where it falls: a point in the
bounding box of a shape that moves, and a direction from which light arrives there, give a ray that goes on to what the
shape may shade. Whether the camera sees that is not asked. What `dr.freeze` records keeps the boxes of its first pass.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..transport.meet import meet
from ..transport.traits import boxes_of
from ..transport.vertex import Walk
from .counted import Counted, key_of
from .edges import Places

RAYS = 1024
THROUGH = 4
"""Surfaces of the shape itself that a ray passes at most."""


@dr.syntax
def cast_shadows(walk: Walk, places: Places, seed: mi.UInt32) -> tuple[mi.Point2f, mi.Bool]:
    """Places of the film, and whether a shadow may fall there. The shapes that move have to be known."""
    moving = walk.traits.moving
    assert moving
    numbers = Counted.of(key_of(dr.arange(mi.UInt32, RAYS), seed))
    number = dr.minimum(mi.UInt32(numbers.next_1d() * len(moving)), len(moving) - 1)
    shape = mi.ShapePtr(moving[0])
    for k in range(1, len(moving)):
        shape = dr.select(number == k, mi.ShapePtr(moving[k]), shape)
    low, high = (dr.gather(mi.Point3f, boxes_of(moving), 2 * number + k) for k in (0, 1))
    u = mi.Point3f(*numbers.next_2d(), numbers.next_1d())
    at = dr.zeros(mi.Interaction3f)
    at.p = low + u * (high - low)
    light, _ = walk.scene.sample_emitter_direction(at, numbers.next_2d(), False, True)
    active = light.pdf > 0
    ray = mi.Ray3f(at.p, -light.d)
    hit = meet(walk, ray, active)
    n = mi.UInt32(0)
    while dr.hint(active & (hit.shape == shape) & (n < THROUGH), exclude=[walk], label="pathreplay: cast a shadow"):
        ray = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal, mi.Bool(True)).spawn_ray(ray.d)
        hit = meet(walk, ray, mi.Bool(True))
        n += 1
    s, inside = places.of_point(ray.o + hit.t * ray.d)
    return s, active & hit.is_valid() & inside
