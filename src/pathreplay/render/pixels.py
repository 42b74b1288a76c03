"""Pixels that are swept: whether they can be, their cameras, and what a loss wants of each."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi

from ..device import device_of
from ..errors import PathreplayError
from ..gradient.pixel_sweep import PixelLoss
from ..gradient.record import LARGEST_RECORD, MAX_DEPTH
from .camera_pass import Pass
from .filter_samples import FilterSamples, is_drawable


def _fits(max_depth: int, spp: int) -> bool:
    """Whether there are two paths or more, and the record of a lane can hold all of them."""
    device = device_of(mi.variant())
    return 1 < spp <= device.most_records(LARGEST_RECORD, MAX_DEPTH) // device.room(max(max_depth, 1))


def sweepable(sensor: mi.Sensor, max_depth: int, spp: int, some: bool = False) -> bool:
    """Whether pixels of a sensor can be swept: a box filter, so that each path belongs to one pixel; colours (rgb) and
    no alpha; an independent sampler; a camera that stands still and takes no time; two paths or more (``spp``), all of
    which fit into the record of a lane. If only ``some`` are, any filter that is a density: see `FilterSamples`."""
    film = sensor.film()
    film.prepare([])
    with dr.resume_grad():
        ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(0.5), mi.Point2f(0.5))
    return bool(
        (film.rfilter().is_box_filter() or (some and is_drawable(film)))
        and mi.is_rgb
        and not mi.has_flag(film.flags(), mi.FilmFlags.Special)
        and film.bitmap().pixel_format() == mi.Bitmap.PixelFormat.RGB
        and sensor.sampler().class_name() == "IndependentSampler"
        and sensor.shutter_open_time() == 0
        and not dr.grad_enabled(ray.o, ray.d)
        and _fits(max_depth, spp)
    )


def pixel_camera(sensor: mi.Sensor, pixel: mi.UInt32) -> Callable[..., tuple[mi.Ray3f, mi.Spectrum]]:
    """Rays through random places of pixels (UInt32, row by row): (sampler, active) -> Ray3f and weight (Spectrum).

    As in Mitsuba's RBIntegrator; places are drawn by the film's filter. Detached.
    """
    width, height = sensor.film().crop_size()
    place_of = _placing(sensor.film(), mi.Point2f(mi.Float(pixel % width), mi.Float(pixel // width)))

    def camera(sampler: mi.Sampler, active: mi.Bool) -> tuple[mi.Ray3f, mi.Spectrum]:
        place = place_of(sampler.next_2d(active)) / mi.Point2f(width, height)
        aperture = sampler.next_2d(active) if sensor.needs_aperture_sample() else mi.Point2f(0)
        return sensor.sample_ray(sensor.shutter_open(), 0.0, place, aperture, active)

    return camera


def _placing(film: mi.Film, corner: mi.Point2f) -> Callable[[mi.Point2f], mi.Point2f]:
    """A place by two random numbers, in the pixel with that corner or, with a filter that is wider, around it.

    Films that do not sample their border filter what is within them, so that places beyond are not drawn.
    """
    if film.rfilter().is_box_filter():
        return lambda u: corner + u
    samples, middle, size = FilterSamples.of(film), corner + 0.5, film.crop_size()
    low, high = mi.Point2f(0), mi.Point2f(1)
    if not film.sample_border():
        for axis in range(2):
            low[axis], high[axis] = samples.share(-middle[axis]), samples.share(size[axis] - middle[axis])
    return lambda u: middle + mi.Point2f(*(samples.draw(u[axis], low[axis], high[axis]) for axis in range(2)))


def pixel_loss(view: Pass, max_depth: int, offset: mi.TensorXf, slope: mi.TensorXf, pixel: mi.UInt32) -> PixelLoss:
    """The loss by each lane's ``pixel``. Raises PathreplayError where the pass or the tensors do not allow it."""
    if not _fits(max_depth, view.spp):
        raise PathreplayError(
            f"pathreplay: {view.spp} samples per pixel, of {max_depth} vertices, cannot be swept: use "
            f"2 or more, and at most {MAX_DEPTH} vertices in all, or mi.render"
        )
    width, height = view.size
    for tensor in (offset, slope):
        if tensor.shape != (height, width, 3):
            raise PathreplayError(
                f"pathreplay: derivative of the loss has shape {tensor.shape}: use {(height, width, 3)}"
            )
    return PixelLoss(*(dr.gather(mi.Color3f, tensor.array, pixel) for tensor in (offset, slope)))
