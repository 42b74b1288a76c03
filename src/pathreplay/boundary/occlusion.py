"""Edges between surfaces, seen from a vertex in directions that its BSDF or phase function samples.

The edges are searched on arcs of directions (see `arcs`). An edge crosses an arc if different surfaces, or different
sheets of one surface, are visible at its ends. The edge is an outline, a crease or the boundary of a hard shadow.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import derivative_by_ray
from pathreplay.adjoint.primal import two_radiances
from pathreplay.boundary.arcs import Arc
from pathreplay.boundary.creases import Crease, off_contact
from pathreplay.boundary.crofton import Bracket, VisibilityProbe, bisect, probe_positions, survey
from pathreplay.boundary.edges import Crossing
from pathreplay.boundary.hard_shadows import HardShadow, ShadowTest
from pathreplay.boundary.importance import DIM, Importance, closeness, own_plane
from pathreplay.boundary.observer import ObserverVertex
from pathreplay.platform import compat
from pathreplay.samplers.counter_sampler import CounterSampler
from pathreplay.samplers.streams import Stream
from pathreplay.transport.motion import may_move
from pathreplay.transport.path import PathState
from pathreplay.transport.signature import edge_normal, mixed, place_met, shape_met, turned_away
from pathreplay.transport.velocity import held_direction, jumps_at_facets
from pathreplay.transport.volume.passage import SHORT_OF


class ArcSegment(Arc):
    """An arc with visibility probes."""

    @property
    def hard(self) -> bool:
        """Whether hard shadows are probed."""
        return self.observer.trace.traits.hard_lights

    def probe(self, t: mi.Float, active: mi.Bool) -> VisibilityProbe:
        return self._probe(t, active, self.hard)

    def _probe(self, t: mi.Float, active: mi.Bool, hard: bool) -> VisibilityProbe:
        observer, trace, x = self.observer, self.observer.trace, self.observer.selected
        ray = observer.origin.spawn_ray(self.at(t))
        first = observer.hit(ray, active & observer.may_scatter(ray.d))
        seen = observer.behind(ray, first, active)
        counts, moves = self._counts(seen), x.moves | may_move(trace, seen)
        close = active & counts  # lanes in which the surface is evaluated
        if trace.media is None:
            close &= moves
        at = seen.compute_surface_interaction(ray, compat.shading_frame(), close)
        if not trace.traits.copies:
            at.shape = seen.shape
        turned = dr.select(turned_away(at, ray.d), mi.UInt32(1), 0)
        place = dr.select(
            observer.keeps_direction, *(place_met(trace, seen, active, at.shape, facets) for facets in (True, False))
        )
        lengths = trace.traits.tables.blend_lengths
        facets = close & ~observer.keeps_direction & jumps_at_facets(lengths, observer.origin, seen, at.p, at.n)
        place = mixed(place, dr.select(facets, seen.prim_index + 1, 0))
        near = closeness(trace, seen)
        if trace.media is not None:
            # Directions may follow their hit points on a moving null boundary (see `ObserverVertex.holds`). The outline
            # of a null boundary is therefore an edge.
            boundary = place_met(trace, first, active, shape_met(trace, first, ray, active), facets=False)
            place, moves = mixed(place, boundary), moves | may_move(trace, first)
            near = dr.maximum(near, closeness(trace, first))
        if hard:
            shade = self._shadow_test(ray, seen, active)
            place, moves = mixed(place, dr.select(shade.dark, mi.UInt32(1), 0)), moves | may_move(trace, shade.hit)
        bright = dr.select(seen.is_valid(), DIM, mi.Float(trace.scene.environment() is not None))
        probe = VisibilityProbe(mixed(place, turned), at.p, at.n, moves, near, bright)
        # A hit from which no light may come has the signature 1, because 0 denotes the sky.
        dark = replace(VisibilityProbe.of(1), moves=moves, near=near, bright=bright)
        return dr.select(counts, probe, dark)

    def _counts(self, seen: mi.PreliminaryIntersection3f) -> mi.Bool:
        """Return whether light may come from a hit. Where a path has to end, the hit must be on an emitter."""
        trace = self.observer.trace
        if trace.media is not None:
            return mi.Bool(True)
        glows = dr.select(seen.is_valid(), seen.shape.emitter() != None, trace.scene.environment() is not None)  # noqa: E711
        return glows | (self.observer.selected.depth + 2 < trace.max_depth)

    def _shadow_test(self, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, active: mi.Bool) -> ShadowTest:
        """Test whether the light that `two_radiances` samples at the hit reaches the hit point."""
        sampler, depth = CounterSampler.stream(self.key, Stream.BEYOND_EDGE), self.observer.selected.depth
        arrival = self.observer.arrival(ray, hit, mi.Float(1))
        return ShadowTest.of(self.observer.trace, arrival, sampler, depth + 1, active)

    def detect(self) -> Importance:
        """Estimate the importance of an edge that crosses this arc."""
        light = self.light
        a, b, _ = probe_positions(self.length)
        found = survey(self.probe, self.length, self.active)
        found.presence *= self.importance()
        return Importance.of(found, light, light * own_plane(self.observer, self.at(a), self.at(b)) / self.longest)

    def resolve(self, weight: mi.Float, generator: mi.PCG32) -> list[Crossing]:
        """Locate the edge by bisection, and compute the weights of both of its sides: see `EdgeSearch.resolve`."""
        observer, trace = self.observer, self.observer.trace
        bracket = bisect(self.probe, self.length, dr.select(self.active, weight, 0), generator)
        active = bracket.weight > 0
        rays = [observer.origin.spawn_ray(self.at(t)) for t in (bracket.a, bracket.b)]
        firsts = [observer.hit(ray, active) for ray in rays]
        edges, through = observer.edge_surfaces(rays, firsts, active)
        near_a, shadow = edges[0].t <= edges[1].t, None
        if self.hard:
            a, b = (self._probe(t, active, hard=False) for t in (bracket.a, bracket.b))
            tests = [self._shadow_test(ray, hit, active) for ray, hit in zip(rays, edges, strict=True)]
            shadow = HardShadow.between(trace, tests[0], tests[1], active & ~a.differs(b))
            near_a = dr.select(shadow.exists, shadow.in_a, near_a)
        sides = zip(rays, firsts, edges, strict=True)
        near, far = (Side(*side) for side in sides)
        near, far = dr.select(near_a, near, far), dr.select(near_a, far, near)
        active = active & near.edge.is_valid() & observer.is_far(near.edge.t)
        crease = Crease.of(trace, (near.edge, near.ray), (far.edge, far.ray), shadow, active)
        edge = OcclusionEdge.of(observer, near, far, crease, active)
        K_near, K_far = self._weights(bracket, edge, near, far, through)
        return [HeldEdge(K_far - K_near, edge), MovedSide(K_near, edge, near), MovedSide(-K_far, edge, far)]

    def _weights(
        self, bracket: Bracket, edge: OcclusionEdge, near: Side, far: Side, through: mi.Bool
    ) -> tuple[mi.Spectrum, mi.Spectrum]:
        """Return the Crofton weights π/2 f / (l p(c)) of both sides (see `crofton`).

        f is the integrand on the near or on the far side. It is estimated with the same random numbers on both sides.
        """
        observer, trace, x, active = self.observer, self.observer.trace, self.observer.selected, edge.active
        f, pdf = observer.towards(far.ray.d, active)
        common = x.β * f * self.per_length(bracket, pdf, active)
        active = active & dr.any(common != 0)
        at_near, at_far = (observer.arrival(side.ray, side.hit, pdf) for side in (near, far))
        arrivals = off_contact(trace, at_near, at_far, active)
        depth, shadow = x.depth + 1, edge.crease.shadow
        # The light that is scattered into the rays before the edge cancels if directions move alike on both sides.
        alike = through | observer.keeps_direction
        alike = alike if shadow is None else alike | shadow.exists
        T, arrivals = observer.onward(arrivals, SHORT_OF * near.edge.t, self.key, active & alike)
        go_on, sampler = active & (depth < trace.max_depth), CounterSampler.stream(self.key, Stream.BEYOND_EDGE)
        paths = [PathState(arrival, mi.Spectrum(1), None, mi.Float(1), depth, go_on) for arrival in arrivals]
        L = list(two_radiances(trace, sampler, *paths))
        if shadow is not None:  # the near side is dark, and the far side is too close to it for another test
            L[1] = dr.select(shadow.exists, L[0] + shadow.scattered(trace, arrivals[1], self.key, active), L[1])
        K_near, K_far = (dr.select(active, common * T * side, 0) for side in L)
        return K_near, K_far


@dataclass
class Side:
    """One side of an edge."""

    ray: mi.Ray3f
    hit: mi.PreliminaryIntersection3f  # may be a miss
    edge: mi.PreliminaryIntersection3f  # hit at the edge: `hit`, or the next hit if both sides share a null boundary


@dataclass
class OcclusionEdge:
    """An edge between two directions from a vertex, towards its near and its far side.

    The normal ``n`` of the edge points from the near side to the far side.
    """

    observer: ObserverVertex
    near: Side
    crease: Crease
    own: mi.Bool  # the edge is in the plane of the observer's own triangle
    n: mi.Vector3f
    slope: mi.Float  # derivative of B along n at a crease, else 1
    active: mi.Bool

    @staticmethod
    def of(observer: ObserverVertex, near: Side, far: Side, crease: Crease, active: mi.Bool) -> OcclusionEdge:
        """Classify the edge between two sides, and compute its normal. The result is detached."""
        own, d = observer.separates(near.ray.d, far.ray.d), near.ray.d
        shadow = mi.Bool(False) if crease.shadow is None else crease.shadow.exists
        edge = OcclusionEdge(observer, near, crease, active & ~shadow & own, observer.si.n, mi.Float(1), active)
        slope = derivative_by_ray(near.ray, lambda ray: edge.crease_gap(ray, observer.si.n)).d
        slope -= dr.dot(slope, d) * d
        is_bent = edge.is_crease & (dr.squared_norm(slope) > 0)
        n = dr.select(is_bent, dr.normalize(slope), edge_normal(near.edge, near.ray, active))
        n = dr.select(dr.dot(n, far.ray.d - d) < 0, -n, n)
        return replace(edge, n=n, slope=dr.select(is_bent, dr.dot(slope, n), 1), active=active & (is_bent | ~shadow))

    @property
    def is_crease(self) -> mi.Bool:
        """Whether no surface occludes another at the edge."""
        return self.own | self.crease.exists

    def crease_gap(self, ray: mi.Ray3f, n: mi.Normal3f) -> mi.Float:
        """Evaluate B (see `edges`), which is zero on the crease.

        ``n`` is the normal of the observer's triangle. It is used if the edge lies in the plane of this triangle.
        """
        return dr.select(self.own, dr.dot(n, ray.d), self.crease.gap(ray, self.active & ~self.own))


@dataclass
class HeldEdge:
    """The `Crossing` for the motion V_edge of the edge in the boundary term of `secondary`.

    The direction to the edge follows a point of the near surface.
    """

    weight: mi.Spectrum
    edge: OcclusionEdge

    def gap(self, at: mi.Interaction3f) -> mi.Float:
        """Evaluate B = n·d for the direction d to the edge. The derivative of B is n·V_edge. At a crease, B is 0."""
        e = self.edge
        d = held_direction(at, e.near.ray.d, e.near.edge, e.active)
        return dr.select(e.active & ~e.is_crease, dr.dot(e.n, d), 0)


@dataclass
class MovedSide:
    """The `Crossing` for the motion V_near or V_far of sampled directions on one side of an edge: see `secondary`.

    The interior term moves the sampled directions in the same way.
    """

    weight: mi.Spectrum
    edge: OcclusionEdge
    side: Side

    def gap(self, at: mi.Interaction3f) -> mi.Float:
        """Evaluate B = n·d, whose derivative is n·V.

        At a crease, B is `OcclusionEdge.crease_gap` divided by `OcclusionEdge.slope`.
        """
        e = self.edge
        ray = e.observer.moved_ray(at, self.side.ray, self.side.hit, e.active)
        return dr.select(e.active, dr.select(e.is_crease, e.crease_gap(ray, at.n) / e.slope, dr.dot(e.n, ray.d)), 0)
