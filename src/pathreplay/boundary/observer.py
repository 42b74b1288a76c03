"""The observer, the vertex of a path that sees an edge: its selection, its motion and its scattering.

The observer is a point on a surface or, in a medium, a real collision.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.record import Layout, record, room_for
from pathreplay.platform import compat
from pathreplay.samplers.counter_sampler import CounterSampler
from pathreplay.samplers.streams import Stream
from pathreplay.transport import arrive, scatter
from pathreplay.transport.facts.traits import is_null
from pathreplay.transport.meet import meet
from pathreplay.transport.motion import may_move, may_turn
from pathreplay.transport.path import PathState
from pathreplay.transport.signature import place_met, shape_met
from pathreplay.transport.start import CameraStart, behind_emitters
from pathreplay.transport.surface import met
from pathreplay.transport.velocity import moved_direction
from pathreplay.transport.vertex import Arrival, Flight, SampledStep, TraceConfig, channel_mean, is_smooth
from pathreplay.transport.volume.media import carried, extinction_of, span
from pathreplay.transport.volume.passage import (
    further,
    is_boundary,
    skip_null,
    transmittance_past_edge,
    transmittance_up_to,
)

Largest = TypeVar("Largest", float, "mi.Float")

NEAR = 10.0
"""Smallest usable distance of an edge, in units of the offset of ray origins. The offset then turns a ray by at most
0.1 radians."""


def omitted_distance(largest: Largest) -> Largest:
    """Return the distance up to which edges are left out, for a surface point with this ``largest`` coordinate."""
    return NEAR * mi.math.RayEpsilon * (1 + largest)


def may_see(trace: TraceConfig, at: Arrival, step: SampledStep) -> tuple[mi.Bool, mi.Spectrum]:
    """Return the lanes whose vertex has a smooth lobe or is a collision in a medium, and a weight (Spectrum).

    The weight belongs to the sampled distance between the previous vertex and this vertex: see `Flight.weight`.
    """
    if trace.media is None:
        return surface_sees(trace, at), mi.Spectrum(1)
    flight = step.kept.media.flight
    return surface_sees(trace, at) | flight.event, flight.weight


def surface_sees(trace: TraceConfig, at: Arrival) -> mi.Bool:
    """Return the lanes whose path arrived at a surface with a smooth lobe."""
    valid = at.hit.is_valid()
    return valid & is_smooth(shape_met(trace, at.hit, at.ray, valid).bsdf())


@dataclass
class SelectedVertex:
    """The vertex of a camera path from which edges are searched."""

    at: Arrival
    k: mi.UInt32  # number of records before the vertex
    depth: mi.UInt32  # number of vertices before this one, without null boundaries
    β: mi.Spectrum  # throughput before the vertex, divided by the selection probability
    mass: mi.Float  # the selection probability is proportional to this value
    moves: mi.Bool  # this or an earlier vertex may move
    active: mi.Bool
    flight: Flight | None = None  # flight to the vertex; None in scenes without media


@dr.syntax
def choose_vertex(
    trace: TraceConfig,
    sampler: CounterSampler,
    ray: mi.Ray3f,
    flows: mi.Bool,
    shares: mi.Float,
    layout: Layout | None,
    records: Any,
) -> tuple[Any, SelectedVertex]:
    """Trace a camera path, and select one of the vertices that `may_see` an edge.

    The selection probability is proportional to the throughput and to the vertex's entry in ``shares``. The index of
    the entry is the number of preceding vertices. Vertices beyond the end of ``shares`` have the last entry.

    In lanes with ``flows`` (see `FilmDomain`), the camera ray may move, so that all vertices count as moving. Vertices
    are written to ``records`` unless ``records`` is None. A path with `max_depth` vertices scatters no light at its
    last vertex, which is therefore not traced. If all paths therefore end at their first vertex, this vertex has no
    predecessors, and None is returned in place of the records.
    """
    room, trace = room_for(trace), replace(trace, max_depth=max(trace.max_depth - 1, 0))
    path = PathState.begin(trace, CameraStart(ray, sampler, mi.Bool(True)))
    if dr.hint(trace.max_depth == 1 and trace.media is None, mode="scalar"):
        return None, _first_vertex(trace, path, flows)
    none, no = mi.UInt32(0), mi.Bool(False)
    flight = None if trace.media is None else Flight.none(trace.media)
    chosen = SelectedVertex(path.at, none, mi.UInt32(0), mi.Spectrum(0), mi.Float(0), no, mi.Bool(False), flight)
    mass = mi.Float(0)
    count = mi.UInt32(0)
    moves = mi.Bool(flows)
    while dr.hint(path.active, exclude=[trace, layout, shares, room], label="pathreplay: choose a vertex"):
        choice = sampler.next_1d()
        u, step = path.choose(trace, sampler)
        scatters, w = may_see(trace, path.at, step)
        share = dr.gather(mi.Float, shares, dr.minimum(count, len(shares) - 1), path.active)
        m = dr.select(path.active & scatters, share * channel_mean(dr.abs(path.β * w)), 0)
        mass += m
        moves |= may_move(trace, path.at.hit)
        take = (m > 0) & (choice * mass < m)
        flight = None if trace.media is None else step.kept.media.flight
        chosen = dr.select(
            take, SelectedVertex(path.at, count, path.depth, path.β * w, m, moves, mi.Bool(True), flight), chosen
        )
        moves |= may_turn(trace, path.at.hit)
        onward, v = path.advance(trace, u, step)
        if dr.hint(records is not None, mode="scalar"):
            assert layout is not None
            records[count] = record(layout, v)
        path = onward
        count += 1
        if dr.hint(trace.media is not None, mode="scalar"):  # null boundaries may fill the record
            path.active &= count < room
    chosen.β *= mass / dr.maximum(chosen.mass, dr.smallest(mi.Float))
    return records, chosen


def _first_vertex(trace: TraceConfig, path: PathState, flows: mi.Bool) -> SelectedVertex:
    """Return the first vertex of a path. It is the only candidate, and the path is not traced further."""
    at, none = path.at, mi.UInt32(0)
    active = path.active & surface_sees(trace, at)
    return SelectedVertex(
        at, none, none, dr.select(active, path.β, 0), mi.Float(1), flows | may_move(trace, at.hit), active
    )


class ObserverVertex:
    """The vertex that sees an edge. All attributes are detached; `moved` returns the vertex with derivatives."""

    def __init__(self, trace: TraceConfig, vertex: SelectedVertex) -> None:
        self.trace, self.selected = trace, vertex
        self.at, self.flight, self.active = at, flight, active = vertex.at, vertex.flight, vertex.active
        self.origin: mi.Interaction3f
        self.si: mi.SurfaceInteraction3f
        if trace.media is None:
            self.origin = self.si = at.hit.compute_surface_interaction(at.ray, compat.shading(), active)
        else:
            # With a given flight, no random numbers are needed, and the sampler may be None.
            self.vertex = arrive.choose(trace, at, None, mi.Spectrum(1), active, flight)  # type: ignore[arg-type]
            self.si, self.origin, self.event = self.vertex.si, self.vertex.origin, self.vertex.inside.event
        # In lanes with `keeps_direction`, sampled directions are fixed, and creases count as edges.
        self.keeps_direction = scatter.keeps_direction(trace, self.si, active)
        if trace.holds_collisions:
            self.keeps_direction |= self.event

    def moved(self, ray: mi.Ray3f) -> mi.Interaction3f:
        """Return the vertex, differentiable in the arriving ``ray`` and in the surface or medium.

        A collision in a medium moves as in `fly_again`.
        """
        si = met(self.at.hit, ray, self.active)
        if self.flight is None:
            return si
        a, b = span(self.at.medium, ray, dr.select(si.is_valid(), si.t, dr.inf), self.event)
        κ = extinction_of(self.trace.media, self.at.medium, ray, self.event)
        t, _ = carried(self.flight.t, a, b, self.event, κ)
        origin = mi.Interaction3f(self.origin)
        origin.p = dr.select(self.event, ray.o + t * ray.d, si.p)
        origin.n = dr.select(self.event, 0, si.n)
        return origin

    def towards(self, d: mi.Vector3f, active: mi.Bool) -> tuple[mi.Spectrum, mi.Float]:
        """Evaluate BSDF or phase function for light from ``d`` (Spectrum), and the density of sampling ``d``."""
        ctx, si = mi.BSDFContext(), self.si
        if self.trace.media is None:
            return si.bsdf().eval_pdf(ctx, si, si.to_local(d), active)
        return scatter.towards(self.vertex, ctx, d, active)

    def sample(self, lobe: mi.Float, u: mi.Point2f) -> tuple[mi.Vector3f, mi.Bool]:
        """Sample a scattering direction; the mask excludes delta lobes and failed samples."""
        si, active = self.si, self.active
        surface = active if self.trace.media is None else active & self.vertex.surface
        sample, _ = si.bsdf().sample(mi.BSDFContext(), si, lobe, u, surface)
        d, pdf, delta = si.to_world(sample.wo), sample.pdf, mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
        if self.trace.media is not None:
            inside, phase = self.vertex.inside, mi.PhaseFunctionContext(None)
            wo, _, pdf_wo = inside.phase.sample(phase, inside.mei, lobe, u, active & self.event)
            d, pdf, delta = dr.select(self.event, wo, d), dr.select(self.event, pdf_wo, pdf), delta & ~self.event
        return d, active & (pdf > 0) & ~delta

    def may_scatter(self, d: mi.Vector3f) -> mi.Bool:
        """Return whether light from ``d`` may be scattered: ``d`` is on the incident side, or the BSDF transmits."""
        above = mi.Frame3f.cos_theta(self.si.to_local(d)) * mi.Frame3f.cos_theta(self.si.wi) > 0
        both = above | mi.has_flag(self.si.bsdf().flags(), mi.BSDFFlags.Transmission)
        return both if self.trace.media is None else both | self.event

    def separates(self, a: mi.Vector3f, b: mi.Vector3f) -> mi.Bool:
        """Return whether the plane of the observer's own triangle separates two directions.

        With interpolated shading normals, a vertex also scatters light from below that plane, where its own shape
        occludes all emitters.
        """
        n = self.si.n
        between = dr.dot(n, a) * dr.dot(n, b) < 0
        return between if self.trace.media is None else between & ~self.event

    def is_far(self, t: mi.Float) -> mi.Bool:
        """Return whether a distance is much larger than the offset of ray origins from their surface.

        Hits at smaller distances have inaccurate positions or are artefacts of rounding. Their reciprocal distance is
        unbounded.
        """
        return t > omitted_distance(dr.max(dr.abs(self.origin.p)))

    def holds(self, hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f, active: mi.Bool) -> mi.Bool:
        """Return whether the direction of ``ray``, from the observer to ``hit``, follows the hit point.

        A direction from a point in a medium follows the hit point only if that surface scatters or emits light: see
        `scatter`.
        """
        active = active & ~self.keeps_direction & ~scatter.is_seen_through(self.trace, hit, ray)
        if self.trace.media is None:
            return active
        shape = shape_met(self.trace, hit, ray, active)
        seen = is_smooth(shape.bsdf()) | (shape.emitter() != None)  # noqa: E711 (an array of pointers)
        return active & (~self.event | seen)

    def moved_ray(
        self, at: mi.Interaction3f, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, active: mi.Bool
    ) -> mi.Ray3f:
        """Return ``ray``, from the vertex to ``hit``, with the derivatives that it has in the interior term.

        It is differentiable in ``at``, the vertex (see `moved`), and in the shape that was hit.
        """
        holds = self.holds(hit, ray, active)
        d, _ = moved_direction(self.trace.traits.tables.blend_lengths, at, ray.d, hit, holds)
        moved = mi.Ray3f(ray)
        moved.o, moved.d = at.spawn_ray(dr.detach(d)).o, d
        return moved

    def hit(self, ray: mi.Ray3f, active: mi.Bool) -> mi.PreliminaryIntersection3f:
        return meet(self.trace, ray, active)

    def behind(self, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, active: mi.Bool) -> mi.PreliminaryIntersection3f:
        """Return a ray's first hit that is not on a null boundary; ``hit`` is the ray's first hit on any surface."""
        return hit if self.trace.media is None else skip_null(self.trace, ray, hit, active)

    def edge_surfaces(
        self, rays: list[mi.Ray3f], firsts: list[mi.PreliminaryIntersection3f], active: mi.Bool
    ) -> tuple[list[mi.PreliminaryIntersection3f], mi.Bool]:
        """Return the hits that form the edge between two rays, and a mask.

        The mask contains the lanes in which both rays first hit the same null boundary. In these lanes, the result has
        the hits behind the boundary. In all other lanes, it has the first hits ``firsts``.
        """
        if self.trace.media is None:
            return firsts, mi.Bool(False)
        shapes = [shape_met(self.trace, first, ray, active) for ray, first in zip(rays, firsts, strict=True)]
        places = [
            place_met(self.trace, *met, facets=False) for met in zip(firsts, (active, active), shapes, strict=True)
        ]
        through = (places[0] == places[1]) & firsts[0].is_valid() & is_null(shapes[0].bsdf())
        pairs = zip(rays, firsts, strict=True)
        return [dr.select(through, self.behind(ray, first, active), first) for ray, first in pairs], through

    def medium(self, d: mi.Vector3f) -> mi.MediumPtr:
        """Return the medium in direction ``d``; None in scenes without media."""
        if self.trace.media is None:
            return None  # `Arrival.medium` is also None in such scenes
        return self.vertex.medium(d)

    def arrival(self, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, pdf: mi.Float) -> Arrival:
        """Return the arrival at ``hit`` of a path that continues from the observer along ``ray``."""
        unsampled = mi.Bool(False)
        if self.trace.media is not None:
            unsampled = self.event & ~self.at.medium.use_emitter_sampling()
        at = Arrival(ray, hit, pdf, unsampled, mi.Bool(False))
        if self.trace.without_caustics:
            at.scattered = self.at.scattered | ((self.selected.depth == 0) & ~unsampled)
        return at if self.trace.media is None else replace(at, medium=self.medium(ray.d), behind=mi.Float(0))

    def transmittance_past_edge(
        self, light: mi.DirectionSample3f, t: mi.Float, key: mi.UInt32, active: mi.Bool
    ) -> mi.Spectrum:
        """Estimate the transmittance to an emitter sample. The shadow ray passes an edge at distance ``t``.

        The result is zero if the medium does not use emitter sampling.
        """
        if self.trace.media is None:
            return mi.Spectrum(1)
        needed = active & (~self.event | self.at.medium.use_emitter_sampling())
        ray = self.origin.spawn_ray_to(light.p)
        T = transmittance_past_edge(
            self.trace, ray, t, self.medium(light.d), CounterSampler.stream(key, Stream.TRANSMITTANCE_PAST_EDGE), needed
        )
        return dr.select(needed, T, 0)

    def onward(
        self, arrivals: list[Arrival], t: mi.Float, key: mi.UInt32, active: mi.Bool
    ) -> tuple[mi.Spectrum, list[Arrival]]:
        """Return the transmittance up to distance ``t``, and the arrivals of rays that continue from there.

        Each returned ray starts at distance ``t`` on the ray of one of the ``arrivals``. In lanes that are not
        ``active``, the transmittance is 1, and the arrivals are unchanged.
        """
        if self.trace.media is None:
            return mi.Spectrum(1), arrivals
        sampler = CounterSampler.stream(key, Stream.TRANSMITTANCE_TO_EDGE)
        T, medium = transmittance_up_to(self.trace, arrivals[0].ray, t, arrivals[0].medium, sampler, active)
        T = dr.select(active, T, 1)
        return T, [dr.select(active, arrival_beyond(self.trace, at, t, medium, active), at) for at in arrivals]


def arrival_beyond(trace: TraceConfig, at: Arrival, t: mi.Float, medium: mi.MediumPtr, active: mi.Bool) -> Arrival:
    """Continue the ray of ``at`` from distance ``t`` on, inside ``medium``; return the `Arrival` at the next hit.

    The next hit is a null boundary, or the hit of ``at``. A new search would not always find the latter: rounding moves
    the rest of a ray sideways, and two rays that enclose an edge may then meet the same surface.
    """
    ray, known = further(at.ray, t), mi.PreliminaryIntersection3f(at.hit)
    known.t -= t
    hit = meet(trace, ray, active)
    if trace.hide_emitters and trace.to_sensor is None:
        hit = behind_emitters(trace, ray, hit, active & at.camera)
    ahead = is_boundary(trace, hit, ray, active) & (hit.t < known.t)
    behind = (known.t <= 0) | is_boundary(trace, at.hit, at.ray, active)
    return replace(at, ray=ray, hit=dr.select(ahead | behind, hit, known), medium=medium, behind=t)
