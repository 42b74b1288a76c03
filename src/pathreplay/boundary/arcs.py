"""Arcs of directions around a vertex, on which edges between surfaces are searched: see `crofton`.

Each arc contains a BSDF sample d, drawn with density p(d). If d were always the centre of the arc, the variance would
be practically unbounded for lobes that are narrower than the arc. The centre of such an arc may lie beside a lobe,
where p is low, while the arc contains the peak of the lobe, at which the BSDF is many thousand times p. The sample d
therefore lies at one of n positions d_i of the arc, selected at random. The density of the arc is the mean of p(d_i)
over all i. This mean is large enough for all lobes that are wider than the spacing of the d_i. Narrower lobes need
shorter arcs. An arc has the length l_j with probability P_j(p(d)). The point at which an edge crosses the arc is a
direction z. The weight of the edge is

    a_j(z) / (l_j · m_j),        m_j = mean over i of p(d_i) P_j(p(d_i)),

    a_j(z) ∝ l_j P_j(p(z)) min(1, p_j / p(z)),        Σ_j a_j(z) = 1,

where p_j is the largest density for which arcs of length l_j are short enough. The expectation, summed over all
lengths, is correct for any a_j with sum 1. The expectation is also correct for every position of d on the arc, because
rotation along a great circle preserves the measure of arcs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import drjit as dr
import mitsuba as mi

from pathreplay.boundary.crofton import Bracket
from pathreplay.boundary.observer import ObserverVertex
from pathreplay.samplers.counter_sampler import CounterSampler
from pathreplay.samplers.streams import Stream
from pathreplay.transport.vertex import channel_mean

UNIFORM = 0.25
"""Fraction of arcs through uniformly sampled directions. BSDF samples are rare in weak lobes and below the horizon."""
LENGTHS = 3
"""Number of arc lengths; each is a quarter of the previous one."""
BROAD = 256.0
"""The longest arcs are short enough for lobes of at most this density, which a metal of roughness 0.02 has."""
ANY_LENGTH = 0.1
"""Fraction of arcs whose length does not depend on the density."""
POSITIONS = 8
"""Number of possible positions of the sample on an arc, if lobes may be narrow."""

A = TypeVar("A", bound="Arc")


@dataclass
class Arc:
    """An arc of a great circle of directions that contains a sampled direction."""

    observer: ObserverVertex
    key: mi.UInt32
    c: mi.Vector3f
    w: mi.Vector3f  # unit tangent at the centre
    length: mi.Float
    longest: float  # largest length; all arcs have this length if no lobe is narrow
    p: mi.Float  # density of the sampled direction
    f: mi.Spectrum  # scattering of light from the sampled direction
    active: mi.Bool  # the sample is valid
    j: mi.UInt32 | None  # index of the length; None if all arcs have one length and are centred at their samples

    @classmethod
    def draw(cls: type[A], observer: ObserverVertex, l: float, narrow: bool, key: mi.UInt32, active: mi.Bool) -> A:
        """Draw an arc. It has at most ``l`` radians if lobes may be ``narrow``, and otherwise exactly ``l`` radians."""
        sampler = CounterSampler.stream(key, Stream.ARC)
        (lobe, u_mode), turn = sampler.next_2d(), dr.two_pi * sampler.next_1d()
        d, smooth = observer.sample(lobe, sampler.next_2d())
        uniform = u_mode < UNIFORM
        d = dr.select(uniform, mi.warp.square_to_uniform_sphere(sampler.next_2d()), d)
        ok = active & (uniform | smooth)
        f, pdf = observer.towards(d, ok)
        p = dr.select(ok, density_of_samples(pdf), 1)
        d = dr.select(ok, d, mi.Vector3f(0, 0, 1))
        sin, cos = dr.sincos(turn)
        w = mi.Frame3f(d).to_world(mi.Vector3f(cos, sin, 0))
        if not narrow:
            return cls(observer, key, d, w, mi.Float(l), l, p, f, ok, None)
        j = draw_length(p, sampler)
        length = l * _length(j)
        offset = -length * _position(dr.minimum(mi.UInt32(POSITIONS * sampler.next_1d()), POSITIONS - 1))
        c, s = dr.cos(offset), dr.sin(offset)
        return cls(observer, key, c * d + s * w, c * w - s * d, length, l, p, f, ok, j)

    def at(self, t: mi.Float) -> mi.Vector3f:
        return self.c * dr.cos(t) + self.w * dr.sin(t)

    @property
    def light(self) -> mi.Float:
        """The throughput of the sampled direction, divided by its density."""
        return dr.select(self.active, channel_mean(dr.abs(self.observer.selected.β * self.f)) / self.p, 0)

    def per_length(self, bracket: Bracket, pdf: mi.Float, active: mi.Bool) -> mi.Float:
        """Return the number of crossings of a bracket times π/2 / (l p(c)): see `Bracket.per_length` and `weight`."""
        return 0.5 * dr.pi * bracket.weight * self.weight(pdf, active)

    def weight(self, pdf: mi.Float, active: mi.Bool) -> mi.Float:
        """Return the weight of an edge; ``pdf`` is the BSDF's density in the direction at which it crosses the arc."""
        if self.j is None:
            return dr.rcp(self.length * self.p)
        p = density_of_samples(pdf)
        a = _length(self.j) * probability(p, self.j) * _suitability(p, self.j) / _normalization(p)
        return a / (self.length * self._density(active))

    @dr.syntax
    def _density(self, active: mi.Bool) -> mi.Float:
        """Return the density of the arc: the mean of p(d_i) P_j(p(d_i)) over the `POSITIONS` directions d_i of the arc.

        The sampled direction is one of the d_i. p(d_i) is the density of samples in direction d_i, and P_j is the
        probability of the arc's length (see `probability`).
        """
        assert self.j is not None
        arc, j, i, total = self, self.j, mi.UInt32(0), mi.Float(0)
        while dr.hint(i < POSITIONS, exclude=[arc, j, active], label="pathreplay: density of an arc"):
            p = density_of_samples(arc.observer.towards(arc.at(_position(i) * arc.length), active)[1])
            total += p * probability(p, j) / POSITIONS
            i += 1
        return total

    def importance(self) -> mi.Float:
        """Estimate the weight of an edge on this arc, relative to its weight if all arcs had the largest length."""
        return mi.Float(1) if self.j is None else _suitability(self.p, self.j) / _normalization(self.p)


def density_of_samples(pdf: mi.Float) -> mi.Float:
    """Return the density p of samples in a direction: the BSDF's density ``pdf``, mixed with the uniform density."""
    return dr.lerp(pdf, dr.inv_four_pi, UNIFORM)


def draw_length(p: mi.Float, sampler: CounterSampler) -> mi.UInt32:
    """Draw the index j of a length with probability P_j(p) (see `probability`)."""
    u, v = sampler.next_1d(), sampler.next_1d()
    j = dr.select(u < ANY_LENGTH, mi.UInt32(u * (LENGTHS / ANY_LENGTH)), mi.UInt32(_level(p) + v))
    return dr.minimum(j, LENGTHS - 1)


def probability(p: mi.Float, j: mi.UInt32) -> mi.Float:
    """Return P_j(p), the probability of the length l_j for a sample with density p."""
    return ANY_LENGTH / LENGTHS + (1 - ANY_LENGTH) * dr.maximum(1 - dr.abs(_level(p) - mi.Float(j)), 0)


def _position(i: mi.UInt32) -> mi.Float:
    """Return the i-th possible position of the sample on the arc, between -1/2 and 1/2 (the two ends of the arc)."""
    return (mi.Float(i) + 0.5) / POSITIONS - 0.5


def _level(p: mi.Float) -> mi.Float:
    """Return the index j, as a real number, for which p_j = `BROAD` · 2^(4j) equals p; clipped to [0, LENGTHS - 1]."""
    return dr.clip(dr.log2(p / BROAD) / 4, 0, LENGTHS - 1)


def _length(j: mi.UInt32) -> mi.Float:
    """Return the arc length l_j, relative to the largest length."""
    return dr.exp2(-2 * mi.Float(j))


def _suitability(p: mi.Float, j: mi.UInt32) -> mi.Float:
    """Return min(1, p_j / p), which is small if arcs of length l_j are too long for the density ``p``.

    For the shortest arcs, the result is always 1.
    """
    return dr.select(j == LENGTHS - 1, 1, dr.minimum(1, BROAD * dr.exp2(4 * mi.Float(j)) / p))


def _normalization(p: mi.Float) -> mi.Float:
    """Return Σ_j l_j P_j(p) min(1, p_j / p), by which all a_j are divided. The unit of l_j is the largest length."""
    levels = map(mi.UInt32, range(LENGTHS))
    return sum((_length(j) * probability(p, j) * _suitability(p, j) for j in levels), mi.Float(0))
