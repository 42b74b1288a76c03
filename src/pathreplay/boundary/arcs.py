"""Arcs of directions around a vertex, along which edges between surfaces are looked for: see `crofton`.

An arc goes through a sample d of the BSDF, drawn with a density p. Were that its centre, the variance would have no
bound worth the name where a lobe is narrower than the arc is long: at the peak f is many thousand times the density
beside it. So d lies at one of n places of the arc at random, and the density of the arc is the mean of p over these
places d_i, which knows of every lobe that is wider than they are apart. Lobes that are narrower yet have shorter arcs:
there are lengths l_j, one of which is drawn with a probability P_j(p), and a crossing at a place z counts

    a_j(z) / (l_j · mean p(d_i) P_j(p(d_i))),        a_j ∝ l_j P_j min(1, p_j / p(z)),        Σ_j a_j = 1,

with p_j the density up to which arcs of length l_j are short enough. Whatever the a_j are, the sum over all lengths has
the right mean. Great circles carry the measure of arcs along, so that it does not matter which place is the sample's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import drjit as dr
import mitsuba as mi

from pathreplay.boundary.observer import ObserverVertex
from pathreplay.samplers.counter_sampler import CounterSampler
from pathreplay.samplers.streams import Stream

EVENLY = 0.25
"""Share of the arcs that are thrown evenly: those that begin below the horizon, or where lobes are weak, count, too."""
LENGTHS = 3
"""So many lengths, each a quarter of the one before."""
BROAD = 256.0
"""Density up to which the longest arcs are short enough: that of a lobe of rough metal of roughness 0.02."""
ANY = 0.1
"""Share of the arcs whose length does not ask for the density."""
PLACES = 8
"""Places of an arc where the sample may lie, if a lobe may be narrow."""

A = TypeVar("A", bound="Arc")


@dataclass
class Arc:
    """A piece of a great circle of directions, through one in which a vertex scatters."""

    observer: ObserverVertex
    key: mi.UInt32
    c: mi.Vector3f
    w: mi.Vector3f  # the direction in which it leaves its centre
    length: mi.Float
    longest: float  # that of arcs where no lobe is narrow
    p: mi.Float  # density of the sample
    f: mi.Spectrum  # what is scattered from there
    active: mi.Bool  # there is one
    j: mi.UInt32 | None  # of its length; None: there is one only, and the sample is the centre

    @classmethod
    def draw(cls: type[A], observer: ObserverVertex, l: float, narrow: bool, key: mi.UInt32, active: mi.Bool) -> A:
        """An arc of at most ``l`` radians; as long as that where no lobe may be ``narrow``."""
        numbers = CounterSampler.stream(key, Stream.ARC)
        (lobe, way), turn = numbers.next_2d(), dr.two_pi * numbers.next_1d()
        d, smooth = observer.sample(lobe, numbers.next_2d())
        evenly = way < EVENLY
        d = dr.select(evenly, mi.warp.square_to_uniform_sphere(numbers.next_2d()), d)
        ok = active & (evenly | smooth)
        f, pdf = observer.towards(d, ok)
        p = dr.select(ok, density_of_samples(pdf), 1)
        d = dr.select(ok, d, mi.Vector3f(0, 0, 1))
        sin, cos = dr.sincos(turn)
        w = mi.Frame3f(d).to_world(mi.Vector3f(cos, sin, 0))
        if not narrow:
            return cls(observer, key, d, w, mi.Float(l), l, p, f, ok, None)
        j = length_drawn(p, numbers)
        full = l * _length(j)
        back = -full * _place(dr.minimum(mi.UInt32(PLACES * numbers.next_1d()), PLACES - 1))
        c, s = dr.cos(back), dr.sin(back)
        return cls(observer, key, c * d + s * w, c * w - s * d, full, l, p, f, ok, j)

    def at(self, t: mi.Float) -> mi.Vector3f:
        return self.c * dr.cos(t) + self.w * dr.sin(t)

    def weight(self, pdf: mi.Float, active: mi.Bool) -> mi.Float:
        """What a crossing counts at a direction that the BSDF samples with density ``pdf``."""
        if self.j is None:
            return dr.rcp(self.length * self.p)
        p = density_of_samples(pdf)
        share = _length(self.j) * probability(p, self.j) * _suits(p, self.j) / _sum(p)
        return share / (self.length * self._density(active))

    @dr.syntax
    def _density(self, active: mi.Bool) -> mi.Float:
        """The mean of p P_j over all places where the sample might lie."""
        arc, i, total = self, mi.UInt32(0), mi.Float(0)
        while dr.hint(i < PLACES, exclude=[arc, active], label="pathreplay: density of an arc"):
            p = density_of_samples(arc.observer.towards(arc.at(_place(i) * arc.length), active)[1])
            total += p * probability(p, arc.j) / PLACES
            i += 1
        return total

    def importance(self) -> mi.Float:
        """What a crossing is likely to count, relative to what it would if all arcs were long."""
        return mi.Float(1) if self.j is None else _suits(self.p, self.j) / _sum(self.p)


def density_of_samples(pdf: mi.Float) -> mi.Float:
    """p, in a direction that the BSDF samples with density ``pdf``."""
    return dr.lerp(pdf, dr.inv_four_pi, EVENLY)


def length_drawn(p: mi.Float, numbers: CounterSampler) -> mi.UInt32:
    """j, with `probability`."""
    u, v = numbers.next_1d(), numbers.next_1d()
    j = dr.select(u < ANY, mi.UInt32(u * (LENGTHS / ANY)), mi.UInt32(_level(p) + v))
    return dr.minimum(j, LENGTHS - 1)


def probability(p: mi.Float, j: mi.UInt32) -> mi.Float:
    """P_j(p)."""
    return ANY / LENGTHS + (1 - ANY) * dr.maximum(1 - dr.abs(_level(p) - mi.Float(j)), 0)


def _place(i: mi.UInt32) -> mi.Float:
    """Of the sample, in lengths from the centre."""
    return (mi.Float(i) + 0.5) / PLACES - 0.5


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
