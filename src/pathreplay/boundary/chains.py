"""Probes, compares and records chains. A chain is a part of a path that passes only through delta lobes.

It starts at the camera, at an emitter or at a scattering vertex.

Two neighbouring chains use the same random numbers, and therefore usually select the same lobes. If a lobe is selected
with different probabilities on the two chains, the chains may continue along different lobes of the same surface. Such
a difference is due to sampling, and no edge lies between the chains.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.record import Layout, record, record_type
from pathreplay.boundary.crofton import VisibilityProbe
from pathreplay.boundary.edges import EdgePath
from pathreplay.boundary.hard_shadows import ShadowTest, sample_light
from pathreplay.platform import compat
from pathreplay.samplers.counter_sampler import CounterSampler
from pathreplay.samplers.streams import Stream
from pathreplay.transport.motion import is_one_of, may_move, may_turn
from pathreplay.transport.path import PathState
from pathreplay.transport.signature import horizon_gap, mixed, place_met, shape_met, turned_away
from pathreplay.transport.start import CameraStart
from pathreplay.transport.surface import steady
from pathreplay.transport.vertex import Arrival, TraceConfig, VertexSamples
from pathreplay.transport.volume.passage import SHORT_OF, transmittance_up_to

MAX_CHAIN = 16
"""Largest number of vertices in a chain of delta lobes."""
NEVER = 0xFFFFFFFF
"""Value of ``rr_depth`` that turns Russian roulette off."""


def chain_config(trace: TraceConfig) -> TraceConfig:
    """Return the configuration for chains.

    Russian roulette is off, because it would end neighbouring paths at different depths. Media and null boundaries are
    left out, because they do not deflect chains. Their transmittance is a separate factor: see
    `transmittance_of_chain`.
    """
    link = None if trace.to_sensor is None else replace(trace.to_sensor, adjoint=None)
    chain = replace(trace, rr_depth=NEVER, max_depth=min(trace.max_depth, MAX_CHAIN), to_sensor=link)
    return chain if trace.media is None else replace(chain, media=None, skips_null=True)  # type: ignore[arg-type]


def begin_chain(chain: TraceConfig, ray: mi.Ray3f, active: mi.Bool) -> PathState:
    """Start chains with the rays of a film domain."""
    return PathState.begin(chain, CameraStart(ray, CounterSampler.of(mi.UInt32(0)), active))


def tests_shadows(trace: TraceConfig) -> bool:
    """Return whether the vertices of a chain are tested for hard shadows.

    On camera paths, the test is whether a light without extent reaches the vertex. On light paths, it is whether the
    sensor sees the vertex.
    """
    return trace.to_sensor is not None or trace.traits.hard_lights


@dr.syntax
def probe_chain(
    trace: TraceConfig, path: PathState, key: mi.UInt32, ray_moves: mi.Bool, from_vertex: bool = False
) -> VisibilityProbe:
    """Probe a path from its present state to its first vertex without a delta lobe.

    Vertices before the first surface that may move are not compared, apart from the first (`VisibilityProbe.still`).
    In lanes with ``ray_moves``, the first ray may move, so that all surfaces count as moving. Hard shadows that static
    surfaces cast onto static surfaces are not compared either. Paths ``from_vertex`` start at a vertex that scatters.
    Edges of their first hits, which `secondary` contains, have little importance.
    """
    sampler = CounterSampler.at_vertex(key, path.depth)
    moves = mi.Bool(ray_moves)
    if dr.hint(not (trace.traits.mirrors or tests_shadows(trace)), mode="scalar"):
        moves |= may_move(trace, path.at.hit)
        return dr.select(moves, _probe_vertex(trace, path, key, path.active & moves), VisibilityProbe.of())
    probe, start = VisibilityProbe.of(), mi.UInt32(path.depth)
    shape = shape_met(trace, path.at.hit, path.at.ray, path.active)
    first, still = place_met(trace, path.at.hit, path.active, shape), mi.UInt32(0)
    while dr.hint(path.active, exclude=[trace], label="pathreplay: chain"):
        moves |= may_move(trace, path.at.hit)
        vertex_probe = dr.select(moves, _probe_vertex(trace, path, key, path.active & moves), VisibilityProbe.of())
        if dr.hint(tests_shadows(trace), mode="scalar"):
            test = _shadow_test(trace, path.at, key, path.depth, path.active)
            dark = test.dark
            if dr.hint(trace.to_sensor is None, mode="scalar"):  # the sensor of light paths may move
                dark &= moves | may_move(trace, test.hit)
            vertex_probe.signature = mixed(vertex_probe.signature, dr.select(dark, mi.UInt32(1), 0))
        slides, at_start = _slides(trace, path.at), path.depth == start
        if dr.hint(from_vertex, mode="scalar"):
            vertex_probe = dr.select(_may_shine(trace, path), vertex_probe, VisibilityProbe.of(1))
            vertex_probe = dr.select(at_start, VisibilityProbe.of(), vertex_probe)
        if dr.hint(trace.to_sensor is not None and trace.to_sensor.caustics, mode="scalar"):
            # A path whose first vertex has no delta lobe carries no caustic.
            vertex_probe = dr.select(at_start & ~slides, VisibilityProbe.of(), vertex_probe)
        path.active &= slides & (path.depth - start < MAX_CHAIN)
        u, step = path.choose(trace, sampler)
        step.active &= step.kept.delta
        lobe = dr.select(step.active, step.kept.lobe + 1, 0)
        signature = mixed(mixed(probe.signature, vertex_probe.signature), lobe)
        still = dr.select(at_start & (from_vertex | ~moves), mixed(first, lobe) | 1, still)
        probe = replace(vertex_probe, signature=signature, still=still)
        moves |= may_turn(trace, path.at.hit)
        path = path.advance(trace, u, step)[0]
    return probe


def _probe_vertex(trace: TraceConfig, path: PathState, key: mi.UInt32, active: mi.Bool) -> VisibilityProbe:
    at = path.at
    traits = trace.traits
    flags = compat.shading() if traits.coarse_meshes or traits.brushed_meshes else compat.shading_frame()
    si = at.hit.compute_surface_interaction(at.ray, flags, active)
    if not traits.copies:
        si.shape = at.hit.shape
    away = turned_away(si, at.ray.d)
    if trace.horizon is not None:
        away |= ~at.hit.is_valid() & (horizon_gap(trace.horizon, at.ray.d) < 0)
    signature = mixed(place_met(trace, at.hit, active, si.shape), dr.select(away, mi.UInt32(1), 0))
    probe = VisibilityProbe(signature, si.p, si.n)
    if not (traits.coarse_meshes or traits.brushed_meshes):
        return probe
    triangle = dr.select(si.is_valid() & si.shape.is_mesh(), at.hit.prim_index + 1, 0)
    if traits.brushed_meshes:  # the tangents of lobes jump at every edge between triangles
        jumps = dr.select(is_one_of(traits.brushed_meshes, at.hit), triangle, 0)
        probe = replace(probe, signature=mixed(probe.signature, jumps))
    if not traits.coarse_meshes:
        return probe
    light, lobe = _scattered(trace, path, steady(si, at.ray, active), key, active)
    return replace(probe, triangle=triangle, light=light, lobe=lobe)


def _scattered(
    trace: TraceConfig, path: PathState, si: mi.SurfaceInteraction3f, key: mi.UInt32, active: mi.Bool
) -> tuple[mi.Vector3f, mi.Vector3f]:
    """Return the directions of the emitter sample and of the BSDF sample. If a sample has weight 0, return 0 for it."""
    u, ctx = VertexSamples.draw(CounterSampler.at_vertex(key, path.depth)), mi.BSDFContext()
    d, lit = sample_light(trace, si, u.light, path.depth, active)
    lobe, weight = si.bsdf().sample(ctx, si, u.lobe, u.direction, active & si.is_valid())
    f = si.bsdf().eval(ctx, si, si.to_local(d), lit)
    to_light = dr.select(lit & dr.any(f != 0), d, 0)
    return to_light, dr.select(dr.any(weight != 0), si.to_world(lobe.wo), 0)


def _slides(trace: TraceConfig, at: Arrival) -> mi.Bool:
    """Return whether the surface has a delta lobe, through which a chain may continue."""
    valid = at.hit.is_valid()
    return valid & mi.has_flag(shape_met(trace, at.hit, at.ray, valid).bsdf().flags(), mi.BSDFFlags.Delta)


def _may_shine(trace: TraceConfig, path: PathState) -> mi.Bool:
    """Return whether light may come from the hit of a path. Where the path has to end, it must be on an emitter."""
    hit = path.at.hit
    shape = shape_met(trace, hit, path.at.ray, path.active)
    glows = dr.select(hit.is_valid(), shape.emitter() != None, trace.scene.environment() is not None)  # noqa: E711
    return glows | (path.depth + 1 < trace.max_depth)


def _shadow_test(trace: TraceConfig, at: Arrival, key: mi.UInt32, k: mi.UInt32, active: mi.Bool) -> ShadowTest:
    return ShadowTest.of(trace, at, CounterSampler.at_vertex(key, k), k, active)


@dataclass
class ChainSplit:
    """The vertex at which two neighbouring chains diverge."""

    k: mi.UInt32  # number of vertices of the two paths before they diverge
    a: Arrival
    b: Arrival
    β: mi.Spectrum  # throughput before the vertex
    parted: mi.Bool  # the chains diverge
    shadows: tuple[ShadowTest, ShadowTest] | None = None  # None if no vertex is tested: see `tests_shadows`


def split_chains(trace: TraceConfig, paths: tuple[PathState, PathState], key: mi.UInt32) -> ChainSplit:
    """Find the first vertex at which two chains with equal random numbers hit different surfaces."""
    a, b = paths
    active = a.active & b.active
    parted = active & _probe_vertex(trace, a, key, active).differs(_probe_vertex(trace, b, key, active))
    if trace.traits.mirrors:
        a, b, parted = _split_later(trace, a, b, parted, key)
    split = ChainSplit(a.depth, a.at, b.at, a.β, parted)
    if tests_shadows(trace):
        shadow_a, shadow_b = (_shadow_test(trace, at, key, split.k, active & ~parted) for at in (a.at, b.at))
        split.shadows = shadow_a, shadow_b
        split.parted |= shadow_a.dark != shadow_b.dark
    return split


@dr.syntax
def _split_later(
    trace: TraceConfig, a: PathState, b: PathState, parted: mi.Bool, key: mi.UInt32
) -> tuple[PathState, PathState, mi.Bool]:
    """Advance two chains that are not ``parted`` until they diverge or end; return both, and where they diverge."""
    start, go_on = mi.UInt32(a.depth), a.active & b.active & ~parted
    sampler_a, sampler_b = CounterSampler.at_vertex(key, a.depth), CounterSampler.at_vertex(key, b.depth)
    while dr.hint(go_on, exclude=[trace], label="pathreplay: split"):
        if dr.hint(tests_shadows(trace), mode="scalar"):
            dark_a, dark_b = (_shadow_test(trace, path.at, key, path.depth, go_on).dark for path in (a, b))
            go_on &= dark_a == dark_b
        go_on &= _slides(trace, a.at) & (a.depth - start < MAX_CHAIN)
        a.active, b.active = mi.Bool(go_on), mi.Bool(go_on)
        u_a, step_a = a.choose(trace, sampler_a)
        u_b, step_b = b.choose(trace, sampler_b)
        go_on &= step_a.active & step_b.active & step_a.kept.delta & step_b.kept.delta
        go_on &= step_a.kept.lobe == step_b.kept.lobe
        step_a.active, step_b.active = mi.Bool(go_on), mi.Bool(go_on)
        next_a, next_b = a.advance(trace, u_a, step_a)[0], b.advance(trace, u_b, step_b)[0]
        go_on &= next_a.active & next_b.active
        a, b = dr.select(go_on, next_a, a), dr.select(go_on, next_b, b)
        parted |= go_on & _probe_vertex(trace, a, key, go_on).differs(_probe_vertex(trace, b, key, go_on))
        go_on &= ~parted
    return a, b, parted


@dr.syntax
def record_chain(
    trace: TraceConfig, s: mi.Point2f, ray: mi.Ray3f, key: mi.UInt32, k: mi.UInt32, at: mi.Ray3f, active: mi.Bool
) -> tuple[EdgePath, mi.Bool]:
    """Record the first ``k`` vertices of the chain along ``ray``.

    The ray ``at`` leads from the last of these vertices to an edge. Returns the recorded path, and the lanes in which
    the chain passes all ``k`` vertices. In a scene without delta lobes, ``k`` is 0, and nothing is recorded.
    """
    layout = Layout.of(trace, True)
    if dr.hint(not trace.traits.mirrors, mode="scalar"):
        return EdgePath(s, key, mi.UInt32(0), at, layout, None), active
    records = dr.alloc_local(record_type(layout), MAX_CHAIN + 1)
    sampler = CounterSampler.of(key)
    path = PathState.begin(trace, CameraStart(ray, sampler, active))
    count = mi.UInt32(0)
    while dr.hint(path.active & (count <= k), exclude=[trace, layout], label="pathreplay: record chain"):
        path.active &= count < k  # the last record has index k; only its `Arrival` is read later
        u, step = path.choose(trace, sampler)
        onward, v = path.advance(trace, u, step)
        records[count] = record(layout, v)
        path = onward
        count += 1
    reached = active & (count == k + 1)
    return EdgePath(s, key, dr.select(reached, k, 0), at, layout, records), reached


@dr.syntax
def transmittance_of_chain(
    trace: TraceConfig,
    ray: mi.Ray3f,
    medium: mi.MediumPtr,
    key: mi.UInt32,
    k: mi.UInt32,
    reach: mi.Float,
    active: mi.Bool,
) -> tuple[mi.Spectrum, mi.MediumPtr]:
    """Estimate the transmittance of a chain up to the distance ``reach`` after its k-th vertex.

    The chain starts in ``medium``. Also returns the medium at the distance ``reach``.
    """
    chain = chain_config(trace)
    sampler, transmittance_sampler = CounterSampler.of(key), CounterSampler.stream(key, Stream.TRANSMITTANCE_OF_CHAIN)
    path = PathState.begin(chain, CameraStart(ray, sampler, active))
    if dr.hint(not trace.traits.mirrors, mode="scalar"):
        return transmittance_up_to(trace, path.at.ray, reach, medium, transmittance_sampler, path.active)
    T = mi.Spectrum(1)
    count = mi.UInt32(0)
    while dr.hint(path.active & (count <= k), exclude=[trace, chain], label="pathreplay: transmittance of a chain"):
        last = count == k
        length = dr.select(last, reach, SHORT_OF * path.at.hit.t)
        part, medium = transmittance_up_to(trace, path.at.ray, length, medium, transmittance_sampler, path.active)
        T *= part
        u, step = path.choose(chain, sampler)
        si = path.at.hit.compute_surface_interaction(path.at.ray, compat.shading(), path.active & ~last)
        turns = path.active & ~last & si.is_valid() & si.is_medium_transition()
        medium = dr.select(turns, si.target_medium(step.kept.d), medium)
        path = path.advance(chain, u, step)[0]
        count += 1
    return T, medium
