"""Edges of shadows, as a vertex sees them among the samples of an emitter: on one side that is seen, or it is hidden.

Segments lie in a unit square. Of most emitters it is that of their samples. Samples of balls go around the middle of
what is seen of them: there straight edges would be bent without bounds, and segments too long to tell; so these are
mapped to a disk first, evenly. Samples of meshes jump in theirs from triangle to triangle; so for these the square is
mapped, evenly, to the cone of directions around a ball that holds the mesh. What follows the emitter, the point that is
glued to it, is the same in both.
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
from pathreplay.boundary.observer import ObserverVertex
from pathreplay.boundary.worth import STEEP, Worth, closeness, own_plane
from pathreplay.samplers.counter_sampler import CounterSampler
from pathreplay.transport.motion import may_move
from pathreplay.transport.signature import edge_normal, outline_gap
from pathreplay.transport.surface import surface_point
from pathreplay.transport.vertex import TraceConfig, mis_weight

BORDER = 1e-4
"""Width of the border of the unit square that is left out: some emitters are singular there (the cone of a sphere)."""
INSIDE = 1 - 2 * BORDER
JUMP = 4.0
"""Emitter samples jump where a bisected piece ends this many times as far from the edge as its slope predicts."""


@dataclass
class SampledEmitter:
    """An emitter, and a ball around it: its radius is 0 where it is no mesh."""

    emitter: mi.EmitterPtr
    centre: mi.Point3f
    radius: mi.Float
    around: mi.Bool  # its samples go around: see `sample_at`

    @staticmethod
    def of(trace: TraceConfig, index: mi.UInt32, active: mi.Bool) -> SampledEmitter:
        """The emitter of an index."""
        emitter = dr.gather(mi.EmitterPtr, trace.scene.emitters_dr(), index, active)
        around = mi.Bool(False)
        if trace.traits.ball_lights:
            around = emitter.get_shape().shape_type() == int(mi.ShapeType.Sphere)
        if not trace.traits.mesh_lights:
            return SampledEmitter(emitter, mi.Point3f(0), mi.Float(0), around)
        ball = dr.gather(mi.Vector4f, trace.traits.tables.emitter_bounds, index, active)
        return SampledEmitter(emitter, mi.Point3f(ball.x, ball.y, ball.z), ball.w, around)

    def may_move(self, trace: TraceConfig) -> mi.Bool:
        """Whether it is known not to stand still."""
        moving = trace.traits.moving
        moves = mi.Bool(moving is None)
        for shape in moving or ():
            if shape.is_emitter():
                moves |= self.emitter == mi.EmitterPtr(shape.emitter())
        return moves


@dataclass
class Glimpse:
    """What is seen of an emitter at a place of its square."""

    light: mi.DirectionSample3f
    Le: mi.Spectrum  # over the density of the place
    density: mi.Float  # with which samples of the emitter have its direction
    ray: mi.Ray3f
    hit: mi.PreliminaryIntersection3f  # what it meets: of a mesh that is seen, that
    hidden: mi.Bool


def _hides(hit: mi.PreliminaryIntersection3f, emitter: mi.EmitterPtr, active: mi.Bool) -> mi.Bool:
    # An emitter's own limb hides it by rounding only.
    return active & hit.is_valid() & (hit.shape.emitter() != emitter)


def sample_at(trace: TraceConfig, lamp: SampledEmitter, u: mi.Point2f) -> mi.Point2f:
    """The sample of an emitter at a place; of a ball that at the place's distance and angle on the disk, as evenly."""
    if not trace.traits.ball_lights:
        return u
    p = mi.warp.square_to_uniform_disk_concentric(u)
    turn = dr.inv_two_pi * dr.atan2(p.y, p.x)
    return dr.select(lamp.around, mi.Point2f(dr.squared_norm(p), turn - dr.floor(turn)), u)


def direction(lamp: SampledEmitter, o: mi.Point3f, u: mi.Point2f) -> tuple[mi.Vector3f, mi.Float]:
    """A direction in the cone from o around the ball, and the solid angle of that; differentiable in u.

    All directions where o is in the ball.
    """
    to = dr.detach(lamp.centre - o)
    dist2, r2 = dr.squared_norm(to), dr.square(lamp.radius)
    # 1 - cos of the cone, without the difference.
    s = dr.select(dist2 > r2, r2 / (dist2 + dr.safe_sqrt(dist2 * (dist2 - r2))), 2)
    p = mi.warp.square_to_uniform_disk_concentric(u)
    n = dr.squared_norm(p)
    across = dr.safe_sqrt(s * (2 - s * n))
    frame = mi.Frame3f(dr.select(dist2 > 0, to * dr.rsqrt(dist2), mi.Vector3f(0, 0, 1)))
    return frame.to_world(mi.Vector3f(across * p.x, across * p.y, 1 - s * n)), dr.two_pi * s


@dataclass
class EmitterSegment(PlaneSegment):
    """A segment in the unit square of one emitter (see `emitters`), which is reflected at the border."""

    observer: ObserverVertex
    key: mi.UInt32
    lamp: SampledEmitter
    share: mi.Float  # 1 / probability of the emitter

    @staticmethod
    def draw(observer: ObserverVertex, l: float, key: mi.UInt32) -> EmitterSegment:
        numbers, scene = CounterSampler.of(key), observer.trace.scene
        which, turn = numbers.next_2d()
        index, share, _ = scene.sample_emitter(which)
        c = BORDER + INSIDE * numbers.next_2d()
        lamp = SampledEmitter.of(observer.trace, index, observer.active)
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
        """The light at a place, or what hides it. Detached."""
        observer, trace, lamp, u = self.observer, self.observer.trace, self.lamp, self.at(t)
        in_cone = active & (lamp.radius > 0)
        light, Le = lamp.emitter.sample_direction(observer.origin, sample_at(trace, lamp, u), active & ~in_cone)
        ray = observer.origin.spawn_ray_to(light.p)
        looks = active & (light.pdf != 0)
        if not trace.traits.mesh_lights:
            hit = observer.behind(ray, observer.hit(ray, looks), looks)
            return Glimpse(light, Le, light.pdf, ray, hit, _hides(hit, light.emitter, looks))
        d, Ω = direction(lamp, observer.origin.p, u)
        ray = dr.select(in_cone, observer.origin.spawn_ray(d), ray)
        looks |= in_cone
        first = observer.hit(ray, looks)
        at_lamp = in_cone & first.is_valid() & (first.shape.emitter() == lamp.emitter)  # also if light goes through it
        hit = dr.select(at_lamp, first, observer.behind(ray, first, looks & ~at_lamp))
        seen = in_cone & hit.is_valid() & (hit.shape.emitter() == lamp.emitter)
        si = hit.compute_surface_interaction(ray, mi.RayFlags.All, seen)
        there = mi.DirectionSample3f(trace.scene, si=si, ref=observer.origin)
        there.d = d
        light, density = dr.select(in_cone, there, light), dr.select(in_cone, 0, light.pdf)
        Le = dr.select(in_cone, dr.select(seen, lamp.emitter.eval(si, seen) * Ω, 0), Le)
        density = dr.select(seen, lamp.emitter.pdf_direction(observer.origin, there, seen), density)
        # What is behind the ball does not hide it.
        near = ~in_cone | (hit.t < dr.norm(lamp.centre - observer.origin.p) + lamp.radius)
        return Glimpse(light, Le, density, ray, hit, _hides(hit, lamp.emitter, looks) & near)

    def followed(self, origin: mi.Interaction3f, u: mi.Point2f, glue: Glimpse, active: mi.Bool) -> mi.Vector3f:
        """The direction to a place of the emitter, differentiable in it, and in the origin and the emitter.

        On a mesh the point that follows it is that which ``glue`` sees.
        """
        trace, lamp = self.observer.trace, self.lamp
        in_cone = active & (lamp.radius > 0)
        light, _ = lamp.emitter.sample_direction(origin, sample_at(trace, lamp, u), active & ~in_cone)
        if not trace.traits.mesh_lights:
            return light.d
        d, _ = direction(lamp, origin.p, u)
        y = surface_point(glue.hit, dr.detach(glue.ray), in_cone & glue.hit.is_valid()).p
        to_y = dr.normalize(dr.select(in_cone, y - origin.p, mi.Vector3f(0, 0, 1)))
        return dr.select(in_cone, d + (to_y - dr.detach(to_y)), light.d)

    def probe(self, t: mi.Float, active: mi.Bool) -> VisibilityProbe:
        """What is seen at a place: see `Probe`."""
        return self._probe(self.glimpse(t, active))

    def _probe(self, seen: Glimpse) -> VisibilityProbe:
        trace, moves = self.observer.trace, self.observer.selected.moves
        moving = moves | self.lamp.may_move(trace) | may_move(trace, seen.hit)
        return VisibilityProbe.of(seen.hidden & moving)

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
            probe.bright = dr.mean(dr.abs(x.β * f * seen.Le)) * self.share * self._mis(seen, pdf)
        survey = Survey.of(probes, active)
        first = reduce(lambda p, q: dr.select(q.hidden & ~(p.hidden & (p.hit.t <= q.hit.t)), q, p), glimpses)
        survey.near = dr.select(first.hidden, closeness(trace, first.hit), 0)
        turn = dr.norm(a - c) + dr.norm(c - b)
        return Worth.of(survey, survey.bright, own_plane(self.observer, a, b) / (turn + self.length * STEEP))

    def _mis(self, seen: Glimpse, pdf: mi.Float) -> mi.Float:
        """The weight of multiple importance sampling; ``pdf`` is that of the BSDF."""
        return dr.select(seen.light.delta, 1, mis_weight(seen.density / self.share, pdf))

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
        jump = observer.selected.β * f * lit.Le * T * (self.share * self._mis(lit, pdf))
        jump *= crossed.per_length(self.length, mi.Float(INSIDE**-2)) * dr.select(a.hidden, -1, 1)
        active &= dr.any(jump != 0) & dr.all(dr.isfinite(jump))
        u, u_lit = (self.at(dr.select(a.hidden, *t)) for t in ((crossed.a, crossed.b), (crossed.b, crossed.a)))
        own = active & observer.parts(lit.light.d, dark.light.d)  # not that of the ray, which begins a little beside
        n = edge_normal(dark.hit, dark.ray, active)
        crossing = ShadowCrossing(jump, self, u, lit, dark, n, own, active)
        return crossing.weighted(self.direction(crossed.a), u_lit)


@dataclass
class ShadowCrossing:
    """A crossing in the square of an emitter, where the lit side ends: see `Crossing`."""

    weight: mi.Spectrum
    segment: EmitterSegment
    u: mi.Point2f  # at the side in the shadow
    lit: Glimpse
    dark: Glimpse  # at u: it hits what casts the shadow
    n: mi.Vector3f
    own: mi.Bool  # what hides the emitter is the plane of the observer's own triangle
    active: mi.Bool

    def gap(self, at: mi.Interaction3f) -> mi.Float:
        return self._gap(at, self.u)

    def _gap(self, at: mi.Interaction3f, u: mi.Point2f) -> mi.Float:
        """B for the emitter sample ``u``: distance of the line to it from the edge."""
        d, dark = self.segment.followed(at, u, self.lit, self.active), self.dark
        return dr.select(self.own, dr.dot(at.n, d), outline_gap(self.n, at.p, d, dark.hit, dark.ray, self.active))

    def weighted(self, w: mi.Vector2f, u_lit: mi.Point2f) -> ShadowCrossing:
        """The crossing with K: its weight so far is the jump along ``w``; ``u_lit`` is the sample at the lit side."""
        observer, dark = self.segment.observer, self.dark
        at = observer.moved(observer.at.ray)
        slope = derivative_by_place(self.u, lambda u: self._gap(at, u))
        # Where a sample of the emitter jumps there is no edge: its other side is far off.
        off = dr.abs(self._gap(at, u_lit) - self._gap(at, self.u))
        jumps = off > JUMP * dr.norm(slope) * dr.norm(u_lit - self.u) + ROUNDING * (dr.norm(dark.ray.o) + dark.hit.t)
        return replace(self, weight=dr.select(self.active & ~jumps, passed(w, self.weight, slope), 0))
