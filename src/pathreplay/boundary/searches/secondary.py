"""Secondary boundary term: edges seen from surface points and medium events, in direct shadows and in indirect light.

At a scattering vertex x, light arrives from a direction ω. When parameters change, the interior term moves ω with a
velocity V. An emitter sample keeps its random numbers u. Any other sample follows its hit point with weight φ (see
`velocity`). In narrow lobes and at collisions in media, a sample keeps its direction instead (see `keeps_direction`).
At an edge, the integrand jumps from f_near to f_far. The boundary term of the scattered radiance J contains the motion
of the edge relative to V:

    dJ/dπ = ∫ [f_near (V_edge - V_near) - f_far (V_edge - V_far)]·n dl,        n normal to the edge, from near to far.

One vertex x of each camera path is selected. Short segments find the edges (see `crofton`). A segment in the unit
square of emitter samples finds changes of the emitter's visibility. Arcs of directions around BSDF samples find changes
of the visible surface. The integrands of both kinds of samples include their MIS weights, so that the two boundary
terms add up. The motion of x is propagated along the path. If x is static, edges between static surfaces are ignored.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.record import Layout, record_type, recordable, room_for
from pathreplay.boundary.cast_shadows import cast_shadows, casters
from pathreplay.boundary.edges import EdgePath, Edges, FilmDomain
from pathreplay.boundary.emitters import EmitterSegment
from pathreplay.boundary.importance import MOST, UNFORESEEN, VERTICES, Importance, Importances, repeated
from pathreplay.boundary.observer import ObserverVertex, SelectedVertex, choose_vertex
from pathreplay.boundary.occlusion import ArcSegment
from pathreplay.boundary.search import EdgeSearch, SegmentDensity
from pathreplay.samplers.counter_sampler import CounterSampler, key_of, quasi_random
from pathreplay.samplers.streams import Stream
from pathreplay.transport.scatter import may_keep_directions
from pathreplay.transport.vertex import TraceConfig

UNGUIDED = 0.8
"""Fraction of the paths that keep the previous density, at each of two refinements: by cast shadows, then by the pilot
pass. Shadows seen in reflections and refractions lie at other film positions."""
ARCS = 8
"""Number of arcs around a vertex with a narrow lobe. Other vertices have one arc: more arcs would take time, and would
hardly reduce the noise."""


@dataclass
class CameraPath:
    """A camera path to a vertex, around which segments are searched for edges.

    In this search, one segment lies in the unit square of an emitter, and all others are arcs of directions. All
    segments of `secondary_chains` are arcs.
    """

    s: mi.Point2f  # film position
    density: mi.Float  # density of ``s``, per pixel
    key: mi.UInt32  # seed of the path's random numbers
    number: mi.UInt32  # the segment that the lane bisects; here 0 is the one in the square, i the i-th arc

    def vertex(
        self, trace: TraceConfig, film: FilmDomain, shares: mi.Float, layout: Layout | None, records: object
    ) -> tuple[Any, SelectedVertex]:
        """Select a vertex of each path (see `choose_vertex`), and record the path unless ``records`` is None."""
        ray, weight = dr.detach(film.ray(self.s, self.key))
        sampler = CounterSampler.of(self.key)
        records, x = choose_vertex(trace, sampler, ray, film.flows(self.s), shares, layout, records)
        x.β *= weight / self.density
        return records, x

    def to_edge(self, x: SelectedVertex, layout: Layout, records: object) -> EdgePath:
        """Return the recorded path to the vertex ``x``."""
        return EdgePath(self.s, self.key, dr.select(x.active, x.k, 0), x.at.ray, layout, records)


@dataclass(frozen=True)
class SecondarySearch(EdgeSearch[CameraPath]):
    """Edge search from path vertices. ``lengths`` are the lengths of segments in the unit square and of arcs (radians).

    The search does not use the adjoint of the image. Forward mode has no adjoint, but must select the same segments as
    reverse mode.
    """

    lengths: tuple[float, float]
    shares: mi.Float  # selection weights of vertices: see `choose_vertex`
    radiance: mi.Float | None = None  # see `Importances.radiance`; estimated by the pilot pass

    bisection = Stream.BISECT_SECONDARY

    @staticmethod
    def of(trace: TraceConfig, film: FilmDomain, lengths: tuple[float, float]) -> SecondarySearch:
        trace = recordable(trace)
        density = SegmentDensity.uniform(film.size, 0.0)
        return SecondarySearch(trace, film, density, lengths, dr.opaque(mi.Float, 1, VERTICES))

    def guided(self, n: int, seed: mi.UInt32) -> SecondarySearch:
        """Refine the density with a pilot pass (see `EdgeSearch`). Some pilot segments are drawn at cast shadows."""
        density = self.density
        if shapes := casters(self.trace):
            s, falls = cast_shadows(self.trace, shapes, self.film, Stream.CAST_SHADOWS.of(seed))
            density = density.refined(s, dr.select(falls, mi.Float(1), 0), UNGUIDED)
        pilot = replace(self, density=density).pilot(n, seed)
        importances = self._importances(pilot)
        radiance = importances.radiance()
        importance = importances.weighed(radiance)[1]
        s = mi.Point2f(*(repeated(x, importance) for x in pilot.s))
        relative_density = repeated(pilot.density, importance) * (density.width * density.height)
        mean_importance = dr.rcp(
            dr.maximum(dr.sum(dr.select(importance > 0, dr.rcp(relative_density), 0)), dr.smallest(mi.Float))
        )
        relative = dr.minimum(importance * relative_density / (MOST * mean_importance), 1)
        return replace(
            self,
            density=density.refined(s, dr.square(relative) / relative_density, UNGUIDED),
            shares=importances.shares(relative),
            radiance=radiance,
        )

    def draw(self, i: mi.UInt32, number: mi.UInt32, n: int, seed: mi.UInt32) -> CameraPath:
        s, density = self.density.draw(*quasi_random(i, n, seed))
        return CameraPath(s, density, key_of(i, Stream.SECONDARY_KEYS.of(seed)), number)

    def detect(self, segments: CameraPath) -> mi.Float:
        """Return the importance of all segments in emitter squares, followed by the importance of all arcs."""
        assert self.radiance is not None
        presence, importance = self._importances(segments).weighed(self.radiance)
        return importance + UNFORESEEN * presence

    def resolve(self, segments: CameraPath, weight: mi.Float, generator: mi.PCG32) -> Edges:
        layout = Layout.of(self.trace, True)
        records = dr.alloc_local(record_type(layout), room_for(self.trace))
        records, x = segments.vertex(self.trace, self.film, self.shares, layout, records)
        x.active &= weight > 0
        observer = ObserverVertex(self.trace, x)
        on_arc = segments.number > 0
        shadow = self._square(observer, segments.key).resolve(dr.select(on_arc, 0, weight), generator)
        arc = self._arc(observer, segments.key, segments.number)
        sides = arc.resolve(dr.select(on_arc, weight / self._arc_count(observer), 0), generator)
        return Edges(segments.to_edge(x, layout, records), [*sides, shadow], observer)

    @property
    def most_arcs(self) -> int:
        """Largest number of arcs around a vertex."""
        return ARCS if may_keep_directions(self.trace) else 1

    def _arc_count(self, observer: ObserverVertex) -> mi.UInt32:
        """Return the number of arcs around a vertex."""
        return dr.select(observer.keeps_direction, mi.UInt32(self.most_arcs), 1)

    def _square(self, observer: ObserverVertex, key: mi.UInt32) -> EmitterSegment:
        return EmitterSegment.draw(observer, self.lengths[0], Stream.EMITTER_SEGMENTS.of(key))

    def _arc(self, observer: ObserverVertex, key: mi.UInt32, number: mi.UInt32) -> ArcSegment:
        narrow = self.trace.traits.narrow or self.trace.media is not None
        key = Stream.ARCS.of(key)
        if self.most_arcs > 1:
            key = key_of(number, key)
        return ArcSegment.draw(observer, self.lengths[1], narrow, key, observer.active)

    def _importances(self, path: CameraPath) -> Importances:
        """Estimate the importance of all segments."""
        _, x = path.vertex(self.trace, self.film, self.shares, None, None)
        observer, n = ObserverVertex(self.trace, x), dr.width(path.key)
        none = dr.zeros(mi.Float, n)

        def per_path(found: Importance) -> Importance:
            return replace(found, presence=found.presence / path.density, edges=found.edges + none)

        square = per_path(self._square(observer, path.key).detect())
        if self.most_arcs == 1:
            arcs = per_path(self._arc(observer, path.key, mi.UInt32(1)).detect())
        else:
            arcs = Importance(*(dr.zeros(mi.Float, n * self.most_arcs) for _ in fields(Importance)))
            self._detect_arcs(observer, path, n, arcs)
        found = Importances(square, arcs, dr.minimum(x.k, VERTICES - 1), x.active)
        dr.eval(path.s, path.density, found)
        return found

    @dr.syntax
    def _detect_arcs(self, observer: ObserverVertex, path: CameraPath, n: int, found: Importance) -> None:
        """Write the importance of all arcs of ``n`` paths to ``found``, in the order of `Importances.arcs`.

        It is divided by the number of arcs around the vertex.
        """
        search, arcs, number = self, self._arc_count(observer), mi.UInt32(0)
        i, stride = dr.arange(mi.UInt32, n), dr.opaque(mi.UInt32, n)
        while dr.hint(number < arcs, exclude=[search, observer, path, found], label="pathreplay: arcs"):
            arc = search._arc(observer, path.key, number + 1).detect()
            dr.scatter(found.presence, arc.presence / (path.density * arcs), i)
            dr.scatter(found.edges, arc.edges / arcs, i)
            dr.scatter(found.light, arc.light / arcs, i)
            i += stride
            number += 1
