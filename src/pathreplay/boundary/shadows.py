"""Edges of shadows, as a vertex sees them among the samples of an emitter.

Segments lie in the unit square of samples. At one end the emitter is seen, at the other it is hidden.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import reduce

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import derivative_by_place
from pathreplay.boundary.crofton import (
    ROUNDING,
    PlaneSegment,
    Survey,
    VisibilityProbe,
    bisect,
    heading,
    passed,
    probed,
)
from pathreplay.boundary.emitters import Glimpse, Lamp, followed, glimpse
from pathreplay.boundary.observer import ObserverVertex
from pathreplay.boundary.worth import STEEP, Worth, closeness, own_plane
from pathreplay.samplers.counter_sampler import CounterSampler
from pathreplay.transport.motion import may_move
from pathreplay.transport.signature import edge_normal, outline_gap
from pathreplay.transport.vertex import mis_weight

BORDER = 1e-4
"""Width of the border of the unit square that is left out: some emitters are singular there (the cone of a sphere)."""
INSIDE = 1 - 2 * BORDER
JUMP = 4.0
"""So many times as far from an edge as its slope says is the other end of a piece where emitter samples jump."""


@dataclass
class EmitterSegment(PlaneSegment):
    """A segment in the unit square of one emitter (see `emitters`), which is reflected at the border."""

    observer: ObserverVertex
    key: mi.UInt32
    lamp: Lamp
    share: mi.Float  # 1 / probability of the emitter

    @staticmethod
    def draw(observer: ObserverVertex, l: float, key: mi.UInt32) -> EmitterSegment:
        numbers, scene = CounterSampler.of(key), observer.trace.scene
        which, turn = numbers.next_2d()
        index, share, _ = scene.sample_emitter(which)
        c = BORDER + INSIDE * numbers.next_2d()
        lamp = Lamp.of(observer.trace, index, observer.active)
        return EmitterSegment(mi.Point2f(c), heading(turn), mi.Float(l), observer, key, lamp, share)

    def at(self, t: mi.Float) -> mi.Point2f:
        return self._folded(t)[0]

    def direction(self, t: mi.Float) -> mi.Vector2f:
        """Its direction at a place."""
        return self._folded(t)[1]

    def _folded(self, t: mi.Float) -> tuple[mi.Point2f, mi.Vector2f]:
        x = (self.c + t * self.w - BORDER) / INSIDE
        x -= 2 * dr.floor(0.5 * x)
        back = x > 1
        return BORDER + INSIDE * dr.select(back, 2 - x, x), dr.select(back, -self.w, self.w)

    def glimpse(self, t: mi.Float, active: mi.Bool) -> Glimpse:
        """The light at a place, or what hides it."""
        return glimpse(self.observer.trace, self.observer, self.lamp, self.at(t), active)

    def probe(self, t: mi.Float, active: mi.Bool) -> VisibilityProbe:
        """What is seen at a place: see `Probe`."""
        return self._probe(self.glimpse(t, active))

    def _probe(self, seen: Glimpse) -> VisibilityProbe:
        x = self.observer.selected
        moves = x.moves | _moves(self.observer, self.lamp.emitter) | may_move(self.observer.trace, seen.hit)
        return VisibilityProbe.of(mi.UInt32(seen.hidden & moves))

    def detect(self) -> Worth:
        """What an edge on the segment may be worth. Where no lobe is narrow, the middle tells what is scattered."""
        trace, x, active = self.observer.trace, self.observer.selected, self.observer.active
        glimpses = [self.glimpse(t, active) for t in probed(self.length)]
        a, b, c = (seen.light.d for seen in glimpses)
        if trace.traits.narrow:
            scattered = [self.observer.towards(d, active) for d in (a, b, c)]
        else:
            scattered = [self.observer.towards(c, active)] * 3
        probes = [self._probe(seen) for seen in glimpses]
        for probe, seen, (f, pdf) in zip(probes, glimpses, scattered, strict=True):
            probe.bright = dr.mean(dr.abs(x.β * self._light(seen, f, pdf)))
        survey = Survey.of(probes, active)
        first = reduce(lambda p, q: dr.select(q.hidden & ~(p.hidden & (p.hit.t <= q.hit.t)), q, p), glimpses)
        survey.near = dr.select(first.hidden, closeness(trace, first.hit), 0)
        turn = dr.norm(a - c) + dr.norm(c - b)
        return Worth.of(survey, survey.bright, own_plane(self.observer, a, b) / (turn + self.length * STEEP))

    def _light(self, seen: Glimpse, f: mi.Spectrum, pdf: mi.Float) -> mi.Spectrum:
        """What is scattered of the light there, weighted by multiple importance sampling."""
        mis = dr.select(seen.light.delta, 1, mis_weight(seen.density / self.share, pdf))
        return f * seen.Le * (self.share * mis)

    def resolve(self, weight: mi.Float, generator: mi.PCG32) -> ShadowCrossing:
        """Bisect the segment, and weigh the edge: see `EdgeSearch.resolve`."""
        observer = self.observer
        crossed = bisect(self.probe, self.length, dr.select(observer.active, weight, 0), generator)
        active = crossed.weight > 0
        a, b = (self.glimpse(t, active) for t in (crossed.a, crossed.b))
        active &= a.hidden != b.hidden
        lit, dark = dr.select(a.hidden, b, a), dr.select(a.hidden, a, b)
        active &= (self.lamp.radius == 0) | (dark.hit.t < lit.hit.t)  # or it is the mesh that ends there
        active &= observer.is_off(dark.hit.t)
        f, pdf = observer.towards(lit.light.d, active)
        T = observer.transmittance_past_edge(lit.light, dark.hit.t, self.key, active)
        jump = observer.selected.β * T * self._light(lit, f, pdf)
        jump *= crossed.per_length(self.length, mi.Float(INSIDE**-2)) * dr.select(a.hidden, -1, 1)
        active &= dr.any(jump != 0) & dr.all(dr.isfinite(jump))
        u, u_lit = (self.at(dr.select(a.hidden, *t)) for t in ((crossed.a, crossed.b), (crossed.b, crossed.a)))
        own = active & observer.parts(lit.light.d, dark.light.d)  # not that of the ray, which begins a little beside
        n = edge_normal(dark.hit, dark.ray, active)
        crossing = ShadowCrossing(jump, observer, self.lamp, u, lit, dark.hit, dark.ray, n, own, active)
        return crossing.weighted(self.direction(crossed.a), u_lit)


def _moves(observer: ObserverVertex, emitter: mi.EmitterPtr) -> mi.Bool:
    """Whether an emitter may move."""
    moving = observer.trace.traits.moving
    moves = mi.Bool(moving is None)
    for shape in moving or ():
        if shape.is_emitter():
            moves |= emitter == mi.EmitterPtr(shape.emitter())
    return moves


@dataclass
class ShadowCrossing:
    """A crossing in the square of an emitter, where the lit side ends: see `Crossing`."""

    weight: mi.Spectrum
    observer: ObserverVertex
    lamp: Lamp
    u: mi.Point2f  # at the side in the shadow
    lit: Glimpse  # at the other
    hit: mi.PreliminaryIntersection3f  # of what casts it
    ray: mi.Ray3f
    n: mi.Vector3f
    own: mi.Bool  # what hides the emitter is the plane of the observer's own triangle
    active: mi.Bool

    def gap(self, at: mi.Interaction3f) -> mi.Float:
        """See `Crossing`."""
        return self._gap(at, self.u)

    def _gap(self, at: mi.Interaction3f, u: mi.Point2f) -> mi.Float:
        """B of another emitter sample: distance of the line to it from the edge."""
        d = followed(self.observer.trace, self.lamp, at, u, self.lit, self.active)
        return dr.select(self.own, dr.dot(at.n, d), outline_gap(self.n, at.p, d, self.hit, self.ray, self.active))

    def weighted(self, w: mi.Vector2f, u_lit: mi.Point2f) -> ShadowCrossing:
        """The crossing with K: its weight so far is the jump along ``w``; ``u_lit`` is the sample at the lit side."""
        at = self.observer.moved(self.observer.at.ray)
        slope = derivative_by_place(self.u, lambda u: self._gap(at, u))
        # Where a sample of the emitter jumps there is no edge: its other side is far off.
        off = dr.abs(self._gap(at, u_lit) - self._gap(at, self.u))
        jumps = off > JUMP * dr.norm(slope) * dr.norm(u_lit - self.u) + ROUNDING * (dr.norm(self.ray.o) + self.hit.t)
        return replace(self, weight=passed(w, self.weight, slope, self.active & ~jumps))
