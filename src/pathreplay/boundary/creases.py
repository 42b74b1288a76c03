"""Creases: edges at which no surface occludes another.

There are four kinds of creases. At a contact, two surfaces meet. The second kind is the boundary of a hard shadow. The
third is a line at which a smooth-shaded mesh turns black, because its shading normal becomes perpendicular to the ray.
This line lies slightly inside the outline of the mesh. The fourth is the horizon of a `sunsky`, below which it is
black.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import drjit as dr
import mitsuba as mi

from pathreplay.boundary.crofton import at_an_angle, hides_itself
from pathreplay.boundary.hard_shadows import HardShadow
from pathreplay.platform import compat
from pathreplay.transport.meet import meet
from pathreplay.transport.signature import horizon_gap, place_met, shape_met, turned_away
from pathreplay.transport.vertex import Arrival, TraceConfig

MEETS = 1e-3
"""Largest relative difference of distances at which two surfaces are considered in contact."""
ASIDE = 2.0
"""Distance from the contact line of two surfaces to which `off_contact` moves hits. The unit is the distance at which
offset ray origins just lie in front of both surfaces."""
STEEPEST = 8.0
"""Bound on the cotangent of half the angle between two surfaces. `ASIDE` suffices for angles of at least 14 degrees."""

Side: TypeAlias = "tuple[mi.PreliminaryIntersection3f, mi.Ray3f]"
"""A hit and its ray."""


@dataclass
class Crease:
    """The crease between the hits of two rays. It is of one of the four kinds that the module describes."""

    a: mi.PreliminaryIntersection3f
    b: mi.PreliminaryIntersection3f
    meets: mi.Bool  # two surfaces are in contact, at an angle
    turns: mi.Bool  # the hits are on one sheet, and only one of their shading normals faces the ray
    shadow: HardShadow | None  # None if no vertex is tested for hard shadows
    sky: mi.Bool  # both rays miss all surfaces
    sunsky: mi.Emitter | None

    @staticmethod
    def of(trace: TraceConfig, side_a: Side, side_b: Side, shadow: HardShadow | None, active: mi.Bool) -> Crease:
        """Classify the edge between two hits. The result is detached."""
        (a, ray_a), (b, ray_b) = side_a, side_b
        both, sky = active & a.is_valid() & b.is_valid(), active & ~a.is_valid() & ~b.is_valid()
        if shadow is not None:
            both &= ~shadow.exists
        flags = compat.shading_frame()
        si_a, si_b = (hit.compute_surface_interaction(ray, flags, both) for hit, ray in (side_a, side_b))
        meets = both & at_an_angle(si_a.n, si_b.n) & (dr.abs(a.t - b.t) < MEETS * dr.minimum(a.t, b.t))
        same = both & (place_met(trace, a, both, si_a.shape) == place_met(trace, b, both, si_b.shape))
        turns = same & (turned_away(si_a, ray_a.d) != turned_away(si_b, ray_b.d)) & ~hides_itself(si_a, si_b)
        sky &= mi.Bool(trace.horizon is not None)
        return Crease(a, b, meets, turns, shadow, sky, trace.horizon)

    @property
    def exists(self) -> mi.Bool:
        """Whether a crease lies between the two hits."""
        exists = self.meets | self.turns | self.sky
        return exists if self.shadow is None else exists | self.shadow.exists

    def gap(self, ray: mi.Ray3f, active: mi.Bool) -> mi.Float:
        """Evaluate B, which is zero on the crease. B is also zero in lanes without a crease.

        B is differentiable in the ray and in the shapes.
        """
        meets, turns = active & self.meets, active & self.turns
        a = self.a.compute_surface_interaction(ray, compat.shading(), meets | turns)
        b = self.b.compute_surface_interaction(ray, compat.shading(), meets)
        B = dr.select(meets, a.t - b.t, dr.select(turns, dr.dot(a.sh_frame.n, ray.d), 0))
        if self.sunsky is not None:
            B = dr.select(active & self.sky, horizon_gap(self.sunsky, ray.d), B)
        return B if self.shadow is None else dr.select(self.shadow.exists, self.shadow.gap(ray, active), B)


def off_contact(trace: TraceConfig, a: Arrival, b: Arrival, active: mi.Bool) -> list[Arrival]:
    """Return the arrivals on the two sides of an edge. In a concave corner of two surfaces, the hits are moved apart.

    The origin of a ray is offset from the surface on which the ray starts. If a hit is closer to the corner than this
    offset, the origin of the next ray lies behind the other surface. For example, the origin could lie below the floor,
    and the ray would miss the floor. The moved hits cause a small error. Radiance is continuous along each surface, so
    that the error is proportional to the distance by which the hits move. This distance is some thousandths of the size
    of objects.
    """
    sides = [(at, at.hit.compute_surface_interaction(at.ray, compat.minimal(), active)) for at in (a, b)]
    normals = [dr.select(dr.dot(si.n, at.ray.d) > 0, -si.n, si.n) for at, si in sides]
    contact, cosine = dr.cross(*normals), dr.dot(*normals)
    ok = active & a.hit.is_valid() & b.hit.is_valid() & at_an_angle(*normals)
    cot = dr.minimum(dr.safe_sqrt((1 - cosine) / (1 + cosine)), STEEPEST)
    x = ASIDE * mi.math.RayEpsilon * (1 + cot) * (1 + dr.max(dr.abs(sides[0][1].p)))
    across = dr.cross(a.ray.d, contact)  # perpendicular to the contact line, in the image plane
    separation = dr.dot(across, a.ray.d - b.ray.d)
    moved = []
    for (at, si), n, other, side in zip(sides, normals, reversed(normals), (separation, -separation), strict=True):
        away = dr.normalize(other - dr.dot(other, n) * n)  # tangent to one surface, away from the other surface
        moved.append(_towards(trace, at, si.p + x * away, 4 * x, ok & (dr.dot(across, away) * side > 0)))
    return moved


def _towards(trace: TraceConfig, at: Arrival, p: mi.Point3f, short: mi.Float, active: mi.Bool) -> Arrival:
    """Move an arrival to the nearby point ``p``, if a ray towards ``p`` hits the same surface as before.

    The ray starts at the distance ``short`` before ``p``.
    """
    ray, to_p = mi.Ray3f(at.ray), p - at.ray.o
    ray.d = dr.normalize(to_p)
    offset = dr.maximum(dr.norm(to_p) - short, 0)
    onward = mi.Ray3f(ray)
    onward.o, onward.maxt = ray.o + offset * ray.d, dr.inf
    hit = meet(trace, onward, active)
    hit.t += offset
    places = [place_met(trace, h, active, shape_met(trace, h, r, active)) for h, r in ((hit, ray), (at.hit, at.ray))]
    same = active & (places[0] == places[1])
    return dr.select(same, replace(at, ray=ray, hit=hit), at)
