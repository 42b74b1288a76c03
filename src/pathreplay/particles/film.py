"""The film of light paths: contributions at arbitrary positions, spread by the reconstruction filter.

Let h be the filter, s the film position of a contribution, and c the value of the contribution. The pixel at x is the
sum of h(x - s) c / ∫h over all contributions, multiplied by the number of pixels and divided by the number of light
paths. The sum is differentiable in c and s. Mitsuba's `ImageBlock` does not divide by ∫h, but by the sum of h over the
pixels around s, and omits the derivative of this divisor.

Contributions from up to one filter radius outside of the film are added as well. A contribution that moves across the
border of the film then changes the image continuously. Camera paths give the same image if ``sample_border`` is true.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.transport.sensor import METER

STEPS = 4096  # number of steps of the midpoint rule for the integral of the filter


@dataclass
class Footprint:
    """The pixels that a contribution reaches: a square with n pixels along each side (see `ParticleFilm`).

    ``corner`` is the pixel with the smallest coordinates. ``x`` and ``y`` are the values of the filter along the axes.
    """

    corner: mi.Point2i
    x: list[mi.Float]
    y: list[mi.Float]


@dataclass(frozen=True)
class ParticleFilm:
    """The film of a sensor. Its methods use buffers with four numbers per pixel: red, green, blue, and zero."""

    film: mi.Film
    width: int
    height: int
    n: int  # pixels along one side of a footprint
    meter: bool  # the sensor is an irradiance meter, whose film has a single pixel
    mass: float | mi.Float  # integral of the filter over the film plane

    @staticmethod
    def of(sensor: mi.Sensor) -> ParticleFilm:
        """Describe the film of a sensor. Raises PathreplayError if it stores spectra instead of colours."""
        film = sensor.film()
        film.prepare([])
        if mi.has_flag(film.flags(), mi.FilmFlags.Special):
            raise PathreplayError(
                f"light paths cannot be added to the film of sensor '{sensor.id()}': a {film.class_name()} stores "
                "spectra; take an hdrfilm"
            )
        filter, (width, height) = film.rfilter(), film.crop_size()
        meter, mass = sensor.class_name() == METER, _length(filter) ** 2
        return ParticleFilm(film, int(width), int(height), math.ceil(2 * float(filter.radius())), meter, mass)

    @property
    def pixels(self) -> int:
        return self.width * self.height

    def footprint(self, s: mi.Point2f) -> Footprint:
        """Return the footprint of a film position, differentiably in the position."""
        filter, radius = self.film.rfilter(), float(self.film.rfilter().radius())
        corner = mi.Point2i(dr.ceil(dr.detach(s) - (radius + 0.5)))
        first = mi.Point2f(corner) + 0.5 - s
        return Footprint(
            corner,
            [filter.eval(first.x + k) for k in range(self.n)],
            [filter.eval(first.y + k) for k in range(self.n)],
        )

    def add(
        self, sums: mi.Float, at: Footprint, x: list[mi.Float], y: list[mi.Float], c: mi.Color3f, ok: mi.Bool
    ) -> None:
        """Add the colour ``c`` to the pixels of the footprint ``at`` in the buffer ``sums``, where ``ok`` is set.

        The weight of a pixel is the product of an entry of ``x`` and an entry of ``y``.
        """
        for column in range(self.n):
            for row in range(self.n):
                index, inside = self._pixel(at, column, row)
                value = c if self.meter else c * (x[column] * y[row])
                dr.scatter_add(sums, mi.Vector4f(value.x, value.y, value.z, 0), index, ok & inside)

    def gather(self, buffer: mi.Float, s: mi.Point2f, active: mi.Bool) -> mi.Color3f:
        """Return Σ h(x - s) A(x) over the pixels x, with A the ``buffer``. The sum is differentiable in s."""
        at, total = self.footprint(s), mi.Color3f(0)
        for column in range(self.n):
            for row in range(self.n):
                index, inside = self._pixel(at, column, row)
                A = dr.gather(mi.Vector4f, buffer, index, active & inside)
                total += mi.Color3f(A.x, A.y, A.z) * (1 if self.meter else at.x[column] * at.y[row])
        return total

    def _pixel(self, at: Footprint, column: int, row: int) -> tuple[mi.UInt32, mi.Bool]:
        if self.meter:
            return mi.UInt32(0), mi.Bool(column == 0 and row == 0)
        x, y = at.corner.x + column, at.corner.y + row
        return mi.UInt32(y * self.width + x), (x >= 0) & (x < self.width) & (y >= 0) & (y < self.height)

    def scale(self, number: int) -> float | mi.Float:
        """Return the factor that converts a sum over ``number`` light paths to an image."""
        return self.pixels / (number * (1.0 if self.meter else self.mass))

    def develop(self, sums: mi.Float) -> mi.TensorXf:
        """Convert a buffer to an image of the film, with zero alpha, differentiably."""
        channels = self.film.create_block().channel_count()
        i = dr.arange(mi.UInt32, self.pixels * channels)
        pixel, channel = i // channels, i % channels
        colour = channel < 3
        value = dr.gather(mi.Float, sums, 4 * pixel + channel, colour)
        block = dr.select(colour, value, dr.select(channel == channels - 1, mi.Float(1), 0))
        tensor = mi.TensorXf(block, (self.height, self.width, channels))
        self.film.prepare([])
        self.film.put_block(mi.ImageBlock(tensor, self.film.crop_offset()))
        return self.film.develop()

    def adjoint(self, grad_in: mi.TensorXf) -> mi.Float:
        """Back-propagate the adjoint ``grad_in`` of an image through `develop`; return the adjoint of the buffer."""
        with dr.resume_grad():
            sums = dr.zeros(mi.Float, 4 * self.pixels)
            dr.enable_grad(sums)
            image = self.develop(sums)
            dr.set_grad(image, grad_in)
            dr.enqueue(dr.ADMode.Backward, image)
            dr.traverse(dr.ADMode.Backward)
            buffer = dr.grad(sums)
        self.film.clear()
        dr.eval(buffer)
        return buffer


# Cache of the integrals of filters along one axis. The keys are the string representations and radii of the filters:
# the representation of a gaussian filter has only two digits, but its radius is four standard deviations.
_LENGTHS: dict[tuple[str, float], float] = {}


def _length(filter: mi.ReconstructionFilter) -> float | mi.Float:
    """Return the integral of a filter along one axis. A pass that `dr.freeze` records includes its computation."""
    radius = float(filter.radius())
    key = str(filter), radius
    if key not in _LENGTHS:
        at = ((dr.arange(mi.Float, STEPS) + 0.5) / STEPS * 2 - 1) * radius
        if dr.flag(dr.JitFlag.FreezingScope):
            return 2 * radius * dr.mean(filter.eval(at))
        _LENGTHS[key] = 2 * radius * float(np.mean(filter.eval(at).numpy(), dtype=float))
    return _LENGTHS[key]


def colour(c: mi.Spectrum, wavelengths: mi.Spectrum) -> mi.Color3f:
    """Convert a radiance to the colour that films store, as Mitsuba does. The conversion is linear."""
    if mi.is_spectral:
        return mi.spectrum_to_srgb(c, wavelengths)  # type: ignore[attr-defined, no-any-return]  # spectral variants only
    return mi.Color3f(c.x) if mi.is_monochromatic else mi.Color3f(c)


def colour_adjoint(A: mi.Color3f, wavelengths: mi.Spectrum) -> mi.Spectrum:
    """Apply the transpose of the linear map `colour`."""
    if mi.is_spectral:
        result = mi.Spectrum(0)
        for k in range(len(result)):
            unit = mi.Spectrum(0)
            unit[k] = 1
            result[k] = dr.dot(A, colour(unit, wavelengths))
        return result
    return mi.Spectrum(A.x + A.y + A.z) if mi.is_monochromatic else mi.Spectrum(A)
