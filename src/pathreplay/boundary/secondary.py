"""Secondary boundary term: edges seen from surface points and medium events, in direct shadows and in indirect light.

At a scattering vertex x, light arrives from a direction ω. When parameters change, the interior term moves ω with a
velocity V. An emitter sample keeps its random numbers u. Any other sample follows its hit point with weight φ (see
`velocity`). In narrow lobes, a sample keeps its direction instead (see `keeps_direction`). At an edge, the integrand
jumps from f_near to f_far. The boundary term of the scattered radiance J contains the motion of the edge relative to V:

    dJ/dπ = ∫ [f_near (V_edge - V_near) - f_far (V_edge - V_far)]·n dl,        n normal to the edge, from near to far.

One vertex x of each camera path is selected. Short segments find the edges (see `crofton`). Segments in the unit square
of emitter samples find changes of the emitter's visibility. Segments that are arcs of directions around BSDF samples
find changes of the visible surface. The integrands of both kinds of samples include their MIS weights, so that the two
boundary terms add up. The motion of x is propagated along the path. If x is static, edges between static surfaces are
ignored.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.record import Layout, deepest, record_type, room_for
from pathreplay.boundary.cast_shadows import cast_shadows, casters
from pathreplay.boundary.edges import EdgePath, Edges, FilmDomain
from pathreplay.boundary.emitters import EmitterSegment
from pathreplay.boundary.importance import MOST, UNFORESEEN, Importance, radiance_of, weighed
from pathreplay.boundary.observer import ObserverVertex, SelectedVertex, choose_vertex
from pathreplay.boundary.occlusion import ArcSegment
from pathreplay.boundary.search import EdgeSearch, SegmentDensity, pilot_size
from pathreplay.samplers.counter_sampler import CounterSampler, key_of, quasi_random
from pathreplay.samplers.streams import Stream
from pathreplay.transport.vertex import TraceConfig

UNGUIDED = 0.8
"""Fraction of pilot segments that are not concentrated at cast shadows, because shadows seen in reflections and
refractions lie at other film positions."""


@dataclass
class CameraPath:
    """A camera path to a vertex. Two segments of the vertex are searched for edges.

    One segment lies in the unit square of an emitter, and the other is an arc of directions.
    """

    s: mi.Point2f  # film position
    density: mi.Float  # density of ``s``, per pixel
    key: mi.UInt32  # seed of the path's random numbers
    on_arc: mi.Bool  # whether the lane bisects the arc instead of the segment in the square


@dataclass(frozen=True)
class SecondarySearch(EdgeSearch[CameraPath]):
    """Edge search from path vertices. ``lengths`` are the lengths of segments in the unit square and of arcs (radians).

    The search does not use the adjoint of the image. Forward mode has no adjoint, but must select the same segments as
    reverse mode.
    """

    lengths: tuple[float, float]
    radiance: mi.Float | None = None  # mean radiance along arcs, estimated by the pilot pass

    bisection = Stream.BISECT_SECONDARY

    @staticmethod
    def of(trace: TraceConfig, film: FilmDomain, lengths: tuple[float, float]) -> SecondarySearch:
        trace = replace(trace, max_depth=min(trace.max_depth, deepest(trace)))
        return SecondarySearch(trace, film, SegmentDensity(int(film.size.x), int(film.size.y), 0.0), lengths)

    def guided(self, n: int, seed: mi.UInt32) -> SecondarySearch:
        """Refine the density with a pilot pass (see `EdgeSearch`). Some pilot segments are drawn at cast shadows."""
        density = self.density
        if shapes := casters(self.trace):
            s, falls = cast_shadows(self.trace, shapes, self.film, Stream.CAST_SHADOWS.of(seed))
            density = density.refined(s, dr.select(falls, mi.Float(1), 0), UNGUIDED)
        n_pilot = pilot_size(n, self.film.size)
        pilot = replace(self, density=density).draw(dr.arange(mi.UInt32, n_pilot), n_pilot, Stream.PILOT.of(seed))
        importances = self._importances(pilot)
        radiance = radiance_of(importances)
        importance = weighed(importances, radiance)[1]
        s = mi.Point2f(*(dr.concat([x, x]) for x in pilot.s))
        relative_density = dr.concat([pilot.density, pilot.density]) * (density.width * density.height)
        mean_importance = dr.rcp(
            dr.maximum(dr.sum(dr.select(importance > 0, dr.rcp(relative_density), 0)), dr.smallest(mi.Float))
        )
        relative = dr.minimum(importance * relative_density / (MOST * mean_importance), 1)
        return replace(
            self, density=density.refined(s, dr.square(relative) / relative_density, UNGUIDED), radiance=radiance
        )

    def draw(self, i: mi.UInt32, n: int, seed: mi.UInt32) -> CameraPath:
        """Draw the path of segment ``i``: see `EdgeSearch`.

        Indices below ``n`` denote segments in emitter squares, and indices from ``n`` to 2 n - 1 denote arcs. Segment i
        and arc n + i have the same path.
        """
        on_arc = i >= n
        i = dr.select(on_arc, i - n, i)
        s, density = self.density.draw(*quasi_random(i, n, seed))
        return CameraPath(s, density, key_of(i, Stream.SECONDARY_KEYS.of(seed)), on_arc)

    def detect(self, segments: CameraPath) -> mi.Float:
        """Return the importance of all segments in emitter squares, followed by the importance of all arcs."""
        assert self.radiance is not None
        presence, importance = weighed(self._importances(segments), self.radiance)
        return importance + UNFORESEEN * presence

    def resolve(self, segments: CameraPath, weight: mi.Float, generator: mi.PCG32) -> Edges:
        layout = Layout.of(self.trace, True)
        records = dr.alloc_local(record_type(layout), room_for(self.trace))
        records, x = self._vertex(segments, layout, records)
        x.active &= weight > 0
        observer = ObserverVertex(self.trace, x)
        square, arc = self._segments(observer, segments.key)
        shadow = square.resolve(dr.select(segments.on_arc, 0, weight), generator)
        sides = arc.resolve(dr.select(segments.on_arc, weight, 0), generator)
        path = EdgePath(segments.s, segments.key, dr.select(x.active, x.k, 0), x.at.ray, layout, records)
        return Edges(path, [*sides, shadow], observer)

    def _vertex(self, path: CameraPath, layout: Layout | None, records: Any) -> tuple[Any, SelectedVertex]:
        """Select a vertex of each camera path, and record the path unless ``records`` is None."""
        ray, weight = dr.detach(self.film.ray(path.s, path.key))
        sampler, flows = CounterSampler.of(path.key), self.film.flows(path.s)
        records, x = choose_vertex(self.trace, sampler, ray, flows, layout, records)
        x.β *= weight / path.density
        return records, x

    def _segments(self, observer: ObserverVertex, key: mi.UInt32) -> tuple[EmitterSegment, ArcSegment]:
        (square, arc), active = self.lengths, observer.active
        narrow = self.trace.traits.narrow or self.trace.media is not None
        return (
            EmitterSegment.draw(observer, square, Stream.EMITTER_SEGMENTS.of(key)),
            ArcSegment.draw(observer, arc, narrow, Stream.ARCS.of(key), active),
        )

    def _importances(self, path: CameraPath) -> list[Importance]:
        """Estimate the importance of the segments in emitter squares, and of the arcs."""
        _, x = self._vertex(path, None, None)
        none = dr.zeros(mi.Float, dr.width(path.key))
        path.density += none  # broadcast to the number of paths
        importances = [segment.detect() for segment in self._segments(ObserverVertex(self.trace, x), path.key)]
        importances = [replace(w, presence=w.presence / path.density, edges=w.edges + none) for w in importances]
        dr.eval(path.s, path.density, importances)
        return importances
