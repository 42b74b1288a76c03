"""Edge search, shared by all boundary terms: draw segments, detect edges, resample, bisect, weigh and record.

Most segments cross no edge. A first kernel therefore probes all segments. Segments are then resampled by importance,
and a second kernel bisects a fixed number of segments, so that it wastes no lanes. A pilot pass with few segments
determines the density of all other segments on the film. Many segments are searched in parts, because memory is
proportional to the number of segments in a part.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, ClassVar, Generic, TypeVar

import drjit as dr
import mitsuba as mi

from pathreplay.boundary.crofton import PlaneSegment, VisibilityProbe, bisect, crossing_weight, detect
from pathreplay.boundary.edges import Edges, FilmDomain
from pathreplay.samplers.counter_sampler import ROUNDS
from pathreplay.samplers.streams import Stream
from pathreplay.transport.vertex import TraceConfig

if TYPE_CHECKING:
    from typing_extensions import Self

PILOT_RATIO, PILOT_PER_PIXEL = 8, 2
"""Ratio of segments to pilot segments, and the largest number of pilot segments per pixel."""
AROUND = 1.0
"""Importance that an edge adds to the eight neighbours of its pixel in total, relative to the pixel itself."""
UNREFINED = 0.25
"""Default fraction of segments drawn from the previous density, because the pilot pass misses some edges."""

AT_ONCE = 2**20
"""Largest number of segments that are probed at once; in secondary searches, the largest number of paths."""

Segments = TypeVar("Segments")
"""One segment per lane."""


@dataclass(frozen=True)
class EdgeSearch(ABC, Generic[Segments]):
    """Template of an edge search. Each subclass defines its segments, edge detection, and weights of edges."""

    trace: TraceConfig
    film: FilmDomain
    density: SegmentDensity  # density of the film positions of paths

    bisection: ClassVar[Stream]  # random stream for the choice among the crossings of one segment

    def find(self, n: int, closer: int, seed: mi.UInt32) -> Iterator[Edges]:
        """Probe ``n`` segments, resample n / ``closer`` of them by importance, and yield their edges, part by part.

        A secondary search probes all segments of ``n`` paths instead. A part consists of every k-th segment, because
        consecutive segments are close to each other on the film.
        """
        seed = mi.UInt32(seed)
        dr.make_opaque(seed)  # the pilot pass launches the same kernels with another seed
        search = self.guided(n, seed)
        parts = -(-n // AT_ONCE)
        for part in range(parts):
            yield search._find_in(n, closer, seed, part, parts)

    def _find_in(self, n: int, closer: int, seed: mi.UInt32, part: int, parts: int) -> Edges:
        count = len(range(part, n, parts))  # segments part, part + parts, part + 2 parts, ...
        lanes = max(count // closer, 1)
        # Opaque: the kernels do not depend on the part. ``lane`` is the number of the part's first lane.
        first, step, width, lane = (dr.opaque(mi.UInt32, x) for x in (part, parts, count, part * lanes))
        importance = self.detect(self._part(first, step, count, n, seed))
        chosen = Resampled.of(importance, lanes, seed, lane)
        number = chosen.index // width
        i = first + step * (chosen.index - number * width)
        generator = mi.PCG32(lanes, initstate=seed + int(self.bisection), initseq=lane + dr.arange(mi.UInt32, lanes))
        return self.resolve(self.draw(i, number, n, seed), chosen.weight * dr.opaque(mi.Float, 1 / n), generator)

    def _part(self, first: mi.UInt32, step: mi.UInt32, count: int, n: int, seed: mi.UInt32) -> Segments:
        """Draw segments ``first``, ``first`` + ``step``, ... of n segments, ``count`` in total."""
        return self.draw(first + step * dr.arange(mi.UInt32, count), mi.UInt32(0), n, seed)

    def pilot(self, n: int, seed: mi.UInt32) -> Segments:
        """Draw the segments of a pilot pass; ``n`` is the number of segments of the pass that follows.

        They are drawn like the segments of that pass, so that one kernel detects the edges on both.
        """
        n, seed = pilot_size(n, self.film.size), Stream.PILOT.of(seed)
        dr.make_opaque(seed)
        search = replace(self, density=self.density.tabulated())
        return search._part(dr.opaque(mi.UInt32, 0), dr.opaque(mi.UInt32, 1), n, n, seed)

    def guided(self, n: int, seed: mi.UInt32) -> EdgeSearch[Segments]:
        """Run a pilot pass, and return a search with a refined density. Without a pilot pass, return this search."""
        return self

    @abstractmethod
    def draw(self, i: mi.UInt32, number: mi.UInt32, n: int, seed: mi.UInt32) -> Segments:
        """Draw the i-th of n segments. In secondary searches, draw a segment of the i-th path: see `CameraPath`."""

    @abstractmethod
    def detect(self, segments: Segments) -> mi.Float:
        """Return the importance of each segment, zero where no edge is detected."""

    @abstractmethod
    def resolve(self, segments: Segments, weight: mi.Float, generator: mi.PCG32) -> Edges:
        """Locate edges on the segments by bisection, compute their weights, and record the paths to the edges.

        ``weight`` has one weight per lane. The sum of weight times contribution estimates the mean over all segments.
        Lanes of weight zero have no edge.
        """


@dataclass
class FilmSegment(PlaneSegment):
    """A segment on the film."""

    key: mi.UInt32  # seed of the random numbers that all paths of the segment share
    density: mi.Float  # joint density of the centre (per pixel) and of all other sampled quantities
    active: mi.Bool


OnFilm = TypeVar("OnFilm", bound=FilmSegment)


@dataclass(frozen=True)
class FilmSearch(EdgeSearch[OnFilm]):
    """Edge search with segments on the film, whose ``length`` is in pixels."""

    length: float

    @classmethod
    def of(cls, trace: TraceConfig, film: FilmDomain, length: float) -> Self:
        return cls(trace, film, SegmentDensity.uniform(film.size, 0.0 if film.reflects else length), length)

    @abstractmethod
    def probe(self, segment: OnFilm, t: mi.Float, active: mi.Bool) -> VisibilityProbe:
        """Probe the position ``t`` of a segment: see `Probe`."""

    @abstractmethod
    def edge(self, segment: OnFilm, a: mi.Float, b: mi.Float, active: mi.Bool) -> Edges:
        """Return the edge between positions ``a`` and ``b`` of a segment.

        The weight of its crossing is the radiance at ``a`` minus the radiance at ``b``; 0 if there is no edge.
        """

    @abstractmethod
    def slope(self, segment: OnFilm, edges: Edges) -> mi.Vector2f:
        """Compute ∂B/∂s, where s is the film position. No parameter receives a gradient."""

    def detect(self, segments: OnFilm) -> mi.Float:
        return detect(partial(self.probe, segments), segments.length, segments.active) / segments.density

    def resolve(self, segments: OnFilm, weight: mi.Float, generator: mi.PCG32) -> Edges:
        weight = dr.select(segments.active, weight, 0)
        bracket = bisect(partial(self.probe, segments), segments.length, weight, generator)
        edges = self.edge(segments, bracket.a, bracket.b, bracket.weight > 0)
        (crossing,) = edges.crossings
        jump = crossing.weight * bracket.per_length(segments.length, segments.density)
        K = crossing_weight(segments.w, jump, self.slope(segments, edges))
        return replace(edges, crossings=[replace(crossing, weight=K)])  # type: ignore[type-var]


@dataclass
class Resampled:
    """Index of the segment that each lane resolves, and the weight of the lane."""

    index: mi.UInt32
    weight: mi.Float  # 1 / expected number of lanes that resolve the same segment; 0 if no segment has an edge

    @staticmethod
    def of(mass: mi.Float, lanes: int, seed: mi.UInt32, first: mi.UInt32 | int = 0) -> Resampled:
        """Resample segments in proportion to their ``mass``, with one stratum per lane.

        The random numbers of a lane depend on ``seed`` and on its number, which starts at ``first``.
        """
        dr.eval(mass)  # used twice below
        n = dr.width(mass)
        cdf = dr.cumsum(mi.Float64(mass))
        stratum = dr.gather(mi.Float64, cdf, dr.opaque(mi.UInt32, n - 1)) / dr.opaque(mi.Float64, lanes)
        lane = dr.arange(mi.UInt32, lanes)
        x = (mi.Float64(lane) + mi.Float64(mi.sample_tea_float32(seed, first + lane, ROUNDS))) * stratum
        index = _index_at(cdf, x)
        importance = dr.gather(mi.Float, mass, index)
        return Resampled(index, dr.select(importance > 0, mi.Float(stratum) / importance, 0))


@dr.syntax
def _index_at(cdf: mi.Float64, x: mi.Float64 | mi.Float) -> mi.UInt32:
    """Return the index of the first entry of ``cdf`` above ``x``, or the last index.

    Kernels with this loop do not depend on the number of entries, and kernels with `dr.binary_search` do.
    """
    low, high = mi.UInt32(0), dr.opaque(mi.UInt32, dr.width(cdf) - 1)
    while dr.hint(low < high, exclude=[cdf, x], label="pathreplay: binary search"):
        middle = (low + high) >> 1
        below = dr.gather(mi.Float64, cdf, middle) <= x
        low, high = dr.select(below, middle + 1, low), dr.select(below, high, middle)
    return low


def pilot_size(n: int, size: mi.ScalarVector2f) -> int:
    """Return the number of pilot segments, for ``n`` segments on a film of ``size`` pixels; about `AT_ONCE` at most.

    It is odd. If it divided the number of pixels, and the quotient divided the width of the film, all rows of the film
    would have pilot segments in the same columns.
    """
    return min(n // PILOT_RATIO, PILOT_PER_PIXEL * int(size.x) * int(size.y), AT_ONCE) | 1


@dataclass(frozen=True)
class SegmentDensity:
    """Density of film positions: constant in each pixel of a grid that covers the film and a margin of width l."""

    width: int
    height: int
    margin: float  # l, the length of segments
    # Cumulative probabilities of the pixels; None: uniform. In single precision, most pixels of a film with millions of
    # pixels would have the probability 0.
    cdf: mi.Float64 | None = None

    @staticmethod
    def uniform(size: mi.ScalarVector2f, l: float) -> SegmentDensity:
        """Create a uniform density over a film of this size in pixels, with a margin for segments of length l."""
        extra = 2 * l + 1 if l else 0
        return SegmentDensity(int(size.x + extra), int(size.y + extra), l)

    def refined(self, s: mi.Point2f, importance: mi.Float, unrefined: float = UNREFINED) -> SegmentDensity:
        """Increase the density in the pixels that contain the positions ``s``, and in their neighbours.

        The ``importance`` of a position is added to its pixel. Smaller amounts are added to the neighbours, because
        edges continue there. The probability of a pixel is proportional to the square root of the importance in the
        pixel. This choice minimises the variance, a sum of (contribution of a segment)² / density. A fraction
        ``unrefined`` of the segments keeps the previous density.
        """
        n, c = self.width * self.height, s + self.margin
        counts = dr.zeros(mi.Float, n)
        for dy, dx in product((-1, 0, 1), repeat=2):
            x, y = mi.Int32(c.x) + dx, mi.Int32(c.y) + dy
            inside = (x >= 0) & (x < self.width) & (y >= 0) & (y < self.height)
            weight = 1.0 if dx == dy == 0 else AROUND / 8
            dr.scatter_add(counts, weight * dr.minimum(importance, 1), mi.UInt32(y * self.width + x), inside)
        counts = dr.sqrt(counts)
        total = dr.sum(counts)
        previous = self._probability(dr.arange(mi.UInt32, n))
        probability = dr.select(total > 0, dr.fma(counts, (1 - unrefined) / total, unrefined * previous), previous)
        cdf = dr.cumsum(mi.Float64(probability))
        cdf /= dr.gather(mi.Float64, cdf, n - 1)
        dr.eval(cdf)
        return replace(self, cdf=cdf)

    def tabulated(self) -> SegmentDensity:
        """Return this density with a table of cumulative probabilities. Without a table, `draw` has another kernel."""
        if self.cdf is not None:
            return self
        n = self.width * self.height
        cdf = mi.Float64(dr.arange(mi.UInt32, n) + 1) / n
        dr.make_opaque(cdf)
        return replace(self, cdf=cdf)

    def _probability(self, i: mi.UInt32) -> mi.Float:
        if self.cdf is None:
            return mi.Float(1 / (self.width * self.height))
        begin = dr.select(i > 0, dr.gather(mi.Float64, self.cdf, i - 1, i > 0), 0)
        return mi.Float(dr.gather(mi.Float64, self.cdf, i) - begin)

    def draw(self, x: mi.Float64 | mi.Float, y: mi.Float64 | mi.Float) -> tuple[mi.Point2f, mi.Float]:
        """Sample a film position from random numbers in the unit square; return it with its density.

        On large films, ``x`` must be a Float64, because it selects both a pixel and a position in this pixel.
        """
        n = self.width * self.height
        if self.cdf is None:
            return mi.Point2f(x, y) * mi.Point2f(self.width, self.height) - self.margin, mi.Float(1 / n)
        i = _index_at(self.cdf, x)
        probability = self._probability(i)
        rest = mi.Float(dr.gather(mi.Float64, self.cdf, i) - x)
        offset = mi.Point2f(dr.clip(1 - rest / probability, 0, dr.one_minus_epsilon(mi.Float)), y)
        return mi.Point2f(mi.Float(i % self.width), mi.Float(i // self.width)) + offset - self.margin, probability
