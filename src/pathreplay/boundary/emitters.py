"""Shadow edges in the domain of emitter samples: the emitter is visible on one side and occluded on the other.

Segments lie in a unit square. For most emitters, a position in the square is the pair of random numbers with which the
emitter is sampled. Two kinds of emitters are exceptions:

- A sphere samples directions in polar coordinates. Close to the pole, straight edges have unbounded curvature in these
  coordinates, and segments cannot resolve them. The square is therefore mapped to a disk first.
- The samples of a mesh are discontinuous where they change from one triangle to the next. The samples of a textured
  area emitter are discontinuous where they change from one texel to the next. The square is therefore mapped to the
  cone of directions around a bounding sphere of the shape.

Both maps preserve areas up to a constant factor. When the scene moves, a sampled direction follows its sampled point on
the emitter, as in the interior term. The maps do not affect this motion.
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
    crossing_weight,
    heading,
    probe_positions,
)
from pathreplay.boundary.importance import STEEP, Importance, closeness, own_plane
from pathreplay.boundary.observer import ObserverVertex
from pathreplay.platform import compat
from pathreplay.samplers.counter_sampler import CounterSampler
from pathreplay.transport.motion import may_move
from pathreplay.transport.signature import edge_normal, outline_gap
from pathreplay.transport.surface import surface_point
from pathreplay.transport.vertex import TraceConfig, channel_mean, mis_weight

BORDER = 1e-4
"""Width of a margin of the unit square that segments do not enter: the samples of some emitters are singular there, for
example in the cone of a sphere."""
INSIDE = 1 - 2 * BORDER
JUMP = 4.0
"""Largest ratio of the change of B over an interval to the change that the slope of B predicts. Above this ratio, the
interval contains a discontinuity of the emitter samples instead of an edge."""


@dataclass
class SampledEmitter:
    """An emitter and, for meshes and textured shapes, its bounding sphere; the radius is 0 for all other emitters."""

    ptr: mi.EmitterPtr
    centre: mi.Point3f
    radius: mi.Float
    polar: mi.Bool  # the emitter samples directions in polar coordinates: see `sample_at`

    @staticmethod
    def of(trace: TraceConfig, index: mi.UInt32, active: mi.Bool) -> SampledEmitter:
        """Look up an emitter by its index in the scene. Without emitters, ``ptr`` is None, and its samples are zero."""
        if not trace.scene.emitters():
            return SampledEmitter(dr.zeros(mi.EmitterPtr), mi.Point3f(0), mi.Float(0), mi.Bool(False))
        ptr = dr.gather(mi.EmitterPtr, trace.scene.emitters_dr(), index, active)
        polar = mi.Bool(False)
        if trace.traits.sphere_lights:
            polar = ptr.get_shape().shape_type() == int(mi.ShapeType.Sphere)
        if not trace.traits.broken_lights:
            return SampledEmitter(ptr, mi.Point3f(0), mi.Float(0), polar)
        sphere = dr.gather(mi.Vector4f, trace.traits.tables.emitter_bounds, index, active)
        return SampledEmitter(ptr, mi.Point3f(sphere.x, sphere.y, sphere.z), sphere.w, polar)

    def may_move(self, trace: TraceConfig) -> mi.Bool:
        moving = trace.traits.moving
        moves = mi.Bool(moving is None)
        for shape in moving or ():
            if shape.is_emitter():
                moves |= self.ptr == mi.EmitterPtr(shape.emitter())
        return moves


@dataclass
class EmitterProbe:
    """The emitter sample at a position of the square, and the hit of its shadow ray."""

    light: mi.DirectionSample3f
    Le: mi.Spectrum  # radiance divided by the density of the position
    density: mi.Float  # density of emitter sampling in this direction
    ray: mi.Ray3f
    hit: mi.PreliminaryIntersection3f  # hit of the shadow ray; may be on the emitter if this has a bounding sphere
    hidden: mi.Bool


def _hides(hit: mi.PreliminaryIntersection3f, emitter: mi.EmitterPtr, active: mi.Bool) -> mi.Bool:
    # Hits on the emitter itself do not count: they occur only at its silhouette, due to rounding.
    return active & hit.is_valid() & (hit.shape.emitter() != emitter)


def sample_at(trace: TraceConfig, emitter: SampledEmitter, u: mi.Point2f) -> mi.Point2f:
    """Return the random numbers for which the emitter is sampled at the position u of the unit square.

    They are u itself, except for spheres: there, an equal-area map from the square to the disk is applied to u.
    """
    if not trace.traits.sphere_lights:
        return u
    p = mi.warp.square_to_uniform_disk_concentric(u)
    turn = dr.inv_two_pi * dr.atan2(p.y, p.x)
    return dr.select(emitter.polar, mi.Point2f(dr.squared_norm(p), turn - dr.floor(turn)), u)


def direction(emitter: SampledEmitter, o: mi.Point3f, u: mi.Point2f) -> tuple[mi.Vector3f, mi.Float]:
    """Map u to a direction in the cone from o around the bounding sphere; also return the cone's solid angle.

    If o is inside the sphere, the cone contains all directions. Differentiable in u.
    """
    to = dr.detach(emitter.centre - o)
    dist2, r2 = dr.squared_norm(to), dr.square(emitter.radius)
    # 1 - cos(half-angle of the cone), without cancellation.
    s = dr.select(dist2 > r2, r2 / (dist2 + dr.safe_sqrt(dist2 * (dist2 - r2))), 2)
    p = mi.warp.square_to_uniform_disk_concentric(u)
    n = dr.squared_norm(p)
    across = dr.safe_sqrt(s * (2 - s * n))
    frame = mi.Frame3f(dr.select(dist2 > 0, to * dr.rsqrt(dist2), mi.Vector3f(0, 0, 1)))
    return frame.to_world(mi.Vector3f(across * p.x, across * p.y, 1 - s * n)), dr.two_pi * s


@dataclass
class EmitterSegment(PlaneSegment):
    """A segment in the unit square of one emitter (see the module). It is reflected at the margin of the square."""

    observer: ObserverVertex
    key: mi.UInt32
    emitter: SampledEmitter
    inv_probability: mi.Float  # 1 / selection probability of the emitter

    @staticmethod
    def draw(observer: ObserverVertex, l: float, key: mi.UInt32) -> EmitterSegment:
        sampler, scene = CounterSampler.of(key), observer.trace.scene
        which, turn = sampler.next_2d()
        index, inv_probability, _ = scene.sample_emitter(which)
        c = BORDER + INSIDE * sampler.next_2d()
        emitter = SampledEmitter.of(observer.trace, index, observer.active)
        return EmitterSegment(mi.Point2f(c), heading(turn), mi.Float(l), observer, key, emitter, inv_probability)

    def at(self, t: mi.Float) -> mi.Point2f:
        return self._reflected(t)[0]

    def direction(self, t: mi.Float) -> mi.Vector2f:
        return self._reflected(t)[1]

    def _reflected(self, t: mi.Float) -> tuple[mi.Point2f, mi.Vector2f]:
        x = (self.c + t * self.w - BORDER) / INSIDE
        x -= 2 * dr.floor(0.5 * x)
        reflected = x > 1
        return BORDER + INSIDE * dr.select(reflected, 2 - x, x), dr.select(reflected, -self.w, self.w)

    def probe_emitter(self, t: mi.Float, active: mi.Bool) -> EmitterProbe:
        """Sample the emitter at position ``t``, and trace the shadow ray. The result is detached."""
        observer, trace, emitter, u = self.observer, self.observer.trace, self.emitter, self.at(t)
        in_cone = active & (emitter.radius > 0)
        light, Le = emitter.ptr.sample_direction(observer.origin, sample_at(trace, emitter, u), active & ~in_cone)
        ray = observer.origin.spawn_ray_to(light.p)
        tested = active & (light.pdf != 0)
        if not trace.traits.broken_lights:
            hit = observer.behind(ray, observer.hit(ray, tested), tested)
            return EmitterProbe(light, Le, light.pdf, ray, hit, _hides(hit, light.emitter, tested))
        d, Ω = direction(emitter, observer.origin.p, u)
        ray = dr.select(in_cone, observer.origin.spawn_ray(d), ray)
        tested |= in_cone
        first = observer.hit(ray, tested)
        # `behind` skips null boundaries, but must not skip the emitter's own surface.
        on_emitter = in_cone & first.is_valid() & (first.shape.emitter() == emitter.ptr)
        hit = dr.select(on_emitter, first, observer.behind(ray, first, tested & ~on_emitter))
        seen = in_cone & hit.is_valid() & (hit.shape.emitter() == emitter.ptr)
        si = hit.compute_surface_interaction(ray, compat.shading(), seen)
        on_shape = mi.DirectionSample3f(trace.scene, si=si, ref=observer.origin)
        on_shape.d = d
        light, density = dr.select(in_cone, on_shape, light), dr.select(in_cone, 0, light.pdf)
        Le = dr.select(in_cone, dr.select(seen, emitter.ptr.eval(si, seen) * Ω, 0), Le)
        density = dr.select(seen, emitter.ptr.pdf_direction(observer.origin, on_shape, seen), density)
        # Surfaces behind the bounding sphere do not occlude the emitter.
        near = ~in_cone | (hit.t < dr.norm(emitter.centre - observer.origin.p) + emitter.radius)
        return EmitterProbe(light, Le, density, ray, hit, _hides(hit, emitter.ptr, tested) & near)

    def followed(self, origin: mi.Interaction3f, u: mi.Point2f, anchor: EmitterProbe, active: mi.Bool) -> mi.Vector3f:
        """Return the direction from ``origin`` to the emitter sample at ``u``.

        The result is differentiable in ``u``, in the origin and in the emitter. If the emitter has a bounding
        sphere, the direction moves like the direction from the origin to the point that the ray of ``anchor`` has hit.
        """
        trace, emitter = self.observer.trace, self.emitter
        in_cone = active & (emitter.radius > 0)
        light, _ = emitter.ptr.sample_direction(origin, sample_at(trace, emitter, u), active & ~in_cone)
        if not trace.traits.broken_lights:
            return light.d
        d, _ = direction(emitter, origin.p, u)
        y = surface_point(anchor.hit, dr.detach(anchor.ray), in_cone & anchor.hit.is_valid()).p
        to_y = dr.normalize(dr.select(in_cone, y - origin.p, mi.Vector3f(0, 0, 1)))
        return dr.select(in_cone, d + (to_y - dr.detach(to_y)), light.d)

    def probe(self, t: mi.Float, active: mi.Bool) -> VisibilityProbe:
        return self._probe(self.probe_emitter(t, active))

    def _probe(self, sample: EmitterProbe) -> VisibilityProbe:
        trace, moves = self.observer.trace, self.observer.selected.moves
        moving = moves | self.emitter.may_move(trace) | may_move(trace, sample.hit)
        return VisibilityProbe.of(sample.hidden & moving)

    def detect(self) -> Importance:
        """Estimate the importance of an edge.

        In scenes without narrow lobes, scattering is evaluated only in the middle of the segment.
        """
        trace, x, active = self.observer.trace, self.observer.selected, self.observer.active
        samples = [self.probe_emitter(t, active) for t in probe_positions(self.length)]
        a, b, c = (sample.light.d for sample in samples)
        if trace.traits.narrow:
            scattered = [self.observer.towards(d, active) for d in (a, b, c)]
        else:
            scattered = [self.observer.towards(c, active)] * 3
        probes = [self._probe(sample) for sample in samples]
        for probe, sample, (f, pdf) in zip(probes, samples, scattered, strict=True):
            probe.bright = channel_mean(dr.abs(x.β * f * sample.Le)) * self.inv_probability * self._mis(sample, pdf)
        survey = Survey.of(probes, active)
        first = reduce(lambda p, q: dr.select(q.hidden & ~(p.hidden & (p.hit.t <= q.hit.t)), q, p), samples)
        survey.near = dr.select(first.hidden, closeness(trace, first.hit), 0)
        turn = dr.norm(a - c) + dr.norm(c - b)
        return Importance.of(survey, survey.bright, own_plane(self.observer, a, b) / (turn + self.length * STEEP))

    def _mis(self, sample: EmitterProbe, pdf: mi.Float) -> mi.Float:
        """Return the MIS weight of an emitter sample; ``pdf`` is the density of the BSDF."""
        return dr.select(sample.light.delta, 1, mis_weight(sample.density / self.inv_probability, pdf))

    def resolve(self, weight: mi.Float, generator: mi.PCG32) -> ShadowCrossing:
        """Locate the edge by bisection, and compute its weight: see `EdgeSearch.resolve`."""
        observer = self.observer
        bracket = bisect(self.probe, self.length, dr.select(observer.active, weight, 0), generator)
        active = bracket.weight > 0
        a, b = (self.probe_emitter(t, active) for t in (bracket.a, bracket.b))
        active &= a.hidden != b.hidden
        lit, dark = dr.select(a.hidden, b, a), dr.select(a.hidden, a, b)
        # The outline of the emitter is not a shadow edge.
        active &= (self.emitter.radius == 0) | (dark.hit.t < lit.hit.t)
        active &= observer.is_far(dark.hit.t)
        f, pdf = observer.towards(lit.light.d, active)
        T = observer.transmittance_past_edge(lit.light, dark.hit.t, self.key, active)
        jump = observer.selected.β * f * lit.Le * T * (self.inv_probability * self._mis(lit, pdf))
        jump *= bracket.per_length(self.length, mi.Float(INSIDE**-2)) * dr.select(a.hidden, -1, 1)
        active &= dr.any(jump != 0) & dr.all(dr.isfinite(jump))
        u, u_lit = (self.at(dr.select(a.hidden, *t)) for t in ((bracket.a, bracket.b), (bracket.b, bracket.a)))
        # The directions of the shadow rays themselves cannot be used, because the origins of the rays are offset.
        own = active & observer.separates(lit.light.d, dark.light.d)
        n = edge_normal(dark.hit, dark.ray, active)
        crossing = ShadowCrossing(jump, self, u, lit, dark, n, own, active)
        return crossing.weighted(self.direction(bracket.a), u_lit)


@dataclass
class ShadowCrossing:
    """Crossing of a segment in an emitter's square with the boundary of the lit part: see `Crossing`."""

    weight: mi.Spectrum
    segment: EmitterSegment
    u: mi.Point2f  # position on the occluded side
    lit: EmitterProbe
    dark: EmitterProbe  # probe at u, whose ray hits the occluder
    n: mi.Vector3f
    own: mi.Bool  # the occluder is the plane of the observer's own triangle
    active: mi.Bool

    def gap(self, at: mi.Interaction3f) -> mi.Float:
        return self._gap(at, self.u)

    def _gap(self, at: mi.Interaction3f, u: mi.Point2f) -> mi.Float:
        """Evaluate B for the emitter sample ``u``: the distance of the shadow ray from the edge."""
        d, dark = self.segment.followed(at, u, self.lit, self.active), self.dark
        return dr.select(self.own, dr.dot(at.n, d), outline_gap(self.n, at.p, d, dark.hit, dark.ray, self.active))

    def weighted(self, w: mi.Vector2f, u_lit: mi.Point2f) -> ShadowCrossing:
        """Replace ``weight``, which is only the jump of the integrand in direction ``w``, by the `crossing_weight`.

        ``u_lit`` is the lit end of the bisected interval.
        """
        observer, dark = self.segment.observer, self.dark
        at = observer.moved(observer.at.ray)
        slope = derivative_by_place(self.u, lambda u: self._gap(at, u))
        # If the emitter samples are discontinuous, B changes more than its slope predicts, and there is no edge.
        off = dr.abs(self._gap(at, u_lit) - self._gap(at, self.u))
        jumps = off > JUMP * dr.norm(slope) * dr.norm(u_lit - self.u) + ROUNDING * (dr.norm(dark.ray.o) + dark.hit.t)
        return replace(self, weight=dr.select(self.active & ~jumps, crossing_weight(w, self.weight, slope), 0))
