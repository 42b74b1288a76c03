"""Secondary boundary term, second part: edges that surface points see in mirrors or through glass.

At a scattering vertex x, light arrives from a direction ω through a chain of delta lobes. When parameters change, the
interior term moves ω with a velocity V (see `secondary`), and the chain moves with ω. The radiance from ω jumps by
f_a - f_b at an edge that lies behind the chain. The boundary term of the scattered radiance J is

    dJ/dπ = - Σ K dB/dπ,    K = π/2 · (f_a - f_b) / (l p(c)) · sgn(w·∂B/∂ω) / |∂B/∂ω|,

summed over the crossings of arcs with edges, as on the film (see `primary`). B is a function of the last ray of the
chain. The path to this ray is recorded from the camera on. It contains x, from which it continues in the direction ω.
Its replay therefore moves ω with V. Arcs of directions are drawn as in `occlusion`. Edges on the first surface that x
sees are not counted here, because `secondary` contains them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import NonFiniteCounter, derivative_by_ray
from pathreplay.adjoint.record import Layout, record, record_type, recordable, room_for
from pathreplay.adjoint.two_passes import PathAdjoint, RecordedPath, sweep_path
from pathreplay.boundary.arcs import Arc
from pathreplay.boundary.chains import NEVER, probe_chain, split_chains
from pathreplay.boundary.creases import off_contact
from pathreplay.boundary.crofton import VisibilityProbe, bisect, crossing_weight, detect
from pathreplay.boundary.edges import EdgePath, Edges, FilmDomain
from pathreplay.boundary.importance import UNFORESEEN, finite, repeated
from pathreplay.boundary.observer import ObserverVertex
from pathreplay.boundary.search import EdgeSearch, SegmentDensity
from pathreplay.boundary.searches.primary import ChainEdge, FilmCrossing, Sides, behind_edges, jump_between
from pathreplay.boundary.searches.secondary import UNGUIDED, CameraPath
from pathreplay.samplers.counter_sampler import CounterSampler, key_of, quasi_random
from pathreplay.samplers.streams import Stream
from pathreplay.transport.path import PathState
from pathreplay.transport.start import CameraStart
from pathreplay.transport.vertex import TraceConfig, channel_mean

EVERY, ARCS = 4, 8
"""The search has 1 / `EVERY` of the usual number of paths, with `ARCS` arcs around a vertex of each. Tracing a path
costs more than probing an arc."""


class ChainArc(Arc):
    """An arc of directions that are continued through delta lobes."""

    @property
    def chain(self) -> TraceConfig:
        """The configuration of chains. Russian roulette would end neighbouring chains at different depths."""
        return replace(self.observer.trace, rr_depth=NEVER)

    @property
    def chain_key(self) -> mi.UInt32:
        return Stream.CHAINS.of(self.key)

    def path(self, t: mi.Float, pdf: mi.Float, active: mi.Bool) -> PathState:
        """Return the path from the vertex in the direction at ``t``, which has the density ``pdf``."""
        observer, x = self.observer, self.observer.selected
        ray = observer.origin.spawn_ray(self.at(t))
        active = active & observer.may_scatter(ray.d)
        at = observer.arrival(ray, observer.hit(ray, active), pdf)
        return PathState(at, mi.Spectrum(1), None, mi.Float(1), x.depth + 1, active)

    def probe(self, t: mi.Float, active: mi.Bool) -> VisibilityProbe:
        path, moves = self.path(t, mi.Float(1), active), self.observer.selected.moves
        return probe_chain(self.chain, path, self.chain_key, moves, from_vertex=True)

    def importance_of_edges(self) -> mi.Float:
        """Estimate the importance of an edge that crosses this arc.

        The sampled direction may be outside of a narrow lobe that the arc crosses. The importance therefore does not
        depend on the scattering in this direction alone.
        """
        presence = detect(self.probe, self.length, self.active) * self.importance()
        light = self.light + UNFORESEEN * channel_mean(dr.abs(self.observer.selected.β))
        return finite(dr.select(self.active, presence * light, 0))

    def tangent(self, t: mi.Float) -> mi.Vector3f:
        """Return the direction of the arc at ``t``."""
        return self.w * dr.cos(t) - self.c * dr.sin(t)


@dataclass(frozen=True)
class SecondaryChainSearch(EdgeSearch[CameraPath]):
    """Edge search from path vertices, in directions that lead through delta lobes. For scenes without media."""

    length: float  # of arcs, in radians

    bisection = Stream.BISECT_CHAINS

    @staticmethod
    def of(trace: TraceConfig, film: FilmDomain, length: float) -> SecondaryChainSearch:
        return SecondaryChainSearch(recordable(trace), film, SegmentDensity.uniform(film.size, 0.0), length)

    def find(self, n: int, closer: int, seed: mi.UInt32) -> Iterator[Edges]:
        return super().find(max(n // EVERY, 1), max(closer // EVERY, 1), seed)

    @staticmethod
    def applies_to(trace: TraceConfig) -> bool:
        """Return whether a scene may have such edges and they can be searched.

        If smooth lobes are sampled attached, the replay of a vertex would not continue in the direction to the edge.
        """
        return bool(trace.traits.mirrors) and trace.media is None and trace.max_depth > 2 and not trace.follows

    def guided(self, n: int, seed: mi.UInt32) -> SecondaryChainSearch:
        """Refine the density of film positions with a pilot pass (see `EdgeSearch`)."""
        pilot = self.pilot(n, seed)
        importance = self.detect(pilot)
        s = mi.Point2f(*(repeated(x, importance) for x in pilot.s))
        return replace(self, density=self.density.refined(s, dr.select(importance > 0, mi.Float(1), 0), UNGUIDED))

    def draw(self, i: mi.UInt32, number: mi.UInt32, n: int, seed: mi.UInt32) -> CameraPath:
        s, density = self.density.draw(*quasi_random(i, n, Stream.CHAIN_CENTRES.of(seed)))
        return CameraPath(s, density, key_of(i, Stream.CHAIN_KEYS.of(seed)), number)

    def detect(self, segments: CameraPath) -> mi.Float:
        """Return the importance of the first arc of each path, then of the second arc of each path, and so on."""
        n = dr.width(segments.key)
        importance = dr.zeros(mi.Float, n * ARCS)
        self._detect_arcs(self._observer(segments), segments, n, importance)
        dr.eval(importance)
        return importance

    def resolve(self, segments: CameraPath, weight: mi.Float, generator: mi.PCG32) -> Edges:
        arc = self._arc(self._observer(segments), segments)
        trace, chain, x, key = self.trace, arc.chain, arc.observer.selected, arc.chain_key
        bracket = bisect(arc.probe, arc.length, dr.select(arc.active, weight, 0), generator)
        active = bracket.weight > 0
        d_a, d_b = arc.at(bracket.a), arc.at(bracket.b)
        f, pdf = arc.observer.towards(d_a, active)
        paths = arc.path(bracket.a, pdf, active), arc.path(bracket.b, pdf, active)
        split = split_chains(chain, paths, key)
        first = x.depth + 1  # number of vertices before the chain
        active = active & arc.observer.is_far(paths[0].at.hit.t) & split.parted & (split.k > first)
        edge = ChainEdge.of(chain, split, active)
        shadow, (a, b) = edge.crease.shadow, off_contact(chain, split.a, split.b, edge.active)
        lit = split.a if shadow is None else dr.select(shadow.in_a, split.b, split.a)
        sides = Sides(a, b, mi.UInt32(split.k), shadow, lit, edge.active)
        L = x.β * f * split.β * jump_between(behind_edges(trace), sides, key)
        L *= arc.per_length(bracket, pdf, edge.active) / ARCS

        d, k = dr.select(edge.near_is_a, d_a, d_b), dr.select(edge.active, split.k - first, 0)
        path, edge.active = self._record(segments, arc, d, pdf, k, edge.near.ray, edge.active)
        slope = self._slope(path, edge, d, dr.select(edge.active, k, 0))
        K = crossing_weight(arc.tangent(bracket.a), dr.select(edge.active, L, 0), slope)
        return Edges(path, [FilmCrossing(K, edge, sides)], None)

    def _observer(self, path: CameraPath) -> ObserverVertex:
        trace = replace(self.trace, max_depth=self.trace.max_depth - 1)  # the chain has at least one vertex
        return ObserverVertex(self.trace, path.vertex(trace, self.film, dr.ones(mi.Float, 1), None, None)[1])

    def _arc(self, observer: ObserverVertex, path: CameraPath) -> ChainArc:
        key = key_of(path.number, Stream.ARCS.of(path.key))
        return ChainArc.draw(observer, self.length, self.trace.traits.narrow, key, observer.active)

    @dr.syntax
    def _detect_arcs(self, observer: ObserverVertex, path: CameraPath, n: int, importance: mi.Float) -> None:
        """Write the importance of all arcs of ``n`` paths to ``importance``."""
        search, number, i, stride = self, mi.UInt32(0), dr.arange(mi.UInt32, n), dr.opaque(mi.UInt32, n)
        while dr.hint(number < ARCS, exclude=[search, observer, path, importance], label="pathreplay: chain arcs"):
            found = search._arc(observer, replace(path, number=number)).importance_of_edges()
            dr.scatter(importance, found, i)
            i += stride
            number += 1

    def _slope(self, path: EdgePath, edge: ChainEdge, d: mi.Vector3f, k: mi.UInt32) -> mi.Vector3f:
        """Compute ∂B/∂ω for the direction ω = ``d``, which the last ``k`` vertices of ``path`` continue."""
        q, none = derivative_by_ray(path.ray, edge.gap), mi.Spectrum(0)
        ray0 = dr.detach(self.film.ray(path.s, path.key)[0])
        chain = RecordedPath(path.layout, path.records, path.k - k, mi.UInt32(k), mi.UInt32(path.k), ray0)
        q = sweep_path(self.trace, chain, PathAdjoint(none, none, q), NonFiniteCounter(), rays_only=True).q
        return q.d - dr.dot(q.d, d) * d

    @dr.syntax
    def _record(
        self,
        segments: CameraPath,
        arc: ChainArc,
        d: mi.Vector3f,
        pdf: mi.Float,
        k: mi.UInt32,
        at: mi.Ray3f,
        active: mi.Bool,
    ) -> tuple[EdgePath, mi.Bool]:
        """Record the camera path to the vertex of ``arc``, its continuation along ``d``, and the ``k`` vertices behind.

        Records 0 to x.k belong to the camera path, x.k + 1 and later ones to the chain. The ray ``at`` leads from the
        last vertex to an edge. Returns the recorded path, and the lanes in which the path passes all vertices.
        """
        trace, x = arc.chain, arc.observer.selected
        layout = Layout.of(trace, True)
        records = dr.alloc_local(record_type(layout), room_for(trace))
        ray = dr.detach(self.film.ray(segments.s, segments.key)[0])
        on_path, on_chain = CounterSampler.of(segments.key), CounterSampler.at_vertex(arc.chain_key, x.depth + 1)
        path = PathState.begin(trace, CameraStart(ray, on_path, active))
        count, last = mi.UInt32(0), x.k + 1 + k
        while dr.hint(path.active & (count <= last), exclude=[trace, layout, x, arc], label="pathreplay: record arcs"):
            path.active &= count < last  # the last record has the index ``last``; only its `Arrival` is read later
            before, here = count <= x.k, count == x.k
            on_path.next_1d()  # the number with which `choose_vertex` selects a vertex
            sampler = dr.select(before, on_path, on_chain)
            u, step = path.choose(trace, sampler)
            on_path, on_chain = dr.select(before, sampler, on_path), dr.select(before, on_chain, sampler)
            step.kept.d, step.kept.pdf = dr.select(here, d, step.kept.d), dr.select(here, pdf, step.kept.pdf)
            step.kept.delta, step.kept.black = step.kept.delta & ~here, step.kept.black & ~here
            step.ray_next = dr.select(here, arc.observer.origin.spawn_ray(d), step.ray_next)
            step.active, step.null, step.w = step.active | here, step.null & ~here, dr.select(here, 1, step.w)
            onward, v = path.advance(trace, u, step)
            records[count] = record(layout, v)
            path = onward
            count += 1
        reached = active & (count == last + 1)
        return EdgePath(segments.s, segments.key, dr.select(reached, last, 0), at, layout, records), reached
