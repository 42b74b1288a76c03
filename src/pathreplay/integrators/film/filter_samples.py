"""Filter importance sampling, so that each path belongs to one pixel for any filter.

If positions are drawn from the density w / ∫ w of a filter w, the mean radiance of paths is the filtered pixel
(Ernst, Stamminger and Greiner, "Filter Importance Sampling", 2006). Pixels share no samples, so images are noisier than
with splatting. A filter is the product of a function of x and a function of y. `FilterSamples` tabulates one of these
functions, or its derivative, as `STEPS` constant steps. If the tabulated function has negative parts, its absolute
value is sampled, and `sign` returns the sign.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

STEPS = 1024


def is_drawable(film: mi.Film) -> bool:
    """Return whether the film's filter is non-negative; `mitchell` and `lanczos` filters are not."""
    return bool(dr.all(film.rfilter().eval(_step_centres(film.rfilter().radius())) >= 0))


def _step_centres(radius: float) -> mi.Float:
    return (dr.arange(mi.Float, STEPS) + 0.5) * (2 * radius / STEPS) - radius


@dataclass(frozen=True)
class FilterSamples:
    """Sampler of signed offsets from a pixel centre along one axis, in pixels, with the density of a filter.

    The tabulated function is constant in each of `STEPS` steps (see the module).
    """

    radius: float
    cdf: mi.Float  # cumulative distribution at the end of each step
    masses: mi.Float  # integral of the filter, or of its derivative, over each step
    total: mi.Float  # sum of the absolute values of the masses

    @staticmethod
    def of(film: mi.Film) -> FilterSamples:
        radius = film.rfilter().radius()
        return FilterSamples._of(radius, film.rfilter().eval(_step_centres(radius)) * (2 * radius / STEPS))

    @staticmethod
    def of_derivative(film: mi.Film) -> FilterSamples:
        """Create the sampler of the filter's derivative. A jump, as at the ends of a box, becomes a point mass."""
        # With this radius, the outermost steps contain the jumps at the ends of the filter.
        radius = film.rfilter().radius() * STEPS / (STEPS - 1)
        step = 2 * radius / STEPS
        x = _step_centres(radius)
        return FilterSamples._of(radius, film.rfilter().eval(x + 0.5 * step) - film.rfilter().eval(x - 0.5 * step))

    @staticmethod
    def _of(radius: float, masses: mi.Float) -> FilterSamples:
        sums = dr.cumsum(dr.abs(masses))
        total = dr.gather(mi.Float, sums, STEPS - 1)
        cdf = sums / total
        dr.eval(cdf, masses, total)  # loops require evaluated arrays
        return FilterSamples(radius, cdf, masses, total)

    def cdf_at(self, x: mi.Float) -> mi.Float:
        position, i = self._locate(x)
        begin, end = self._step(i)
        return dr.lerp(begin, end, position - mi.Float(i))

    def draw(self, u: mi.Float, low: mi.Float, high: mi.Float) -> mi.Float:
        """Return the offset at which the cumulative distribution is ``low`` + ``u`` (``high`` - ``low``)."""
        v = dr.lerp(low, high, u)
        last = STEPS - 1
        i = dr.minimum(dr.binary_search(0, last, lambda i: dr.gather(mi.Float, self.cdf, i) <= v), last)
        begin, end = self._step(i)
        across = dr.clip((v - begin) / (end - begin), 0, 1)
        return (mi.Float(i) + across) * (2 * self.radius / STEPS) - self.radius

    def _step(self, i: mi.UInt32) -> tuple[mi.Float, mi.Float]:
        """Return the cumulative distribution at the beginning and the end of step i."""
        begin = dr.select(i > 0, dr.gather(mi.Float, self.cdf, i - 1, i > 0), 0)
        return begin, dr.gather(mi.Float, self.cdf, i)

    def mass(self, x: mi.Float) -> mi.Float:
        """Return the integral of the tabulated function over the step at an offset. Zero outside the support."""
        return dr.select(dr.abs(x) <= self.radius, dr.gather(mi.Float, self.masses, self._locate(x)[1]), 0)

    def sign(self, x: mi.Float) -> mi.Float:
        return dr.sign(dr.gather(mi.Float, self.masses, self._locate(x)[1]))

    def _locate(self, x: mi.Float) -> tuple[mi.Float, mi.UInt32]:
        """Return an offset in units of steps, and the index of its step."""
        position = dr.clip((x + self.radius) * (0.5 * STEPS / self.radius), 0, STEPS)
        return position, dr.minimum(mi.UInt32(position), STEPS - 1)
