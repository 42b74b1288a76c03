"""Places on the film of a pass: their camera rays, what an adjoint image wants of them, and how they make an image."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..gradient.counted import Counted
from ..plugins import mitsuba_integrator
from .camera_pass import Pass

QUADRATURE = 128
"""Points of the integral over a filter."""


@dataclass(frozen=True)
class FilmPlaces:
    """The part of a film that paths begin in: its crop window, and its border where it samples one. See `Places`."""

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
        """The camera ray through a place, and its weight: see `Places`."""
        sensor, film, numbers = self.view.sensor, self.view.sensor.film(), Counted(key, mi.UInt32(0x40000))
        place = (self.corner + s - mi.ScalarPoint2f(film.crop_offset())) / mi.ScalarVector2f(film.crop_size())
        time = sensor.shutter_open() + numbers.next_1d() * sensor.shutter_open_time()
        wavelength, aperture = numbers.next_1d(), numbers.next_2d()
        ray, weight = self.view.camera_ray(time, wavelength, place, aperture)
        return mi.Ray3f(ray), dr.detach(weight)

    def undeveloped(self, grad_in: mi.TensorXf) -> mi.TensorXf:
        """The adjoint of a film block's pixels, from that of the image: g_j / ∫ h_j, with the filter h_j of pixel j."""
        with dr.resume_grad():
            pixels = mi.TensorXf(self._block().tensor())
            dr.enable_grad(pixels)
            image = self._developed(pixels)
            dr.set_grad(image, grad_in)
            dr.enqueue(dr.ADMode.Backward, image)
            dr.traverse(dr.ADMode.Backward)
            return dr.grad(pixels)

    def importance(self, wanted: mi.TensorXf, s: mi.Point2f, wavelengths: mi.Spectrum) -> mi.Spectrum:
        """W(s) = Σ_j g_j h_j(s) / ∫ h_j, what is wanted of radiance at places, per pixel of film; outside nothing.

        ``wanted`` is the adjoint of a block: see `undeveloped`.
        """
        inside = dr.all((s >= 0) & (s < self.size))
        with dr.resume_grad():
            L = dr.full(mi.Spectrum, 1.0, dr.width(s))
            dr.enable_grad(L)
            block = self._block()
            self._put(block, s, L, wavelengths)
            made = block.tensor()
            dr.set_grad(made, wanted)
            dr.enqueue(dr.ADMode.Backward, made)
            dr.traverse(dr.ADMode.Backward)
            return dr.select(inside, dr.grad(L), 0)

    def image(self, s: mi.Point2f, L: mi.Spectrum, wavelengths: mi.Spectrum) -> mi.TensorXf:
        """The image that radiances make which arrive at places, each for a pixel's area of film."""
        block = self._block()
        self._put(block, s, dr.select(dr.all((s >= 0) & (s < self.size)), L, 0), wavelengths)
        return self._developed(block.tensor())

    def importance_of_pixels(self, wanted: mi.TensorXf, pixel: mi.UInt32, wavelengths: mi.Spectrum) -> mi.Spectrum:
        """g_j / ∫ h_j of pixels by their number (row by row), what is wanted of radiance in them: see `importance`."""
        border = self._border()
        inner = wanted[border:-border, border:-border] if border else wanted
        with dr.resume_grad():
            L = dr.full(mi.Spectrum, 1.0, dr.width(pixel))
            dr.enable_grad(L)
            made = self._pixels(pixel, L, wavelengths)
            dr.set_grad(made, inner)
            dr.enqueue(dr.ADMode.Backward, made)
            dr.traverse(dr.ADMode.Backward)
            return dr.grad(L)

    def image_of_pixels(self, pixel: mi.UInt32, L: mi.Spectrum, wavelengths: mi.Spectrum) -> mi.TensorXf:
        """The image of which each pixel, by its number, has the sum of its radiances, divided by ∫ h_j."""
        border, made = self._border(), self._pixels(pixel, L, wavelengths)
        if border:
            height, width, channels = made.shape
            whole = dr.zeros(mi.TensorXf, (height + 2 * border, width + 2 * border, channels))
            whole[border:-border, border:-border] = made
            made = whole
        return self._developed(made)

    def _pixels(self, pixel: mi.UInt32, L: mi.Spectrum, wavelengths: mi.Spectrum) -> mi.TensorXf:
        """The pixels of a block without its border, each of which is what it is given."""
        film, like = self.view.sensor.film(), self._block()
        offset, size = mi.ScalarPoint2i(film.crop_offset()), mi.ScalarVector2u(film.crop_size())
        box = mi.load_dict({"type": "box"})
        block = mi.ImageBlock(size, offset, like.channel_count(), box, border=False, normalize=False)
        place = mi.Point2f(mi.Float(pixel % size.x), mi.Float(pixel // size.x)) + 0.5 + mi.ScalarPoint2f(offset)
        _splat(block, film, place, L, wavelengths)
        return block.tensor()

    def _border(self) -> int:
        """Of the film's blocks, in pixels."""
        block = self._block()
        return int(block.border_size()) if block.has_border() else 0

    def _block(self) -> mi.ImageBlock:
        film = self.view.sensor.film()
        film.prepare([])
        return film.create_block()

    def _put(self, block: mi.ImageBlock, s: mi.Point2f, L: mi.Spectrum, wavelengths: mi.Spectrum) -> None:
        _splat(block, self.view.sensor.film(), self.corner + s, L, wavelengths)

    def _developed(self, pixels: mi.TensorXf) -> mi.TensorXf:
        """The image of a block without weights: those of its pixels are ∫ h_j."""
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


def _splat(block: mi.ImageBlock, film: mi.Film, place: mi.Point2f, L: mi.Spectrum, wavelengths: mi.Spectrum) -> None:
    mitsuba_integrator()._splat_to_block(
        block, film, place, value=L, weight=mi.Float(0), alpha=mi.Float(0), aovs=[], wavelengths=wavelengths
    )
