"""The search for edges, the same in all domains: draw segments, detect edges, resample, bisect, weigh and record.

Most segments find nothing. So all of them are probed first, which is one kernel; of those with an edge a fixed number
is resampled and resolved, in another, which thus wastes no lane and has the same width each time. A first look with few
segments decides where on the film the others are drawn.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import ClassVar, Generic, TypeVar

import drjit as dr
import mitsuba as mi

from pathreplay.boundary.crofton import PlaneSegment, VisibilityProbe, bisect, detect, passed
from pathreplay.boundary.edges import Edges, FilmDomain
from pathreplay.samplers.counter_sampler import ROUNDS
from pathreplay.samplers.streams import Stream
from pathreplay.transport.vertex import TraceConfig

LOOKS, PER_PIXEL = 8, 2
"""Of so many segments one belongs to the first look, which has at most so many segments per pixel."""
AROUND = 1.0
"""Segments that are drawn at the pixels around what was found, for one at its own."""
EVENLY = 0.25
"""Share of the segments that are drawn evenly, unless one asks for more: the first look misses some."""

Segments = TypeVar("Segments")
"""A segment for each lane."""


@dataclass(frozen=True)
class EdgeSearch(ABC, Generic[Segments]):
    """A template: its domains say what segments are, how an edge is detected on one, and what the edge weighs."""

    trace: TraceConfig
    film: FilmDomain
    density: SegmentDensity  # of the places where paths begin

    bisection: ClassVar[Stream]  # of the choice among the crossings of one segment

    def find(self, n: int, closer: int, seed: mi.UInt32) -> Edges:
        """Edges on ``n`` segments, of which ``closer`` are resolved. Detached."""
        search = self.guided(n, seed)
        importance = search.detect(search.draw(dr.arange(mi.UInt32, n), n, seed))
        chosen = Resampled.of(importance, closer, seed)
        share = chosen.weight * dr.opaque(mi.Float, 1 / n)  # opaque: one kernel for all numbers of segments
        generator = mi.PCG32(closer, initstate=seed + int(self.bisection), initseq=dr.arange(mi.UInt32, closer))
        return search.resolve(search.draw(chosen.index, n, seed), share, generator)

    def guided(self, n: int, seed: mi.UInt32) -> EdgeSearch[Segments]:
        """The search with what a first look tells of where segments are to be drawn. Without one, the same."""
        return self

    @abstractmethod
    def draw(self, i: mi.UInt32, n: int, seed: mi.UInt32) -> Segments:
        """The i-th of n segments."""

    @abstractmethod
    def detect(self, segments: Segments) -> mi.Float:
        """The importance of resolving each segment: zero where it has no edge."""

    @abstractmethod
    def resolve(self, segments: Segments, weight: mi.Float, generator: mi.PCG32) -> Edges:
        """Bisect the segments, weigh what crosses them and record the path to it. A lane stands for ``weight`` of all.

        Lanes of weight zero find nothing.
        """


@dataclass
class FilmSegment(PlaneSegment):
    """A segment on the film."""

    key: mi.UInt32  # of the random numbers that its paths share
    density: mi.Float  # of its centre, per pixel, and of what else is drawn
    active: mi.Bool


OnFilm = TypeVar("OnFilm", bound=FilmSegment)


@dataclass(frozen=True)
class FilmSearch(EdgeSearch[OnFilm]):
    """A search by segments on the film, of a ``length`` in pixels."""

    length: float

    @classmethod
    def of(cls, trace: TraceConfig, film: FilmDomain, length: float) -> FilmSearch[OnFilm]:
        return cls(trace, film, SegmentDensity.even(film.size, length), length)

    @abstractmethod
    def probe(self, segment: OnFilm, t: mi.Float, active: mi.Bool) -> VisibilityProbe:
        """What is seen at a place of a segment: see `Probe`."""

    @abstractmethod
    def edge(self, segment: OnFilm, a: mi.Float, b: mi.Float, active: mi.Bool) -> Edges:
        """The edge between two places of a segment. Its crossing weighs the jump of the radiance, from ``a`` to ``b``.

        Where there is none it weighs 0.
        """

    @abstractmethod
    def slope(self, segment: OnFilm, edges: Edges) -> mi.Vector2f:
        """∂B/∂s: how fast the edge is passed on the film. Reaches no parameter."""

    def detect(self, segments: OnFilm) -> mi.Float:
        return detect(partial(self.probe, segments), segments.length, segments.active) / segments.density

    def resolve(self, segments: OnFilm, weight: mi.Float, generator: mi.PCG32) -> Edges:
        weight = dr.select(segments.active, weight, 0)
        crossed = bisect(partial(self.probe, segments), segments.length, weight, generator)
        edges = self.edge(segments, crossed.a, crossed.b, crossed.weight > 0)
        (crossing,) = edges.crossings
        jump = crossing.weight * crossed.per_length(segments.length, segments.density)
        K = passed(segments.w, jump, self.slope(segments, edges))
        return replace(edges, crossings=[replace(crossing, weight=K)])  # type: ignore[type-var]


@dataclass
class Resampled:
    """A segment for each lane, by its index among many, and what the lane stands for."""

    index: mi.UInt32
    weight: mi.Float  # 1 / expected number of lanes with that segment; 0: no segment finds anything

    @staticmethod
    def of(mass: mi.Float, lanes: int, seed: mi.UInt32) -> Resampled:
        """As often as ``mass`` says, which is that of each segment."""
        dr.eval(mass)  # before it is used twice
        n = dr.width(mass)
        until = dr.cumsum(mi.Float64(mass))
        total = dr.gather(mi.Float64, until, n - 1)
        lane = dr.arange(mi.UInt32, lanes)
        x = (mi.Float64(lane) + mi.Float64(mi.sample_tea_float32(seed, lane, ROUNDS))) * (total / lanes)
        found = dr.binary_search(0, n - 1, lambda i: dr.gather(mi.Float64, until, i) <= x)
        index = mi.UInt32(dr.minimum(found, n - 1))  # a number where there is one segment
        own = dr.gather(mi.Float, mass, index)
        return Resampled(index, dr.select(own > 0, mi.Float(total / lanes) / own, 0))


def looks_of(n: int, size: mi.ScalarVector2f) -> int:
    """How many segments the first look has, of ``n`` in all, on a film of ``size`` pixels."""
    return max(min(n // LOOKS, PER_PIXEL * int(size.x) * int(size.y)), 1)


@dataclass(frozen=True)
class SegmentDensity:
    """A distribution of places: constant in each pixel of a grid that covers the film, and l beyond."""

    width: int
    height: int
    margin: float  # l
    until: mi.Float | None = None  # of each pixel, the probability of those up to it; None: all alike

    @staticmethod
    def even(size: mi.ScalarVector2f, l: float) -> SegmentDensity:
        """Uniform density over a film of this size in pixels, for segments of length l."""
        return SegmentDensity(int(size.x + 2 * l + 1), int(size.y + 2 * l + 1), l)

    def refined(self, s: mi.Point2f, found: mi.Float, evenly: float = EVENLY) -> SegmentDensity:
        """More often where there was something, at places ``s`` so much, and around: edges go on.

        By the root of how much: variance is a sum of (what segments find, squared) / density, which is then least.
        ``evenly`` is the share of places that are drawn as before.
        """
        n, c = self.width * self.height, s + self.margin
        counts = dr.zeros(mi.Float, n)
        for dy, dx in product((-1, 0, 1), repeat=2):
            x, y = mi.Int32(c.x) + dx, mi.Int32(c.y) + dy
            inside = (x >= 0) & (x < self.width) & (y >= 0) & (y < self.height)
            part = 1.0 if dx == dy == 0 else AROUND / 8
            dr.scatter_add(counts, part * dr.minimum(found, 1), mi.UInt32(y * self.width + x), inside)
        counts = dr.sqrt(counts)
        total = dr.sum(counts)
        before = self._share(dr.arange(mi.UInt32, n))
        share = dr.select(total > 0, dr.fma(counts, (1 - evenly) / total, evenly * before), before)
        until = dr.cumsum(share)
        return SegmentDensity(self.width, self.height, self.margin, until / dr.gather(mi.Float, until, n - 1))

    def _share(self, i: mi.UInt32) -> mi.Float:
        """The probability of a pixel."""
        if self.until is None:
            return mi.Float(1 / (self.width * self.height))
        begin = dr.select(i > 0, dr.gather(mi.Float, self.until, i - 1, i > 0), 0)
        return dr.gather(mi.Float, self.until, i) - begin

    def draw(self, u: mi.Point2f) -> tuple[mi.Point2f, mi.Float]:
        """A place on the film, and its density, from random numbers in the unit square."""
        n = self.width * self.height
        if self.until is None:
            return u * mi.Point2f(self.width, self.height) - self.margin, mi.Float(1 / n)
        below = lambda i: dr.gather(mi.Float, self.until, i) <= u.x  # noqa: E731
        i = mi.UInt32(dr.minimum(dr.binary_search(0, n - 1, below), n - 1))  # a number where there is one pixel
        share = self._share(i)
        begin = dr.gather(mi.Float, self.until, i) - share
        x = dr.clip((u.x - begin) / share, 0, dr.one_minus_epsilon(mi.Float))
        return mi.Point2f(mi.Float(i % self.width) + x, mi.Float(i // self.width) + u.y) - self.margin, share
