"""The term of a film whose places move: what their flow does to the weights of what is seen.

With the filter h_j of pixel j, of which only the part on the film D counts, and the velocity v of the film's places

    dI_j/dπ = 1/∫_D h_j · ( ∫_D div(h_j v) L ds - ∮_∂D h_j L v·n dl )                         (see `FilmFlow`).

Filters are products, h_j = f(x) f(y), and the border of the film is the place where f(x) falls to zero at once. So both
parts with ∂f/∂x are one integral over a measure, df(x), in which the mass beyond the border lies at the border:

    ∫ f(y) dy ∫ v_x L df(x),        ∫ f(x) dx ∫ v_y L df(y),        ∫_D h_j (∂v_x/∂x + ∂v_y/∂y) L ds.

df is odd: places x away from the middle of a pixel, to its right and to its left, count against each other. Their
paths have the same random numbers, so that what they have in common cancels, as it does in a difference of two
pictures. Paths only tell L: nothing of them is differentiated, and no edge has to be found.

On a film of many pixels the two places are close to each other, and most that is left is noise. So the adjoint W_j of
pixels is taken apart. Its mean over some pixels around, W̄_j, is smooth, and with it neighbours cancel better than pairs
do: a path at x counts for all pixels of its row at once,

    (W_j - W̄_j) sgn df(x - x_j) + Σ_i W̄_i df(x - x_i) / Σ_i |df(x - x_i)|,

where the sum in the denominator is the density of all places of the row. Forward mode is the transpose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from pathreplay.adjoint.autodiff import backward, tangents
from pathreplay.adjoint.baseline import Baseline
from pathreplay.adjoint.primal import primal
from pathreplay.integrators.camera_pass import Pass
from pathreplay.integrators.film.camera_flow import FilmFlow, Sample
from pathreplay.integrators.film.domain import FilmPlaces
from pathreplay.integrators.film.filter_samples import FilterSamples
from pathreplay.integrators.term import TermResult
from pathreplay.samplers.owen_sobol import OwenSobolSampler
from pathreplay.transport.start import CameraStart
from pathreplay.transport.vertex import TraceConfig

GROUP = 5
"""Paths with the same random numbers: to the right and to the left, above and below, and one for the divergence."""
BLUR, MOST = 16, 16
"""The adjoint of pixels is averaged over a BLUR-th of the film's shorter side to each side, and at most MOST pixels.

The noise of the smooth part falls with the third power of that length, as long as the adjoint is smooth over it."""
NUMBERS = 1
"""Number of the set of random numbers; the interior uses 0."""


@dataclass
class Flowing:
    """Paths, and how the flow of their places weighs what they bring."""

    pixel: mi.UInt32  # row by row
    sample: Sample  # of their camera rays
    axis: mi.UInt32  # along which places of pairs count
    single: mi.Bool  # a path for the divergence
    offset: mi.Float  # of paired paths: distance from the pixel's centre along their axis
    slope: FilterSamples  # which these are drawn from
    L: mi.Spectrum  # times its weight; what the velocity of places is multiplied with
    wavelengths: mi.Spectrum


@dataclass(frozen=True)
class FilmMotion:
    """A term: what the flow of a film does to the picture; the rest of the motion is left to other terms."""

    flow: FilmFlow

    def forward(self, view: Pass, trace: TraceConfig, learned: Baseline | None) -> TermResult:
        """Tangent of the image: see `Term`."""
        places, f = FilmPlaces.of(view), self._walked(view, trace)
        with dr.resume_grad():
            (δ,) = tangents(self._moved(view, f))
        pixels = places.pixels(f.pixel, f.L * δ, f.wavelengths)
        pixels += blurred(sum(places.pixels(i, f.L * δ * share, f.wavelengths) for i, share in self._shared(view, f)))
        return TermResult(places.developed(pixels))

    def backward(self, view: Pass, trace: TraceConfig, grad_in: mi.TensorXf, learned: Baseline | None) -> TermResult:
        """Back-propagate the adjoint of the image: see `Term`."""
        places, f = FilmPlaces.of(view), self._walked(view, trace)
        wanted = places.undeveloped(grad_in)
        smooth = blurred(wanted)
        W = places.importance_of_pixels(wanted, f.pixel, f.wavelengths)
        W += sum(share * places.importance_of_pixels(smooth, i, f.wavelengths) for i, share in self._shared(view, f))
        δ = dr.sum(W * f.L)
        # Every parameter of the camera sums over these apart, which would walk the paths as often.
        dr.eval(δ, f.sample.place)
        with dr.resume_grad():
            backward(δ * self._moved(view, f))
        dr.eval()
        return TermResult()

    def note(self, trace: TraceConfig) -> str:
        """Nothing: see `Term`."""
        return ""

    def _moved(self, view: Pass, f: Flowing) -> mi.Float:
        """Of pairs the velocity of their place along their axis, in pixels; of single paths its divergence."""
        v = self.flow.velocity(f.sample) * mi.Vector2f(*view.size)
        return dr.select(f.single, self.flow.divergence(f.sample), dr.select(f.axis == 0, v.x, v.y))

    def _shared(self, view: Pass, f: Flowing) -> list[tuple[mi.UInt32, mi.Float]]:
        """How much of the smooth weight of which pixels a path of a pair has, as shares of the weight of its own.

        Less all of its own, which has that already.
        """
        width, height = view.size
        slope, along_x = f.slope, f.axis == 0
        place, most = dr.select(along_x, f.pixel % width, f.pixel // width), dr.select(along_x, mi.Int32(width), height)
        first, total = mi.Int32(dr.ceil(f.offset - slope.radius)), mi.Float(0)
        masses = []
        for k in range(math.ceil(2 * slope.radius)):
            i = first + k
            inside = ~f.single & (mi.Int32(place) + i >= 0) & (mi.Int32(place) + i < most)
            mass = dr.select(inside, slope.mass(f.offset - mi.Float(i)), 0)
            pixel = mi.UInt32(mi.Int32(f.pixel) + i * dr.select(along_x, mi.Int32(1), width))
            masses.append((dr.select(inside, pixel, f.pixel), mass))
            total += dr.abs(mass)
        scale = dr.select(total > 0, slope.sign(f.offset) / total, 0)
        return [(f.pixel, dr.select(f.single, 0, mi.Float(-1))), *((pixel, mass * scale) for pixel, mass in masses)]

    def _usual(self, view: Pass, trace: TraceConfig) -> mi.Float:
        """What is usually seen, as one number, by paths of its own.

        A picture that is the same everywhere does not change while its places move, so that radiance counts less that.
        """
        width, height = view.size
        pixel = dr.arange(mi.UInt32, width * height)
        numbers = view.numbers(pixel, width, mi.UInt32(0), 1, NUMBERS + 1)
        place = (mi.Point2f(pixel % width, pixel // width) + numbers.next_2d()) / mi.Point2f(width, height)
        sample = Sample(view.sensor.shutter_open(), numbers.next_1d(), place, numbers.next_2d())
        there = dr.full(mi.Bool, True, width * height) & self.flow.moves_at(place)
        L, _ = _seen(view, trace, sample, numbers, there)
        return dr.sum(dr.mean(L)) / dr.maximum(mi.Float(dr.count(there)), 1)

    def _walked(self, view: Pass, trace: TraceConfig) -> Flowing:
        """Walk the paths of a pass."""
        width, height = view.size
        groups = -(-view.spp // self.flow.samples)
        i = dr.arange(mi.UInt32, width * height * groups * GROUP)
        member, group = i % GROUP, i // GROUP
        pixel, single, axis = group // groups, member == GROUP - 1, member // 2
        numbers = view.numbers(pixel, width, group % groups, groups, NUMBERS)

        sensor, film, u = view.sensor, view.sensor.film(), numbers.next_2d()
        places, filter, slope = FilmPlaces.of(view), FilterSamples.of(film), FilterSamples.of_slope(film)
        middle = mi.Point2f(mi.Float(pixel % width), mi.Float(pixel // width)) + 0.5
        middle += mi.Point2f(mi.ScalarPoint2f(film.crop_offset()) - places.corner)
        s, weight, offset = mi.Point2f(0), mi.Float(1 / groups), mi.Float(0)
        for k in range(2):
            low, high = filter.share(-middle[k]), filter.share(places.size[k] - middle[k])
            x, away = filter.draw(u[k], low, high), slope.draw(u[k], mi.Float(0.5), mi.Float(1))
            pairs = ~single & (axis == k)
            x = dr.select(pairs, dr.select(member % 2 == 0, away, -away), x)
            offset = dr.select(pairs, x, offset)
            s[k] = dr.clip(middle[k] + x, 0, places.size[k])
            mass = dr.select(pairs, 0.5 * slope.total * slope.sign(x), filter.total * (high - low) * filter.sign(x))
            weight *= mass
        place = places.in_sensor(s)

        time = sensor.shutter_open() + numbers.next_1d() * sensor.shutter_open_time()
        sample = Sample(time, numbers.next_1d(), place, numbers.next_2d())
        L, wavelengths = _seen(view, trace, sample, numbers, self.flow.moves_at(place))
        L = (L - self._usual(view, trace)) * weight
        return Flowing(pixel, sample, axis, single, offset, slope, L, wavelengths)


def _seen(
    view: Pass, trace: TraceConfig, sample: Sample, numbers: OwenSobolSampler, active: mi.Bool
) -> tuple[mi.Spectrum, mi.Spectrum]:
    """What a path brings that begins with the camera ray of a sample, times the ray's weight; and its wavelengths."""
    ray, weight = dr.detach(sample.ray(view.sensor))
    L, _ = primal(trace, CameraStart(mi.Ray3f(ray), numbers, active))
    return L * weight, ray.wavelengths


def blurred(pixels: mi.TensorXf) -> mi.TensorXf:
    """The mean of pixels over a square around each, with zero beyond the border: its own transpose."""
    height, width, channels = pixels.shape
    reach = min(max(min(height, width) // BLUR, 1), MOST)
    index, values = dr.arange(mi.UInt32, height * width * channels), pixels.array
    for stride, most in ((channels, width), (channels * width, height)):
        place, total = mi.Int32(index // stride % most), mi.Float(0)
        for k in range(-reach, reach + 1):
            inside = (place + k >= 0) & (place + k < most)
            total += dr.gather(mi.Float, values, mi.UInt32(mi.Int32(index) + k * stride), inside)
        values = total / (2 * reach + 1)
        dr.eval(values)  # before it is read at other places
    return mi.TensorXf(values, pixels.shape)
