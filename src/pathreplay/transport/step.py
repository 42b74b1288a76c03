"""The step: one vertex of a path, L_i = e_i + w_i L_{i+1}, composed of arrive, connect and scatter.

`choose_step` samples a vertex in the sampling pass. `repeat_step` evaluates the recorded choices again and is
differentiable. Loops, images and gradient accumulation belong to the callers.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from pathreplay.samplers.sampler import Sampler
from pathreplay.transport import arrive, connect, particle, scatter
from pathreplay.transport.vertex import (
    Arrival,
    Flight,
    KnownLight,
    Lighting,
    SampledInMedia,
    SampledStep,
    Step,
    TraceConfig,
    VertexRecord,
    VertexSamples,
    reciprocal,
)


@dataclass
class Visit:
    """The state of a path that arrives at a vertex."""

    at: Arrival
    β: mi.Spectrum  # throughput, on which the probability of a real collision depends
    go_on: mi.Bool  # False at the last vertex that ``max_depth`` allows
    active: mi.Bool


def choose_step(
    trace: TraceConfig,
    visit: Visit,
    u: VertexSamples,
    sampler: Sampler,
    flight: Flight | None = None,
    ctx: mi.BSDFContext | None = None,
) -> SampledStep:
    """Sample a step. The random numbers ``u`` determine the emitter sample and the continuation.

    With media, ``sampler`` provides the random numbers of the shadow ray and, unless ``flight`` is given, of the
    flight. Null boundaries are returned as ``null`` steps, which do not count as vertices. ``ctx`` contains the
    transport mode (default: radiance) and may restrict sampling on surfaces to one BSDF component.
    """
    at, go_on, active = visit.at, visit.go_on, visit.active
    if trace.to_sensor is not None:
        return particle.choose_step(trace, at, visit.β, u, sampler, go_on, active, flight)
    ctx = mi.BSDFContext() if ctx is None else ctx
    v = arrive.choose(trace, at, sampler, visit.β, active, flight)
    link = connect.choose(trace, v, u, sampler, go_on)
    to = scatter.choose(trace, v, at, u, ctx, link.light.d, link.lit, go_on)
    reached = link.reaches(to.pdf_light, False)
    kept, e, w, medium = to.kept, v.glow + dr.select(link.lit, to.f * reached, 0), to.w, at.medium
    kept.light = link.light
    lighting: Lighting = None  # type: ignore[assignment]
    if v.inside is not None:
        kept.media = SampledInMedia(to.null, v.inside.flight, link.shadow)
        e, w = v.inside.e + v.inside.w * e, v.inside.w * w
        medium = v.medium(kept.d)
    elif not trace.traits.lights_vary:
        kept.known = KnownLight(v.glow, link.light.d, reached)
    else:
        w_light = to.f * (link.mis(to.pdf_light) * reciprocal(link.light.pdf))
        seen = arrive.sees_lights(trace, at, v.si, active)
        lighting = Lighting(v.si, seen, link.light, dr.select(link.lit, w_light, 0), link.lit)
    ray_next, signature = v.origin.spawn_ray(kept.d), v.signature(at, kept.lobe, go_on)
    return SampledStep(e, w, ray_next, kept.pdf, signature, kept, to.eta, to.null, to.active, medium, lighting)


def repeat_step(
    trace: TraceConfig, again: VertexRecord, attached: bool, active: mi.Bool, ctx: mi.BSDFContext | None = None
) -> Step:
    """Evaluate a recorded step again, differentiable in emission, BSDFs, textures and media.

    If ``attached``, the step is also differentiable in the incident ray, its density and all geometry. The hit point
    then moves with ray and shape, and the continuation moves as described in `scatter`. Otherwise vertices and
    directions are constant. Visibility and Russian roulette are never differentiated. ``ctx`` is the context that
    `choose_step` used.
    """
    if trace.to_sensor is not None:
        return particle.repeat_step(trace, again, attached, active)
    ctx = mi.BSDFContext() if ctx is None else ctx
    v = arrive.repeat(trace, again, attached, active)
    e = v.glow + connect.repeat(trace, v, again, ctx, attached)
    w, d, pdf = scatter.repeat(trace, v, again, ctx, attached)
    if v.inside is not None:
        e, w = v.inside.e + v.inside.w * e, v.inside.w * w
    return Step(e, w, v.origin.spawn_ray(d), pdf, v.signature(again.at, again.kept.lobe, again.go_on))
