"""Volumetric boundary term: boundaries of the hard shadows that lights without extent cast into media.

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
from pathreplay.adjoint.record import Layout, deepest, record, record_type, room_for
from pathreplay.boundary.arcs import Arc
from pathreplay.boundary.crofton import VisibilityProbe, bisect, crossing_weight, detect, heading
from pathreplay.boundary.edges import EdgePath, Edges, FilmDomain
from pathreplay.boundary.hard_shadows import HardShadow, ShadowTest
from pathreplay.boundary.observer import ObserverVertex, SelectedVertex, choose_vertex
from pathreplay.boundary.search import EdgeSearch, FilmSearch, FilmSegment, SegmentDensity
from pathreplay.boundary.secondary import CameraPath
from pathreplay.platform import compat
from pathreplay.samplers.counter_sampler import CounterSampler, key_of, quasi_random
from pathreplay.samplers.streams import Stream
from pathreplay.transport.meet import meet
from pathreplay.transport.path import PathState
from pathreplay.transport.start import CameraStart
from pathreplay.transport.step import choose_step
from pathreplay.transport.surface import met
from pathreplay.transport.velocity import moved_direction
from pathreplay.transport.vertex import Arrival, Flight, TraceConfig, VertexSamples
from pathreplay.transport.volume.media import interaction
from pathreplay.transport.volume.passage import STEP, is_boundary, skip_null, transmittance_up_to

if TYPE_CHECKING:
    from typing_extensions import Self


@dataclass
class BeamSegment(FilmSegment):
    """A segment on the film, at one distance τ along all its camera rays."""

    τ: mi.Float


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
        return super().of(replace(trace, max_depth=min(trace.max_depth, deepest(trace))), film, length)

    def draw(self, i: mi.UInt32, n: int, seed: mi.UInt32) -> BeamSegment:
        key = key_of(i, Stream.VOLUMETRIC_KEYS.of(seed))
        sampler = CounterSampler.stream(key, Stream.BEAM)
        w = heading(sampler.next_1d())
        c, density = self.density.draw(*quasi_random(i, n, Stream.VOLUMETRIC_CENTRES.of(seed)))
        ray = dr.detach(self.film.ray(c, key)[0])
        τ, pdf = _distance(self.trace, ray, self._hit(ray, mi.Bool(True)), sampler.next_1d())
        ok = dr.isfinite(τ) & (pdf > 0)
        density = density * dr.select(ok, pdf, 1)
        return BeamSegment(c, w, mi.Float(self.length), key, density, ok, dr.select(ok, τ, 0))

    def probe(self, segment: BeamSegment, t: mi.Float, active: mi.Bool) -> VisibilityProbe:
        visible, test = self._shadow_test(segment, t, active)
        return VisibilityProbe.of(dr.select(visible, mi.UInt32(1), 0) | dr.select(test.dark, mi.UInt32(2), 0))

    def _shadow_test(self, segment: BeamSegment, t: mi.Float, active: mi.Bool) -> tuple[mi.Bool, ShadowTest]:
        """Return whether the camera sees the medium point at position ``t``, and the shadow test of that point."""
        ray = dr.detach(self.film.ray(segment.at(t), segment.key)[0])
        hit = self._hit(ray, active)
        visible = active & ~(hit.is_valid() & (hit.t < segment.τ))
        u = CounterSampler.stream(segment.key, Stream.BEAM_EMITTER).next_2d()
        return visible, ShadowTest.at(self.trace, _point_on(ray, segment.τ), u, visible)

    def edge(self, segment: BeamSegment, a: mi.Float, b: mi.Float, active: mi.Bool) -> Edges:
        (visible_a, test_a), (visible_b, test_b) = (self._shadow_test(segment, t, active) for t in (a, b))
        shadow = HardShadow.between(self.trace, test_a, test_b, active & visible_a & visible_b)
        s = segment.at(dr.select(shadow.in_a, a, b))
        ray, weight = dr.detach(self.film.ray(s, segment.key))
        path, observer = self._particle(s, ray, segment, shadow.exists & shadow.lit.lit)
        jump = weight * dr.select(shadow.in_a, -1, 1) * self._radiance(ray, segment, observer, shadow)
        return Edges(path, [BeamCrossing(dr.select(observer.active, jump, 0), shadow, observer.active)], observer)

    def slope(self, segment: BeamSegment, edges: Edges) -> mi.Vector2f:
        (crossing,), path = edges.crossings, edges.path
        return derivative_by_place(path.s, lambda s: crossing.gap(_point_on(self.film.ray(s, path.key)[0], segment.τ)))

    def _radiance(
        self, ray: mi.Ray3f, segment: BeamSegment, observer: ObserverVertex, shadow: HardShadow
    ) -> mi.Spectrum:
        """Estimate f, the radiance that the lit medium point scatters to the camera.

        It is zero if the medium does not use emitter sampling, or if paths are too short to be scattered.
        """
        trace = self.trace
        active, link = mi.Bool(observer.active), trace.to_sensor
        if link is None:
            active &= observer.at.medium.use_emitter_sampling() & (trace.max_depth > 1)
        sampler = CounterSampler.stream(segment.key, Stream.TRANSMITTANCE_OF_BEAM)
        T = transmittance_up_to(trace, ray, segment.τ, self.film.medium(trace, ray, active), sampler, active)[0]
        T *= shadow.blocked(trace, observer.at.medium, sampler, active)
        f = T * observer.selected.β * observer.towards(shadow.lit.ray.d, active)[0] * shadow.lit.Le
        if link is not None and link.adjoint is not None:
            f *= link.adjoint(shadow.lit.uv, ray.wavelengths, active)
        return dr.select(active, f, 0)

    def _hit(self, ray: mi.Ray3f, active: mi.Bool) -> mi.PreliminaryIntersection3f:
        """Return the first hit of a ray on a surface that is not a null boundary."""
        return skip_null(self.trace, ray, meet(self.trace, ray, active), active)

    @dr.syntax
    def _particle(
        self, s: mi.Point2f, ray: mi.Ray3f, segment: BeamSegment, active: mi.Bool
    ) -> tuple[EdgePath, ObserverVertex]:
        """Record the path through null boundaries to the medium point; return the path and the observer there."""
        trace, layout, τ = self.trace, Layout.of(self.trace, True), segment.τ
        records = dr.alloc_local(record_type(layout), room_for(trace))
        sampler = CounterSampler.of(segment.key)
        path = PathState.begin(trace, CameraStart(ray, sampler, active))
        path.at.medium = self.film.medium(trace, ray, active)
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
        σ_s, _, _ = at.medium.get_scattering_coefficients(interaction(at.medium, at.ray, flight.t), active)
        flight.σ_s = dr.detach(σ_s)
        x = SelectedVertex(at, k, k, flight.σ_s, mi.Float(1), mi.Bool(True), active, flight)
        edge_path = EdgePath(s, segment.key, dr.select(active, k, 0), at.ray, layout, records)
        return edge_path, ObserverVertex(trace, x)


def _point_on(ray: mi.Ray3f, τ: mi.Float) -> mi.Interaction3f:
    """Return the interaction at distance ``τ`` along a ray."""
    x = dr.zeros(mi.Interaction3f)
    x.p, x.t, x.time, x.wavelengths = ray.o + τ * ray.d, mi.Float(0), ray.time, ray.wavelengths
    return x


def _distance(
    trace: TraceConfig, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, u: mi.Float
) -> tuple[mi.Float, mi.Float]:
    """Sample a distance τ along a ray, up to its ``hit``; return it with its density.

    If the ray leaves the scene, the distances end behind the scene. In media without bounds, they do not end: half of
    them lie behind the scene.
    """
    # `dr.freeze` would keep the bounding box that the scene had when the pass was recorded.
    sphere = dr.gather(mi.Vector4f, trace.traits.tables.scene_bounds, mi.UInt32(0))
    far = dr.norm(ray.o - mi.Point3f(sphere.x, sphere.y, sphere.z)) + sphere.w
    reach = dr.select(hit.is_valid(), hit.t, far)
    τ, pdf = u * reach, dr.rcp(reach)
    if trace.media.bounded:
        return τ, pdf
    beyond = far * u / (1 - u)
    pdf_beyond = far / dr.square(far + beyond)
    return dr.select(hit.is_valid(), τ, beyond), dr.select(hit.is_valid(), pdf, pdf_beyond)


class BeamArc(Arc):
    """An arc of directions around a vertex, with points of a medium at one distance τ along all directions."""

    @cached_property
    def distance(self) -> tuple[mi.Float, mi.Float]:
        """Distance τ and its density."""
        ray = self.observer.origin.spawn_ray(self.c)
        u = CounterSampler.stream(self.key, Stream.BEAM).next_1d()
        return _distance(self.observer.trace, ray, self._hit(ray, self.active), u)

    def _hit(self, ray: mi.Ray3f, active: mi.Bool) -> mi.PreliminaryIntersection3f:
        return self.observer.behind(ray, self.observer.hit(ray, active), active)

    def probe(self, t: mi.Float, active: mi.Bool) -> VisibilityProbe:
        visible, test = self._shadow_test(t, active)
        return VisibilityProbe.of(dr.select(visible, mi.UInt32(1), 0) | dr.select(test.dark, mi.UInt32(2), 0))

    def _shadow_test(self, t: mi.Float, active: mi.Bool) -> tuple[mi.Bool, ShadowTest]:
        """Return whether the vertex sees the medium point at position ``t``, and the shadow test of that point."""
        ray, τ = self.observer.origin.spawn_ray(self.at(t)), self.distance[0]
        active = active & self.observer.may_scatter(ray.d)
        hit = self._hit(ray, active)
        visible = active & ~(hit.is_valid() & (hit.t < τ))
        u = CounterSampler.stream(self.key, Stream.BEAM_EMITTER).next_2d()
        return visible, ShadowTest.at(self.observer.trace, _point_on(ray, τ), u, visible)

    def importance_of_edges(self) -> mi.Float:
        """Estimate the importance of a shadow boundary that crosses this arc."""
        presence = detect(self.probe, self.length, self.active) * self.importance() / self.distance[1]
        return dr.select(self.active, presence * dr.mean(dr.abs(self.observer.selected.β * self.f)) / self.p, 0)

    def resolve(self, weight: mi.Float, generator: mi.PCG32) -> ScatteredBeam:
        """Locate the shadow boundary by bisection, and compute its weight K: see `EdgeSearch.resolve`."""
        x, trace, (τ, pdf_τ) = self.observer, self.observer.trace, self.distance
        bracket = bisect(self.probe, self.length, dr.select(self.active, weight, 0), generator)
        active = bracket.weight > 0
        (seen_a, test_a), (seen_b, test_b) = (self._shadow_test(t, active) for t in (bracket.a, bracket.b))
        shadow = HardShadow.between(trace, test_a, test_b, active & seen_a & seen_b)
        active = shadow.exists & shadow.lit.lit
        d_a, d_b = self.at(bracket.a), self.at(bracket.b)
        ray = x.origin.spawn_ray(dr.select(shadow.in_a, d_a, d_b))
        first, medium = x.hit(ray, active), x.medium(ray.d)
        y, entry = _observer_at(trace, ray, first, τ, medium, active)
        active = y.active & y.at.medium.use_emitter_sampling()
        sampler = CounterSampler.stream(self.key, Stream.TRANSMITTANCE_OF_BEAM)
        T, _ = transmittance_up_to(trace, ray, τ, medium, sampler, active)
        T *= shadow.blocked(trace, y.at.medium, sampler, active)
        f, pdf = x.towards(ray.d, active)
        f *= T * y.selected.β * y.towards(shadow.lit.ray.d, active)[0] * shadow.lit.Le
        per_length = 0.5 * dr.pi * bracket.weight * self.weight(pdf, active) / pdf_τ
        jump = dr.select(shadow.in_a, -1, 1) * x.selected.β * f * per_length
        slope = derivative_by_ray(ray, lambda ray: shadow.gap_at(_point_on(ray, τ), active)).d
        slope -= dr.dot(slope, ray.d) * ray.d
        K = crossing_weight(d_b - d_a, dr.select(active, jump, 0), slope)
        return ScatteredBeam(K, shadow, x, ray, first, entry, y)


@dataclass
class ScatteredBeam:
    """The `Crossing` of an arc with a shadow boundary in a medium."""

    weight: mi.Spectrum
    shadow: HardShadow
    x: ObserverVertex  # the vertex
    ray: mi.Ray3f  # from x to the point of the medium
    first: mi.PreliminaryIntersection3f  # first hit of the ray
    entry: mi.PreliminaryIntersection3f  # last null boundary before the point; invalid if there is none
    y: ObserverVertex  # the point of the medium

    def gap(self, at: mi.Interaction3f) -> mi.Float:
        active, trace = self.y.active, self.x.trace
        holds = self.x.holds(self.first, self.ray, active)
        d, _ = moved_direction(trace.traits.tables.blend_lengths, at, self.ray.d, self.first, holds)
        ray = mi.Ray3f(self.ray)
        ray.o, ray.d = at.spawn_ray(dr.detach(d)).o, d
        passed = active & self.entry.is_valid()
        ray.o = dr.select(passed, met(self.entry, ray, passed).p, ray.o)
        return self.shadow.gap_at(self.y.moved(ray), active)


@dr.syntax
def _observer_at(
    trace: TraceConfig,
    ray: mi.Ray3f,
    first: mi.PreliminaryIntersection3f,
    τ: mi.Float,
    medium: mi.MediumPtr,
    active: mi.Bool,
) -> tuple[ObserverVertex, mi.PreliminaryIntersection3f]:
    """Return the observer at distance ``τ`` along a ray that starts in ``medium``, and the last null boundary before.

    ``first`` is the first hit of the ray.
    """
    here, entry, onward = mi.PreliminaryIntersection3f(first), dr.zeros(mi.PreliminaryIntersection3f), mi.Ray3f(ray)
    entry.t = mi.Float(dr.inf)
    medium, gone = mi.MediumPtr(medium), mi.Float(0)
    passing = active & (here.t < τ) & is_boundary(trace, here, ray, active)
    while dr.hint(passing, exclude=[trace, ray, τ], label="pathreplay: to a point of a medium"):
        si = here.compute_surface_interaction(onward, compat.minimal(), passing)
        medium = dr.select(si.is_medium_transition(), si.target_medium(ray.d), medium)
        entry = mi.PreliminaryIntersection3f(here)
        entry.t = gone + here.t
        gone = entry.t + STEP * (1 + dr.max(dr.abs(ray.o)) + entry.t)
        onward.o, onward.maxt = ray.o + gone * ray.d, ray.maxt - gone
        here = meet(trace, onward, passing)
        passing &= (gone + here.t < τ) & is_boundary(trace, here, onward, passing)
    active = active & (medium != None) & (gone < τ)  # noqa: E711 (an array of pointers)
    flight = Flight.none(trace.media)
    flight.event, flight.t = active, τ - gone
    σ_s, _, _ = medium.get_scattering_coefficients(interaction(medium, onward, flight.t), active)
    flight.σ_s = dr.detach(σ_s)
    at = Arrival(onward, here, mi.Float(1), mi.Bool(False), mi.Bool(False), medium, mi.Float(0))
    zero = mi.UInt32(0)
    y = SelectedVertex(at, zero, zero, flight.σ_s, mi.Float(1), mi.Bool(True), active, flight)
    return ObserverVertex(trace, y), entry


@dataclass(frozen=True)
class ScatteredBeamSearch(EdgeSearch[CameraPath]):
    """Edge search over directions from path vertices, and distances along these directions."""

    length: float  # of arcs, in radians

    bisection = Stream.BISECT_SCATTERED

    @staticmethod
    def of(trace: TraceConfig, film: FilmDomain, length: float) -> ScatteredBeamSearch:
        trace = replace(trace, max_depth=min(trace.max_depth, deepest(trace)))
        return ScatteredBeamSearch(trace, film, SegmentDensity.uniform(film.size, 0.0), length)

    def draw(self, i: mi.UInt32, n: int, seed: mi.UInt32) -> CameraPath:
        s, density = self.density.draw(*quasi_random(i, n, Stream.SCATTERED_CENTRES.of(seed)))
        return CameraPath(s, density, key_of(i, Stream.SCATTERED_KEYS.of(seed)), mi.UInt32(1))

    def detect(self, segments: CameraPath) -> mi.Float:
        return self._arc(segments, None, None)[0].importance_of_edges()

    def resolve(self, segments: CameraPath, weight: mi.Float, generator: mi.PCG32) -> Edges:
        layout = Layout.of(self.trace, True)
        arc, records = self._arc(segments, layout, dr.alloc_local(record_type(layout), room_for(self.trace)))
        crossing, x = arc.resolve(weight, generator), arc.observer.selected
        path = EdgePath(segments.s, segments.key, dr.select(x.active, x.k, 0), x.at.ray, layout, records)
        return Edges(path, [crossing], arc.observer)

    def _arc(self, path: CameraPath, layout: Layout | None, records: object) -> tuple[BeamArc, object]:
        """Draw an arc around a vertex of each path, and record the path unless ``records`` is None."""
        ray, weight = dr.detach(self.film.ray(path.s, path.key))
        trace = replace(self.trace, max_depth=self.trace.max_depth - 1)  # the point of the medium is a vertex, too
        shares, sampler = dr.ones(mi.Float, 1), CounterSampler.of(path.key)
        records, x = choose_vertex(trace, sampler, ray, self.film.flows(path.s), shares, layout, records)
        x.β *= weight / path.density
        arc = BeamArc.draw(ObserverVertex(self.trace, x), self.length, True, Stream.ARCS.of(path.key), x.active)
        return arc, records
