"""Edges on the film that are seen through media: what is left of the light that comes from there.

At an edge at distance t₀, both sides share the way to it, and all that is scattered there. So the radiance jumps by

    T(t₀) · (L of the near surface - L of the ray that goes on in the same medium),

and beyond t₀ paths are walked as ever. Chains of delta lobes are walked as if there were no media (`clear`), which
they pass with the transmittance as their weight.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from pathreplay.samplers.counter_sampler import CounterSampler
from pathreplay.samplers.streams import Stream
from pathreplay.transport.meet import meet
from pathreplay.transport.path import PathState
from pathreplay.transport.start import CameraStart, behind_emitters
from pathreplay.transport.vertex import Arrival, TraceConfig
from pathreplay.transport.volume.passage import SHORT_OF, further, transmittance_up_to


def clear(trace: TraceConfig) -> TraceConfig:
    """The walk as if there were no media, nor null boundaries."""
    return trace if trace.media is None else replace(trace, media=None, clear=True)  # type: ignore[arg-type]


@dr.syntax
def transmittance_to_split(
    trace: TraceConfig, ray: mi.Ray3f, key: mi.UInt32, k: mi.UInt32, reach: mi.Float, active: mi.Bool
) -> tuple[mi.Spectrum, mi.MediumPtr]:
    """Transmittance of a chain up to ``reach`` after its k-th vertex, and the medium there."""
    thin = clear(trace)
    numbers, others = CounterSampler.of(key), CounterSampler.stream(key, Stream.TRANSMITTANCE_OF_CHAIN)
    path = PathState.begin(thin, CameraStart(ray, numbers, active))
    T = mi.Spectrum(1)
    around = trace.media.around
    medium = dr.zeros(mi.MediumPtr) if around is None else mi.MediumPtr(around)
    count = mi.UInt32(0)
    while dr.hint(path.active & (count <= k), exclude=[trace, thin], label="pathreplay: left of light"):
        last = count == k
        length = dr.select(last, reach, SHORT_OF * path.at.hit.t)
        part, medium = transmittance_up_to(trace, path.at.ray, length, medium, others, path.active)
        T *= part
        u, step = path.choose(thin, numbers)
        si = path.at.hit.compute_surface_interaction(path.at.ray, mi.RayFlags.All, path.active & ~last)
        turns = path.active & ~last & si.is_valid() & si.is_medium_transition()
        medium = dr.select(turns, si.target_medium(step.kept.d), medium)
        path = path.advance(thin, u, step)[0]
        count += 1
    return T, medium


def going_on(trace: TraceConfig, at: Arrival, t: mi.Float, medium: mi.MediumPtr, active: mi.Bool) -> Arrival:
    """The same arrival, as it is seen from distance ``t`` on its ray, where there is ``medium``."""
    ray = further(at.ray, t)
    hit = meet(trace, ray, active)
    if trace.hide_emitters:
        hit = behind_emitters(trace, ray, hit, active & at.camera)
    return Arrival(ray, hit, at.pdf, at.delta, at.camera, medium, t)
