"""Places around a pixel that are drawn by the film's filter, so that a path belongs to one pixel, whatever the filter.

Filter importance sampling (Ernst, Stamminger and Greiner, "Filter Importance Sampling", 2006): with density w / ∫ w the
mean of what paths bring is the filtered pixel. No sample is shared with the neighbours, which makes a picture noisier
than one that is splatted. Filters are products of one function of x and one of y, taken as a staircase of `STEPS`.
Where a function is negative in places, its size is drawn, and `sign` tells.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

STEPS = 1024


def is_drawable(film: mi.Film) -> bool:
    """Whether the film's filter is a density: those of some are negative in places (`mitchell`, `lanczos`)."""
    return bool(dr.all(film.rfilter().eval(_middles(film.rfilter().radius())) >= 0))


def _middles(radius: float) -> mi.Float:
    return (dr.arange(mi.Float, STEPS) + 0.5) * (2 * radius / STEPS) - radius


@dataclass(frozen=True)
class FilterSamples:
    """Draws distances from the middle of a pixel, in pixels and along one axis, with the density of a filter."""

    radius: float
    until: mi.Float  # of each step, the share of the filter up to its end
    masses: mi.Float  # integral over each step
    total: mi.Float  # of their sizes

    @staticmethod
    def of(film: mi.Film) -> FilterSamples:
        """Samples of the film's filter."""
        radius = film.rfilter().radius()
        return FilterSamples._of(radius, film.rfilter().eval(_middles(radius)) * (2 * radius / STEPS))

    @staticmethod
    def of_slope(film: mi.Film) -> FilterSamples:
        """Samples of the filter's derivative. A jump, as at the ends of a box, is a point mass of its height."""
        radius = film.rfilter().radius() * STEPS / (STEPS - 1)  # jumps at its ends lie in the middle of steps
        step = 2 * radius / STEPS
        x = _middles(radius)
        return FilterSamples._of(radius, film.rfilter().eval(x + 0.5 * step) - film.rfilter().eval(x - 0.5 * step))

    @staticmethod
    def _of(radius: float, masses: mi.Float) -> FilterSamples:
        sums = dr.cumsum(dr.abs(masses))
        total = dr.gather(mi.Float, sums, STEPS - 1)
        until = sums / total
        dr.eval(until, masses, total)  # before loops read them
        return FilterSamples(radius, until, masses, total)

    def share(self, x: mi.Float) -> mi.Float:
        """The share of the filter up to a distance."""
        place, i = self._place(x)
        begin, end = self._step(i)
        return dr.lerp(begin, end, place - mi.Float(i))

    def draw(self, u: mi.Float, low: mi.Float, high: mi.Float) -> mi.Float:
        """A distance from a random number, between those of the shares ``low`` and ``high``."""
        v = dr.lerp(low, high, u)
        last = STEPS - 1
        i = dr.minimum(dr.binary_search(0, last, lambda i: dr.gather(mi.Float, self.until, i) <= v), last)
        begin, end = self._step(i)
        across = dr.clip((v - begin) / (end - begin), 0, 1)
        return (mi.Float(i) + across) * (2 * self.radius / STEPS) - self.radius

    def _step(self, i: mi.UInt32) -> tuple[mi.Float, mi.Float]:
        """The shares up to its begin and its end."""
        begin = dr.select(i > 0, dr.gather(mi.Float, self.until, i - 1, i > 0), 0)
        return begin, dr.gather(mi.Float, self.until, i)

    def mass(self, x: mi.Float) -> mi.Float:
        """The integral of the function over the step that a distance is in; beyond the filter, zero."""
        return dr.select(dr.abs(x) <= self.radius, dr.gather(mi.Float, self.masses, self._place(x)[1]), 0)

    def sign(self, x: mi.Float) -> mi.Float:
        """The sign of the function at a distance."""
        return dr.sign(dr.gather(mi.Float, self.masses, self._place(x)[1]))

    def _place(self, x: mi.Float) -> tuple[mi.Float, mi.UInt32]:
        """A distance in steps, and the number of its step."""
        place = dr.clip((x + self.radius) * (0.5 * STEPS / self.radius), 0, STEPS)
        return place, dr.minimum(mi.UInt32(place), STEPS - 1)
