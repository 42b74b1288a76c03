"""Arcs of directions around a vertex, along which edges between surfaces are looked for: see `crofton`.

Their centres are samples of the BSDF, with a density p, and their lengths suit it. At the peak of a lobe that is
narrower than an arc is long, f is many times the density at a centre beside the peak, and the variance has no bound
that a user would call one. So arcs have several lengths l_j. One is drawn with a probability P_j(p), which prefers
short arcs where p is high. A crossing at a place with density p counts

    a_j(p) / (P_j(p_c) l_j),        a_j ∝ l_j P_j(p) min(1, p_j / p),        Σ_j a_j = 1,

with p_c the density at the centre of its arc, and p_j the density up to which arcs of length l_j are short enough.
Whatever the a_j are, the sum over all lengths has the right mean; these a_j are small where an arc is too long.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .counted import Counted
from .seer import Seer

EVENLY = 0.25
"""Share of the arcs that are thrown evenly: those that begin below the horizon, or where lobes are weak, count, too."""
LENGTHS = 4
"""So many lengths, each a quarter of the one before."""
BROAD = 64 / dr.pi
"""Density up to which the longest arcs are short enough: that of a lobe of rough metal 0.06 rough, beside whose peak,
half an arc away, the density is a third less."""
ANY = 0.1
"""Share of the arcs whose length does not ask for the density."""


@dataclass
class Arc:
    """A piece of a great circle of directions."""

    c: mi.Vector3f
    w: mi.Vector3f  # the direction in which it leaves its centre
    begin: mi.Float
    end: mi.Float
    p: mi.Float  # density of the centre, in which all lengths share
    j: mi.UInt32 | None  # of its length; None: there is one only

    def at(self, t: mi.Float) -> mi.Vector3f:
        return self.c * dr.cos(t) + self.w * dr.sin(t)

    def weight(self, p: mi.Float) -> mi.Float:
        """What a crossing counts at a direction with so much of the centres' density: a_j(p) / (P_j(p_c) l_j p_c)."""
        l = self.end - self.begin
        if self.j is None:
            return dr.rcp(l * self.p)
        longest = l * dr.exp2(2 * mi.Float(self.j))
        share = probability(p, self.j) / probability(self.p, self.j)
        return share * _suits(p, self.j) / (_sum(p) * longest * self.p)

    def importance(self) -> mi.Float:
        """The same, where the density is that of the centre, relative to what it would be if all arcs were long."""
        return mi.Float(1) if self.j is None else _suits(self.p, self.j) / _sum(self.p)


def arc(seer: Seer, l: float, narrow: bool, key: mi.UInt32, active: mi.Bool) -> tuple[Arc, mi.Bool]:
    """An arc around a direction in which a vertex scatters, and whether there is one.

    The longest ones are ``l`` radians long; all are where no lobe may be ``narrow``.
    """
    numbers = Counted(key, mi.UInt32(0x100))
    d, smooth = seer.sample(numbers.next_1d(), numbers.next_2d())
    evenly = numbers.next_1d() < EVENLY
    d = dr.select(evenly, mi.warp.square_to_uniform_sphere(numbers.next_2d()), d)
    ok = active & (evenly | smooth)
    p = dr.select(ok, density_of_centres(seer.towards(d, ok)[1]), 1)
    c = dr.select(ok, d, mi.Vector3f(0, 0, 1))
    turn = dr.two_pi * numbers.next_1d()
    w = mi.Frame3f(c).to_world(mi.Vector3f(dr.cos(turn), dr.sin(turn), 0))
    j = length_drawn(p, numbers) if narrow else None
    half = mi.Float(0.5 * l) if j is None else 0.5 * l * _length(j)
    return Arc(c, w, -half, half, p, j), ok


def density_of_centres(pdf: mi.Float) -> mi.Float:
    """That of centres in a direction that the BSDF samples with density ``pdf``."""
    return dr.lerp(pdf, dr.inv_four_pi, EVENLY)


def length_drawn(p: mi.Float, numbers: Counted) -> mi.UInt32:
    """j, with `probability`."""
    u, v = numbers.next_1d(), numbers.next_1d()
    return dr.select(u < ANY, mi.UInt32(u * (LENGTHS / ANY)), mi.UInt32(_level(p) + v))


def probability(p: mi.Float, j: mi.UInt32) -> mi.Float:
    """P_j(p)."""
    return ANY / LENGTHS + (1 - ANY) * dr.maximum(1 - dr.abs(_level(p) - mi.Float(j)), 0)


def _level(p: mi.Float) -> mi.Float:
    """The j whose arcs suit a density, between 0 and the last."""
    return dr.clip(dr.log2(p / BROAD) / 4, 0, LENGTHS - 1)


def _length(j: mi.UInt32) -> mi.Float:
    """l_j, relative to the longest."""
    return dr.exp2(-2 * mi.Float(j))


def _suits(p: mi.Float, j: mi.UInt32) -> mi.Float:
    """min(1, p_j / p); of the shortest 1."""
    return dr.select(j == LENGTHS - 1, 1, dr.minimum(1, BROAD * dr.exp2(4 * mi.Float(j)) / p))


def _sum(p: mi.Float) -> mi.Float:
    """Σ_j l_j P_j min(1, p_j / p), relative to the longest length."""
    each = map(mi.UInt32, range(LENGTHS))
    return sum((_length(j) * probability(p, j) * _suits(p, j) for j in each), mi.Float(0))
