"""Beams: borders of the hard shadows that lights without extent cast into media.

The camera sees particles x = o + τ d at all distances τ, and x is lit or not. So there are edges on the film for each
τ, found by short segments on which τ stays the same (see `crofton`), as for hard shadows on surfaces:

    dI/dπ = - Σ K dB/dπ,    K = π/2 · f / (l p(c) p(τ) N) · sgn(w·∂B/∂s) / |∂B/∂s|,    B = n·(x + r d - z),

f is what the lit side sends to the camera, with the transmittance of both ways. dB/dπ is taken with x as the interior
moves it, ∂B/∂s with τ held, since places and distances together are the domain of the integral.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import derivative_by_place
from pathreplay.adjoint.record import Layout, deepest, record, record_type, room_for
from pathreplay.boundary.crofton import PlaneSegment, VisibilityProbe, bisect, detect, heading, passed
from pathreplay.boundary.edges import EdgePath, Edges, FilmDomain
from pathreplay.boundary.observer import ObserverVertex, SelectedVertex
from pathreplay.boundary.search import EdgeSearch, SegmentDensity
from pathreplay.samplers.counter_sampler import CounterSampler, key_of, quasi_random
from pathreplay.samplers.streams import Stream
from pathreplay.transport.emitters import draw_emitter
from pathreplay.transport.meet import meet
from pathreplay.transport.path import PathState
from pathreplay.transport.signature import edge_normal, outline_gap
from pathreplay.transport.start import CameraStart
from pathreplay.transport.step import Visit, choose_step
from pathreplay.transport.vertex import Flight, TraceConfig, VertexSamples
from pathreplay.transport.volume.media import interaction
from pathreplay.transport.volume.passage import skip_null, transmittance_past_edge, transmittance_up_to


@dataclass
class BeamSegment(PlaneSegment):
    """A segment on the film, and of particles that are seen there at one distance."""

    density: mi.Float  # of its centre, per pixel, and of the distance
    key: mi.UInt32
    τ: mi.Float
    active: mi.Bool  # there are particles

    @property
    def emitter_sample(self) -> mi.Point2f:
        """The random numbers that say which light."""
        return CounterSampler.stream(self.key, Stream.BEAM_EMITTER).next_2d()


@dataclass
class Lighting:
    """A particle, and what is between it and the light that is sampled there."""

    there: mi.Bool  # nothing hides it from the camera
    ray: mi.Ray3f  # towards the light, if that has no extent
    hit: mi.PreliminaryIntersection3f
    hidden: mi.Bool
    Le: mi.Spectrum  # over the probability of the light
    lit: mi.Bool  # there is such a light


@dataclass
class BeamCrossing:
    """A crossing of the border of a beam: see `Crossing`."""

    weight: mi.Spectrum
    scene: mi.Scene
    emitter_sample: mi.Point2f
    dark: Lighting
    n: mi.Vector3f
    active: mi.Bool

    def gap(self, at: mi.Interaction3f) -> mi.Float:
        """See `Crossing`."""
        light, _ = self.scene.sample_emitter_direction(at, self.emitter_sample, False, self.active)
        return outline_gap(self.n, at.p, light.d, self.dark.hit, self.dark.ray, self.active)


@dataclass(frozen=True)
class VolumetricSearch(EdgeSearch[BeamSegment]):
    """A search by segments of a ``length`` in pixels."""

    length: float

    bisection = Stream.BISECT_VOLUMETRIC

    @staticmethod
    def of(trace: TraceConfig, film: FilmDomain, length: float) -> VolumetricSearch:
        trace = replace(trace, max_depth=min(trace.max_depth, deepest(trace)))
        return VolumetricSearch(trace, film, SegmentDensity.even(film.size, length), length)

    def guided(self, n: int, seed: mi.UInt32) -> VolumetricSearch:
        """See `EdgeSearch`. There is no first look: beams fill a large part of what they are seen in."""
        return self

    def draw(self, i: mi.UInt32, n: int, seed: mi.UInt32) -> BeamSegment:
        """See `EdgeSearch`."""
        key = key_of(i, Stream.VOLUMETRIC_KEYS.of(seed))
        numbers = CounterSampler.stream(key, Stream.BEAM)
        w = heading(numbers.next_1d())
        c, density = self.density.draw(mi.Point2f(quasi_random(i, n, Stream.VOLUMETRIC_CENTRES.of(seed))))
        reach = self._reach(dr.detach(self.film.ray(c, key)[0]))
        τ = numbers.next_1d() * reach
        ok = dr.isfinite(reach) & (reach > 0)
        density = density * dr.select(ok, dr.rcp(reach), 1)
        return BeamSegment(c, w, mi.Float(self.length), density, key, dr.select(ok, τ, 0), ok)

    def probe(self, segment: BeamSegment, t: mi.Float, active: mi.Bool) -> VisibilityProbe:
        """What is seen at a place of a segment: see `Probe`."""
        x = self._lighting(segment, t, active)
        return VisibilityProbe.of(dr.select(x.there, mi.UInt32(1), 0) | dr.select(x.hidden, mi.UInt32(2), 0))

    def detect(self, segments: BeamSegment) -> mi.Float:
        """See `EdgeSearch`."""
        return detect(partial(self.probe, segments), segments.length, segments.active) / segments.density

    def resolve(self, segments: BeamSegment, weight: mi.Float, generator: mi.PCG32) -> Edges:
        """See `EdgeSearch`."""
        weight = dr.select(segments.active, weight, 0)
        crossed = bisect(partial(self.probe, segments), segments.length, weight, generator)
        active = crossed.weight > 0
        a, b = (self._lighting(segments, t, active) for t in (crossed.a, crossed.b))
        active &= a.there & b.there & (a.hidden != b.hidden)
        s = segments.at(dr.select(a.hidden, crossed.a, crossed.b))
        dark, bright = dr.select(a.hidden, a, b), dr.select(a.hidden, b, a)
        active &= bright.lit
        ray, ray_weight = dr.detach(self.film.ray(s, segments.key))
        path, observer = self._particle(s, ray, segments, active)
        active &= observer.active
        crossing = BeamCrossing(
            mi.Spectrum(0), self.trace.scene, segments.emitter_sample, dark, edge_normal(dark.hit, dark.ray, active),
            active,
        )  # fmt: skip
        jump = ray_weight * self._radiance(ray, segments, observer, dark, bright)
        jump *= crossed.per_length(segments.length, segments.density)
        jump *= dr.select(a.hidden, -1, 1)  # from begin to end of the segment
        slope = derivative_by_place(s, lambda s: crossing.gap(_place_on(self.film.ray(s, segments.key)[0], segments.τ)))
        return Edges(path, [replace(crossing, weight=passed(segments.w, jump, slope, active))], observer)

    def _radiance(
        self, ray: mi.Ray3f, segment: BeamSegment, observer: ObserverVertex, dark: Lighting, bright: Lighting
    ) -> mi.Spectrum:
        """f: what the particle sends to the camera, where it is lit."""
        trace, active = self.trace, observer.active
        numbers = CounterSampler.stream(segment.key, Stream.TRANSMITTANCE_OF_BEAM)
        around = trace.media.around
        medium = dr.zeros(mi.MediumPtr) if around is None else mi.MediumPtr(around)
        T = transmittance_up_to(trace, ray, segment.τ, medium, numbers, active)[0]
        T *= transmittance_past_edge(trace, bright.ray, dark.hit.t, observer.at.medium, numbers, active)
        return T * observer.flight.σ_s * observer.towards(bright.ray.d, active)[0] * bright.Le

    def _hit(self, ray: mi.Ray3f, active: mi.Bool) -> mi.PreliminaryIntersection3f:
        """What a ray meets behind null boundaries."""
        return skip_null(self.trace, ray, meet(self.trace, ray, active), active)

    def _reach(self, ray: mi.Ray3f) -> mi.Float:
        """How far particles are looked for: up to what the ray meets or, if that is nothing, the end of the scene."""
        hit, box = self._hit(ray, mi.Bool(True)), self.trace.scene.bbox()
        far = dr.norm(ray.o - box.center()) + 0.5 * dr.norm(box.extents())
        return dr.select(hit.is_valid(), hit.t, far)

    def _lighting(self, segment: BeamSegment, t: mi.Float, active: mi.Bool) -> Lighting:
        ray = dr.detach(self.film.ray(segment.at(t), segment.key)[0])
        before = self._hit(ray, active)
        there = active & ~(before.is_valid() & (before.t < segment.τ))
        x = _place_on(ray, segment.τ)
        light, Le = draw_emitter(self.trace.scene, x, segment.emitter_sample, there, visible=False)
        lit = there & light.delta & (light.pdf != 0)
        towards = x.spawn_ray_to(light.p)
        hit = self._hit(towards, lit)
        return Lighting(there, towards, hit, lit & hit.is_valid(), Le, lit)

    @dr.syntax
    def _particle(
        self, s: mi.Point2f, ray: mi.Ray3f, segment: BeamSegment, active: mi.Bool
    ) -> tuple[EdgePath, ObserverVertex]:
        """Record the way to the particle, through null boundaries; the path there, and the particle."""
        trace, layout, τ = self.trace, Layout.of(self.trace, True), segment.τ
        records: Any = dr.alloc_local(record_type(layout), room_for(trace))
        numbers = CounterSampler.of(segment.key)
        path = PathState.begin(trace, CameraStart(ray, numbers, active))
        at, flight = path.at, Flight.none(trace.media)
        gone, k, count = mi.Float(0), mi.UInt32(0), mi.UInt32(0)
        go_on = path.active & (count < room_for(trace))
        while dr.hint(go_on, exclude=[trace, layout, self], label="pathreplay: to a particle"):
            length = dr.select(path.at.hit.is_valid(), path.at.hit.t, dr.inf)
            event = (gone + length > τ) & (path.at.medium != None)  # noqa: E711 (an array of pointers)
            here = Flight.none(trace.media)
            here.event, here.t = event, dr.select(event, τ - gone, 0)
            u = VertexSamples.draw(numbers)
            step = choose_step(trace, Visit(path.at, path.β, mi.Bool(False), path.active), u, numbers, here)
            onward, v = path.advance(trace, u, step)
            records[count] = record(layout, v)
            at, k = dr.select(event, path.at, at), dr.select(event, count, k)
            flight = dr.select(event, here, flight)
            gone += dr.norm(onward.at.ray.o - path.at.ray.o)
            go_on = onward.active & step.null & ~event & (gone < τ)
            path = onward
            count += 1
        active = active & flight.event
        σ_s, _, _ = at.medium.get_scattering_coefficients(interaction(at.medium, at.ray, flight.t), active)
        flight.σ_s = dr.detach(σ_s)
        x = SelectedVertex(at, k, k, mi.Spectrum(1), mi.Float(1), mi.Bool(True), active, flight)
        edge_path = EdgePath(s, segment.key, dr.select(active, k, 0), at.ray, layout, records)
        return edge_path, ObserverVertex(trace, x)


def _place_on(ray: mi.Ray3f, τ: mi.Float) -> mi.Interaction3f:
    """The place of a particle at a distance."""
    x = dr.zeros(mi.Interaction3f)
    x.p, x.t, x.time, x.wavelengths = ray.o + τ * ray.d, mi.Float(0), ray.time, ray.wavelengths
    return x
