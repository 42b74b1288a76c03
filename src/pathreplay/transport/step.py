"""The step: one vertex of a path, L_i = e_i + w_i L_{i+1}, made of arriving, connecting and scattering.

`choose_step` draws, in a first walk; `repeat_step` is given what was chosen and is differentiable. Loops, images and
their gradients are their callers' business.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from pathreplay.transport import arrive, connect, scatter
from pathreplay.transport.vertex import (
    Arrival,
    Flight,
    KnownLight,
    Lighting,
    SampledInMedia,
    SampledStep,
    Signature,
    Step,
    TraceConfig,
    VertexRecord,
    VertexSamples,
    reciprocal,
)


@dataclass
class Visit:
    """State of a path that arrives at a vertex."""

    at: Arrival
    β: mi.Spectrum  # throughput; real collisions are sampled in proportion to it
    go_on: mi.Bool  # False at the last vertex that ``max_depth`` allows
    active: mi.Bool


def choose_step(
    trace: TraceConfig,
    visit: Visit,
    u: VertexSamples,
    sampler: mi.Sampler,
    flight: Flight | None = None,
    ctx: mi.BSDFContext | None = None,
) -> SampledStep:
    """The step of a first walk, which draws emitter sample and continuation from the numbers ``u``.

    With media also the flight, unless ``flight`` is given, and the shadow ray, both from ``sampler``; null boundaries
    come back as ``null`` steps, which are not counted as vertices. ``ctx`` has the transport mode (radiance), and
    Mitsuba's number of a lobe where surfaces are to scatter by that one alone.
    """
    ctx = mi.BSDFContext() if ctx is None else ctx
    at, go_on, active = visit.at, visit.go_on, visit.active
    v = arrive.choose(trace, at, sampler, visit.β, active, flight)
    link = connect.choose(trace, v, at.medium, u, sampler, go_on)
    to = scatter.choose(trace, v, at, u, ctx, link.light.d, link.lit, go_on)
    reached = link.reaches(to.pdf_light, False)
    kept, e, w, medium = to.kept, v.glow + dr.select(link.lit, to.f * reached, 0), to.w, at.medium
    kept.light = link.light
    lighting: Lighting = None  # type: ignore[assignment]
    if v.inside is not None:
        kept.media = SampledInMedia(to.null, v.inside.flight, link.shadow)
        e, w = v.inside.e + v.inside.w * e, v.inside.w * w
        crossed = (v.surface | v.inside.through) & v.si.is_medium_transition()
        medium = dr.select(crossed, v.si.target_medium(kept.d), medium)
    elif not trace.traits.lights_vary:
        kept.known = KnownLight(v.glow, link.light.d, reached)
    else:
        w_light = to.f * (link.mis(to.pdf_light) * reciprocal(link.light.pdf))
        seen = arrive.sees_lights(trace, at, v.si, active)
        lighting = Lighting(v.si, seen, link.light, dr.select(link.lit, w_light, 0), link.lit)
    signature, ray_next = _signature(v, at, kept.lobe, go_on), v.origin.spawn_ray(kept.d)
    return SampledStep(e, w, ray_next, kept.pdf, signature, kept, to.eta, to.null, to.active, medium, lighting)


def repeat_step(
    trace: TraceConfig, again: VertexRecord, attached: bool, active: mi.Bool, ctx: mi.BSDFContext | None = None
) -> Step:
    """The same step once more, differentiable in emission, BSDFs, textures and media.

    If ``attached``, also in the ray that arrives, its density and everything that moves: the hit point follows ray and
    shape, and the continuation follows as `scatter` says. Else vertices and directions are constants. Visibility and
    Russian roulette are never differentiated. ``ctx`` is that of the first walk.
    """
    ctx = mi.BSDFContext() if ctx is None else ctx
    v = arrive.repeat(trace, again, attached, active)
    e = v.glow + connect.repeat(trace, v, again, ctx, attached)
    w, d, pdf = scatter.repeat(trace, v, again, ctx, attached)
    if v.inside is not None:
        e, w = v.inside.e + v.inside.w * e, v.inside.w * w
    return Step(e, w, v.origin.spawn_ray(d), pdf, _signature(v, again.at, again.kept.lobe, again.go_on))


def _signature(v: arrive.Vertex, at: Arrival, lobe: mi.UInt32, go_on: mi.Bool) -> Signature:
    met, shape = v.si.is_valid(), dr.reinterpret_array(mi.UInt32, at.hit.shape)
    if v.inside is not None:
        met, shape = v.surface | (v.inside.event & go_on), dr.select(v.inside.event, 0, shape)
    return Signature(met, shape, lobe)
