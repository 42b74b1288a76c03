"""Edges on the film: what silhouettes, creases and borders do to an image, seen directly, in mirrors and through glass.

A camera ray and the delta lobes after it slide over what they meet: the place s on the film is fixed, the point that
is seen is not. At an edge the radiance f(s) jumps, and if the edge moves, an integral over the film changes by the
jump times the area that is swept. Edges are found by short lines on the film (see `crofton`), and with N of them

    dI/dπ = - Σ K dB/dπ,    K = π/2 · (f_a - f_b) / (l p(c) N) · sgn(w·∂B/∂s) / |∂B/∂s|,

with B(s, π) = 0 on the edge, f_a and f_b the radiances at its two sides, and w the direction from a to b. At an outline
B = n·(o + t d - z): z is the point of the near surface, glued to it, o + t d the same point on the path, and n normal
to both edge and ray. Where two surfaces meet, B is the difference of their distances. A smooth mesh goes dark where its
shading normal is at right angles to the ray, a little before its outline; there B is their product.

Lights without extent cast hard shadows, the borders of which are in the image as well. There the point x that is seen
slides with the path, and B = n·(x + r d - z), with the point z of what is in the way, r away in the direction d of the
light.

Both sides of an edge share their random numbers, and so the lobes before it. Where lobes differ, because they are
chosen with another probability, there is no edge: that is a choice of the walk.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import NonFiniteCounter, derivative_by_place, derivative_by_ray
from pathreplay.adjoint.primal import walk_on
from pathreplay.adjoint.record import Layout, record, record_type
from pathreplay.boundary.creases import CreaseOrContour, off_contact
from pathreplay.boundary.crofton import Crossed, PlaneLine, Resampled, VisibilityProbe, bisect, detect, passed
from pathreplay.boundary.edges import Edges, FilmDomain, ray_to_camera
from pathreplay.boundary.hard_shadows import ShadowTest, light_of
from pathreplay.boundary.segment_density import SegmentDensity, looks_of
from pathreplay.boundary.through_media import clear, going_on, transmittance_to_split
from pathreplay.samplers.counter_sampler import CounterSampler, key_of, quasi_random
from pathreplay.samplers.streams import Stream
from pathreplay.transport.motion import may_move
from pathreplay.transport.path import PathState
from pathreplay.transport.signature import edge_normal, mixed, outline_gap, place_met, shape_met, turned_away
from pathreplay.transport.start import CameraStart
from pathreplay.transport.surface import steady
from pathreplay.transport.vertex import Arrival, TraceConfig, VertexSamples
from pathreplay.transport.volume.passage import SHORT_OF

MAX_CHAIN = 16
"""Vertices of a chain of delta lobes, at most."""


@dataclass
class FilmLine(PlaneLine):
    """A line on the film."""

    density: mi.Float  # of its centre, per pixel
    key: mi.UInt32  # of the random numbers that its paths share


@dataclass
class ChainSplit:
    """Where two chains part that begin close to each other."""

    k: mi.UInt32  # vertices that they share
    a: Arrival
    b: Arrival
    β: mi.Spectrum  # throughput before
    found: mi.Bool
    shade_a: ShadowTest | None = None  # where there are lights that cast hard shadows
    shade_b: ShadowTest | None = None


@dataclass
class FilmCrossing:
    """An edge on the film, and what the jump there weighs."""

    line: FilmLine
    s: mi.Point2f  # on its near side
    k: mi.UInt32  # vertices before
    near: Arrival
    bend: CreaseOrContour
    n: mi.Vector3f
    shadow: mi.Bool  # it is the border of a hard shadow, or of a picture that is thrown
    shade: ShadowTest | None
    jump: mi.Spectrum  # (f_a - f_b) · π/2 / (l p(c) N)
    active: mi.Bool


def primary_edges(trace: TraceConfig, places: FilmDomain, lines: int, closer: int, seed: mi.UInt32, l: float) -> Edges:
    """Find edges on the film by so many lines of length ``l`` (pixels), and look ``closer`` at as many. Detached.

    A first look, with few lines (see `looks_of`), decides where they are thrown.
    """
    full, trace = trace, clear(without_roulette(trace))

    def line(centres: SegmentDensity, i: mi.UInt32, n: int, seed: mi.UInt32, l: float) -> FilmLine:
        key = key_of(i, Stream.PRIMARY_KEYS.of(seed))
        x, y, turn = quasi_random(i, n, seed, 3)
        c, density = centres.draw(mi.Point2f(x, y))
        sin, cos = dr.sincos(dr.two_pi * turn)
        return FilmLine(c - centres.margin, mi.Vector2f(cos, sin), mi.Float(-0.5 * l), mi.Float(0.5 * l), density, key)

    def probe(line: FilmLine, t: mi.Float, active: mi.Bool) -> VisibilityProbe:
        s = line.at(t)
        return chain_sight(trace, places.ray(s, line.key)[0], line.key, active, places.flows(s))

    centres = SegmentDensity.even(places.size, l)
    few = looks_of(lines, places.size)
    first = line(centres, dr.arange(mi.UInt32, few), few, Stream.FIRST_LOOK.of(seed), 2 * l)
    centres = centres.refined(first.c + centres.margin, detect(probe, first, mi.Bool(True)))
    every = line(centres, dr.arange(mi.UInt32, lines), lines, seed, l)
    chosen = Resampled.of(detect(probe, every, mi.Bool(True)) / every.density, closer, seed)
    pick = mi.PCG32(closer, initstate=seed + int(Stream.BISECT_PRIMARY), initseq=dr.arange(mi.UInt32, closer))
    crossed = bisect(probe, line(centres, chosen.index, lines, seed, l), chosen.weight, pick)
    per_line = dr.opaque(mi.Float, 0.5 * dr.pi / (l * lines))  # one kernel for all numbers of samples
    c = _weighed(trace, full, places, crossed, per_line)
    layout = Layout.of(trace, True)
    records = dr.alloc_local(record_type(layout), MAX_CHAIN + 1)
    records, reached = _record_chain(trace, places.ray(c.s, c.line.key)[0], c, layout, records)
    c = replace(c, active=reached, k=dr.select(reached, c.k, 0))

    edges = Edges(c.s, c.line.key, c.k, c.near.ray, layout, records, lambda ray: mi.Spectrum(_gap(trace, c, ray)))
    K = passed(c.line.w, c.jump, _slope(trace, places, edges), c.active)
    return replace(edges, motion=lambda ray: -K * _gap(trace, c, ray))


def without_roulette(trace: TraceConfig) -> TraceConfig:
    """The walk as chains take it: roulette would end paths beside an edge in different places."""
    return replace(trace, rr_depth=0xFFFFFFFF, max_depth=min(trace.max_depth, MAX_CHAIN))


def steadied(trace: TraceConfig) -> TraceConfig:
    """The walk beyond an edge: coarse meshes cut lobes off at creases, and nothing else is to jump there."""
    return replace(trace, steady=trace.traits.coarse_meshes and not trace.traits.brushed_meshes)


def chain_sight(trace: TraceConfig, ray: mi.Ray3f, key: mi.UInt32, active: mi.Bool, flows: mi.Bool) -> VisibilityProbe:
    """What a path meets from the camera to the first vertex where it is scattered; until something moves, nothing.

    ``flows``: all that is met may move under the place where the path begins.
    """
    if trace.traits.mirrors or trace.traits.hard_lights or trace.media is not None:
        return _chain_sight(trace, ray, key, active, flows)
    path = PathState.begin(trace, CameraStart(ray, CounterSampler.of(key), active))
    moves = flows | may_move(trace, path.at.hit)
    return dr.select(moves, _sight(trace, path, key, active & moves), VisibilityProbe.nothing())


@dr.syntax
def _chain_sight(trace: TraceConfig, ray: mi.Ray3f, key: mi.UInt32, active: mi.Bool, flows: mi.Bool) -> VisibilityProbe:
    numbers = CounterSampler.of(key)
    path = PathState.begin(trace, CameraStart(ray, numbers, active))
    sight, moves = VisibilityProbe.nothing(), mi.Bool(flows)
    while dr.hint(path.active, exclude=[trace], label="pathreplay: chain"):
        moves |= may_move(trace, path.at.hit)
        here = dr.select(moves, _sight(trace, path, key, path.active & moves), VisibilityProbe.nothing())
        if dr.hint(trace.traits.hard_lights, mode="scalar"):
            dark = _shade(trace, path.at, key, path.depth, path.active).dark
            here.signature = mixed(here.signature, dr.select(dark, mi.UInt32(1), 0))
        path.active &= _slides(trace, path.at)
        u, step = path.choose(trace, numbers)
        step.active &= step.kept.delta
        lobe = dr.select(step.active, step.kept.lobe + 1, 0)
        sight = replace(here, signature=mixed(mixed(sight.signature, here.signature), lobe))
        path = path.advance(trace, u, step)[0]
    return sight


def _sight(trace: TraceConfig, path: PathState, key: mi.UInt32, active: mi.Bool) -> VisibilityProbe:
    at = path.at
    flags = mi.RayFlags.All if trace.traits.coarse_meshes else mi.RayFlags.Minimal | mi.RayFlags.ShadingFrame
    si = at.hit.compute_surface_interaction(at.ray, flags, active)
    if not trace.traits.copies:
        si.shape = at.hit.shape
    kind = dr.select(turned_away(si, at.ray.d), mi.UInt32(1), 0)
    sight = VisibilityProbe(mixed(place_met(trace, at.hit, active, si.shape), kind), si.p, si.n)
    if not trace.traits.coarse_meshes:
        return sight
    triangle = dr.select(si.is_valid() & si.shape.is_mesh(), at.hit.prim_index + 1, 0)
    if trace.traits.brushed_meshes:  # at every crease the tangent jumps, and lobes with it
        return replace(sight, signature=mixed(sight.signature, triangle))
    light, lobe = _directions(trace, path, steady(si, at.ray, active), key, active)
    return replace(sight, triangle=triangle, light=light, lobe=lobe)


def _directions(
    trace: TraceConfig, path: PathState, si: mi.SurfaceInteraction3f, key: mi.UInt32, active: mi.Bool
) -> tuple[mi.Vector3f, mi.Vector3f]:
    """Those of light and lobe that are sampled there; zero where nothing is scattered."""
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


def _shade(trace: TraceConfig, at: Arrival, key: mi.UInt32, k: mi.UInt32, active: mi.Bool) -> ShadowTest:
    return ShadowTest.of(trace, at, VertexSamples.draw(CounterSampler.at_vertex(key, k)).light, k, active)


@dr.syntax
def _split(trace: TraceConfig, rays: tuple[mi.Ray3f, mi.Ray3f], key: mi.UInt32, active: mi.Bool) -> ChainSplit:
    """Where two chains with the same random numbers part: at the first vertex where they meet different things."""
    numbers_a, numbers_b = CounterSampler.of(key), CounterSampler.of(key)
    a = PathState.begin(trace, CameraStart(rays[0], numbers_a, active))
    b = PathState.begin(trace, CameraStart(rays[1], numbers_b, active))
    found = active & _sight(trace, a, key, active).differs(_sight(trace, b, key, active))
    go_on = active & ~found
    while dr.hint(go_on, exclude=[trace], label="pathreplay: fork"):
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
        found |= go_on & _sight(trace, a, key, go_on).differs(_sight(trace, b, key, go_on))
        go_on &= ~found
    split = ChainSplit(a.depth, a.at, b.at, a.β, found)
    if dr.hint(trace.traits.hard_lights, mode="scalar"):
        split.shade_a, split.shade_b = (_shade(trace, at, key, split.k, active & ~found) for at in (a.at, b.at))
        split.found |= split.shade_a.dark != split.shade_b.dark
    return split


def _weighed(
    trace: TraceConfig, full: TraceConfig, places: FilmDomain, found: Crossed, per_line: mi.Float
) -> FilmCrossing:
    """What the jump of radiance is, with the same random numbers on both sides. ``full`` is the walk with media."""
    line, active = found.line, found.weight > 0
    ends = line.at(found.a), line.at(found.b)
    (ray_a, weight), (ray_b, _) = (places.ray(s, line.key) for s in ends)
    split = _split(trace, (ray_a, ray_b), line.key, active)
    active &= split.found
    sides, onward = off_contact(trace, split.a, split.b, active), steadied(trace)
    if full.media is not None:
        onward, t = steadied(full), SHORT_OF * dr.minimum(split.a.hit.t, split.b.hit.t)
        T, medium = transmittance_to_split(full, ray_a, line.key, split.k, t, active)
        active &= dr.any(T != 0)
        sides, weight = [going_on(full, side, t, medium, active) for side in sides], weight * T
    f = []
    for side in sides:
        path = PathState(side, mi.Spectrum(1), None, mi.Float(1), mi.UInt32(split.k), mi.Bool(active))
        f.append(walk_on(onward, CounterSampler.at_vertex(line.key, split.k), path)[0])
    jump = weight * split.β * (f[0] - f[1]) * (per_line * found.weight / line.density)

    near_a, shadow = split.a.hit.t <= split.b.hit.t, mi.Bool(False)
    if split.shade_a is not None:
        shadow = split.shade_a.dark != split.shade_b.dark
        near_a = dr.select(shadow, split.shade_a.dark, near_a)
    near = dr.select(near_a, split.a, split.b)
    shade = None if split.shade_a is None else dr.select(near_a, split.shade_a, split.shade_b)
    active &= near.hit.is_valid()
    bend = CreaseOrContour.of(trace, ((split.a.hit, split.a.ray), (split.b.hit, split.b.ray)), active & ~shadow)
    n = edge_normal(near.hit, near.ray, active)
    if shade is not None:
        n = dr.select(shadow, shade.normal(active & shadow), n)
    s = dr.select(near_a, *ends)
    return FilmCrossing(line, s, split.k, near, bend, n, shadow, shade, jump, active)


def _gap(trace: TraceConfig, c: FilmCrossing, ray: mi.Ray3f) -> mi.Float:
    """B: zero on the edge; differentiable in the ray that arrives, and in the shapes."""
    outline = outline_gap(c.n, ray.o, ray.d, c.near.hit, ray, c.active)
    B = dr.select(c.bend.meets | c.bend.turns, c.bend.gap(ray, c.active), outline)
    return (
        B if c.shade is None else dr.select(c.shadow, c.shade.gap(trace, c.n, c.near.hit, ray, c.active & c.shadow), B)
    )


@dr.syntax
def _record_chain(
    trace: TraceConfig, ray: mi.Ray3f, c: FilmCrossing, layout: Layout, records: Any
) -> tuple[Any, mi.Bool]:
    """Record the vertices that the two sides share, and the arrival at the edge after them; whether it was reached."""
    numbers = CounterSampler.of(c.line.key)
    path = PathState.begin(trace, CameraStart(ray, numbers, c.active))
    count = mi.UInt32(0)
    while dr.hint(path.active & (count <= c.k), exclude=[trace, layout], label="pathreplay: record chain"):
        path.active &= count < c.k  # of the last one only the arrival will be read
        u, step = path.choose(trace, numbers)
        onward, v = path.advance(trace, u, step)
        records[count] = record(layout, v)
        path = onward
        count += 1
    return records, c.active & (count == c.k + 1)


def _slope(trace: TraceConfig, places: FilmDomain, edges: Edges) -> mi.Vector2f:
    """∂B/∂s: how fast the edge is passed on the film. Reaches no parameter."""
    q = derivative_by_ray(edges.ray, lambda ray: edges.motion(ray)[0])
    q = ray_to_camera(trace, places, edges, q, NonFiniteCounter(), rays_only=True)

    def along(s: mi.Point2f) -> mi.Float:
        ray, _ = places.ray(s, edges.key)
        return dr.dot(q.o, ray.o) + dr.dot(q.d, ray.d)

    return derivative_by_place(edges.s, along)
