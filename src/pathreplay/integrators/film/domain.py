"""Film positions of a pass: their camera rays, their importance under an adjoint image, and splatting."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from pathreplay.integrators.camera_pass import Pass
from pathreplay.platform.registration import mitsuba_integrator
from pathreplay.samplers.counter_sampler import CounterSampler
from pathreplay.samplers.streams import Stream

PROJECTING = frozenset({"PerspectiveCamera", "ThinLensCamera"})
"""By class: sensors that know where a point is seen."""
QUADRATURE = 128
"""Points of the integral over a filter."""


@dataclass(frozen=True)
class FilmPlaces:
    """The part of a film where paths begin: its crop window, and its border if it samples one. See `FilmDomain`."""

    view: Pass
    corner: mi.ScalarPoint2f  # in the film's pixels
    size: mi.ScalarVector2f

    @staticmethod
    def of(view: Pass) -> FilmPlaces:
        film = view.sensor.film()
        border = film.rfilter().border_size() if film.sample_border() else 0
        corner = mi.ScalarPoint2f(film.crop_offset()) - border
        return FilmPlaces(view, corner, mi.ScalarVector2f(film.crop_size()) + 2 * border)

    def ray(self, s: mi.Point2f, key: mi.UInt32) -> tuple[mi.Ray3f, mi.Spectrum]:
        """The camera ray through a place, and its weight: see `FilmDomain`."""
        sensor, numbers, place = self.view.sensor, CounterSampler.stream(key, Stream.CAMERA), self.in_sensor(s)
        time = sensor.shutter_open() + numbers.next_1d() * sensor.shutter_open_time()
        wavelength, aperture = numbers.next_1d(), numbers.next_2d()
        ray, weight = self.view.camera_ray(time, wavelength, place, aperture)
        return mi.Ray3f(ray), dr.detach(weight)

    def flows(self, s: mi.Point2f) -> mi.Bool:
        """Whether what stands still may slide under a place: see `FilmDomain`."""
        flow = self.view.flow
        return mi.Bool(False) if flow is None else flow.leaves_rest_at(self.in_sensor(s))

    def of_point(self, p: mi.Point3f) -> tuple[mi.Point2f, mi.Bool]:
        """The place where a point of space would be seen: see `FilmDomain`."""
        sensor = self.view.sensor
        if sensor.class_name() not in PROJECTING:
            return mi.Point2f(0), mi.Bool(False)
        at = dr.zeros(mi.Interaction3f)
        at.p = p
        direction, _ = sensor.sample_direction(at, mi.Point2f(0.5), True)
        return direction.uv + (mi.ScalarPoint2f(sensor.film().crop_offset()) - self.corner), direction.pdf > 0

    def in_sensor(self, s: mi.Point2f) -> mi.Point2f:
        """A place in widths and heights of the crop window, as sensors want it."""
        film = self.view.sensor.film()
        return (self.corner + s - mi.ScalarPoint2f(film.crop_offset())) / mi.ScalarVector2f(film.crop_size())

    def undeveloped(self, grad_in: mi.TensorXf) -> mi.TensorXf:
        """Adjoint of a film block's pixels from that of the image: g_j / ∫ h_j, with the filter h_j of pixel j."""
        with dr.resume_grad():
            pixels = mi.TensorXf(self._block().tensor())
            dr.enable_grad(pixels)
            image = self.developed(pixels)
            dr.set_grad(image, grad_in)
            dr.enqueue(dr.ADMode.Backward, image)
            dr.traverse(dr.ADMode.Backward)
            return dr.grad(pixels)

    def importance(self, wanted: mi.TensorXf, s: mi.Point2f, wavelengths: mi.Spectrum) -> mi.Spectrum:
        """W(s) = Σ_j g_j h_j(s) / ∫ h_j, what is wanted of radiance at places, per pixel of film; outside nothing.

        ``wanted`` is the adjoint of a block: see `undeveloped`.
        """
        inside = dr.all((s >= 0) & (s < self.size))
        return dr.select(inside, _adjoint(lambda L: self._put(s, L, wavelengths), dr.width(s), wanted), 0)

    def image(self, s: mi.Point2f, L: mi.Spectrum, wavelengths: mi.Spectrum) -> mi.TensorXf:
        """The image that radiances make which arrive at places, each for a pixel's area of film."""
        inside = dr.all((s >= 0) & (s < self.size))
        return self.developed(self._put(s, dr.select(inside, L, 0), wavelengths))

    def importance_of_pixels(self, wanted: mi.TensorXf, pixel: mi.UInt32, wavelengths: mi.Spectrum) -> mi.Spectrum:
        """Importance g_j / ∫ h_j of pixels by row-major index: see `importance`."""
        return _adjoint(lambda L: self.pixels(pixel, L, wavelengths), dr.width(pixel), wanted)

    def pixels(self, pixel: mi.UInt32, L: mi.Spectrum, wavelengths: mi.Spectrum) -> mi.TensorXf:
        """The pixels of a block without a filter: each is the sum of the radiances that are given for its number."""
        film, like = self.view.sensor.film(), self._block()
        offset, size = mi.ScalarPoint2i(film.crop_offset()), mi.ScalarVector2u(film.crop_size())
        block = mi.ImageBlock(size, offset, like.channel_count())
        place = mi.Point2f(mi.Float(pixel % size.x), mi.Float(pixel // size.x)) + 0.5 + mi.ScalarPoint2f(offset)
        _splat(block, film, place, L, wavelengths)
        return block.tensor()

    def _block(self) -> mi.ImageBlock:
        film = self.view.sensor.film()
        film.prepare([])
        return film.create_block()

    def _put(self, s: mi.Point2f, L: mi.Spectrum, wavelengths: mi.Spectrum) -> mi.TensorXf:
        """The pixels of a block under the film's filter."""
        block = self._block()
        _splat(block, self.view.sensor.film(), self.corner + s, L, wavelengths)
        return block.tensor()

    def developed(self, pixels: mi.TensorXf) -> mi.TensorXf:
        """The image of a block without weights: each pixel is divided by ∫ h_j."""
        film, block = self.view.sensor.film(), self._block()
        height, width, channels = pixels.shape
        index = dr.arange(mi.UInt32, height * width * channels)
        place = index // channels
        x, y = self._reach(block, place % width, 0), self._reach(block, place // width, 1)
        weights = dr.select(index % channels == channels - 1, x * y, 0)
        whole = mi.TensorXf(weights, pixels.shape) + pixels
        film.put_block(mi.ImageBlock(whole, block.offset(), film.rfilter(), block.has_border()))
        return film.develop()

    def _reach(self, block: mi.ImageBlock, number: mi.UInt32, axis: int) -> mi.Float:
        """∫ h_j along one axis, over the places, of pixels by their number."""
        rfilter = self.view.sensor.film().rfilter()
        if rfilter.is_box_filter():
            return mi.Float(1)
        pixel = mi.Float(number) + (block.offset()[axis] - block.border_size() + 0.5)
        begin, end = self.corner[axis], self.corner[axis] + self.size[axis]
        step = 2 * rfilter.radius() / QUADRATURE
        total = mi.Float(0)
        for k in range(QUADRATURE):
            x = (k + 0.5) * step - rfilter.radius()
            total += dr.select((pixel + x >= begin) & (pixel + x < end), rfilter.eval(mi.Float(x)), 0)
        return total * step


def _adjoint(make: Callable[[mi.Spectrum], mi.TensorXf], lanes: int, wanted: mi.TensorXf) -> mi.Spectrum:
    """The adjoint of radiances of which pixels are made, linearly, from that of the pixels."""
    with dr.resume_grad():
        L = dr.full(mi.Spectrum, 1.0, lanes)
        dr.enable_grad(L)
        made = make(L)
        dr.set_grad(made, wanted)
        dr.enqueue(dr.ADMode.Backward, made)
        dr.traverse(dr.ADMode.Backward)
        return dr.grad(L)


def _splat(block: mi.ImageBlock, film: mi.Film, place: mi.Point2f, L: mi.Spectrum, wavelengths: mi.Spectrum) -> None:
    mitsuba_integrator()._splat_to_block(
        block, film, place, value=L, weight=mi.Float(0), alpha=mi.Float(0), aovs=[], wavelengths=wavelengths
    )
