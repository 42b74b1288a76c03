"""Edges that points of surfaces see, and particles of media: shadows, and what moves in and out of indirect light.

At a vertex x that scatters, light arrives from a direction ω, which the interior lets move with a velocity V when
parameters move: it follows the number u that drew it (emitter samples), or the point that it hit (other samples, with
the share φ, see `velocity`). At an edge the integrand jumps from f_near to f_far, and what V does not follow is

    dJ/dπ = ∫ [f_near (V_edge - V_near) - f_far (V_edge - V_far)]·n dl,        n normal to the edge, from near to far.

One vertex of each camera path is chosen. Edges are found by short lines (see `crofton`) in the unit square of emitter
samples, where the visibility changes, and by short arcs around samples of the BSDF, where it is another surface that is
seen. Multiple importance sampling belongs to both integrands, which thus add up. What moves x goes back along the path.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ..transport.passage import SHORT_OF
from ..transport.path import PathState
from ..transport.signature import edge_normal, mixed, outline_gap, place_met
from ..transport.start import CameraStart
from ..transport.traits import is_null
from ..transport.velocity import held_direction, moved_direction
from ..transport.vertex import Arrival, Flight, Walk, mis_weight
from .adjoint import derivative_by_place
from .counted import Counted, quasi_random
from .crofton import ROUNDING, PlaneLine, Sight, bisect, search
from .edges import Edges, Places
from .primal import walk_on
from .record import Layout, deepest, record, record_type, room_for
from .seer import Seer, may_see

BORDER = 1e-4
"""Width of the border of the unit square that is left out: some emitters are singular there (the cone of a sphere)."""


Importance = Callable[..., "mi.Spectrum"]


@dataclass
class Chosen:
    """The vertex of a camera path that looks for edges."""

    at: Arrival
    k: mi.UInt32  # records before
    depth: mi.UInt32  # vertices before: as many, but null boundaries are none
    β: mi.Spectrum  # throughput before, over the probability of the choice
    mass: mi.Float  # by which it was chosen
    active: mi.Bool
    flight: Flight | None = None  # before it, with media


@dataclass
class SquareLine(PlaneLine):
    """A line in the unit square of samples of one emitter."""

    emitter: mi.EmitterPtr
    share: mi.Float  # 1 / probability of the emitter


@dataclass
class Arc:
    """A piece of a great circle of directions."""

    c: mi.Vector3f
    w: mi.Vector3f  # the direction in which it leaves its centre
    pdf: mi.Float  # density of the centre
    begin: mi.Float
    end: mi.Float

    def at(self, t: mi.Float) -> mi.Vector3f:
        return self.c * dr.cos(t) + self.w * dr.sin(t)


@dr.syntax
def choose_vertex(
    walk: Walk, numbers: Counted, ray: mi.Ray3f, W: mi.Spectrum, layout: Layout, records: Any
) -> tuple[Any, Chosen]:
    """Record a camera path, and choose one of the vertices that scatter smoothly, by what they count."""
    path = PathState.begin(walk, CameraStart(ray, numbers, mi.Bool(True)))
    none, flight = mi.UInt32(0), None if walk.media is None else Flight.none(walk.media)
    chosen = Chosen(path.at, none, mi.UInt32(0), mi.Spectrum(0), mi.Float(0), mi.Bool(False), flight)
    mass = mi.Float(0)
    count = mi.UInt32(0)
    while dr.hint(path.active, exclude=[walk, layout, W], label="pathreplay: choose a vertex"):
        pick = numbers.next_1d()
        u, step = path.choose(walk, numbers)
        here, w = may_see(walk, path.at, step)
        here &= path.active & (path.depth + 1 < walk.max_depth)
        m = dr.select(here, dr.mean(dr.abs(path.β * w * W)), 0)
        mass += m
        take = (m > 0) & (pick * mass < m)
        flight = None if walk.media is None else step.kept.media.flight
        seer = Chosen(path.at, count, path.depth, path.β * w, m, mi.Bool(True), flight)
        chosen = dr.select(take, seer, chosen)
        onward, v = path.advance(walk, u, step)
        records[count] = record(layout, v)
        path = onward
        count += 1
    chosen.β *= mass / dr.maximum(chosen.mass, dr.smallest(mi.Float))
    return records, chosen


@dataclass
class Shaded:
    """A crossing in the square of an emitter: where the lit side ends."""

    line: SquareLine
    u: mi.Point2f  # at the side in the shadow
    u_lit: mi.Point2f
    hit: mi.PreliminaryIntersection3f  # of what casts it
    ray: mi.Ray3f
    n: mi.Vector3f
    K: mi.Spectrum
    active: mi.Bool


def emitter_edges(walk: Walk, x: Chosen, seer: Seer, lines: int, l: float, key: mi.UInt32, pick: mi.PCG32) -> Shaded:
    """Find the edge of a shadow among the samples of an emitter, and weigh it. Detached."""
    scene, origin = walk.scene, seer.origin

    def draw(j: mi.UInt32) -> tuple[SquareLine, mi.Bool]:
        numbers = Counted(key, 8 * j)
        index, share, _ = scene.sample_emitter(numbers.next_1d())
        turn = dr.two_pi * numbers.next_1d()
        c, w = numbers.next_2d() * (1 + l) - 0.5 * l, mi.Vector2f(dr.cos(turn), dr.sin(turn))
        begin, end = mi.Float(-0.5 * l), mi.Float(0.5 * l)
        for axis in range(2):  # the part that is inside
            cuts = (BORDER - c[axis]) / w[axis], (1 - BORDER - c[axis]) / w[axis]
            begin, end = dr.maximum(begin, dr.minimum(*cuts)), dr.minimum(end, dr.maximum(*cuts))
        inside = x.active & (begin < end)
        emitter = dr.gather(mi.EmitterPtr, scene.emitters_dr(), index, x.active)
        begin, end = dr.select(inside, begin, 0), dr.select(inside, end, 0)
        return SquareLine(c, w, begin, end, emitter, share), inside

    def shadowed(line: SquareLine, t: mi.Float, active: mi.Bool) -> tuple[Any, ...]:
        light, Le = line.emitter.sample_direction(origin, line.at(t), active)
        ray = origin.spawn_ray_to(light.p)
        lit = active & (light.pdf != 0)
        hit = seer.behind(ray, seer.hit(ray, lit), lit)
        # A lamp's own limb hides it by rounding only.
        hidden = lit & hit.is_valid() & (hit.shape.emitter() != light.emitter)
        return light, Le, ray, hit, hidden

    def look(line: SquareLine, t: mi.Float, active: mi.Bool) -> Sight:
        return Sight(mi.UInt32(shadowed(line, t, active)[-1]), mi.Point3f(0), mi.Normal3f(0))

    found = bisect(look, search(draw, look, lines, pick), pick)
    line, active = found.line, found.weight > 0
    a_hidden = shadowed(line, found.a, active)[-1]
    light, Le, *_ = shadowed(line, dr.select(a_hidden, found.b, found.a), active)
    t = dr.select(a_hidden, found.a, found.b)
    _, _, ray, hit, hidden = shadowed(line, t, active)
    active &= hidden
    f, pdf = seer.towards(light.d, active)
    density = light.pdf / line.share
    Le *= seer.past(light, hit.t, key, active)
    F = x.β * f * Le * line.share * dr.select(light.delta, 1, mis_weight(density, pdf))
    K = 0.5 * dr.pi * dr.square(1 + l) / (l * lines) * found.weight * F * dr.select(a_hidden, -1, 1)
    u, u_lit = line.at(t), line.at(dr.select(a_hidden, found.b, found.a))
    return Shaded(line, u, u_lit, hit, ray, edge_normal(hit, ray, active), K, active & dr.all(dr.isfinite(K)))


def shadow_gap(seer: Seer, c: Shaded, at: mi.Ray3f, u: mi.Point2f) -> mi.Float:
    """B: distance of the line to the emitter sample from the edge; differentiable in all that moves."""
    origin = seer.moved(at)
    light, _ = c.line.emitter.sample_direction(origin, u, c.active)
    return outline_gap(c.n, origin.p, light.d, c.hit, c.ray, c.active)


def shadow_weight(seer: Seer, c: Shaded) -> mi.Spectrum:
    """K in full: with the derivative of B along the line.

    Lamps with a texture are sampled by texels, between which the sample jumps: what it jumps over is no edge.
    """

    def gap(u: mi.Point2f) -> mi.Float:
        return shadow_gap(seer, c, seer.at.ray, u)

    slope = derivative_by_place(c.u, gap)
    passed, expected = dr.detach(gap(c.u_lit) - gap(c.u)), dr.dot(slope, c.u_lit - c.u)
    jumps = dr.abs(passed - expected) > dr.abs(expected) + ROUNDING * c.hit.t
    return c.line.passed(c.K, slope, c.active & ~jumps)


@dataclass
class Hiding:
    """A crossing on an arc: one surface hides another."""

    edge: mi.PreliminaryIntersection3f  # of the one that hides
    near: mi.PreliminaryIntersection3f  # what the direction at its side hits: it, or a null boundary before it
    far: mi.PreliminaryIntersection3f  # may be none
    d_near: mi.Vector3f
    d_far: mi.Vector3f
    n: mi.Vector3f  # from near to far
    K_near: mi.Spectrum
    K_far: mi.Spectrum
    active: mi.Bool


def arc_edges(walk: Walk, x: Chosen, seer: Seer, lines: int, l: float, key: mi.UInt32, pick: mi.PCG32) -> Hiding:
    """Find an edge between two surfaces among the directions in which x scatters, and weigh both sides. Detached."""

    def draw(j: mi.UInt32) -> tuple[Arc, mi.Bool]:
        numbers = Counted(key, 0x100 + 8 * j)
        c, pdf, ok = seer.sample(numbers.next_1d(), numbers.next_2d())
        turn = dr.two_pi * numbers.next_1d()
        w = mi.Frame3f(c).to_world(mi.Vector3f(dr.cos(turn), dr.sin(turn), 0))
        return Arc(c, w, pdf, mi.Float(-0.5 * l), mi.Float(0.5 * l)), ok

    def look(line: Arc, t: mi.Float, active: mi.Bool) -> Sight:
        ray = seer.origin.spawn_ray(line.at(t))
        first = seer.hit(ray, active)
        seen = seer.behind(ray, first, active)
        at = seen.compute_surface_interaction(ray, mi.RayFlags.Minimal, active)
        place = place_met(walk, seen, active, facets=False)
        if walk.media is not None:  # directions follow null boundaries, too
            place = mixed(place, place_met(walk, first, active, facets=False))
        return Sight(place, at.p, at.n)

    found = bisect(look, search(draw, look, lines, pick), pick)
    line, active = found.line, found.weight > 0
    rays = [seer.origin.spawn_ray(line.at(t)) for t in (found.a, found.b)]
    firsts = [seer.hit(ray, active) for ray in rays]
    edges, through = firsts, mi.Bool(False)
    if walk.media is not None:  # the edge of what was met first or, where that is one null boundary, of what is behind
        behind = [seer.behind(ray, first, active) for ray, first in zip(rays, firsts, strict=True)]
        places = [place_met(walk, first, active, facets=False) for first in firsts]
        through = (places[0] == places[1]) & firsts[0].is_valid() & is_null(firsts[0].shape.bsdf())
        edges = [dr.select(through, seen, first) for seen, first in zip(behind, firsts, strict=True)]
    near_a = edges[0].t <= edges[1].t
    edge = dr.select(near_a, *edges)
    near, far = dr.select(near_a, *firsts), dr.select(near_a, *firsts[::-1])
    ray_near, ray_far = dr.select(near_a, *rays), dr.select(near_a, *rays[::-1])
    active &= edge.is_valid()

    n = edge_normal(edge, ray_near, active)
    n = dr.select(dr.dot(n, ray_far.d - ray_near.d) < 0, -n, n)
    f, pdf = seer.towards(ray_far.d, active)
    common = x.β * f * (0.5 * dr.pi / (l * lines) * found.weight / line.pdf)
    active &= dr.any(common != 0)
    arrivals, depth = [seer.arrival(ray_near, near, pdf), seer.arrival(ray_far, far, pdf)], x.depth + 1
    T, arrivals = seer.onward(arrivals, SHORT_OF * edge.t, key, active & through)
    K = []
    for arrival in arrivals:
        path = PathState(arrival, mi.Spectrum(1), None, mi.Float(1), depth, active & (depth < walk.max_depth))
        L, _ = walk_on(walk, Counted(key, mi.UInt32(0x20000)), path)
        K.append(dr.select(active, common * T * L, 0))
    return Hiding(edge, near, far, ray_near.d, ray_far.d, n, K[0], K[1], active)


def hiding_motion(walk: Walk, seer: Seer, c: Hiding, at: mi.Ray3f) -> mi.Spectrum:
    """What the edge sweeps that the directions at its sides do not follow; differentiable in all that moves."""
    origin = seer.moved(at)
    lengths = walk.traits.tables.blend_lengths
    edge = held_direction(origin, c.d_near, c.edge, c.active)
    d_near, _ = moved_direction(lengths, origin, c.d_near, c.near, seer.holds(c.near, c.active))
    d_far, _ = moved_direction(lengths, origin, c.d_far, c.far, seer.holds(c.far, c.active))
    swept = c.K_near * dr.dot(c.n, edge - d_near) - c.K_far * dr.dot(c.n, edge - d_far)
    return dr.select(c.active, swept, 0)


def inner_edges(
    walk: Walk,
    places: Places,
    lane: mi.UInt32,
    seed: mi.UInt32,
    lines: int,
    lengths: tuple[float, float],
    W: Importance,
) -> Edges:
    """Find an edge that a vertex sees in each lane, by ``lines`` lines of each kind. Detached.

    ``lengths`` are those in the square and on the sphere (radians). ``W`` (place, ray) -> Spectrum is what light counts
    that arrives at a place of the film: it decides which paths are worth looking at.
    """
    walk = replace(walk, max_depth=min(walk.max_depth, deepest(walk)))
    key = mixed(mixed(lane, seed), mi.UInt32(0x2545F491))
    pick = mi.PCG32(dr.width(lane), initstate=seed + 1, initseq=lane)
    s = quasi_random(lane, seed) * places.size
    ray0, weight = dr.detach(places.ray(s, key))
    layout = Layout.of(walk, True)
    records = dr.alloc_local(record_type(layout), room_for(walk))
    β = weight * dr.opaque(mi.Float, places.size.x * places.size.y / dr.width(lane))
    records, x = choose_vertex(walk, Counted.of(key), ray0, W(s, ray0), layout, records)
    x.β *= β

    square, arc = lengths
    seer = Seer(walk, x.at, x.flight, x.active)
    shaded = emitter_edges(walk, x, seer, lines, square, key ^ 0x1B873593, pick)
    K = shadow_weight(seer, shaded)
    hiding = arc_edges(walk, x, seer, lines, arc, key ^ 0x38B34AE5, pick)

    def motion(ray: mi.Ray3f) -> mi.Spectrum:
        return hiding_motion(walk, seer, hiding, ray) - K * shadow_gap(seer, shaded, ray, shaded.u)

    k = dr.select(x.active, x.k, 0)
    return Edges(s, key, k, x.at.ray, layout, records, motion)
