"""The step of a light path: one vertex, connected to the sensor instead of to an emitter.

A light path satisfies the same recursion L_i = e_i + w_i L_{i+1} as a camera path. Here, e_i is the contribution of
vertex i to the film, times the adjoint of the image at the film position of this contribution. BSDFs are evaluated in
importance mode.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from pathreplay.samplers.sampler import Sampler
from pathreplay.transport import arrive, scatter
from pathreplay.transport.sensor import SensorLink
from pathreplay.transport.start import occluder
from pathreplay.transport.vertex import (
    Arrival,
    Flight,
    SampledInMedia,
    SampledStep,
    Splat,
    Step,
    TraceConfig,
    VertexRecord,
    VertexSamples,
    is_smooth,
)
from pathreplay.transport.volume.shadow import shadow, shadow_again


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
    """Sample a step, and test whether the sensor sees the vertex. Nothing is differentiated.

    At the last vertex, ``go_on`` is False, and the path is connected but not continued. If
    ``trace.to_sensor.caustics``, the first vertex is not connected, and only delta lobes continue the path there. With
    media, the connection to the sensor has a transmittance, and the throughput ``β`` affects the flight to the vertex
    (see `fly`) unless ``flight`` is given.
    """
    link, ctx = _link(trace), mi.BSDFContext(mi.TransportMode.Importance)
    v = arrive.choose(trace, at, sampler, β, active, flight)
    to = link.sight(v.origin, u.light, active)
    lit = active & to.valid & _connects(trace, v)
    if link.caustics:
        lit &= ~at.camera
    sampled = scatter.choose(trace, v, at, u, ctx, to.d, lit, active)
    c, w, kept, medium = sampled.f * to.W, sampled.w, sampled.kept, at.medium
    lit &= dr.any(c != 0)
    going, first = sampled.active & go_on, at.camera
    ray = v.origin.spawn_ray_to(to.end)
    if v.inside is None:
        lit &= ~(occluder(trace, ray, lit).is_valid() if trace.hide_emitters else trace.scene.ray_test(ray, lit))
    else:
        dark = shadow(trace, ray, v.medium(to.d), sampler, lit)
        lit &= dr.any(dark.T != 0)
        kept.media = SampledInMedia(sampled.null, v.inside.flight, dark)
        c, w, medium = v.inside.w * dark.T * c, v.inside.w * w, v.medium(kept.d)
        going, first = sampled.active & (go_on | sampled.null), first & ~sampled.null
    if link.caustics:
        going &= ~first | kept.delta
    kept.lit = lit
    splat = Splat(dr.select(lit, c, 0), to.s)
    e, ray_next, met = _weighted(link, splat, at, lit), v.origin.spawn_ray(kept.d), v.met(go_on)
    eta, u = mi.Float(1), sampled.u
    return SampledStep(
        e, w, ray_next, kept.pdf, met, kept, eta, sampled.null, going, u, sampled.u_weight, medium, splat=splat
    )


def repeat_step(trace: TraceConfig, again: VertexRecord, attached: bool, active: mi.Bool) -> Step:
    """Evaluate a recorded step again, differentiably: see `step.repeat_step`. Visibility is not differentiated."""
    link, ctx, lit = _link(trace), mi.BSDFContext(mi.TransportMode.Importance), again.kept.lit
    v = arrive.repeat(trace, again, attached, active)
    with dr.suspend_grad(when=not attached):
        to = link.sight(v.origin, again.u.light, lit)
    c, (w, d, pdf) = scatter.towards(v, ctx, to.d, lit)[0] * to.W, scatter.repeat(trace, v, again, ctx, attached)
    if v.inside is not None:
        T = shadow_again(trace, v.origin.spawn_ray_to(to.end), again.kept.media.shadow, attached, lit)
        c, w = v.inside.w * T * c, v.inside.w * w
    splat = Splat(dr.select(lit, c, 0), to.s)
    return Step(_weighted(link, splat, again.at, lit), w, v.origin.spawn_ray(d), pdf, splat=splat)


def _link(trace: TraceConfig) -> SensorLink:
    assert trace.to_sensor is not None
    return trace.to_sensor


def _connects(trace: TraceConfig, v: arrive.Vertex) -> mi.Bool:
    """Return whether a vertex may be connected to the sensor: it scatters smoothly, and is not on a hidden emitter."""
    connects = v.surface & is_smooth(v.bsdf)
    if trace.hide_emitters and trace.traits.area_lights:
        connects &= v.si.shape.emitter() == None  # noqa: E711 (an array of pointers)
    if v.inside is None:
        return connects
    # In a medium without emitter sampling, a collision counts as a delta lobe where caustics are set apart.
    event = v.inside.event & v.inside.around.use_emitter_sampling() if _link(trace).caustics else v.inside.event
    return connects | event


def _weighted(link: SensorLink, splat: Splat, at: Arrival, lit: mi.Bool) -> mi.Spectrum:
    """Return a vertex's contribution to the film, times the adjoint of the image; zero if there is no adjoint."""
    if link.adjoint is None:
        return mi.Spectrum(0)
    return dr.select(lit, splat.c * link.adjoint(splat.s, at.ray.wavelengths, lit), 0)
