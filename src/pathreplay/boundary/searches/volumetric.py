"""Volumetric boundary term: boundaries of the hard shadows that lights without extent cast into media.

On light paths, the sensor takes the place of the light (see `emission`).

The camera sees points x = o + τ d of a medium at all distances τ. Each x is either lit or in shadow. For each τ, the
boundary of the shadow is an edge on the film. Short segments with constant τ find this edge (see `crofton`):

    dI/dπ = - Σ K dB/dπ,    K = π/2 · f / (l p(c) p(τ) N) · sgn(w·∂B/∂s) / |∂B/∂s|,    B = n·(x + r d - z),

where f is the radiance that the lit side scatters to the camera, including the transmittances from the light to x and
from x to the camera, and N is the number of segments. `primary` defines the symbols in B. In dB/dπ, x moves as in the
interior term. ∂B/∂s is taken at constant τ, because the domain of the integral consists of film positions and
distances.

Vertices of paths see the points of a medium, too. There, directions on an arc take the place of film positions (see
`arcs`), and the sampled direction moves as in the interior term.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import derivative_by_place, derivative_by_ray
from pathreplay.adjoint.record import Layout, record, record_type, recordable, room_for
from pathreplay.boundary.arcs import Arc
from pathreplay.boundary.crofton import VisibilityProbe, bisect, crossing_weight, detect, heading, probe_positions
from pathreplay.boundary.edges import EdgePath, Edges, FilmDomain
from pathreplay.boundary.hard_shadows import HardShadow, ShadowTest
from pathreplay.boundary.observer import ObserverVertex, SelectedVertex
from pathreplay.boundary.search import EdgeSearch, FilmSearch, FilmSegment, SegmentDensity
from pathreplay.boundary.searches.secondary import CameraPath
from pathreplay.samplers.counter_sampler import CounterSampler, key_of, quasi_random
from pathreplay.samplers.streams import Stream
from pathreplay.transport.meet import meet
from pathreplay.transport.path import PathState
from pathreplay.transport.start import CameraStart
from pathreplay.transport.step import choose_step
from pathreplay.transport.surface import met
from pathreplay.transport.vertex import Arrival, Flight, TraceConfig, VertexSamples
from pathreplay.transport.volume.media import interaction
from pathreplay.transport.volume.passage import is_boundary, past, skip_null, transmittance_up_to

if TYPE_CHECKING:
    from typing_extensions import Self

NEAR = 0.4
"""Probability of the part of the density of distances from a vertex that favours small distances: `Distance.draw`."""


@dataclass
class BeamSegment(FilmSegment):
    """A segment on the film, at one distance τ along all its camera rays."""

    τ: mi.Float
    relevance: mi.Float


@dataclass
class BeamCrossing:
    """Crossing of a film segment with a shadow boundary in a medium: see `Crossing`."""

    weight: mi.Spectrum
    shadow: HardShadow
    active: mi.Bool

    def gap(self, at: mi.Interaction3f) -> mi.Float:
        return self.shadow.gap_at(at, self.active)


@dataclass(frozen=True)
class VolumetricSearch(FilmSearch[BeamSegment]):
    """Edge search over film positions and distances.

    There is no pilot pass, because shadow boundaries in a medium fill much of the image.
    """

    bisection = Stream.BISECT_VOLUMETRIC

    @classmethod
    def of(cls, trace: TraceConfig, film: FilmDomain, length: float) -> Self:
        return super().of(recordable(trace), film, length)

    def draw(self, i: mi.UInt32, number: mi.UInt32, n: int, seed: mi.UInt32) -> BeamSegment:
        key = key_of(i, Stream.VOLUMETRIC_KEYS.of(seed))
        sampler = CounterSampler.stream(key, Stream.BEAM)
        w = heading(sampler.next_1d())
        c, density = self.density.draw(*quasi_random(i, n, Stream.VOLUMETRIC_CENTRES.of(seed)))
        rays = [dr.detach(self.film.ray(c + t * w, key)[0]) for t in probe_positions(mi.Float(self.length))]
        hits = [self._hit(ray, mi.Bool(True)) for ray in rays]
        along = Distance.draw(self.trace, rays[-1].o, hits, sampler.next_1d(), near=0)
        density = density * dr.select(along.ok, along.pdf, 1)
        return BeamSegment(c, w, mi.Float(self.length), key, density, along.ok, along.τ, along.relevance)

    def detect(self, segments: BeamSegment) -> mi.Float:
        return segments.relevance * super().detect(segments)

    def probe(self, segment: BeamSegment, t: mi.Float, active: mi.Bool) -> VisibilityProbe:
        return _probe(*self._shadow_test(segment, t, active))

    def _shadow_test(self, segment: BeamSegment, t: mi.Float, active: mi.Bool) -> tuple[mi.Bool, ShadowTest]:
        """Return whether the camera sees the medium point at position ``t``, and the shadow test of that point."""
        ray = dr.detach(self.film.ray(segment.at(t), segment.key)[0])
        return _shadow_test(self.trace, ray, segment.τ, self._hit(ray, active), segment.key, active)

    def edge(self, segment: BeamSegment, a: mi.Float, b: mi.Float, active: mi.Bool) -> Edges:
        (visible_a, test_a), (visible_b, test_b) = (self._shadow_test(segment, t, active) for t in (a, b))
        shadow = HardShadow.between(self.trace, test_a, test_b, active & visible_a & visible_b)
        s = segment.at(dr.select(shadow.in_a, a, b))
        ray, weight = dr.detach(self.film.ray(s, segment.key))
        active = shadow.exists & shadow.lit.lit
        medium = self.film.medium(self.trace, ray, active)
        path, observer = self._particle(s, ray, medium, segment, active)
        jump = weight * dr.select(shadow.in_a, -1, 1) * self._radiance(ray, medium, segment, observer, shadow)
        return Edges(path, [BeamCrossing(dr.select(observer.active, jump, 0), shadow, observer.active)], observer)

    def slope(self, segment: BeamSegment, edges: Edges) -> mi.Vector2f:
        (crossing,), path = edges.crossings, edges.path
        return derivative_by_place(path.s, lambda s: crossing.gap(_point_on(self.film.ray(s, path.key)[0], segment.τ)))

    def _radiance(
        self,
        ray: mi.Ray3f,
        medium: mi.MediumPtr,
        segment: BeamSegment,
        observer: ObserverVertex,
        shadow: HardShadow,
    ) -> mi.Spectrum:
        """Estimate f, the radiance that the lit medium point scatters to the camera. ``ray`` starts in ``medium``.

        It is zero if the medium does not use emitter sampling, or if paths are too short to be scattered.
        """
        trace = self.trace
        active, link = mi.Bool(observer.active), trace.to_sensor
        if link is None:
            active &= observer.at.medium.use_emitter_sampling() & (trace.max_depth > 1)
        sampler = CounterSampler.stream(segment.key, Stream.TRANSMITTANCE_OF_BEAM)
        T = transmittance_up_to(trace, ray, segment.τ, medium, sampler, active)[0]
        f = T * _scattered(observer, shadow, sampler, active)
        if link is not None and link.adjoint is not None:
            f *= link.adjoint(shadow.lit.uv, ray.wavelengths, active)
        return dr.select(active, f, 0)

    def _hit(self, ray: mi.Ray3f, active: mi.Bool) -> mi.PreliminaryIntersection3f:
        """Return the first hit of a ray on a surface that is not a null boundary."""
        return skip_null(self.trace, ray, meet(self.trace, ray, active), active)

    @dr.syntax
    def _particle(
        self, s: mi.Point2f, ray: mi.Ray3f, medium: mi.MediumPtr, segment: BeamSegment, active: mi.Bool
    ) -> tuple[EdgePath, ObserverVertex]:
        """Record the path through null boundaries to the medium point; return the path and the observer there."""
        trace, layout, τ = self.trace, Layout.of(self.trace, True), segment.τ
        records = dr.alloc_local(record_type(layout), room_for(trace))
        sampler = CounterSampler.of(segment.key)
        path = PathState.begin(trace, CameraStart(ray, sampler, active))
        path.at.medium = medium
        at, flight = path.at, Flight.none(trace.media)
        travelled, k, count = mi.Float(0), mi.UInt32(0), mi.UInt32(0)
        room, go_on = room_for(trace), mi.Bool(path.active)
        while dr.hint(go_on, exclude=[trace, layout, self, room], label="pathreplay: to a particle"):
            length = dr.select(path.at.hit.is_valid(), path.at.hit.t, dr.inf)
            event = (travelled + length > τ) & (path.at.medium != None)  # noqa: E711 (an array of pointers)
            event_flight = Flight.none(trace.media)
            event_flight.event, event_flight.t = event, dr.select(event, τ - travelled, 0)
            u = VertexSamples.draw(sampler)
            step = choose_step(trace, path.at, path.β, u, sampler, mi.Bool(False), path.active, event_flight)
            onward, v = path.advance(trace, u, step)
            records[count] = record(layout, v)
            at, k = dr.select(event, path.at, at), dr.select(event, count, k)
            flight = dr.select(event, event_flight, flight)
            travelled += dr.norm(onward.at.ray.o - path.at.ray.o)
            go_on = onward.active & step.null & ~event & (travelled < τ) & (count + 1 < room)
            path = onward
            count += 1
        active = active & flight.event
        edge_path = EdgePath(s, segment.key, dr.select(active, k, 0), at.ray, layout, records)
        return edge_path, _collision(trace, at, k, flight, active)


def _collision(trace: TraceConfig, at: Arrival, k: mi.UInt32, flight: Flight, active: mi.Bool) -> ObserverVertex:
    """Return the observer at the end of a ``flight``, with ``k`` vertices before it."""
    σ_s, _, _ = at.medium.get_scattering_coefficients(interaction(at.medium, at.ray, flight.t), active)
    flight.σ_s = dr.detach(σ_s)
    return ObserverVertex(trace, SelectedVertex(at, k, k, flight.σ_s, mi.Float(1), mi.Bool(True), active, flight))


def _scattered(y: ObserverVertex, shadow: HardShadow, sampler: CounterSampler, active: mi.Bool) -> mi.Spectrum:
    """Return the light of the sampled emitter that only the lit side scatters at the medium point ``y``."""
    Le = shadow.lit.Le * shadow.blocked(y.trace, y.at.medium, sampler, active)
    return y.selected.β * y.towards(shadow.lit.ray.d, active)[0] * Le


def _point_on(ray: mi.Ray3f, τ: mi.Float) -> mi.Interaction3f:
    """Return the interaction at distance ``τ`` along a ray."""
    x = dr.zeros(mi.Interaction3f)
    x.p, x.t, x.time, x.wavelengths = ray.o + τ * ray.d, mi.Float(0), ray.time, ray.wavelengths
    return x


@dataclass
class Distance:
    """A sampled distance along a ray."""

    τ: mi.Float
    pdf: mi.Float
    relevance: mi.Float  # factor of the importance of edges; small far behind the scene

    @staticmethod
    def draw(
        trace: TraceConfig, o: mi.Point3f, hits: list[mi.PreliminaryIntersection3f], u: mi.Float, near: float
    ) -> Distance:
        """Sample a distance for rays from ``o``, up to the farthest of their first ``hits``.

        The part of the density of probability ``near`` is proportional to 1 / √τ, because |∂B/∂s| is proportional to τ
        for small τ. The rest of the density is constant. If a ray leaves the scene, the distances end behind the scene
        or, in media without bounds, have no end.
        """
        # `dr.freeze` would keep the bounding box that the scene had when the pass was recorded.
        center, radius = trace.traits.tables.scene_sphere()
        far = dr.norm(o - center) + radius
        reach, leaves = mi.Float(0), mi.Bool(False)
        for hit in hits:
            reach = dr.maximum(reach, dr.select(hit.is_valid(), hit.t, far))
            leaves |= ~hit.is_valid()
        leaves &= not trace.media.bounded or trace.media.around is not None
        v = dr.minimum((u - near) / (1 - near), dr.one_minus_epsilon(mi.Float))
        τ = dr.select(leaves, far * v / (1 - v), reach * v)
        if near:
            τ = dr.select(u < near, reach * dr.square(u / near), τ)
        pdf = (1 - near) * dr.select(leaves, far / dr.square(far + τ), dr.rcp(reach))
        pdf += dr.select(τ < reach, 0.5 * near * dr.rsqrt(τ * reach), 0)
        ok = dr.isfinite(τ) & (τ > 0) & dr.isfinite(pdf)
        return Distance(dr.select(ok, τ, 0), dr.select(ok, pdf, 0), dr.select(ok, dr.minimum(1, dr.square(far / τ)), 0))

    @property
    def ok(self) -> mi.Bool:
        """Whether the distance was sampled."""
        return self.pdf > 0


def _shadow_test(
    trace: TraceConfig, ray: mi.Ray3f, τ: mi.Float, hit: mi.PreliminaryIntersection3f, key: mi.UInt32, active: mi.Bool
) -> tuple[mi.Bool, ShadowTest]:
    """Return whether the medium point at distance ``τ`` lies before the first ``hit``, and its shadow test."""
    visible = active & ~(hit.is_valid() & (hit.t < τ))
    u = CounterSampler.stream(key, Stream.BEAM_EMITTER).next_2d()
    return visible, ShadowTest.at(trace, _point_on(ray, τ), u, visible)


def _probe(visible: mi.Bool, test: ShadowTest) -> VisibilityProbe:
    return VisibilityProbe.of(dr.select(visible, mi.UInt32(1), 0) | dr.select(test.dark, mi.UInt32(2), 0))


class BeamArc(Arc):
    """An arc of directions around a vertex, with points of a medium at one distance τ along all directions."""

    @cached_property
    def distance(self) -> Distance:
        u, observer = CounterSampler.stream(self.key, Stream.BEAM).next_1d(), self.observer
        rays = [observer.origin.spawn_ray(self.at(t)) for t in probe_positions(self.length)]
        return Distance.draw(observer.trace, observer.origin.p, [self._hit(ray, self.active) for ray in rays], u, NEAR)

    def _hit(self, ray: mi.Ray3f, active: mi.Bool) -> mi.PreliminaryIntersection3f:
        return self.observer.behind(ray, self.observer.hit(ray, active), active)

    def probe(self, t: mi.Float, active: mi.Bool) -> VisibilityProbe:
        return _probe(*self._shadow_test(t, active))

    def _shadow_test(self, t: mi.Float, active: mi.Bool) -> tuple[mi.Bool, ShadowTest]:
        """Return whether the vertex sees the medium point at position ``t``, and the shadow test of that point."""
        ray = self.observer.origin.spawn_ray(self.at(t))
        active = active & self.observer.may_scatter(ray.d)
        return _shadow_test(self.observer.trace, ray, self.distance.τ, self._hit(ray, active), self.key, active)

    def importance_of_edges(self) -> mi.Float:
        """Estimate the importance of a shadow boundary that crosses this arc."""
        active = self.active & self.distance.ok
        presence = detect(self.probe, self.length, active) * self.importance() * self.distance.relevance
        return dr.select(active, presence * self.light / self.distance.pdf, 0)

    def resolve(self, weight: mi.Float, generator: mi.PCG32) -> ScatteredBeam:
        """Locate the shadow boundary by bisection, and compute its weight K: see `EdgeSearch.resolve`."""
        x, trace, τ = self.observer, self.observer.trace, self.distance.τ
        bracket = bisect(self.probe, self.length, dr.select(self.active, weight, 0), generator)
        active = (bracket.weight > 0) & self.distance.ok
        (seen_a, test_a), (seen_b, test_b) = (self._shadow_test(t, active) for t in (bracket.a, bracket.b))
        shadow = HardShadow.between(trace, test_a, test_b, active & seen_a & seen_b)
        active = shadow.exists & shadow.lit.lit
        d_a, d_b = self.at(bracket.a), self.at(bracket.b)
        ray = x.origin.spawn_ray(dr.select(shadow.in_a, d_a, d_b))
        first, sampler = x.hit(ray, active), CounterSampler.stream(self.key, Stream.TRANSMITTANCE_OF_BEAM)
        T, medium = transmittance_up_to(trace, ray, τ, x.medium(ray.d), sampler, active)
        y, entry, before = _observer_at(x, ray, first, τ, medium, active & dr.any(T != 0))
        active = y.active & y.at.medium.use_emitter_sampling()
        f, pdf = x.towards(ray.d, active)
        f *= T * _scattered(y, shadow, sampler, active)
        per_length = self.per_length(bracket, pdf, active) / self.distance.pdf
        jump = dr.select(shadow.in_a, -1, 1) * x.selected.β * f * per_length
        slope = derivative_by_ray(ray, lambda ray: shadow.gap_at(_point_on(ray, τ), active)).d
        slope -= dr.dot(slope, ray.d) * ray.d
        K = crossing_weight(d_b - d_a, dr.select(active, jump, 0), slope)
        return ScatteredBeam(K, shadow, x, ray, first, entry, before, y)


@dataclass
class ScatteredBeam:
    """The `Crossing` of an arc with a shadow boundary in a medium."""

    weight: mi.Spectrum
    shadow: HardShadow
    x: ObserverVertex  # the vertex
    ray: mi.Ray3f  # from x to the point of the medium
    first: mi.PreliminaryIntersection3f  # first hit of the ray
    entry: mi.PreliminaryIntersection3f  # last null boundary before the point; invalid if there is none
    before: mi.Float  # distance along the ray from which ``entry`` is the first hit
    y: ObserverVertex  # the point of the medium

    def gap(self, at: mi.Interaction3f) -> mi.Float:
        active = self.y.active
        ray, passed = self.x.moved_ray(at, self.ray, self.first, active), active & self.entry.is_valid()
        start = mi.Ray3f(ray)
        start.o = ray.o + self.before * ray.d
        ray.o = dr.select(passed, met(self.entry, start, passed).p, ray.o)
        return self.shadow.gap_at(self.y.moved(ray), active)


@dr.syntax
def _observer_at(
    x: ObserverVertex,
    ray: mi.Ray3f,
    first: mi.PreliminaryIntersection3f,
    τ: mi.Float,
    medium: mi.MediumPtr,
    active: mi.Bool,
) -> tuple[ObserverVertex, mi.PreliminaryIntersection3f, mi.Float]:
    """Return the observer at distance ``τ`` along a ray from ``x``, which is in ``medium`` there.

    Also returns the last null boundary before the observer, and the distance along the ray from which this boundary is
    the first hit. ``first`` is the first hit of the ray.
    """
    trace = x.trace
    here, entry, onward = mi.PreliminaryIntersection3f(first), dr.zeros(mi.PreliminaryIntersection3f), mi.Ray3f(ray)
    entry.t = mi.Float(dr.inf)
    gone, before = mi.Float(0), mi.Float(0)
    passing = active & (here.t < τ) & is_boundary(trace, here, ray, active)
    while dr.hint(passing, exclude=[x, trace, ray, τ], label="pathreplay: to a point of a medium"):
        entry, before = mi.PreliminaryIntersection3f(here), mi.Float(gone)
        onward, gone = past(ray, gone + here.t)
        here = meet(trace, onward, passing)
        passing &= (gone + here.t < τ) & is_boundary(trace, here, onward, passing)
    active = active & (medium != None) & (gone < τ)  # noqa: E711 (an array of pointers)
    flight = Flight.none(trace.media)
    flight.event, flight.t = active, τ - gone
    at = replace(x.arrival(onward, here, mi.Float(1)), medium=medium)
    return _collision(trace, at, mi.UInt32(0), flight, active), entry, before


@dataclass(frozen=True)
class ScatteredBeamSearch(EdgeSearch[CameraPath]):
    """Edge search over directions from path vertices, and distances along these directions."""

    length: float  # of arcs, in radians

    bisection = Stream.BISECT_SCATTERED

    @staticmethod
    def of(trace: TraceConfig, film: FilmDomain, length: float) -> ScatteredBeamSearch:
        return ScatteredBeamSearch(recordable(trace), film, SegmentDensity.uniform(film.size, 0.0), length)

    def draw(self, i: mi.UInt32, number: mi.UInt32, n: int, seed: mi.UInt32) -> CameraPath:
        s, density = self.density.draw(*quasi_random(i, n, Stream.SCATTERED_CENTRES.of(seed)))
        return CameraPath(s, density, key_of(i, Stream.SCATTERED_KEYS.of(seed)), mi.UInt32(1))

    def detect(self, segments: CameraPath) -> mi.Float:
        return self._arc(segments, None, None)[0].importance_of_edges()

    def resolve(self, segments: CameraPath, weight: mi.Float, generator: mi.PCG32) -> Edges:
        layout = Layout.of(self.trace, True)
        arc, records = self._arc(segments, layout, dr.alloc_local(record_type(layout), room_for(self.trace)))
        path = segments.to_edge(arc.observer.selected, layout, records)
        return Edges(path, [arc.resolve(weight, generator)], arc.observer)

    def _arc(self, path: CameraPath, layout: Layout | None, records: object) -> tuple[BeamArc, object]:
        """Draw an arc around a vertex of each path, and record the path unless ``records`` is None."""
        trace = replace(self.trace, max_depth=self.trace.max_depth - 1)  # the point of the medium is a vertex, too
        records, x = path.vertex(trace, self.film, dr.ones(mi.Float, 1), layout, records)
        arc = BeamArc.draw(ObserverVertex(self.trace, x), self.length, True, Stream.ARCS.of(path.key), x.active)
        return arc, records
