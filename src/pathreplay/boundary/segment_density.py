"""Where on the film edges are worth looking for: at random by pixel, more often where a first look has found some."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import drjit as dr
import mitsuba as mi

LOOKS, PER_PIXEL = 8, 2
"""Of so many lines one belongs to the first look, which has at most so many lines per pixel."""
AROUND = 1.0
"""Lines that are thrown at the pixels around what was found, for one at its own."""
EVENLY = 0.25
"""Share of the lines that are thrown evenly, unless one asks for more: the first look misses some."""


def looks_of(lines: int, size: mi.ScalarVector2f) -> int:
    """How many lines the first look has, of ``lines`` in all, on a film of ``size`` pixels."""
    return max(min(lines // LOOKS, PER_PIXEL * int(size.x) * int(size.y)), 1)


@dataclass(frozen=True)
class SegmentDensity:
    """A distribution of places: constant in each pixel of a grid that covers the film, and l beyond."""

    width: int
    height: int
    margin: float  # l
    until: mi.Float | None = None  # of each pixel, the probability of those up to it; None: all alike

    @staticmethod
    def even(size: mi.ScalarVector2f, l: float) -> SegmentDensity:
        """All places alike, of a film of so many pixels and lines of length l."""
        return SegmentDensity(int(size.x + 2 * l + 1), int(size.y + 2 * l + 1), l)

    def refined(self, c: mi.Point2f, found: mi.Float, evenly: float = EVENLY) -> SegmentDensity:
        """More often where there was something, at places ``c`` so much, and around: edges go on.

        By the root of how much: variance is a sum of (what lines find, squared) / density, which is then least.
        ``evenly`` is the share of places that are drawn as before.
        """
        n = self.width * self.height
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
        """A place, from the corner of the grid, and its density, from random numbers in the unit square."""
        n = self.width * self.height
        if self.until is None:
            return u * mi.Point2f(self.width, self.height), mi.Float(1 / n)
        below = lambda i: dr.gather(mi.Float, self.until, i) <= u.x  # noqa: E731
        i = mi.UInt32(dr.minimum(dr.binary_search(0, n - 1, below), n - 1))  # a number where there is one pixel
        share = self._share(i)
        begin = dr.gather(mi.Float, self.until, i) - share
        x = dr.clip((u.x - begin) / share, 0, dr.one_minus_epsilon(mi.Float))
        return mi.Point2f(mi.Float(i % self.width) + x, mi.Float(i // self.width) + u.y), share
