"""Primary boundary term: edges on the film, seen directly, in mirrors or through glass.

The film position s of a path is constant. The points at which the camera ray and the following rays of delta lobes hit
a moving surface therefore slide over the surface. The radiance f(s) jumps at an edge. If the edge moves, the integral
over the film changes by the jump times the area that the edge sweeps. Short segments on the film find the edges (see
`crofton`). With N segments,

    dI/dπ = - Σ K dB/dπ,    K = π/2 · (f_a - f_b) / (l p(c) N) · sgn(w·∂B/∂s) / |∂B/∂s|,

where B(s, π) = 0 on the edge, f_a and f_b are the radiances on its two sides, and w is the direction from a to b. The
function B depends on the kind of edge:

- Outline: B = n·(o + t d - z). The ray (o, d) of the path hits the nearer surface at distance t, in the point z. The
  surface coordinates of z are fixed. The vector n is perpendicular to the edge and to the ray.
- Contact of two surfaces: B is the difference of the distances of the two surfaces along the ray.
- Smooth-shaded mesh: B is the dot product of the ray direction and the shading normal. B vanishes slightly before the
  outline of the mesh. Between this line and the outline, the mesh is black.
- Horizon of a `sunsky`: B is the height of the ray direction above the horizon.
- Boundary of a hard shadow: B = n·(x + r d - z). The visible point x slides with the path. The light lies in the
  direction d from x, and z is the point of the occluder in this direction, at distance r from x.

In a medium, both sides of an edge at distance t₀ share the transmittance T and all light that is scattered before t₀.
The radiance jumps by T(t₀) (L_near - L_far). Here L_near is the radiance of the near surface, and L_far is the radiance
along the ray that continues in the same medium. Beyond t₀, paths are sampled as usual.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import NonFiniteCounter, derivative_by_place, derivative_by_ray
from pathreplay.adjoint.primal import two_radiances
from pathreplay.boundary.chains import (
    ChainSplit,
    begin_chain,
    chain_config,
    probe_chain,
    record_chain,
    split_chains,
    transmittance_of_chain,
)
from pathreplay.boundary.creases import Crease, off_contact
from pathreplay.boundary.crofton import VisibilityProbe, heading
from pathreplay.boundary.edges import Edges, ray_to_camera
from pathreplay.boundary.hard_shadows import HardShadow
from pathreplay.boundary.observer import arrival_beyond
from pathreplay.boundary.search import FilmSearch, FilmSegment
from pathreplay.samplers.counter_sampler import CounterSampler, key_of, quasi_random
from pathreplay.samplers.streams import Stream
from pathreplay.transport.path import PathState
from pathreplay.transport.signature import edge_normal, outline_gap
from pathreplay.transport.vertex import Arrival, TraceConfig
from pathreplay.transport.volume.passage import SHORT_OF


@dataclass
class Sides:
    """What lies behind an edge, on side a and on side b."""

    a: Arrival
    b: Arrival
    k: mi.UInt32  # number of vertices before the edge
    shadow: HardShadow | None  # None if no vertex is tested for hard shadows
    lit: Arrival  # at the boundary of a hard shadow, the arrival on the lit side
    active: mi.Bool

    def paths(self) -> list[PathState]:
        """Return the paths that continue on the two sides. At the boundary of a hard shadow, they are not active."""
        active = self.active if self.shadow is None else self.active & ~self.shadow.exists
        one = mi.Spectrum(1), None, mi.Float(1)
        return [PathState(side, *one, mi.UInt32(self.k), mi.Bool(active)) for side in (self.a, self.b)]

    def shadow_jump(self, trace: TraceConfig, key: mi.UInt32) -> mi.Spectrum:
        """Return f_a - f_b at the boundary of a hard shadow: the scattered light of the sampled emitter.

        The emitter is not tested again for visibility: the two sides are so close that rounding would decide the test.
        """
        assert self.shadow is not None
        L = self.shadow.scattered(trace, self.lit, key, self.active)
        return dr.select(self.shadow.in_a, -L, L)


@dataclass
class ChainEdge:
    """The edge between two chains that diverge. The attributes are detached."""

    near: Arrival
    near_is_a: mi.Bool
    n: mi.Vector3f  # normal of an outline
    crease: Crease
    active: mi.Bool

    @staticmethod
    def of(chain: TraceConfig, split: ChainSplit, active: mi.Bool) -> ChainEdge:
        near_is_a, shadow = split.a.hit.t <= split.b.hit.t, None
        if split.shadows is not None:
            shadow = HardShadow.between(chain, split.shadows[0], split.shadows[1], active)
            near_is_a = dr.select(shadow.exists, shadow.in_a, near_is_a)
        near = dr.select(near_is_a, split.a, split.b)
        crease = Crease.of(chain, (split.a.hit, split.a.ray), (split.b.hit, split.b.ray), shadow, active)
        active = active & (near.hit.is_valid() | crease.sky)
        return ChainEdge(near, near_is_a, edge_normal(near.hit, near.ray, active & ~crease.sky), crease, active)

    def gap(self, at: mi.Ray3f) -> mi.Float:
        """Evaluate B for the last ray ``at`` of a chain: see `Crossing.gap`."""
        outline = outline_gap(self.n, at.o, at.d, self.near.hit, at, self.active & ~self.crease.exists)
        return dr.select(self.crease.exists, self.crease.gap(at, self.active), outline)


@dataclass
class FilmCrossing:
    """Crossing of a film segment, or of an arc that continues through delta lobes, with an edge: see `Crossing`."""

    weight: mi.Spectrum
    edge: ChainEdge
    sides: Sides

    def gap(self, at: mi.Ray3f) -> mi.Float:
        return self.edge.gap(at)


@dataclass(frozen=True)
class PrimarySearch(FilmSearch[FilmSegment]):
    """Edge search on the film. It finds edges that are visible directly or through chains of delta lobes."""

    bisection = Stream.BISECT_PRIMARY

    @cached_property
    def chain(self) -> TraceConfig:
        return chain_config(self.trace)

    def guided(self, n: int, seed: mi.UInt32) -> PrimarySearch:
        """Refine the density with a pilot pass (see `EdgeSearch`). Pilot segments have twice the usual length."""
        wide = replace(self, length=2 * self.length)
        pilot = wide.pilot(n, seed)
        importance = wide.detect(pilot)
        dr.eval(importance)
        return replace(self, density=self.density.refined(pilot.c, importance * pilot.density))

    def draw(self, i: mi.UInt32, number: mi.UInt32, n: int, seed: mi.UInt32) -> FilmSegment:
        x, y, turn = quasi_random(i, n, seed, 3)
        c, density = self.density.draw(x, y)
        key = key_of(i, Stream.PRIMARY_KEYS.of(seed))
        length = dr.opaque(mi.Float, self.length)  # one kernel for all lengths
        return FilmSegment(c, heading(mi.Float(turn)), length, key, density, mi.Bool(True))

    def probe(self, segment: FilmSegment, t: mi.Float, active: mi.Bool) -> VisibilityProbe:
        s = segment.at(t)
        path = begin_chain(self.chain, self.film.ray(s, segment.key)[0], active)
        return probe_chain(self.chain, path, segment.key, self.film.flows(s))

    def edge(self, segment: FilmSegment, a: mi.Float, b: mi.Float, active: mi.Bool) -> Edges:
        ends, key = (segment.at(a), segment.at(b)), segment.key
        (ray_a, weight), (ray_b, weight_b) = (self.film.ray(s, key) for s in ends)
        weight = dr.select(dr.any(weight_b != 0), weight, 0)  # an edge of the emission, not of visibility
        paths = begin_chain(self.chain, ray_a, active), begin_chain(self.chain, ray_b, active)
        split = split_chains(self.chain, paths, key)
        edge = ChainEdge.of(self.chain, split, active & split.parted)
        sides, T = self._sides(split, edge.crease.shadow, ray_a, key, edge.active)
        L, s = weight * split.β * T * self.jump(sides, key), dr.select(edge.near_is_a, *ends)
        ray = self.film.ray(s, key)[0]
        path, edge.active = record_chain(self.chain, s, ray, key, split.k, edge.near.ray, edge.active)
        return Edges(path, [FilmCrossing(dr.select(edge.active, L, 0), edge, sides)], None)

    def _sides(
        self, split: ChainSplit, shadow: HardShadow | None, ray: mi.Ray3f, key: mi.UInt32, active: mi.Bool
    ) -> tuple[Sides, mi.Spectrum]:
        """Return what lies behind the edge, and the transmittance up to the edge. ``ray`` is the ray of side a."""
        trace = self.trace
        lit = split.a if shadow is None else dr.select(shadow.in_a, split.b, split.a)
        (a, b), T = off_contact(self.chain, split.a, split.b, active), mi.Spectrum(1)
        if trace.media is not None:
            t = SHORT_OF * dr.minimum(split.a.hit.t, split.b.hit.t)
            t = dr.select(dr.isfinite(t), t, 0)  # at the horizon of a `sunsky`, neither ray hits a surface
            medium = self.film.medium(trace, ray, active)
            T, medium = transmittance_of_chain(trace, ray, medium, key, split.k, t, active)
            active = active & dr.any(T != 0)
            a, b = (arrival_beyond(trace, side, t, medium, active) for side in (a, b))
            lit = replace(lit, medium=medium, behind=mi.Float(0))
        return Sides(a, b, mi.UInt32(split.k), shadow, lit, active), T

    @property
    def onward(self) -> TraceConfig:
        """The configuration of the paths behind an edge."""
        return behind_edges(self.trace)

    def jump(self, sides: Sides, key: mi.UInt32) -> mi.Spectrum:
        """Estimate f_a - f_b, with the same random numbers on both sides."""
        return jump_between(self.onward, sides, key)

    def slope(self, segment: FilmSegment, edges: Edges) -> mi.Vector2f:
        path, (crossing,) = edges.path, edges.crossings
        q = derivative_by_ray(path.ray, crossing.gap)
        q = ray_to_camera(self.chain, self.film, path, q, NonFiniteCounter(), rays_only=True)

        def along(s: mi.Point2f) -> mi.Float:
            ray, _ = self.film.ray(s, path.key)
            return dr.dot(q.o, ray.o) + dr.dot(q.d, ray.d)

        return derivative_by_place(path.s, along)


def behind_edges(trace: TraceConfig) -> TraceConfig:
    """Return the configuration of the paths behind an edge.

    On coarse meshes, a triangle occludes the part of a lobe that lies below its plane. `steady` makes the shading
    frames continuous across triangles, so that only this occlusion differs between the two sides of a crease.
    """
    traits = trace.traits
    return replace(trace, steady_frames=traits.coarse_meshes and not traits.brushed_meshes)


def jump_between(trace: TraceConfig, sides: Sides, key: mi.UInt32) -> mi.Spectrum:
    """Estimate f_a - f_b, with the same random numbers on both sides. ``trace`` is that of `behind_edges`."""
    a, b = two_radiances(trace, CounterSampler.at_vertex(key, sides.k), *sides.paths())
    return a - b if sides.shadow is None else dr.select(sides.shadow.exists, sides.shadow_jump(trace, key), a - b)
