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


def _fits(max_depth: int, spp: int) -> bool:
    """Whether there are two paths or more, and the record of a lane can hold all of them."""
    device = device_of(mi.variant())
    return 1 < spp <= device.most_records(LARGEST_RECORD, MAX_DEPTH) // device.room(max(max_depth, 1))


def sweepable(sensor: mi.Sensor, max_depth: int, spp: int) -> bool:
    """Whether pixels of a sensor can be swept: a box filter, so that each path belongs to one pixel; colours (rgb) and
    no alpha; an independent sampler; a camera that stands still and takes no time; two paths or more (``spp``), all of
    which fit into the record of a lane."""
    film = sensor.film()
    film.prepare([])
    with dr.resume_grad():
        ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(0.5), mi.Point2f(0.5))
    return bool(
        film.rfilter().is_box_filter()
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

    As in Mitsuba's RBIntegrator. Detached.
    """
    width, height = sensor.film().crop_size()
    corner = mi.Point2f(mi.Float(pixel % width), mi.Float(pixel // width))

    def camera(sampler: mi.Sampler, active: mi.Bool) -> tuple[mi.Ray3f, mi.Spectrum]:
        place = (corner + sampler.next_2d(active)) / mi.Point2f(width, height)
        aperture = sampler.next_2d(active) if sensor.needs_aperture_sample() else mi.Point2f(0)
        return sensor.sample_ray(sensor.shutter_open(), 0.0, place, aperture, active)

    return camera


def pixel_loss(view: Pass, max_depth: int, offset: mi.TensorXf, slope: mi.TensorXf) -> PixelLoss:
    """The loss by each lane's pixel. Raises PathreplayError where the pass or the tensors do not allow it."""
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
    pixel = dr.arange(mi.UInt32, width * height)
    return PixelLoss(*(dr.gather(mi.Color3f, tensor.array, pixel) for tensor in (offset, slope)))
