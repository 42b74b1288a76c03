"""The gradient term of a film flow: the derivative of the filter weights when film positions move.

With the filter h_j of pixel j, restricted to the film D, and the velocity v of film positions (see `camera_flow`),

    dI_j/dπ = 1/∫_D h_j · ( ∫_D div(h_j v) L ds - ∮_∂D h_j L v·n dl ).

Filters are products h_j = f(x) f(y), and f(x) jumps to zero at the border of the film. The derivative of f is therefore
a measure df(x): the slope of f inside the film, and the jump as a point mass at the border. The derivative of I_j
consists of the three integrals

    ∫ f(y) dy ∫ v_x L df(x),        ∫ f(x) dx ∫ v_y L df(y),        ∫_D h_j (∂v_x/∂x + ∂v_y/∂y) L ds.

The measure df is odd: two positions at the same distance to the right and to the left of a pixel centre have opposite
signs. Paths are sampled in such pairs with the same random numbers, so that common parts of their radiance cancel, as
in a finite difference of two images. Paths only estimate L: they are not differentiated, and no edges are sampled.

On a film of many pixels, the two positions of a pair are close to each other, and the difference of their radiance is
mostly noise. The adjoint W_j of pixel j is therefore split into its local mean W̄_j and the remainder W_j - W̄_j. The
local mean is smooth, so that the contributions of one path to adjacent pixels almost cancel. A path at x that was
sampled for the pixel at x_j therefore contributes to all pixels of the row, with the weight

    (W_j - W̄_j) sgn df(x - x_j) + Σ_i W̄_i df(x - x_i) / Σ_i |df(x - x_i)|,

where the denominator is the density of the positions that are sampled for all pixels of the row. Forward mode applies
the transpose of this map from W to weights.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import reduce
from operator import add

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import backward, tangents
from pathreplay.adjoint.baseline import Baseline
from pathreplay.adjoint.primal import primal
from pathreplay.integrators.camera_pass import Pass
from pathreplay.integrators.film.camera_flow import FilmFlow
from pathreplay.integrators.film.domain import FilmPlaces
from pathreplay.integrators.film.filter_samples import FilterSamples
from pathreplay.integrators.film.sample import Sample
from pathreplay.integrators.term import Term, TermResult
from pathreplay.samplers.owen_sobol import OwenSobolSampler
from pathreplay.samplers.streams import Stream
from pathreplay.transport.start import CameraStart
from pathreplay.transport.vertex import TraceConfig, channel_mean

GROUP = 5
"""Number of paths with the same random numbers: right and left, above and below, and one for the divergence."""
BLUR, MOST = 16, 16
"""The local mean of the adjoint at a pixel is the mean over a square around the pixel. The square extends to each side
by 1 / BLUR of the film's shorter side, but by at most MOST pixels. The noise of the term that contains the local mean
falls with the third power of this length, if the adjoint is smooth over the square."""

CLIP = 4.0
"""Radiance above CLIP · (mean √L)² is clipped in `FilmMotion._typical_radiance`."""


@dataclass
class FlowPaths:
    """The paths that `FilmMotion` traces: their pixels, their film positions and their weighted radiance."""

    pixel: mi.UInt32  # row-major index
    sample: Sample  # sample of the camera ray
    axis: mi.UInt32  # axis along which the two positions of a pair differ
    single: mi.Bool  # whether the path estimates the divergence and belongs to no pair
    offset: mi.Float  # distance of a path of a pair from the pixel centre, along the axis
    derivative: FilterSamples  # sampler that draws the offsets from the derivative of the filter
    L: mi.Spectrum  # weighted radiance, to be multiplied by the velocity or the divergence
    wavelengths: mi.Spectrum


@dataclass(frozen=True)
class FilmMotion(Term):
    """The gradient term of a film flow. It does not differentiate motion of rays that the flow does not contain."""

    flow: FilmFlow

    def forward(self, view: Pass, trace: TraceConfig, learned: Baseline | None) -> TermResult:
        places, f = FilmPlaces.of(view), self._trace(view, trace)
        with dr.resume_grad():
            (δ,) = tangents(self._flow_factor(view, f))
        pixels = places.pixels(f.pixel, f.L * δ, f.wavelengths)
        shifted = (places.pixels(i, f.L * δ * factor, f.wavelengths) for i, factor in self._smooth_factors(view, f))
        pixels += blurred(reduce(add, shifted))
        return TermResult(places.developed(pixels))

    def backward(self, view: Pass, trace: TraceConfig, grad_in: mi.TensorXf, learned: Baseline | None) -> TermResult:
        places, f = FilmPlaces.of(view), self._trace(view, trace)
        block_grad = places.undeveloped(grad_in)
        smooth = blurred(block_grad)
        W = places.importance_of_pixels(block_grad, f.pixel, f.wavelengths)
        W += sum(
            factor * places.importance_of_pixels(smooth, i, f.wavelengths)
            for i, factor in self._smooth_factors(view, f)
        )
        δ = dr.sum(W * f.L)
        # The gradient of each camera parameter is a separate sum. Without evaluation, each sum would trace all paths.
        dr.eval(δ, f.sample.position)
        with dr.resume_grad():
            backward(δ * self._flow_factor(view, f))
        dr.eval()
        return TermResult()

    def _flow_factor(self, view: Pass, f: FlowPaths) -> mi.Float:
        """Return the factor by which the radiance of each path is multiplied.

        For a path of a pair, the factor is the velocity along the axis of the pair, in pixels. For a path that belongs
        to no pair, the factor is the divergence of the flow.
        """
        v = self.flow.velocity(f.sample) * mi.Vector2f(*view.size)
        return dr.select(f.single, self.flow.divergence(f.sample), dr.select(f.axis == 0, v.x, v.y))

    def _smooth_factors(self, view: Pass, f: FlowPaths) -> list[tuple[mi.UInt32, mi.Float]]:
        """Return the pixels to which a path contributes through the local mean W̄ of the adjoint, with factors.

        `backward` multiplies the radiance of a path by a weight. This weight is the adjoint W of the path's own pixel,
        plus the sum of factor · W̄ over the returned pairs (pixel, factor). The first pair is the path's own pixel with
        the factor -1, so that W becomes W - W̄. For a path that belongs to no pair of paths, all factors are zero.
        """
        width, height = view.size
        derivative, along_x = f.derivative, f.axis == 0
        index, most = dr.select(along_x, f.pixel % width, f.pixel // width), dr.select(along_x, mi.Int32(width), height)
        first, total = mi.Int32(dr.ceil(f.offset - derivative.radius)), mi.Float(0)
        masses = []
        for k in range(math.ceil(2 * derivative.radius)):
            i = first + k
            inside = ~f.single & (mi.Int32(index) + i >= 0) & (mi.Int32(index) + i < most)
            mass = dr.select(inside, derivative.mass(f.offset - mi.Float(i)), 0)
            pixel = mi.UInt32(mi.Int32(f.pixel) + i * dr.select(along_x, mi.Int32(1), width))
            masses.append((dr.select(inside, pixel, f.pixel), mass))
            total += dr.abs(mass)
        scale = dr.select(total > 0, derivative.sign(f.offset) / total, 0)
        return [(f.pixel, dr.select(f.single, 0, mi.Float(-1))), *((pixel, mass * scale) for pixel, mass in masses)]

    def _typical_radiance(self, view: Pass, trace: TraceConfig) -> mi.Float:
        """Estimate a typical radiance over the positions at which the flow may be non-zero, from independent paths.

        Subtracting it from all radiance reduces noise. The subtraction adds no bias, because motion does not change a
        constant image. The estimate is a mean of clipped radiance (see `CLIP`). The mean of the radiance itself would
        depend on whether one of the paths meets a small, bright light.
        """
        width, height = view.size
        pixel = dr.arange(mi.UInt32, width * height)
        sampler = view.sobol_sampler(pixel, width, mi.UInt32(0), 1, Stream.FLOW_MEAN)
        position = (mi.Point2f(pixel % width, pixel // width) + sampler.next_2d()) / mi.Point2f(width, height)
        sample = Sample(view.sensor.shutter_open(), sampler.next_1d(), position, sampler.next_2d())
        moving = dr.full(mi.Bool, True, width * height) & self.flow.moves_at(position)
        L = channel_mean(_radiance(view, trace, sample, sampler, moving)[0])
        dr.eval(L)  # two sums follow
        n = dr.maximum(mi.Float(dr.count(moving)), 1)
        most = CLIP * dr.square(dr.sum(dr.safe_sqrt(L)) / n)
        return dr.sum(dr.minimum(L, most)) / n

    def _trace(self, view: Pass, trace: TraceConfig) -> FlowPaths:
        width, height = view.size
        number = -(-view.spp // self.flow.samples)
        i, groups = dr.arange(mi.UInt32, width * height * number * GROUP), dr.opaque(mi.UInt32, number)
        member, group = i % GROUP, i // GROUP
        pixel, single, axis = group // groups, member == GROUP - 1, member // 2
        sampler = view.sobol_sampler(pixel, width, group % groups, number, Stream.FLOW)

        sensor, film, u = view.sensor, view.sensor.film(), sampler.next_2d()
        places, filter, derivative = FilmPlaces.of(view), FilterSamples.of(film), FilterSamples.of_derivative(film)
        middle = mi.Point2f(mi.Float(pixel % width), mi.Float(pixel // width)) + 0.5
        middle += mi.Point2f(mi.ScalarPoint2f(film.crop_offset()) - places.corner)
        s, weight, offset = mi.Point2f(0), dr.opaque(mi.Float, 1 / number), mi.Float(0)
        for k in range(2):
            low, high = filter.cdf_at(-middle[k]), filter.cdf_at(places.size[k] - middle[k])
            x, away = filter.draw(u[k], low, high), derivative.draw(u[k], mi.Float(0.5), mi.Float(1))
            pairs = ~single & (axis == k)
            x = dr.select(pairs, dr.select(member % 2 == 0, away, -away), x)
            offset = dr.select(pairs, x, offset)
            s[k] = dr.clip(middle[k] + x, 0, places.size[k])
            mass = dr.select(
                pairs, 0.5 * derivative.total * derivative.sign(x), filter.total * (high - low) * filter.sign(x)
            )
            weight *= mass
        position = places.in_sensor(s)

        time = sensor.shutter_open() + sampler.next_1d() * sensor.shutter_open_time()
        sample = Sample(time, sampler.next_1d(), position, sampler.next_2d())
        L, wavelengths = _radiance(view, trace, sample, sampler, self.flow.moves_at(position))
        L = (L - self._typical_radiance(view, trace)) * weight
        return FlowPaths(pixel, sample, axis, single, offset, derivative, L, wavelengths)


def _radiance(
    view: Pass, trace: TraceConfig, sample: Sample, sampler: OwenSobolSampler, active: mi.Bool
) -> tuple[mi.Spectrum, mi.Spectrum]:
    """Return the weighted radiance along the camera ray of a sample, and the wavelengths of the ray."""
    ray, weight = dr.detach(sample.ray(view.sensor))
    L, _ = primal(trace, CameraStart(mi.Ray3f(ray), sampler, active))
    return L * weight, ray.wavelengths


def blurred(pixels: mi.TensorXf) -> mi.TensorXf:
    """Average pixels over squares, with zeros outside the image. This linear map is its own transpose."""
    height, width, channels = pixels.shape
    reach = min(max(min(height, width) // BLUR, 1), MOST)
    index, values = dr.arange(mi.UInt32, height * width * channels), pixels.array
    for stride, most in ((channels, width), (channels * width, height)):
        position, total = mi.Int32(index // stride % most), mi.Float(0)
        for k in range(-reach, reach + 1):
            inside = (position + k >= 0) & (position + k < most)
            total += dr.gather(mi.Float, values, mi.UInt32(mi.Int32(index) + k * stride), inside)
        values = total / (2 * reach + 1)
        dr.eval(values)  # required before the next axis gathers from these values
    return mi.TensorXf(values, pixels.shape)
