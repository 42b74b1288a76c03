"""Edges that points of surfaces see, and particles of media: shadows, and what moves in and out of indirect light.

At a vertex x that scatters, light arrives from a direction ω, which the interior lets move with a velocity V when
parameters move: it follows the number u that drew it (emitter samples), or the point that it hit (other samples, with
the share φ, see `velocity`; in narrow lobes it stays, see `keeps_direction`). At an edge the integrand jumps from
f_near to f_far, and what V does not follow is

    dJ/dπ = ∫ [f_near (V_edge - V_near) - f_far (V_edge - V_far)]·n dl,        n normal to the edge, from near to far.

One vertex of each camera path is chosen. Edges are found by short lines (see `crofton`) in the unit square of emitter
samples, where the visibility changes, and by short arcs around samples of the BSDF, where it is another surface that is
seen. Multiple importance sampling belongs to both integrands, which thus add up. What moves x goes back along the path.
Where x does not move, all that does not move looks alike, so that no line is spent on edges that stay where they are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import derivative_by_place, derivative_by_ray
from pathreplay.adjoint.primal import walk_on
from pathreplay.adjoint.record import Layout, deepest, record, record_type, room_for
from pathreplay.boundary.arcs import Arc, arc, density_of_samples
from pathreplay.boundary.cast_shadows import cast_shadows, casters
from pathreplay.boundary.creases import CreaseOrContour, off_contact
from pathreplay.boundary.crofton import (
    ROUNDING,
    Crossed,
    PlaneLine,
    Probe,
    Resampled,
    VisibilityProbe,
    bisect,
    looked_at,
    passed,
    survey,
)
from pathreplay.boundary.edges import Edges, FilmDomain
from pathreplay.boundary.emitters import Glimpse, Lamp, followed, glimpse
from pathreplay.boundary.hard_shadows import ShadowTest
from pathreplay.boundary.observer import ObserverVertex, may_see, surface_sees
from pathreplay.boundary.segment_density import SegmentDensity, looks_of
from pathreplay.boundary.worth import DIM, MOST, STEEP, UNFORESEEN, Worth, closeness, own_plane, radiance_of, weighed
from pathreplay.samplers.counter_sampler import CounterSampler, key_of, quasi_random
from pathreplay.samplers.streams import Stream
from pathreplay.transport.motion import may_move
from pathreplay.transport.path import PathState
from pathreplay.transport.signature import edge_normal, mixed, outline_gap, place_met, shape_met, turned_away
from pathreplay.transport.start import CameraStart
from pathreplay.transport.velocity import held_direction, jumps_at_facets, moved_direction
from pathreplay.transport.vertex import Arrival, Flight, TraceConfig, VertexSamples, mis_weight
from pathreplay.transport.volume.passage import SHORT_OF

BORDER = 1e-4
"""Width of the border of the unit square that is left out: some emitters are singular there (the cone of a sphere)."""
INSIDE = 1 - 2 * BORDER
JUMP = 4.0
"""So many times as far from an edge as its slope says is the other end of a line where a sample of an emitter jumps."""
WIDELY = 0.8
"""Share of the lines that are thrown as if nobody had looked first: shadows are seen by way of other surfaces, too."""


@dataclass
class SelectedVertex:
    """The vertex of a camera path that looks for edges."""

    at: Arrival
    k: mi.UInt32  # records before
    depth: mi.UInt32  # vertices before: as many, but null boundaries are none
    β: mi.Spectrum  # throughput before, over the probability of the choice
    mass: mi.Float  # by which it was chosen
    moves: mi.Bool  # it, or a vertex before, may move
    active: mi.Bool
    flight: Flight | None = None  # before it, with media


@dataclass
class SquareLine(PlaneLine):
    """A line in the unit square of one emitter (see `emitters`), which is reflected at the border."""

    lamp: Lamp
    share: mi.Float  # 1 / probability of the emitter

    def at(self, t: mi.Float) -> mi.Point2f:
        return self._folded(t)[0]

    def way(self, t: mi.Float) -> mi.Vector2f:
        """Its direction there."""
        return self._folded(t)[1]

    def _folded(self, t: mi.Float) -> tuple[mi.Point2f, mi.Vector2f]:
        x = (self.c + t * self.w - BORDER) / INSIDE
        x -= 2 * dr.floor(0.5 * x)
        back = x > 1
        return BORDER + INSIDE * dr.select(back, 2 - x, x), dr.select(back, -self.w, self.w)


@dr.syntax
def choose_vertex(
    trace: TraceConfig, numbers: CounterSampler, ray: mi.Ray3f, flows: mi.Bool, layout: Layout, records: Any
) -> tuple[Any, SelectedVertex]:
    """Walk along a camera path, and choose one of the vertices that scatter smoothly, by what they count.

    ``flows``: all vertices may move under the place where the path begins. Vertices up to the chosen one are recorded,
    if there are ``records``. The last vertex that ``trace`` allows scatters nothing: the walk ends before.
    """
    trace = replace(trace, max_depth=max(trace.max_depth - 1, 0))
    path = PathState.begin(trace, CameraStart(ray, numbers, mi.Bool(True)))
    if dr.hint(trace.max_depth == 1 and trace.media is None and records is None, mode="scalar"):
        return None, _first_vertex(trace, path, flows)
    none, no = mi.UInt32(0), mi.Bool(False)
    flight = None if trace.media is None else Flight.none(trace.media)
    chosen = SelectedVertex(path.at, none, mi.UInt32(0), mi.Spectrum(0), mi.Float(0), no, mi.Bool(False), flight)
    mass = mi.Float(0)
    count = mi.UInt32(0)
    moves = mi.Bool(flows)
    while dr.hint(path.active, exclude=[trace, layout], label="pathreplay: choose a vertex"):
        choice = numbers.next_1d()
        u, step = path.choose(trace, numbers)
        here, w = may_see(trace, path.at, step)
        m = dr.select(path.active & here, dr.mean(dr.abs(path.β * w)), 0)
        mass += m
        moves |= may_move(trace, path.at.hit)
        take = (m > 0) & (choice * mass < m)
        flight = None if trace.media is None else step.kept.media.flight
        chosen = dr.select(
            take, SelectedVertex(path.at, count, path.depth, path.β * w, m, moves, mi.Bool(True), flight), chosen
        )
        onward, v = path.advance(trace, u, step)
        if dr.hint(records is not None, mode="scalar"):
            records[count] = record(layout, v)
        path = onward
        count += 1
    chosen.β *= mass / dr.maximum(chosen.mass, dr.smallest(mi.Float))
    return records, chosen


def _first_vertex(trace: TraceConfig, path: PathState, flows: mi.Bool) -> SelectedVertex:
    """The first vertex, which is the only candidate; nothing is traced beyond it."""
    at, none = path.at, mi.UInt32(0)
    active = path.active & surface_sees(trace, at)
    return SelectedVertex(
        at, none, none, dr.select(active, path.β, 0), mi.Float(1), flows | may_move(trace, at.hit), active
    )


@dataclass
class Search:
    """How a search looks at its lines: it glances at all, or looks closer at some."""

    chosen: mi.Float | None = None  # what the line of each lane stands for, or None: glance
    pick: mi.PCG32 | None = None

    def closer(self, probe: Probe, line: Any, active: mi.Bool) -> Crossed:
        return bisect(probe, line, dr.select(active, self.chosen, 0), self.pick)


@dataclass
class ShadowEdge:
    """A crossing in the square of an emitter: where the lit side ends."""

    lamp: Lamp
    w: mi.Vector2f  # direction of the line
    u: mi.Point2f  # at the side in the shadow
    u_lit: mi.Point2f  # and at the other
    lit: Glimpse  # there
    hit: mi.PreliminaryIntersection3f  # of what casts it
    ray: mi.Ray3f
    n: mi.Vector3f
    own: mi.Bool  # what hides the lamp is the plane of the seer's own triangle
    K: mi.Spectrum
    active: mi.Bool


def emitter_line(trace: TraceConfig, x: SelectedVertex, l: float, key: mi.UInt32) -> SquareLine:
    """A line among the samples of an emitter."""
    numbers, scene = CounterSampler.of(key), trace.scene
    which, turn = numbers.next_2d()
    index, share, _ = scene.sample_emitter(which)
    sin, cos = dr.sincos(dr.two_pi * turn)
    c = BORDER + INSIDE * numbers.next_2d()
    lamp = Lamp.of(trace, index, x.active)
    return SquareLine(mi.Point2f(c), mi.Vector2f(cos, sin), mi.Float(-0.5 * l), mi.Float(0.5 * l), lamp, share)


def emitter_edges(
    trace: TraceConfig, x: SelectedVertex, observer: ObserverVertex, l: float, key: mi.UInt32, search: Search
) -> Any:
    """Find the edge of a shadow among the samples of an emitter, and weigh it: see `Search`. Detached."""
    line = emitter_line(trace, x, l, key)

    def sight(seen: Glimpse) -> VisibilityProbe:
        moves = x.moves | _lamp_moves(trace, line.lamp.emitter) | may_move(trace, seen.hit)
        return VisibilityProbe(mi.UInt32(seen.hidden & moves), mi.Point3f(0), mi.Normal3f(0))

    def probe(line: SquareLine, t: mi.Float, active: mi.Bool) -> VisibilityProbe:
        return sight(glimpse(trace, observer, line.lamp, line.at(t), active))

    if search.chosen is None:
        glimpses = [glimpse(trace, observer, line.lamp, line.at(t), x.active) for t in looked_at(line)]
        return _square_worth(trace, x, observer, line, l, [(seen, sight(seen)) for seen in glimpses], x.active)
    found = search.closer(probe, line, x.active)
    active = found.weight > 0
    a, b = (glimpse(trace, observer, line.lamp, line.at(t), active) for t in (found.a, found.b))
    active &= a.hidden != b.hidden
    lit, dark = dr.select(a.hidden, b, a), dr.select(a.hidden, a, b)
    active &= (line.lamp.radius == 0) | (dark.hit.t < lit.hit.t)  # or it is the mesh that ends there
    light, hit = lit.light, dark.hit
    active &= observer.is_off(hit.t)
    f, pdf = observer.towards(light.d, active)
    F = x.β * f * lit.Le * observer.transmittance_past_edge(light, hit.t, key, active) * line.share
    F *= dr.select(light.delta, 1, mis_weight(lit.density / line.share, pdf))
    K = 0.5 * dr.pi * INSIDE**2 / l * found.weight * F * dr.select(a.hidden, -1, 1)
    active &= dr.any(K != 0) & dr.all(dr.isfinite(K))
    u, u_lit = (line.at(dr.select(a.hidden, *ends)) for ends in ((found.a, found.b), (found.b, found.a)))
    own = active & observer.parts(light.d, dark.light.d)  # not that of the ray, which begins a little beside
    return ShadowEdge(
        line.lamp, line.way(found.a), u, u_lit, lit, hit, dark.ray, edge_normal(hit, dark.ray, active), own, K, active
    )


def _square_worth(
    trace: TraceConfig,
    x: SelectedVertex,
    observer: ObserverVertex,
    line: SquareLine,
    l: float,
    seen: list[tuple[Glimpse, VisibilityProbe]],
    active: mi.Bool,
) -> Worth:
    """What a line is worth where so much is seen. Where no lobe is narrow, its middle tells what x scatters."""
    glimpses, sights = zip(*seen, strict=True)
    a, b, c = (each.light.d for each in glimpses)
    if trace.traits.narrow:
        scattered = [observer.towards(d, active) for d in (a, b, c)]
    else:
        scattered = [observer.towards(c, active)] * 3
    bright = []
    for each, (f, pdf) in zip(glimpses, scattered, strict=True):
        F = dr.mean(dr.abs(x.β * f * each.Le)) * line.share
        bright.append(F * dr.select(each.light.delta, 1, mis_weight(each.density / line.share, pdf)))
    first = reduce(lambda p, q: dr.select(q.hidden & ~(p.hidden & (p.hit.t <= q.hit.t)), q, p), glimpses)
    told = survey([replace(sight, bright=F) for sight, F in zip(sights, bright, strict=True)], active)
    told.near = dr.select(first.hidden, closeness(trace, first.hit), 0)
    turn = dr.norm(a - c) + dr.norm(c - b)
    return Worth.of(told, told.bright, own_plane(observer, a, b) / (turn + l * STEEP))


def _lamp_moves(trace: TraceConfig, emitter: mi.EmitterPtr) -> mi.Bool:
    moving = trace.traits.moving
    moves = mi.Bool(moving is None)
    for shape in moving or ():
        if shape.is_emitter():
            moves |= emitter == mi.EmitterPtr(shape.emitter())
    return moves


def shadow_gap(observer: ObserverVertex, c: ShadowEdge, at: mi.Ray3f, u: mi.Point2f) -> mi.Float:
    """B: distance of the line to the emitter sample from the edge; differentiable in all that moves."""
    origin = observer.moved(at)
    d = followed(observer.trace, c.lamp, origin, u, c.lit, c.active)
    return dr.select(c.own, dr.dot(origin.n, d), outline_gap(c.n, origin.p, d, c.hit, c.ray, c.active))


def shadow_weight(observer: ObserverVertex, c: ShadowEdge) -> mi.Spectrum:
    """K in full: with the derivative of B along the line."""
    slope = derivative_by_place(c.u, lambda u: shadow_gap(observer, c, observer.at.ray, u))
    # Where a sample of the emitter jumps there is no edge: its other side is far off.
    off = dr.abs(shadow_gap(observer, c, observer.at.ray, c.u_lit) - shadow_gap(observer, c, observer.at.ray, c.u))
    jumps = off > JUMP * dr.norm(slope) * dr.norm(c.u_lit - c.u) + ROUNDING * (dr.norm(c.ray.o) + c.hit.t)
    return passed(c.w, c.K, slope, c.active & ~jumps)


@dataclass
class HardShadow:
    """Of a light without extent, on the surface that is seen at both sides: its border is crossed there."""

    there: mi.Bool
    shade: ShadowTest  # at the side in the shadow, which is the near one
    n: mi.Vector3f

    def gap(self, trace: TraceConfig, hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f, active: mi.Bool) -> mi.Float:
        return self.shade.gap(trace, self.n, hit, ray, active & self.there)

    def slope(
        self, trace: TraceConfig, hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f, active: mi.Bool
    ) -> mi.Vector3f:
        return derivative_by_ray(ray, lambda ray: self.gap(trace, hit, ray, active)).d


@dataclass
class OcclusionEdge:
    """A crossing on an arc: one surface hides another, or bends, or a hard shadow ends on it."""

    edge: mi.PreliminaryIntersection3f  # of the one that hides
    near: mi.PreliminaryIntersection3f  # what the direction at its side hits: it, or a null boundary before it
    far: mi.PreliminaryIntersection3f  # may be none
    d_near: mi.Vector3f
    d_far: mi.Vector3f
    n: mi.Vector3f  # from near to far
    bend: CreaseOrContour
    hard: HardShadow | None
    own: mi.Bool  # it is the plane of the seer's own triangle
    slope: mi.Float  # of its B, along n
    K_near: mi.Spectrum
    K_far: mi.Spectrum
    active: mi.Bool


def _views(
    trace: TraceConfig, x: SelectedVertex, observer: ObserverVertex, key: mi.UInt32, hard: bool
) -> tuple[Callable[..., VisibilityProbe], Callable[..., ShadowTest]]:
    """What x sees along an arc, and what of it lies in the shadow of a light without extent, if any is ``hard``."""

    def shade(ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, active: mi.Bool) -> ShadowTest:
        u = VertexSamples.draw(CounterSampler.stream(key, Stream.BEYOND_EDGE)).light  # as `walk_on` draws it
        return ShadowTest.of(trace, observer.arrival(ray, hit, mi.Float(1)), u, x.depth + 1, active)

    def probe(line: Arc, t: mi.Float, active: mi.Bool, shaded: bool = hard) -> VisibilityProbe:
        ray = observer.origin.spawn_ray(line.at(t))
        first = observer.hit(ray, active & observer.may_scatter(ray.d))
        seen = observer.behind(ray, first, active)
        counts, moves = _counts(trace, x, seen), x.moves | may_move(trace, seen)
        close = active & counts  # nothing else is looked at closely
        if trace.media is None:
            close &= moves
        at = seen.compute_surface_interaction(ray, mi.RayFlags.Minimal | mi.RayFlags.ShadingFrame, close)
        if not trace.traits.copies:
            at.shape = seen.shape
        turned = dr.select(turned_away(at, ray.d), mi.UInt32(1), 0)
        places = [place_met(trace, seen, active, at.shape, facets) for facets in (True, False)]
        place = dr.select(observer.keeps, *places)
        facets = (
            close
            & ~observer.keeps
            & jumps_at_facets(trace.traits.tables.blend_lengths, observer.origin, seen, at.p, at.n)
        )
        place = mixed(place, dr.select(facets, seen.prim_index + 1, 0))
        if trace.media is not None:  # directions follow null boundaries, too
            boundary = place_met(trace, first, active, shape_met(trace, first, ray, active), facets=False)
            place, moves = mixed(place, boundary), moves | may_move(trace, first)
        if shaded:
            dimmed = shade(ray, seen, active)
            place, moves = mixed(place, dr.select(dimmed.dark, mi.UInt32(1), 0)), moves | may_move(trace, dimmed.hit)
        near = closeness(trace, seen)
        if trace.media is not None:
            near = dr.maximum(near, closeness(trace, first))
        bright = dr.select(seen.is_valid(), DIM, mi.Float(trace.scene.environment() is not None))
        sight = VisibilityProbe(mixed(place, turned), at.p, at.n, moves, near, bright)
        # As nothing, a sky would be.
        dark = replace(VisibilityProbe.nothing(), signature=mi.UInt32(1), moves=moves, near=near, bright=bright)
        return dr.select(counts, sight, dark)

    return probe, shade


def arc_edges(
    trace: TraceConfig, x: SelectedVertex, observer: ObserverVertex, l: float, key: mi.UInt32, search: Search
) -> Any:
    """Find an edge between two surfaces among the directions in which x scatters, and weigh both sides: see `Search`.

    Detached.
    """
    line, ok = arc(observer, l, trace.traits.narrow or trace.media is not None, key, x.active)
    hard = trace.traits.hard_lights and trace.media is None
    probe, shade = _views(trace, x, observer, key, hard)
    if search.chosen is None:
        light = dr.select(ok, dr.mean(dr.abs(x.β * line.f)) / line.p, 0)
        own = own_plane(observer, line.at(line.begin), line.at(line.end))
        seen = survey([probe(line, t, ok) for t in looked_at(line)], ok)
        return Worth.of(replace(seen, found=seen.found * line.importance()), light, light * own / l)
    found = search.closer(probe, line, ok)
    active = found.weight > 0
    rays = [observer.origin.spawn_ray(line.at(t)) for t in (found.a, found.b)]
    firsts = [observer.hit(ray, active) for ray in rays]
    edges, through = observer.edges(rays, firsts, active)
    near_a, shadow, shades = edges[0].t <= edges[1].t, mi.Bool(False), None
    if hard:
        shades = [shade(ray, first, active) for ray, first in zip(rays, firsts, strict=True)]
        a, b = (probe(line, t, active, shaded=False) for t in (found.a, found.b))
        shadow = active & ~a.differs(b) & (shades[0].dark != shades[1].dark)
        near_a = dr.select(shadow, shades[0].dark, near_a)
    edge, near, far = dr.select(near_a, *edges), dr.select(near_a, *firsts), dr.select(near_a, *firsts[::-1])
    ray_near, ray_far = dr.select(near_a, *rays), dr.select(near_a, *rays[::-1])
    active &= edge.is_valid() & observer.is_off(edge.t)

    bend = CreaseOrContour.of(trace, ((edge, ray_near), (dr.select(near_a, *edges[::-1]), ray_far)), active & ~shadow)
    slope = derivative_by_ray(ray_near, lambda ray: bend.gap(ray, active)).d
    own = active & ~shadow & observer.parts(ray_near.d, ray_far.d)
    border = None
    if shades is not None:
        dark = dr.select(near_a, *shades)
        border = HardShadow(shadow, dark, dark.normal(shadow))
        slope = dr.select(shadow, border.slope(trace, edge, ray_near, active), slope)
    slope = dr.select(own, observer.si.n, slope)
    slope -= dr.dot(slope, ray_near.d) * ray_near.d
    bent = (own | bend.meets | bend.turns | shadow) & (dr.squared_norm(slope) > 0)
    active &= bent | ~shadow
    n = dr.select(bent, dr.normalize(slope), edge_normal(edge, ray_near, active))
    n = dr.select(dr.dot(n, ray_far.d - ray_near.d) < 0, -n, n)
    steep = dr.select(bent, dr.dot(slope, n), 1)
    f, pdf = observer.towards(ray_far.d, active)
    common = x.β * f * (0.5 * dr.pi * found.weight * line.weight(observer, density_of_samples(pdf), active))
    active &= dr.any(common != 0)
    arrivals = off_contact(trace, observer.arrival(ray_near, near, pdf), observer.arrival(ray_far, far, pdf), active)
    depth = x.depth + 1
    T, arrivals = observer.onward(arrivals, SHORT_OF * edge.t, key, active & through)
    K = []
    for arrival in arrivals:
        path = PathState(arrival, mi.Spectrum(1), None, mi.Float(1), depth, active & (depth < trace.max_depth))
        L, _ = walk_on(trace, CounterSampler.stream(key, Stream.BEYOND_EDGE), path)
        K.append(dr.select(active, common * T * L, 0))
    return OcclusionEdge(edge, near, far, ray_near.d, ray_far.d, n, bend, border, own, steep, K[0], K[1], active)


def _counts(trace: TraceConfig, x: SelectedVertex, seen: mi.PreliminaryIntersection3f) -> mi.Bool:
    """Whether light may come from what x sees: at the end of a path only what glows has any."""
    if trace.media is not None:
        return mi.Bool(True)
    glows = dr.select(seen.is_valid(), seen.shape.emitter() != None, trace.scene.environment() is not None)  # noqa: E711
    return glows | (x.depth + 2 < trace.max_depth)


def hiding_motion(trace: TraceConfig, observer: ObserverVertex, c: OcclusionEdge, at: mi.Ray3f) -> mi.Spectrum:
    """What the edge sweeps that the directions at its sides do not follow; differentiable in all that moves."""
    origin = observer.moved(at)
    lengths = trace.traits.tables.blend_lengths
    edge = held_direction(origin, c.d_near, c.edge, c.active)
    d_near, _ = moved_direction(lengths, origin, c.d_near, c.near, observer.holds(c.near, c.active))
    d_far, _ = moved_direction(lengths, origin, c.d_far, c.far, observer.holds(c.far, c.active))
    shadow = mi.Bool(False) if c.hard is None else c.hard.there
    bends = c.own | c.bend.meets | c.bend.turns | shadow

    def gap(d: mi.Vector3f) -> mi.Float:
        """How far a direction is from the edge, along n."""
        ray = mi.Ray3f(origin.spawn_ray(dr.detach(d)).o, d)
        B = dr.select(c.own, dr.dot(origin.n, d), c.bend.gap(ray, c.active & ~c.own))
        if c.hard is not None:
            B = dr.select(shadow, c.hard.gap(trace, c.edge, ray, c.active), B)
        return dr.select(bends, -B / c.slope, dr.dot(c.n, edge - d))

    swept = c.K_near * gap(d_near) - c.K_far * gap(d_far)
    return dr.select(c.active, swept, 0)


def secondary_edges(
    trace: TraceConfig,
    places: FilmDomain,
    lines: int,
    closer: int,
    seed: mi.UInt32,
    lengths: tuple[float, float],
) -> Edges:
    """Find edges that vertices see by so many lines of each kind, and look ``closer`` at as many. Detached.

    ``lengths`` are those in the square and on the sphere (radians). What light counts that arrives at the film decides
    nothing here, since forward mode would not know it and choose otherwise.
    """
    trace = replace(trace, max_depth=min(trace.max_depth, deepest(trace)))
    layout = Layout.of(trace, True)
    square, arc = lengths

    def path(centres: SegmentDensity, i: mi.UInt32, n: int, seed: mi.UInt32, records: Any) -> tuple[Any, ...]:
        key = key_of(i, Stream.SECONDARY_KEYS.of(seed))
        s, density = centres.draw(mi.Point2f(quasi_random(i, n, seed)))
        ray, weight = dr.detach(places.ray(s, key))
        records, x = choose_vertex(trace, CounterSampler.of(key), ray, places.flows(s), layout, records)
        x.β *= weight / (density * dr.opaque(mi.Float, n))
        return s, density, key, records, x

    def glances(centres: SegmentDensity, n: int, seed: mi.UInt32) -> tuple[mi.Point2f, mi.Float, list[Worth]]:
        s, density, key, _, x = path(centres, dr.arange(mi.UInt32, n), n, seed, None)
        observer = ObserverVertex(trace, x.at, x.flight, x.active)
        in_squares = emitter_edges(trace, x, observer, square, Stream.EMITTER_SEGMENTS.of(key), Search())
        on_arcs = arc_edges(trace, x, observer, arc, Stream.ARCS.of(key), Search())
        none = dr.zeros(mi.Float, n)
        density += none  # as many as lines, as all of these
        worths = [replace(w, found=w.found / density, edges=w.edges + none) for w in (in_squares, on_arcs)]
        dr.eval(s, density, worths)
        return s, density, worths

    centres = SegmentDensity(int(places.size.x), int(places.size.y), 0.0)
    if shapes := casters(trace):
        s, falls = cast_shadows(trace, shapes, places, Stream.CAST_SHADOWS.of(seed))
        centres = centres.refined(s, dr.select(falls, mi.Float(1), 0), WIDELY)
    s, density, first = glances(centres, looks_of(lines, places.size), Stream.FIRST_LOOK.of(seed))
    radiance = radiance_of(first)
    worth = weighed(first, radiance)[1]
    of_both = mi.Point2f(dr.concat([s.x, s.x]), dr.concat([s.y, s.y]))
    often = dr.concat([density, density]) * (centres.width * centres.height)
    usual = dr.rcp(dr.maximum(dr.sum(dr.select(worth > 0, dr.rcp(often), 0)), dr.smallest(mi.Float)))
    relative = dr.minimum(worth * often / (MOST * usual), 1)
    centres = centres.refined(of_both, dr.square(relative) / often, WIDELY)
    found, worth = weighed(glances(centres, lines, seed)[2], radiance)
    chosen = Resampled.of(worth + UNFORESEEN * found, closer, seed)

    on_arc = chosen.index >= lines
    i = dr.select(on_arc, chosen.index - lines, chosen.index)
    pick = mi.PCG32(closer, initstate=seed + int(Stream.BISECT_SECONDARY), initseq=dr.arange(mi.UInt32, closer))
    s, _, key, records, x = path(centres, i, lines, seed, dr.alloc_local(record_type(layout), room_for(trace)))
    x.active &= chosen.weight > 0
    of_square, of_arc = dr.select(on_arc, 0, chosen.weight), dr.select(on_arc, chosen.weight, 0)
    observer = ObserverVertex(trace, x.at, x.flight, x.active)
    shaded = emitter_edges(trace, x, observer, square, Stream.EMITTER_SEGMENTS.of(key), Search(of_square, pick))
    K = shadow_weight(observer, shaded)
    hiding = arc_edges(trace, x, observer, arc, Stream.ARCS.of(key), Search(of_arc, pick))

    def motion(ray: mi.Ray3f) -> mi.Spectrum:
        return hiding_motion(trace, observer, hiding, ray) - K * shadow_gap(observer, shaded, ray, shaded.u)

    k = dr.select(x.active, x.k, 0)
    return Edges(s, key, k, x.at.ray, layout, records, motion)
