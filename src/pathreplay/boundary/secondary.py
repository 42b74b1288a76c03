"""Edges that points of surfaces see, and particles of media: shadows, and what moves in and out of indirect light.

At a vertex x that scatters, light arrives from a direction ω, which the interior lets move with a velocity V when
parameters move: it follows the number u that drew it (emitter samples), or the point that it hit (other samples, with
the share φ, see `velocity`; in narrow lobes it stays, see `keeps_direction`). At an edge the integrand jumps from
f_near to f_far, and what V does not follow is

    dJ/dπ = ∫ [f_near (V_edge - V_near) - f_far (V_edge - V_far)]·n dl,        n normal to the edge, from near to far.

One vertex of each camera path is chosen. Edges are found by short segments (see `crofton`) in the unit square of
emitter samples, where the visibility changes, and by short arcs around samples of the BSDF, where it is another surface
that is seen. Multiple importance sampling belongs to both integrands, which thus add up. What moves x goes back along
the path. Where x does not move, all that does not move looks alike, so that no segment is spent on edges that stay.
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
from pathreplay.boundary.observer import ObserverVertex, SelectedVertex, choose_vertex
from pathreplay.boundary.occlusion import ArcSegment
from pathreplay.boundary.search import EdgeSearch, SegmentDensity, looks_of
from pathreplay.boundary.worth import MOST, UNFORESEEN, Worth, radiance_of, weighed
from pathreplay.samplers.counter_sampler import CounterSampler, key_of, quasi_random
from pathreplay.samplers.streams import Stream
from pathreplay.transport.vertex import TraceConfig

WIDELY = 0.8
"""Share of the segments that are drawn as before the first look: shadows are seen by way of other surfaces, too."""


@dataclass
class CameraPath:
    """The path to the vertex of a segment. Each vertex has two, one among emitter samples and one on the sphere."""

    s: mi.Point2f  # where it begins
    density: mi.Float  # of s, per pixel
    key: mi.UInt32  # of its random numbers
    on_arc: mi.Bool  # which of the two segments is meant


@dataclass(frozen=True)
class SecondarySearch(EdgeSearch[CameraPath]):
    """A search from vertices, by segments of two ``lengths``: in the unit square, and on the sphere (radians).

    What light counts that arrives at the film decides nothing here, since forward mode would not know it and choose
    otherwise.
    """

    lengths: tuple[float, float]
    radiance: mi.Float | None = None  # brightness seen by arcs, estimated by the first probe

    bisection = Stream.BISECT_SECONDARY

    @staticmethod
    def of(trace: TraceConfig, film: FilmDomain, lengths: tuple[float, float]) -> SecondarySearch:
        trace = replace(trace, max_depth=min(trace.max_depth, deepest(trace)))
        return SecondarySearch(trace, film, SegmentDensity(int(film.size.x), int(film.size.y), 0.0), lengths)

    def guided(self, n: int, seed: mi.UInt32) -> SecondarySearch:
        """See `EdgeSearch`. Shadows that are cast decide where the first look is taken."""
        density = self.density
        if shapes := casters(self.trace):
            s, falls = cast_shadows(self.trace, shapes, self.film, Stream.CAST_SHADOWS.of(seed))
            density = density.refined(s, dr.select(falls, mi.Float(1), 0), WIDELY)
        few = looks_of(n, self.film.size)
        first = replace(self, density=density).draw(dr.arange(mi.UInt32, few), few, Stream.FIRST_LOOK.of(seed))
        worths = self._worths(first)
        radiance = radiance_of(worths)
        worth = weighed(worths, radiance)[1]
        s = mi.Point2f(*(dr.concat([x, x]) for x in first.s))
        often = dr.concat([first.density, first.density]) * (density.width * density.height)
        usual = dr.rcp(dr.maximum(dr.sum(dr.select(worth > 0, dr.rcp(often), 0)), dr.smallest(mi.Float)))
        relative = dr.minimum(worth * often / (MOST * usual), 1)
        return replace(self, density=density.refined(s, dr.square(relative) / often, WIDELY), radiance=radiance)

    def draw(self, i: mi.UInt32, n: int, seed: mi.UInt32) -> CameraPath:
        """See `EdgeSearch`. From the n-th on, segments are arcs."""
        on_arc = i >= n
        i = dr.select(on_arc, i - n, i)
        s, density = self.density.draw(mi.Point2f(quasi_random(i, n, seed)))
        return CameraPath(s, density, key_of(i, Stream.SECONDARY_KEYS.of(seed)), on_arc)

    def detect(self, segments: CameraPath) -> mi.Float:
        """See `EdgeSearch`. All segments among emitter samples, and then all arcs."""
        assert self.radiance is not None
        found, worth = weighed(self._worths(segments), self.radiance)
        return worth + UNFORESEEN * found

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
        """The vertex of each path, which is recorded if there are ``records``."""
        ray, weight = dr.detach(self.film.ray(path.s, path.key))
        numbers, flows = CounterSampler.of(path.key), self.film.flows(path.s)
        records, x = choose_vertex(self.trace, numbers, ray, flows, layout, records)
        x.β *= weight / path.density
        return records, x

    def _segments(self, observer: ObserverVertex, key: mi.UInt32) -> tuple[EmitterSegment, ArcSegment]:
        (square, arc), active = self.lengths, observer.active
        narrow = self.trace.traits.narrow or self.trace.media is not None
        return (
            EmitterSegment.draw(observer, square, Stream.EMITTER_SEGMENTS.of(key)),
            ArcSegment.draw(observer, arc, narrow, Stream.ARCS.of(key), active),
        )

    def _worths(self, path: CameraPath) -> list[Worth]:
        """What edges on the segments may be worth: of those among emitter samples, and of arcs."""
        _, x = self._vertex(path, None, None)
        none = dr.zeros(mi.Float, dr.width(path.key))
        path.density += none  # as many as paths, as all of these
        worths = [segment.detect() for segment in self._segments(ObserverVertex(self.trace, x), path.key)]
        worths = [replace(w, found=w.found / path.density, edges=w.edges + none) for w in worths]
        dr.eval(path.s, path.density, worths)
        return worths
