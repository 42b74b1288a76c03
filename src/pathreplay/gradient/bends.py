"""Edges that are no outlines: lines where two surfaces meet, and where a smooth one turns dark.

A smooth mesh goes dark where its shading normal is at right angles to the ray, a little before its outline.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..transport.signature import place_met, turned_away
from ..transport.vertex import Walk
from .crofton import at_an_angle, hides_itself

MEETS = 1e-3
"""Relative difference of two distances up to which surfaces meet."""


@dataclass
class Bend:
    """What two rays met, at the two sides of an edge."""

    a: mi.PreliminaryIntersection3f
    b: mi.PreliminaryIntersection3f
    meets: mi.Bool  # two surfaces meet there, at an angle
    turns: mi.Bool  # it is one sheet of one surface, the shading normal of which is at right angles to the ray

    @staticmethod
    def of(
        walk: Walk,
        sides: tuple[tuple[mi.PreliminaryIntersection3f, mi.Ray3f], tuple[mi.PreliminaryIntersection3f, mi.Ray3f]],
        active: mi.Bool,
    ) -> Bend:
        """Detached."""
        (a, _), (b, _) = sides
        both = active & a.is_valid() & b.is_valid()
        flags = mi.RayFlags.Minimal | mi.RayFlags.ShadingFrame
        si_a, si_b = (x.compute_surface_interaction(ray, flags, both) for x, ray in sides)
        meets = both & at_an_angle(si_a.n, si_b.n) & (dr.abs(a.t - b.t) < MEETS * dr.minimum(a.t, b.t))
        same = both & (place_met(walk, a, both) == place_met(walk, b, both))
        dark = [turned_away(si, ray.d) for si, (_, ray) in zip((si_a, si_b), sides, strict=True)]
        turns = same & (dark[0] != dark[1]) & ~hides_itself(si_a.p, si_a.n, si_b.p, si_b.n)
        return Bend(a, b, meets, turns)

    def gap(self, ray: mi.Ray3f, active: mi.Bool) -> mi.Float:
        """B: zero on the edge, and wherever there is none; differentiable in the ray and in the shapes."""
        meets, turns = active & self.meets, active & self.turns
        t = [hit.compute_surface_interaction(ray, mi.RayFlags.All, meets).t for hit in (self.a, self.b)]
        si = self.a.compute_surface_interaction(ray, mi.RayFlags.All, turns)
        return dr.select(meets, t[0] - t[1], dr.select(turns, dr.dot(si.sh_frame.n, ray.d), 0))
