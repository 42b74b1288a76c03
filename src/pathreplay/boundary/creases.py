"""Edges that are no outlines: where two surfaces meet, where a smooth one turns dark, and where a hard shadow ends.

A smooth mesh goes dark where its shading normal is at right angles to the ray, a little before its outline.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import drjit as dr
import mitsuba as mi

from pathreplay.boundary.crofton import at_an_angle, hides_itself
from pathreplay.boundary.hard_shadows import HardShadow
from pathreplay.transport.meet import meet
from pathreplay.transport.signature import place_met, shape_met, turned_away
from pathreplay.transport.vertex import Arrival, TraceConfig

MEETS = 1e-3
"""Relative difference of two distances up to which surfaces meet."""
ASIDE = 2.0
"""Distance from a line of contact at which light is looked at, over the least at which rays begin between its sides."""
STEEPEST = 8.0
"""Cotangent of half the angle of the sharpest corner for which that is far enough: it has 14 degrees."""

Side: TypeAlias = "tuple[mi.PreliminaryIntersection3f, mi.Ray3f]"
"""What a ray met, and the ray."""


@dataclass
class Crease:
    """An edge that is no outline between what two rays met, if there is one."""

    a: mi.PreliminaryIntersection3f
    b: mi.PreliminaryIntersection3f
    meets: mi.Bool  # two surfaces meet there, at an angle
    turns: mi.Bool  # it is one sheet of one surface, the shading normal of which is at right angles to the ray
    shadow: HardShadow | None  # where there are lights that cast them

    @staticmethod
    def of(trace: TraceConfig, side_a: Side, side_b: Side, shadow: HardShadow | None, active: mi.Bool) -> Crease:
        """Detached."""
        (a, ray_a), (b, ray_b) = side_a, side_b
        both = active & a.is_valid() & b.is_valid()
        if shadow is not None:
            both &= ~shadow.there
        flags = mi.RayFlags.Minimal | mi.RayFlags.ShadingFrame
        si_a, si_b = (hit.compute_surface_interaction(ray, flags, both) for hit, ray in (side_a, side_b))
        meets = both & at_an_angle(si_a.n, si_b.n) & (dr.abs(a.t - b.t) < MEETS * dr.minimum(a.t, b.t))
        same = both & (place_met(trace, a, both, si_a.shape) == place_met(trace, b, both, si_b.shape))
        turns = same & (turned_away(si_a, ray_a.d) != turned_away(si_b, ray_b.d)) & ~hides_itself(si_a, si_b)
        return Crease(a, b, meets, turns, shadow)

    @property
    def there(self) -> mi.Bool:
        """Whether there is one."""
        there = self.meets | self.turns
        return there if self.shadow is None else there | self.shadow.there

    def gap(self, ray: mi.Ray3f, active: mi.Bool) -> mi.Float:
        """B: zero on the edge, and wherever there is none; differentiable in the ray and in the shapes."""
        meets, turns = active & self.meets, active & self.turns
        t = [hit.compute_surface_interaction(ray, mi.RayFlags.All, meets).t for hit in (self.a, self.b)]
        si = self.a.compute_surface_interaction(ray, mi.RayFlags.All, turns)
        B = dr.select(meets, t[0] - t[1], dr.select(turns, dr.dot(si.sh_frame.n, ray.d), 0))
        return B if self.shadow is None else dr.select(self.shadow.there, self.shadow.gap(ray, active), B)


def off_contact(trace: TraceConfig, a: Arrival, b: Arrival, active: mi.Bool) -> list[Arrival]:
    """The arrivals at two sides of an edge; where two surfaces meet in a hollow, a little further from each other.

    Rays begin beside their surface. Closer to a line of contact than that they begin behind the other surface, and see
    what is there: a sky below the floor. Light is continuous along each surface, so that an error is left that is
    proportional to the distance, some thousandths of the size of things.
    """
    sides = [(at, at.hit.compute_surface_interaction(at.ray, mi.RayFlags.Minimal, active)) for at in (a, b)]
    normals = [dr.select(dr.dot(si.n, at.ray.d) > 0, -si.n, si.n) for at, si in sides]
    along, cosine = dr.cross(*normals), dr.dot(*normals)
    ok = active & a.hit.is_valid() & b.hit.is_valid() & at_an_angle(*normals)
    cot = dr.minimum(dr.safe_sqrt((1 - cosine) / (1 + cosine)), STEEPEST)
    x = ASIDE * mi.math.RayEpsilon * (1 + cot) * (1 + dr.max(dr.abs(sides[0][1].p)))
    across = dr.cross(a.ray.d, along)  # for the eye, from the one to the other
    parts = dr.dot(across, a.ray.d - b.ray.d)
    moved = []
    for (at, si), n, other, side in zip(sides, normals, reversed(normals), (parts, -parts), strict=True):
        away = dr.normalize(other - dr.dot(other, n) * n)  # along the surface, to the front of the other one
        moved.append(_towards(trace, at, si.p + x * away, 4 * x, ok & (dr.dot(across, away) * side > 0)))
    return moved


def _towards(trace: TraceConfig, at: Arrival, p: mi.Point3f, short: mi.Float, active: mi.Bool) -> Arrival:
    """The arrival at another point close by: looked for from ``short`` of it on, and the same where it is elsewhere."""
    ray, line = mi.Ray3f(at.ray), p - at.ray.o
    ray.d = dr.normalize(line)
    gone = dr.maximum(dr.norm(line) - short, 0)
    rest = mi.Ray3f(ray)
    rest.o, rest.maxt = ray.o + gone * ray.d, dr.inf
    hit = meet(trace, rest, active)
    hit.t += gone
    places = [place_met(trace, h, active, shape_met(trace, h, r, active)) for h, r in ((hit, ray), (at.hit, at.ray))]
    same = active & (places[0] == places[1])
    return dr.select(same, replace(at, ray=ray, hit=hit), at)
