"""Pixels that are swept: whether they can be, their cameras, and what a loss wants of each."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.adjoint.pixel_sweep import PixelLoss
from pathreplay.adjoint.record import LARGEST_RECORD, MAX_DEPTH
from pathreplay.errors import PathreplayError
from pathreplay.integrators.camera_pass import Pass
from pathreplay.integrators.film.filter_samples import FilterSamples, is_drawable
from pathreplay.integrators.lifetimes import is_recording
from pathreplay.platform.device import device_of


def _most(max_depth: int) -> int:
    """Of how many paths the record of a lane can hold the vertices."""
    device = device_of(mi.variant())
    return device.most_records(LARGEST_RECORD, MAX_DEPTH) // device.room(max(max_depth, 1))


def obstacle(sensor: mi.Sensor, max_depth: int, spp: int, some: bool = False) -> str:
    """Why pixels of a sensor cannot be swept, as the end of a sentence, with the remedy; "" where they can.

    That takes a box filter, so that each path belongs to one pixel, or if only ``some`` are swept, any filter that is a
    density (see `FilterSamples`); colours (rgb) and no alpha; an independent sampler; a camera that stands still and
    takes no time; two paths or more (``spp``), all of which fit into the record of a lane.
    """
    film, sampler = sensor.film(), sensor.sampler()
    film.prepare([])
    with dr.resume_grad():
        ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(0.5), mi.Point2f(0.5))
    format, most = film.bitmap().pixel_format(), _most(max_depth)
    box = film.rfilter().is_box_filter()
    if not mi.is_rgb:
        return f"variant {mi.variant()!r} has other colours than rgb; take an rgb variant"
    if not box and not some:
        return "its filter couples pixels; give its film the filter 'box'"
    if not box and not is_drawable(film):
        return "its filter is negative in places; give its film 'box', 'tent' or 'gaussian'"
    if mi.has_flag(film.flags(), mi.FilmFlags.Special) or format != mi.Bitmap.PixelFormat.RGB:
        return "its film is none of plain colours; give it an hdrfilm with pixel_format 'rgb'"
    if sampler.class_name() != "IndependentSampler":
        return f"its sampler is of class {sampler.class_name()}; make it 'independent'"
    if sensor.shutter_open_time() > 0:
        return "its shutter is open for a while; close it at once"
    if dr.grad_enabled(ray.o, ray.d):
        return "it moves; hold it"
    if spp < 2:
        return f"{spp} samples a pixel cannot judge each other; take 2 or more"
    if spp > most:
        return f"{spp} samples a pixel of {max_depth} vertices are more than the {most} that are held; take fewer"
    return ""


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


def pixel_loss(
    view: Pass, max_depth: int, offset: mi.TensorXf, slope: mi.TensorXf, pixels: mi.UInt32 | None
) -> PixelLoss:
    """The loss by each lane's pixel: all of them, or ``pixels``, for each of which the tensors have a row.

    Raises PathreplayError where the pass, the tensors or the pixels do not allow it.
    """
    if not 1 < view.spp <= _most(max_depth):
        raise PathreplayError(
            f"pathreplay: {view.spp} samples per pixel, of {max_depth} vertices, cannot be swept: use "
            f"2 or more, and at most {MAX_DEPTH} vertices in all, or mi.render"
        )
    width, height = view.size
    shape = (height, width, 3) if pixels is None else (dr.width(pixels), 1, 3)
    for tensor in (offset, slope):
        if tensor.shape != shape:
            raise PathreplayError(f"pathreplay: derivative of the loss has shape {tensor.shape}: use {shape}")
    if pixels is not None and not is_recording():
        numbers = np.unique(np.array(pixels))
        if len(numbers) < dr.width(pixels) or numbers[-1] >= width * height:
            raise PathreplayError(
                f"pathreplay: 'pixels' has one twice, or one beyond the {width} x {height} of the film"
            )
    row = dr.arange(mi.UInt32, shape[0] * shape[1])
    return PixelLoss(*(dr.gather(mi.Color3f, tensor.array, row) for tensor in (offset, slope)))


def among(pixels: mi.UInt32, rows: mi.TensorXf, size: tuple[int, int]) -> mi.TensorXf:
    """The picture of so many pixels across and up that has these rows at its ``pixels``, and is zero elsewhere."""
    width, height = size
    picture = dr.zeros(mi.TensorXf, (height, width, 3))
    dr.scatter(picture.array, dr.gather(mi.Color3f, rows.array, dr.arange(mi.UInt32, dr.width(pixels))), pixels)
    return picture
