"""Volumetric boundary term: boundaries of the hard shadows that lights without extent cast into media.

The camera sees points x = o + τ d of a medium at all distances τ. Each x is either lit or in shadow. For each τ, the
boundary of the shadow is an edge on the film. Short segments with constant τ find this edge (see `crofton`):

    dI/dπ = - Σ K dB/dπ,    K = π/2 · f / (l p(c) p(τ) N) · sgn(w·∂B/∂s) / |∂B/∂s|,    B = n·(x + r d - z),

where f is the radiance that the lit side scatters to the camera, including the transmittances from the light to x and
from x to the camera, and N is the number of segments. `primary` defines the symbols in B. In dB/dπ, x moves as in the
interior term. ∂B/∂s is taken at constant τ, because the domain of the integral consists of film positions and
distances.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import derivative_by_place
from pathreplay.adjoint.record import Layout, deepest, record, record_type, room_for
from pathreplay.boundary.crofton import VisibilityProbe, heading
from pathreplay.boundary.edges import EdgePath, Edges, FilmDomain
from pathreplay.boundary.hard_shadows import HardShadow, ShadowTest
from pathreplay.boundary.observer import ObserverVertex, SelectedVertex
from pathreplay.boundary.search import FilmSearch, FilmSegment
from pathreplay.samplers.counter_sampler import CounterSampler, key_of, quasi_random
from pathreplay.samplers.streams import Stream
from pathreplay.transport.meet import meet
from pathreplay.transport.path import PathState
from pathreplay.transport.start import CameraStart
from pathreplay.transport.step import choose_step
from pathreplay.transport.vertex import Flight, TraceConfig, VertexSamples
from pathreplay.transport.volume.media import interaction
from pathreplay.transport.volume.passage import skip_null, transmittance_up_to


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


Beams = TypeVar("Beams", bound="VolumetricSearch")


@dataclass(frozen=True)
class VolumetricSearch(FilmSearch[BeamSegment]):
    """Edge search over film positions and distances.

    There is no pilot pass, because shadow boundaries in a medium fill much of the image.
    """

    bisection = Stream.BISECT_VOLUMETRIC

    @classmethod
    def of(cls: type[Beams], trace: TraceConfig, film: FilmDomain, length: float) -> Beams:
        return super().of(replace(trace, max_depth=min(trace.max_depth, deepest(trace))), film, length)

    def draw(self, i: mi.UInt32, n: int, seed: mi.UInt32) -> BeamSegment:
        key = key_of(i, Stream.VOLUMETRIC_KEYS.of(seed))
        sampler = CounterSampler.stream(key, Stream.BEAM)
        w = heading(sampler.next_1d())
        c, density = self.density.draw(*quasi_random(i, n, Stream.VOLUMETRIC_CENTRES.of(seed)))
        τ, pdf = self._distance(dr.detach(self.film.ray(c, key)[0]), sampler.next_1d())
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

    def _distance(self, ray: mi.Ray3f, u: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Sample a distance τ along a ray, up to its hit; return it with its density.

        If the ray leaves the scene, the distances end behind the scene. In media without bounds, they do not end: half
        of them lie behind the scene.
        """
        hit, box = self._hit(ray, mi.Bool(True)), self.trace.scene.bbox()
        far = dr.norm(ray.o - box.center()) + 0.5 * dr.norm(box.extents())
        reach = dr.select(hit.is_valid(), hit.t, far)
        τ, pdf = u * reach, dr.rcp(reach)
        if self.trace.media.bounded:
            return τ, pdf
        beyond = far * u / (1 - u)
        pdf_beyond = far / dr.square(far + beyond)
        return dr.select(hit.is_valid(), τ, beyond), dr.select(hit.is_valid(), pdf, pdf_beyond)

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
