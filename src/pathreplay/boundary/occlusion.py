"""Edges between surfaces, as a vertex sees them among the directions in which it scatters.

Segments are arcs (see `arcs`). At their ends different surfaces are seen, or different sheets of one. One hides the
other, it bends, or a hard shadow ends on it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import derivative_by_ray
from pathreplay.adjoint.primal import walk_on
from pathreplay.boundary.arcs import Arc, arc, density_of_samples
from pathreplay.boundary.creases import CreaseOrContour, Side, off_contact
from pathreplay.boundary.crofton import Crossed, Survey, VisibilityProbe, bisect, probed
from pathreplay.boundary.edges import Crossing
from pathreplay.boundary.hard_shadows import HardShadow, ShadowTest
from pathreplay.boundary.observer import ObserverVertex
from pathreplay.boundary.worth import DIM, Worth, closeness, own_plane
from pathreplay.samplers.counter_sampler import CounterSampler
from pathreplay.samplers.streams import Stream
from pathreplay.transport.motion import may_move
from pathreplay.transport.path import PathState
from pathreplay.transport.signature import edge_normal, mixed, place_met, shape_met, turned_away
from pathreplay.transport.velocity import held_direction, jumps_at_facets, moved_direction
from pathreplay.transport.volume.passage import SHORT_OF


@dataclass
class ArcSegment:
    """An arc of directions from a vertex, and what is seen along it."""

    observer: ObserverVertex
    key: mi.UInt32
    arc: Arc
    active: mi.Bool
    longest: float  # length of arcs for broad lobes, in radians
    hard: bool  # whether hard shadows are seen

    @staticmethod
    def draw(observer: ObserverVertex, l: float, key: mi.UInt32) -> ArcSegment:
        traits, media = observer.trace.traits, observer.trace.media
        drawn, ok = arc(observer, l, traits.narrow or media is not None, key, observer.active)
        return ArcSegment(observer, key, drawn, ok, l, traits.hard_lights and media is None)

    def probe(self, t: mi.Float, active: mi.Bool) -> VisibilityProbe:
        """What is seen at a place: see `Probe`."""
        return self._probe(t, active, self.hard)

    def _probe(self, t: mi.Float, active: mi.Bool, hard: bool) -> VisibilityProbe:
        observer, trace, x = self.observer, self.observer.trace, self.observer.selected
        ray = observer.origin.spawn_ray(self.arc.at(t))
        first = observer.hit(ray, active & observer.may_scatter(ray.d))
        seen = observer.behind(ray, first, active)
        counts, moves = self._counts(seen), x.moves | may_move(trace, seen)
        close = active & counts  # nothing else is looked at closely
        if trace.media is None:
            close &= moves
        at = seen.compute_surface_interaction(ray, mi.RayFlags.Minimal | mi.RayFlags.ShadingFrame, close)
        if not trace.traits.copies:
            at.shape = seen.shape
        turned = dr.select(turned_away(at, ray.d), mi.UInt32(1), 0)
        place = dr.select(
            observer.keeps, *(place_met(trace, seen, active, at.shape, facets) for facets in (True, False))
        )
        lengths = trace.traits.tables.blend_lengths
        facets = close & ~observer.keeps & jumps_at_facets(lengths, observer.origin, seen, at.p, at.n)
        place = mixed(place, dr.select(facets, seen.prim_index + 1, 0))
        near = closeness(trace, seen)
        if trace.media is not None:  # directions follow null boundaries, too
            boundary = place_met(trace, first, active, shape_met(trace, first, ray, active), facets=False)
            place, moves = mixed(place, boundary), moves | may_move(trace, first)
            near = dr.maximum(near, closeness(trace, first))
        if hard:
            shade = self._shadow_test(ray, seen, active)
            place, moves = mixed(place, dr.select(shade.dark, mi.UInt32(1), 0)), moves | may_move(trace, shade.hit)
        bright = dr.select(seen.is_valid(), DIM, mi.Float(trace.scene.environment() is not None))
        probe = VisibilityProbe(mixed(place, turned), at.p, at.n, moves, near, bright)
        # As nothing, a sky would be.
        dark = replace(VisibilityProbe.of(mi.UInt32(1)), moves=moves, near=near, bright=bright)
        return dr.select(counts, probe, dark)

    def _counts(self, seen: mi.PreliminaryIntersection3f) -> mi.Bool:
        """Whether light may come from what is seen: at the end of a path only what glows has any."""
        trace = self.observer.trace
        if trace.media is not None:
            return mi.Bool(True)
        glows = dr.select(seen.is_valid(), seen.shape.emitter() != None, trace.scene.environment() is not None)  # noqa: E711
        return glows | (self.observer.selected.depth + 2 < trace.max_depth)

    def _shadow_test(self, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, active: mi.Bool) -> ShadowTest:
        """What of it lies in the shadow of a light without extent: that which `walk_on` draws there."""
        numbers, depth = CounterSampler.stream(self.key, Stream.BEYOND_EDGE), self.observer.selected.depth
        arrival = self.observer.arrival(ray, hit, mi.Float(1))
        return ShadowTest.of(self.observer.trace, arrival, numbers, depth + 1, active)

    def detect(self) -> Worth:
        """What an edge on the arc may be worth."""
        arc, ok = self.arc, self.active
        light = dr.select(ok, dr.mean(dr.abs(self.observer.selected.β * arc.f)) / arc.p, 0)
        ends = (arc.at(t) for t in probed(arc.length)[:2])
        survey = Survey.of([self.probe(t, ok) for t in probed(arc.length)], ok)
        survey.found *= arc.importance()
        return Worth.of(survey, light, light * own_plane(self.observer, *ends) / self.longest)

    def resolve(self, weight: mi.Float, generator: mi.PCG32) -> list[Crossing]:
        """Bisect the arc, and weigh both sides of the edge: see `EdgeSearch.resolve`."""
        observer, trace = self.observer, self.observer.trace
        crossed = bisect(self.probe, self.arc.length, dr.select(self.active, weight, 0), generator)
        active = crossed.weight > 0
        rays = [observer.origin.spawn_ray(self.arc.at(t)) for t in (crossed.a, crossed.b)]
        firsts = [observer.hit(ray, active) for ray in rays]
        edges, through = observer.edges(rays, firsts, active)
        near_a, shadow = edges[0].t <= edges[1].t, None
        if self.hard:
            a, b = (self._probe(t, active, hard=False) for t in (crossed.a, crossed.b))
            tests = [self._shadow_test(ray, first, active) for ray, first in zip(rays, firsts, strict=True)]
            shadow = HardShadow.between(trace, *tests, active & ~a.differs(b))
            near_a = dr.select(shadow.there, shadow.in_a, near_a)
        (near, far), (hit, beside) = _ordered(near_a, firsts), _ordered(near_a, edges)
        ray_near, ray_far = _ordered(near_a, rays)
        active = active & hit.is_valid() & observer.is_off(hit.t)
        outlined = active if shadow is None else active & ~shadow.there
        crease = CreaseOrContour.of(trace, (hit, ray_near), (beside, ray_far), outlined)
        own = outlined & observer.parts(ray_near.d, ray_far.d)
        edge = OcclusionEdge.of(Bend(hit, crease, shadow, own, active), observer, ray_near, ray_far)
        sides = [(ray_near, near), (ray_far, far)]
        K_near, K_far = self._weights(crossed, edge, sides, through)
        return [
            HeldEdge(K_far - K_near, edge),
            MovedSide(K_near, edge, ray_near.d, near),
            MovedSide(-K_far, edge, ray_far.d, far),
        ]

    def _weights(
        self, crossed: Crossed, edge: OcclusionEdge, sides: list[Side], through: mi.Bool
    ) -> tuple[mi.Spectrum, mi.Spectrum]:
        """π/2 f / (l p(c)) of the two sides: near the edge and far, both with the same random numbers."""
        observer, trace, x = self.observer, self.observer.trace, self.observer.selected
        d = sides[1][0].d
        f, pdf = observer.towards(d, edge.active)
        per_length = 0.5 * dr.pi * crossed.weight * self.arc.weight(observer, density_of_samples(pdf), edge.active)
        common = x.β * f * per_length
        active = edge.active & dr.any(common != 0)
        near, far = (observer.arrival(ray, hit, pdf) for ray, hit in sides)
        arrivals = off_contact(trace, near, far, active)
        T, arrivals = observer.onward(arrivals, SHORT_OF * edge.bend.hit.t, self.key, active & through)
        K, depth = [], x.depth + 1
        for arrival in arrivals:
            path = PathState(arrival, mi.Spectrum(1), None, mi.Float(1), depth, active & (depth < trace.max_depth))
            L, _ = walk_on(trace, CounterSampler.stream(self.key, Stream.BEYOND_EDGE), path)
            K.append(dr.select(active, common * T * L, 0))
        return K[0], K[1]


def _ordered(near_a: mi.Bool, pair: list[Any]) -> tuple[Any, Any]:
    """What belongs to the near side, and what to the far one."""
    a, b = pair
    return dr.select(near_a, a, b), dr.select(near_a, b, a)


@dataclass
class Bend:
    """What is at an edge where no surface hides another: a crease or contour, a hard shadow, or a plane."""

    hit: mi.PreliminaryIntersection3f
    crease: CreaseOrContour
    shadow: HardShadow | None
    own: mi.Bool  # the plane of the observer's own triangle
    active: mi.Bool

    @property
    def there(self) -> mi.Bool:
        """Whether the edge is one of these."""
        there = self.own | self.crease.there
        return there if self.shadow is None else there | self.shadow.there

    def gap(self, ray: mi.Ray3f, n: mi.Normal3f) -> mi.Float:
        """B: zero on the edge; differentiable in the ray and the shapes. ``n`` is the normal of the own plane."""
        B = dr.select(self.own, dr.dot(n, ray.d), self.crease.gap(ray, self.active & ~self.own))
        if self.shadow is None:
            return B
        return dr.select(self.shadow.there, self.shadow.gap(self.hit, ray, self.active), B)


@dataclass
class OcclusionEdge:
    """An edge that a vertex sees between two directions, ``n`` normal to it and from the near one to the far one."""

    bend: Bend
    observer: ObserverVertex
    d: mi.Vector3f  # on its near side
    n: mi.Vector3f
    slope: mi.Float  # of the bend's B, along n
    bent: mi.Bool
    active: mi.Bool

    @staticmethod
    def of(bend: Bend, observer: ObserverVertex, near: mi.Ray3f, far: mi.Ray3f) -> OcclusionEdge:
        """The edge between two rays. Detached."""
        slope = derivative_by_ray(near, lambda ray: bend.gap(ray, observer.si.n)).d
        slope -= dr.dot(slope, near.d) * near.d
        bent = bend.there & (dr.squared_norm(slope) > 0)
        active = bend.active if bend.shadow is None else bend.active & (bent | ~bend.shadow.there)
        n = dr.select(bent, dr.normalize(slope), edge_normal(bend.hit, near, active))
        n = dr.select(dr.dot(n, far.d - near.d) < 0, -n, n)
        return OcclusionEdge(bend, observer, near.d, n, dr.select(bent, dr.dot(slope, n), 1), bend.there, active)


@dataclass
class HeldEdge:
    """The edge itself, where one surface hides another: it follows the point of the near one. See `Crossing`."""

    weight: mi.Spectrum
    edge: OcclusionEdge

    def gap(self, at: mi.Interaction3f) -> mi.Float:
        """See `Crossing`: n·d, whose motion is n·V_edge."""
        e = self.edge
        return dr.select(e.active & ~e.bent, dr.dot(e.n, held_direction(at, e.d, e.bend.hit, e.active)), 0)


@dataclass
class MovedSide:
    """A side of the edge: its direction moves with the velocity that the interior gives it. See `Crossing`."""

    weight: mi.Spectrum
    edge: OcclusionEdge
    d: mi.Vector3f
    hit: mi.PreliminaryIntersection3f  # along d; may be none

    def gap(self, at: mi.Interaction3f) -> mi.Float:
        """See `Crossing`: n·d, whose motion is n·V, or how far d is from a bend."""
        e, lengths = self.edge, self.edge.observer.trace.traits.tables.blend_lengths
        d, _ = moved_direction(lengths, at, self.d, self.hit, e.observer.holds(self.hit, e.active))
        ray = mi.Ray3f(at.spawn_ray(dr.detach(d)).o, d)
        return dr.select(e.active, dr.select(e.bent, e.bend.gap(ray, at.n) / e.slope, dr.dot(e.n, d)), 0)
