"""Chains of delta lobes from the camera: what they meet, where two of them part, and their records.

Chains that begin close to each other share their random numbers, and so their lobes. Where lobes differ, because they
are chosen with another probability, there is no edge: that is a choice of the walk.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.record import Layout, record, record_type
from pathreplay.boundary.crofton import VisibilityProbe
from pathreplay.boundary.edges import EdgePath
from pathreplay.boundary.hard_shadows import ShadowTest, light_of
from pathreplay.samplers.counter_sampler import CounterSampler
from pathreplay.samplers.streams import Stream
from pathreplay.transport.motion import may_move
from pathreplay.transport.path import PathState
from pathreplay.transport.signature import mixed, place_met, shape_met, turned_away
from pathreplay.transport.start import CameraStart, medium_around
from pathreplay.transport.surface import steady
from pathreplay.transport.vertex import Arrival, TraceConfig, VertexSamples
from pathreplay.transport.volume.passage import SHORT_OF, transmittance_up_to

MAX_CHAIN = 16
"""Vertices of a chain of delta lobes, at most."""
NEVER = 0xFFFFFFFF
"""Depth of Russian roulette."""


def chain_config(trace: TraceConfig) -> TraceConfig:
    """The walk as chains take it: without roulette, which would end paths beside an edge in different places.

    Nor are there media or null boundaries, which chains pass with the transmittance as their weight.
    """
    chain = replace(trace, rr_depth=NEVER, max_depth=min(trace.max_depth, MAX_CHAIN))
    return chain if trace.media is None else replace(chain, media=None, skips_null=True)  # type: ignore[arg-type]


@dr.syntax
def probe_chain(trace: TraceConfig, ray: mi.Ray3f, key: mi.UInt32, active: mi.Bool, flows: mi.Bool) -> VisibilityProbe:
    """What a path meets from the camera to the first vertex where it is scattered; until something moves, nothing.

    ``flows``: all that is met may move under the place where the path begins.
    """
    numbers = CounterSampler.of(key)
    path = PathState.begin(trace, CameraStart(ray, numbers, active))
    if dr.hint(not (trace.traits.mirrors or trace.traits.hard_lights), mode="scalar"):
        moved = flows | may_move(trace, path.at.hit)
        return dr.select(moved, _probe_vertex(trace, path, key, active & moved), VisibilityProbe.of())
    probe, moves = VisibilityProbe.of(), mi.Bool(flows)
    while dr.hint(path.active, exclude=[trace], label="pathreplay: chain"):
        moves |= may_move(trace, path.at.hit)
        here = dr.select(moves, _probe_vertex(trace, path, key, path.active & moves), VisibilityProbe.of())
        if dr.hint(trace.traits.hard_lights, mode="scalar"):
            dark = _shadow_test(trace, path.at, key, path.depth, path.active).dark
            here.signature = mixed(here.signature, dr.select(dark, mi.UInt32(1), 0))
        path.active &= _slides(trace, path.at)
        u, step = path.choose(trace, numbers)
        step.active &= step.kept.delta
        lobe = dr.select(step.active, step.kept.lobe + 1, 0)
        probe = replace(here, signature=mixed(mixed(probe.signature, here.signature), lobe))
        path = path.advance(trace, u, step)[0]
    return probe


def _probe_vertex(trace: TraceConfig, path: PathState, key: mi.UInt32, active: mi.Bool) -> VisibilityProbe:
    at = path.at
    flags = mi.RayFlags.All if trace.traits.coarse_meshes else mi.RayFlags.Minimal | mi.RayFlags.ShadingFrame
    si = at.hit.compute_surface_interaction(at.ray, flags, active)
    if not trace.traits.copies:
        si.shape = at.hit.shape
    away = dr.select(turned_away(si, at.ray.d), mi.UInt32(1), 0)
    probe = VisibilityProbe(mixed(place_met(trace, at.hit, active, si.shape), away), si.p, si.n)
    if not trace.traits.coarse_meshes:
        return probe
    triangle = dr.select(si.is_valid() & si.shape.is_mesh(), at.hit.prim_index + 1, 0)
    if trace.traits.brushed_meshes:  # at every crease the tangent jumps, and lobes with it
        return replace(probe, signature=mixed(probe.signature, triangle))
    light, lobe = _scattered(trace, path, steady(si, at.ray, active), key, active)
    return replace(probe, triangle=triangle, light=light, lobe=lobe)


def _scattered(
    trace: TraceConfig, path: PathState, si: mi.SurfaceInteraction3f, key: mi.UInt32, active: mi.Bool
) -> tuple[mi.Vector3f, mi.Vector3f]:
    """The directions of light and of the lobe that are sampled there; zero where nothing is scattered."""
    u, ctx = VertexSamples.draw(CounterSampler.at_vertex(key, path.depth)), mi.BSDFContext()
    light, lit = light_of(trace, si, u.light, path.depth, active)
    lobe, weight = si.bsdf().sample(ctx, si, u.lobe, u.direction, active & si.is_valid())
    f = si.bsdf().eval(ctx, si, si.to_local(light.d), lit)
    to_light = dr.select(lit & dr.any(f != 0), light.d, 0)
    return to_light, dr.select(dr.any(weight != 0), si.to_world(lobe.wo), 0)


def _slides(trace: TraceConfig, at: Arrival) -> mi.Bool:
    """Whether paths may be reflected or refracted there without being scattered."""
    valid = at.hit.is_valid()
    return valid & mi.has_flag(shape_met(trace, at.hit, at.ray, valid).bsdf().flags(), mi.BSDFFlags.Delta)


def _shadow_test(trace: TraceConfig, at: Arrival, key: mi.UInt32, k: mi.UInt32, active: mi.Bool) -> ShadowTest:
    return ShadowTest.of(trace, at, CounterSampler.at_vertex(key, k), k, active)


@dataclass
class ChainSplit:
    """Where two chains part that begin close to each other."""

    k: mi.UInt32  # vertices that they share
    a: Arrival
    b: Arrival
    β: mi.Spectrum  # throughput before
    found: mi.Bool
    shadows: tuple[ShadowTest, ShadowTest] | None = None  # where there are lights that cast hard shadows


@dr.syntax
def split_chains(trace: TraceConfig, rays: tuple[mi.Ray3f, mi.Ray3f], key: mi.UInt32, active: mi.Bool) -> ChainSplit:
    """Where two chains with the same random numbers part: at the first vertex where they meet different things."""
    numbers_a, numbers_b = CounterSampler.of(key), CounterSampler.of(key)
    a = PathState.begin(trace, CameraStart(rays[0], numbers_a, active))
    b = PathState.begin(trace, CameraStart(rays[1], numbers_b, active))
    found = active & _probe_vertex(trace, a, key, active).differs(_probe_vertex(trace, b, key, active))
    go_on = active & ~found
    while dr.hint(go_on, exclude=[trace], label="pathreplay: split"):
        go_on &= _slides(trace, a.at)
        a.active, b.active = mi.Bool(go_on), mi.Bool(go_on)
        u_a, step_a = a.choose(trace, numbers_a)
        u_b, step_b = b.choose(trace, numbers_b)
        go_on &= step_a.active & step_b.active & step_a.kept.delta & step_b.kept.delta
        go_on &= step_a.kept.lobe == step_b.kept.lobe
        step_a.active, step_b.active = mi.Bool(go_on), mi.Bool(go_on)
        next_a, next_b = a.advance(trace, u_a, step_a)[0], b.advance(trace, u_b, step_b)[0]
        go_on &= next_a.active & next_b.active
        a, b = dr.select(go_on, next_a, a), dr.select(go_on, next_b, b)
        found |= go_on & _probe_vertex(trace, a, key, go_on).differs(_probe_vertex(trace, b, key, go_on))
        go_on &= ~found
    split = ChainSplit(a.depth, a.at, b.at, a.β, found)
    if dr.hint(trace.traits.hard_lights, mode="scalar"):
        shadow_a, shadow_b = (_shadow_test(trace, at, key, split.k, active & ~found) for at in (a.at, b.at))
        split.shadows = shadow_a, shadow_b
        split.found |= shadow_a.dark != shadow_b.dark
    return split


@dr.syntax
def record_chain(
    trace: TraceConfig, s: mi.Point2f, ray: mi.Ray3f, key: mi.UInt32, k: mi.UInt32, at: mi.Ray3f, active: mi.Bool
) -> tuple[EdgePath, mi.Bool]:
    """The path along ``ray``: ``k`` vertices, and the arrival ``at`` an edge after them; whether that was reached."""
    layout = Layout.of(trace, True)
    records = dr.alloc_local(record_type(layout), MAX_CHAIN + 1)
    numbers = CounterSampler.of(key)
    path = PathState.begin(trace, CameraStart(ray, numbers, active))
    count = mi.UInt32(0)
    while dr.hint(path.active & (count <= k), exclude=[trace, layout], label="pathreplay: record chain"):
        path.active &= count < k  # of the last one only the arrival will be read
        u, step = path.choose(trace, numbers)
        onward, v = path.advance(trace, u, step)
        records[count] = record(layout, v)
        path = onward
        count += 1
    reached = active & (count == k + 1)
    return EdgePath(s, key, dr.select(reached, k, 0), at, layout, records), reached


@dr.syntax
def transmittance_of_chain(
    trace: TraceConfig, ray: mi.Ray3f, key: mi.UInt32, k: mi.UInt32, reach: mi.Float, active: mi.Bool
) -> tuple[mi.Spectrum, mi.MediumPtr]:
    """Transmittance of a chain up to ``reach`` after its k-th vertex, and the medium there."""
    chain = chain_config(trace)
    numbers, others = CounterSampler.of(key), CounterSampler.stream(key, Stream.TRANSMITTANCE_OF_CHAIN)
    path = PathState.begin(chain, CameraStart(ray, numbers, active))
    T = mi.Spectrum(1)
    medium, count = medium_around(trace), mi.UInt32(0)
    while dr.hint(path.active & (count <= k), exclude=[trace, chain], label="pathreplay: transmittance of a chain"):
        last = count == k
        length = dr.select(last, reach, SHORT_OF * path.at.hit.t)
        part, medium = transmittance_up_to(trace, path.at.ray, length, medium, others, path.active)
        T *= part
        u, step = path.choose(chain, numbers)
        si = path.at.hit.compute_surface_interaction(path.at.ray, mi.RayFlags.All, path.active & ~last)
        turns = path.active & ~last & si.is_valid() & si.is_medium_transition()
        medium = dr.select(turns, si.target_medium(step.kept.d), medium)
        path = path.advance(chain, u, step)[0]
        count += 1
    return T, medium
