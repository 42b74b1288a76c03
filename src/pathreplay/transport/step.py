"""The step: one vertex of a path, L_i = e_i + w_i L_{i+1}, composed of arrive, connect and scatter.

`choose_step` samples a vertex in the sampling pass. `repeat_step` evaluates the recorded choices again and is
differentiable. Loops, images and gradient accumulation belong to the callers.
"""

from __future__ import annotations

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


def choose_step(
    trace: TraceConfig,
    at: Arrival,
    β: mi.Spectrum,
    u: VertexSamples,
    sampler: Sampler,
    go_on: mi.Bool,
    active: mi.Bool,
    flight: Flight | None = None,
) -> SampledStep:
    """Sample a step. The random numbers ``u`` determine the emitter sample and the continuation.

    At the last vertex that ``max_depth`` allows, ``go_on`` is False. With media, ``sampler`` provides the random
    numbers of the shadow ray and, unless ``flight`` is given, of the flight, which depends on the throughput ``β``.
    Null boundaries are returned as ``null`` steps, which do not count as vertices.
    """
    if trace.to_sensor is not None:
        return particle.choose_step(trace, at, β, u, sampler, go_on, active, flight)
    ctx = mi.BSDFContext()
    v = arrive.choose(trace, at, sampler, β, active, flight)
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
    ray_next, met = v.origin.spawn_ray(kept.d), v.met(go_on)
    return SampledStep(
        e, w, ray_next, kept.pdf, met, kept, to.eta, to.null, to.active, to.u, to.u_weight, medium, lighting
    )


def repeat_step(trace: TraceConfig, again: VertexRecord, attached: bool, active: mi.Bool) -> Step:
    """Evaluate a recorded step again, differentiable in emission, BSDFs, textures and media.

    If ``attached``, the step is also differentiable in the incident ray, its density and all geometry. The hit point
    then moves with ray and shape, and the continuation moves as described in `scatter`. Otherwise vertices and
    directions are constant. Visibility and Russian roulette are never differentiated.
    """
    if trace.to_sensor is not None:
        return particle.repeat_step(trace, again, attached, active)
    ctx = mi.BSDFContext()
    v = arrive.repeat(trace, again, attached, active)
    e = v.glow + connect.repeat(trace, v, again, ctx, attached)
    w, d, pdf = scatter.repeat(trace, v, again, ctx, attached)
    if v.inside is not None:
        e, w = v.inside.e + v.inside.w * e, v.inside.w * w
    return Step(e, w, v.origin.spawn_ray(d), pdf)
