"""Beams: borders of the hard shadows that lights without extent cast into media.

The camera sees particles x = o + τ d at all distances τ, and x is lit or not. So there are edges on the film for each
τ, found by short lines on which τ stays the same (see `crofton`), as for hard shadows on surfaces:

    dI/dπ = - Σ K dB/dπ,    K = π/2 · f / (l p(c) p(τ) N) · sgn(w·∂B/∂s) / |∂B/∂s|,    B = n·(x + r d - z),

f is what the lit side sends to the camera, with the transmittance of both ways. dB/dπ is taken with x as the interior
moves it, ∂B/∂s with τ held, since places and distances together are the domain of the integral.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import derivative_by_place
from pathreplay.adjoint.record import Layout, deepest, record, record_type, room_for
from pathreplay.boundary.crofton import PlaneLine, Resampled, VisibilityProbe, bisect, detect, passed
from pathreplay.boundary.edges import Edges, FilmDomain
from pathreplay.boundary.observer import ObserverVertex
from pathreplay.boundary.segment_density import SegmentDensity
from pathreplay.samplers.counter_sampler import CounterSampler, key_of, quasi_random
from pathreplay.samplers.streams import Stream
from pathreplay.transport.emitters import draw_emitter
from pathreplay.transport.meet import meet
from pathreplay.transport.path import PathState
from pathreplay.transport.signature import edge_normal, outline_gap
from pathreplay.transport.start import CameraStart
from pathreplay.transport.step import Visit, choose_step
from pathreplay.transport.vertex import Arrival, Flight, TraceConfig, VertexSamples
from pathreplay.transport.volume.media import interaction
from pathreplay.transport.volume.passage import skip_null, transmittance_past_edge, transmittance_up_to


@dataclass
class BeamLine(PlaneLine):
    """A line on the film, and of particles that are seen there at one distance."""

    density: mi.Float  # of its centre, per pixel, and of the distance
    key: mi.UInt32
    τ: mi.Float


@dataclass
class Lighting:
    """A particle, and what is between it and the light that is sampled there."""

    there: mi.Bool  # nothing hides it from the camera
    ray: mi.Ray3f  # towards the light, if that has no extent
    hit: mi.PreliminaryIntersection3f
    hidden: mi.Bool
    Le: mi.Spectrum  # over the probability of the light
    lit: mi.Bool  # there is such a light


def volumetric_edges(
    trace: TraceConfig, places: FilmDomain, lines: int, closer: int, seed: mi.UInt32, l: float
) -> Edges:
    """Find borders of hard shadows by lines of length ``l`` (pixels), and look ``closer`` at as many. Detached."""
    trace = replace(trace, max_depth=min(trace.max_depth, deepest(trace)))
    centres = SegmentDensity.even(places.size, l)

    def draw(i: mi.UInt32) -> tuple[BeamLine, mi.Bool]:
        key = key_of(i, Stream.VOLUMETRIC_KEYS.of(seed))
        numbers = CounterSampler.stream(key, Stream.BEAM)
        turn = dr.two_pi * numbers.next_1d()
        w = mi.Vector2f(dr.cos(turn), dr.sin(turn))
        c, density = centres.draw(mi.Point2f(quasi_random(i, lines, Stream.VOLUMETRIC_CENTRES.of(seed))))
        reach = _reach(trace, dr.detach(places.ray(c - centres.margin, key)[0]))
        τ = numbers.next_1d() * reach
        ok = dr.isfinite(reach) & (reach > 0)
        density *= dr.select(ok, dr.rcp(reach), 1)
        begin, end = mi.Float(-0.5 * l), mi.Float(0.5 * l)
        return BeamLine(c - centres.margin, w, begin, end, density, key, dr.select(ok, τ, 0)), ok

    def probe(line: BeamLine, t: mi.Float, active: mi.Bool) -> VisibilityProbe:
        x = _lighting(trace, places, line, line.at(t), active)
        word = dr.select(x.there, mi.UInt32(1), 0) | dr.select(x.hidden, mi.UInt32(2), 0)
        return VisibilityProbe(word, mi.Point3f(0), mi.Normal3f(0))

    every, ok = draw(dr.arange(mi.UInt32, lines))
    chosen = Resampled.of(detect(probe, every, ok) / every.density, closer, seed)
    pick = mi.PCG32(closer, initstate=seed + int(Stream.BISECT_VOLUMETRIC), initseq=dr.arange(mi.UInt32, closer))
    line, ok = draw(chosen.index)
    found = bisect(probe, line, dr.select(ok, chosen.weight, 0), pick)
    active = found.weight > 0
    a, b = (_lighting(trace, places, line, line.at(t), active) for t in (found.a, found.b))
    active &= a.there & b.there & (a.hidden != b.hidden)
    s = line.at(dr.select(a.hidden, found.a, found.b))
    dark, bright = dr.select(a.hidden, a, b), dr.select(a.hidden, b, a)
    active &= bright.lit
    camera_ray, weight = dr.detach(places.ray(s, line.key))
    layout = Layout.of(trace, True)
    records = dr.alloc_local(record_type(layout), room_for(trace))
    records, k, at, flight = _to_particle(trace, camera_ray, line, active, layout, records)
    active &= flight.event
    observer = ObserverVertex(trace, at, flight, active)
    n = edge_normal(dark.hit, dark.ray, active)

    per_line = dr.opaque(mi.Float, 0.5 * dr.pi / (l * lines))
    others = CounterSampler.stream(line.key, Stream.TRANSMITTANCE_OF_BEAM)
    around = trace.media.around
    medium = dr.zeros(mi.MediumPtr) if around is None else mi.MediumPtr(around)
    T = transmittance_up_to(trace, camera_ray, line.τ, medium, others, active)[0]
    T *= transmittance_past_edge(trace, bright.ray, dark.hit.t, at.medium, others, active)
    f = weight * T * flight.σ_s * observer.towards(bright.ray.d, active)[0] * bright.Le
    jump = f * (found.weight * per_line / line.density)
    jump *= dr.select(a.hidden, -1, 1)  # from begin to end of the line

    def gap(origin: mi.Interaction3f) -> mi.Float:
        light, _ = trace.scene.sample_emitter_direction(origin, _which(line), False, active)
        return outline_gap(n, origin.p, light.d, dark.hit, dark.ray, active)

    def along(s: mi.Point2f) -> mi.Float:
        return gap(_particle(places.ray(s, line.key)[0], line.τ))

    K = passed(line.w, jump, derivative_by_place(s, along), active)
    return Edges(
        s, line.key, dr.select(active, k, 0), at.ray, layout, records, lambda ray: -K * gap(observer.moved(ray))
    )


def _which(line: BeamLine) -> mi.Point2f:
    """The random numbers that say which light."""
    return CounterSampler.stream(line.key, Stream.BEAM_EMITTER).next_2d()


def _particle(ray: mi.Ray3f, τ: mi.Float) -> mi.Interaction3f:
    x = dr.zeros(mi.Interaction3f)
    x.p, x.t, x.time, x.wavelengths = ray.o + τ * ray.d, mi.Float(0), ray.time, ray.wavelengths
    return x


def _hit(trace: TraceConfig, ray: mi.Ray3f, active: mi.Bool) -> mi.PreliminaryIntersection3f:
    """What a ray meets behind null boundaries."""
    hit = meet(trace, ray, active)
    return skip_null(trace, ray, hit, active)


def _reach(trace: TraceConfig, ray: mi.Ray3f) -> mi.Float:
    """How far particles are looked for: up to what the ray meets or, if that is nothing, the end of the scene."""
    hit = _hit(trace, ray, mi.Bool(True))
    box = trace.scene.bbox()
    far = dr.norm(ray.o - box.center()) + 0.5 * dr.norm(box.extents())
    return dr.select(hit.is_valid(), hit.t, far)


def _lighting(trace: TraceConfig, places: FilmDomain, line: BeamLine, s: mi.Point2f, active: mi.Bool) -> Lighting:
    ray = dr.detach(places.ray(s, line.key)[0])
    before = _hit(trace, ray, active)
    there = active & ~(before.is_valid() & (before.t < line.τ))
    x = _particle(ray, line.τ)
    light, Le = draw_emitter(trace.scene, x, _which(line), there, visible=False)
    lit = there & light.delta & (light.pdf != 0)
    towards = x.spawn_ray_to(light.p)
    hit = _hit(trace, towards, lit)
    return Lighting(there, towards, hit, lit & hit.is_valid(), Le, lit)


@dr.syntax
def _to_particle(
    trace: TraceConfig, ray: mi.Ray3f, line: BeamLine, active: mi.Bool, layout: Layout, records: Any
) -> tuple[Any, mi.UInt32, Arrival, Flight]:
    """Record the way to the particle, through null boundaries; the arrival there, and its flight."""
    numbers = CounterSampler.of(line.key)
    path = PathState.begin(trace, CameraStart(ray, numbers, active))
    at, flight = path.at, Flight.none(trace.media)
    gone, k, count = mi.Float(0), mi.UInt32(0), mi.UInt32(0)
    go_on = path.active & (count < room_for(trace))
    while dr.hint(go_on, exclude=[trace, layout], label="pathreplay: to a particle"):
        length = dr.select(path.at.hit.is_valid(), path.at.hit.t, dr.inf)
        event = (gone + length > line.τ) & (path.at.medium != None)  # noqa: E711 (an array of pointers)
        here = Flight.none(trace.media)
        here.event, here.t = event, dr.select(event, line.τ - gone, 0)
        u = VertexSamples.draw(numbers)
        step = choose_step(trace, Visit(path.at, path.β, mi.Bool(False), path.active), u, numbers, here)
        onward, v = path.advance(trace, u, step)
        records[count] = record(layout, v)
        at, k = dr.select(event, path.at, at), dr.select(event, count, k)
        flight = dr.select(event, here, flight)
        gone += dr.norm(onward.at.ray.o - path.at.ray.o)
        go_on = onward.active & step.null & ~event & (gone < line.τ)
        path = onward
        count += 1
    active &= flight.event
    σ_s, _, _ = at.medium.get_scattering_coefficients(interaction(at.medium, at.ray, flight.t), active)
    flight.σ_s = dr.detach(σ_s)
    return records, k, at, flight
