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
from pathreplay.transport.meet import meet
from pathreplay.transport.sensor import SensorLink, Sighting
from pathreplay.transport.start import behind_emitters
from pathreplay.transport.surface import normal_in_frame
from pathreplay.transport.vertex import (
    Arrival,
    SampledStep,
    Signature,
    Splat,
    Step,
    TraceConfig,
    VertexRecord,
    VertexSamples,
    is_smooth,
)


def choose_step(
    trace: TraceConfig, at: Arrival, u: VertexSamples, sampler: Sampler, go_on: mi.Bool, active: mi.Bool
) -> SampledStep:
    """Sample a step, and test whether the sensor sees the vertex. Nothing is differentiated.

    At the last vertex, ``go_on`` is False, and the path is connected but not continued. If
    ``trace.to_sensor.caustics``, the first vertex is not connected, and only delta lobes continue the path after the
    first vertex.
    """
    link, ctx = _link(trace), mi.BSDFContext(mi.TransportMode.Importance)
    v = arrive.choose(trace, at, sampler, mi.Spectrum(1), active)
    to = _sight(link, v, u, active)
    lit = active & v.surface & is_smooth(v.bsdf) & to.valid
    if link.caustics:
        lit &= ~at.camera
    sampled = scatter.choose(trace, v, at, u, ctx, to.d, lit, active)
    c = sampled.f * to.W
    lit &= dr.any(c != 0)
    lit &= _unoccluded(trace, v, to, lit)
    going = sampled.active & go_on
    if link.caustics:
        going &= ~at.camera | sampled.kept.delta
    kept = sampled.kept
    kept.lit = lit
    splat = Splat(dr.select(lit, c, 0), to.s)
    ray_next = v.origin.spawn_ray(kept.d)
    signature = _signature(v, at, kept.lobe)
    no = mi.Bool(False)
    e = _weighted(link, splat, at, lit)
    return SampledStep(e, sampled.w, ray_next, kept.pdf, signature, kept, mi.Float(1), no, going, splat=splat)


def repeat_step(trace: TraceConfig, again: VertexRecord, attached: bool, active: mi.Bool) -> Step:
    """Evaluate a recorded step again, differentiably: see `step.repeat_step`. Visibility is not differentiated."""
    link, ctx, lit = _link(trace), mi.BSDFContext(mi.TransportMode.Importance), again.kept.lit
    v = arrive.repeat(trace, again, attached, active)
    with dr.suspend_grad(when=not attached):
        to = _sight(link, v, again.u, lit)
        v.n = normal_in_frame(again.at.hit, again.at.ray, v.si, active)
    f, _ = scatter.towards(v, ctx, to.d, lit)
    splat = Splat(dr.select(lit, f * to.W, 0), to.s)
    w, d, pdf = scatter.repeat(trace, v, again, ctx, attached)
    signature = _signature(v, again.at, again.kept.lobe)
    return Step(_weighted(link, splat, again.at, lit), w, v.origin.spawn_ray(d), pdf, signature, splat=splat)


def _link(trace: TraceConfig) -> SensorLink:
    assert trace.to_sensor is not None
    return trace.to_sensor


def _sight(link: SensorLink, v: arrive.Vertex, u: VertexSamples, active: mi.Bool) -> Sighting:
    return link.sight(v.origin, u.light, active)


def _unoccluded(trace: TraceConfig, v: arrive.Vertex, to: Sighting, active: mi.Bool) -> mi.Bool:
    """Test whether the sensor sees a vertex. With ``hide_emitters``, area emitters are hidden and occlude nothing."""
    ray = v.origin.spawn_ray_to(to.end)
    if not (trace.hide_emitters and trace.traits.area_lights):
        return ~trace.scene.ray_test(ray, active)
    active = active & (v.si.shape.emitter() == None)  # noqa: E711 (an array of pointers)
    # `behind_emitters` ignores the end of the ray. Surfaces beyond this end do not occlude the sensor.
    hit = behind_emitters(trace, ray, meet(trace, ray, active), active)
    return active & ~(hit.is_valid() & (hit.t < ray.maxt))


def _weighted(link: SensorLink, splat: Splat, at: Arrival, lit: mi.Bool) -> mi.Spectrum:
    """Return a vertex's contribution to the film, times the adjoint of the image; zero if there is no adjoint."""
    if link.adjoint is None:
        return mi.Spectrum(0)
    return dr.select(lit, splat.c * link.adjoint(splat.s, at.ray.wavelengths, lit), 0)


def _signature(v: arrive.Vertex, at: Arrival, lobe: mi.UInt32) -> Signature:
    return Signature(v.si.is_valid(), dr.reinterpret_array(mi.UInt32, at.hit.shape), lobe)
