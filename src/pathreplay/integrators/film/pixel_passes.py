"""Inputs of `pixel_sweep`, which computes an image and the gradient of a loss from the same paths.

The inputs are the camera rays and the loss derivative of each pixel. `obstacle` checks whether a sensor is supported.
"""

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


def _largest_spp(max_depth: int) -> int:
    """Return the largest number of paths for which one lane can store the vertices of all paths in local memory."""
    device = device_of(mi.variant())
    return device.most_records(LARGEST_RECORD, MAX_DEPTH) // device.room(max(max_depth, 1))


def _why_no_sets(max_depth: int, spp: int) -> str:
    """Return why ``spp`` paths cannot be recorded and form independent sets, with the remedy; "" if they can."""
    most = _largest_spp(max_depth)
    if most < 2:
        return f"a record cannot hold two paths of {max_depth} vertices; lower max_depth"
    if spp < 2:
        return f"{spp} samples per pixel cannot provide independent loss derivatives for each other; take 2 or more"
    if spp > most:
        return (
            f"{spp} samples per pixel of {max_depth} vertices are more than the {most} that a record holds; take fewer"
        )
    return ""


def obstacle(sensor: mi.Sensor, max_depth: int, spp: int, some: bool = False) -> str:
    """Return why `pixel_sweep` does not support a sensor, with the remedy; "" if it does.

    `pixel_sweep` requires an rgb image without alpha, an independent sampler, and a camera without motion and with an
    instantaneous shutter. The filter must be a box, so that each path belongs to one pixel. If only ``some`` pixels are
    rendered, any non-negative filter can be used (see `FilterSamples`). The number ``spp`` of paths of a pixel must be
    at least two, and the vertices of these paths must fit together into the local memory of one lane.

    The returned text can follow the word "since" in a message.
    """
    film, sampler = sensor.film(), sensor.sampler()
    film.prepare([])
    with dr.resume_grad():
        ray, _ = sensor.sample_ray_differential(0.0, 0.5, mi.Point2f(0.5), mi.Point2f(0.5))
    format, box = film.bitmap().pixel_format(), film.rfilter().is_box_filter()
    if not mi.is_rgb:
        return f"variant {mi.variant()!r} does not use rgb colours; take an rgb variant"
    if not box and not some:
        return "its filter couples pixels; give its film the filter 'box'"
    if not box and not is_drawable(film):
        return "its filter is negative in places; give its film 'box', 'tent' or 'gaussian'"
    if mi.has_flag(film.flags(), mi.FilmFlags.Special) or format != mi.Bitmap.PixelFormat.RGB:
        return "its film does not store plain rgb; give it an hdrfilm with pixel_format 'rgb'"
    if sampler.class_name() != "IndependentSampler":
        return f"its sampler is of class {sampler.class_name()}; make it 'independent'"
    if sensor.shutter_open_time() > 0:
        return "its shutter stays open for a time; set shutter_close to shutter_open"
    if dr.grad_enabled(ray.o, ray.d):
        return "it moves; freeze it"
    return _why_no_sets(max_depth, spp)


def pixel_camera(sensor: mi.Sensor, pixel: mi.UInt32) -> Callable[..., tuple[mi.Ray3f, mi.Spectrum]]:
    """Return a function that samples one ray through each of the pixels with the row-major indices ``pixel``.

    The function maps (sampler, active) to the rays (Ray3f) and their weights (Spectrum). Rays are sampled as in
    Mitsuba's RBIntegrator, except that the film's filter is importance sampled. The results are detached.
    """
    width, height = sensor.film().crop_size()
    sample_position = _position_sampler(sensor.film(), mi.Point2f(mi.Float(pixel % width), mi.Float(pixel // width)))

    def camera(sampler: mi.Sampler, active: mi.Bool) -> tuple[mi.Ray3f, mi.Spectrum]:
        position = sample_position(sampler.next_2d(active)) / mi.Point2f(width, height)
        aperture = sampler.next_2d(active) if sensor.needs_aperture_sample() else mi.Point2f(0)
        # The meters of Mitsuba 3.9 do not implement `sample_ray`.
        ray, weight = sensor.sample_ray_differential(sensor.shutter_open(), 0.0, position, aperture, active)
        return mi.Ray3f(ray), weight

    return camera


def _position_sampler(film: mi.Film, corner: mi.Point2f) -> Callable[[mi.Point2f], mi.Point2f]:
    """Return a function that maps two random numbers to a film position in the filter support of a pixel.

    ``corner`` is the lower corner of the pixel. Unless the film samples its border, positions stay inside the film.
    """
    if film.rfilter().is_box_filter():
        return lambda u: corner + u
    samples, middle, size = FilterSamples.of(film), corner + 0.5, film.crop_size()
    low, high = mi.Point2f(0), mi.Point2f(1)
    if not film.sample_border():
        for axis in range(2):
            low[axis], high[axis] = samples.cdf_at(-middle[axis]), samples.cdf_at(size[axis] - middle[axis])
    return lambda u: middle + mi.Point2f(*(samples.draw(u[axis], low[axis], high[axis]) for axis in range(2)))


def pixel_loss(
    view: Pass, max_depth: int, offset: mi.TensorXf, slope: mi.TensorXf, pixels: mi.UInt32 | None
) -> PixelLoss:
    """Gather the loss derivative, ``offset`` + ``slope`` · image, for the pixel of each lane.

    There is one lane for each pixel of the film or, if ``pixels`` is given, one lane for each entry of ``pixels``. In
    the second case, ``offset`` and ``slope`` have one row per entry.

    Raises PathreplayError for an unsuitable number of samples, a wrong shape, or repeated or invalid pixels.
    """
    if why := _why_no_sets(max_depth, view.spp):
        raise PathreplayError(f"pathreplay: {why}, or use mi.render")
    width, height = view.size
    shape = (height, width, 3) if pixels is None else (dr.width(pixels), 1, 3)
    for tensor in (offset, slope):
        if tensor.shape != shape:
            raise PathreplayError(f"pathreplay: derivative of the loss has shape {tensor.shape}: use {shape}")
    if pixels is not None and not is_recording():
        indices = np.unique(np.array(pixels))
        if len(indices) < dr.width(pixels) or indices[-1] >= width * height:
            raise PathreplayError(
                f"pathreplay: 'pixels' contains a repeated index, or one outside the film of {width} x {height} pixels"
            )
    row = dr.arange(mi.UInt32, shape[0] * shape[1])
    return PixelLoss(*(dr.gather(mi.Spectrum, tensor.array, row) for tensor in (offset, slope)))


def scatter_rows(pixels: mi.UInt32, rows: mi.TensorXf, size: tuple[int, int]) -> mi.TensorXf:
    """Scatter one row per pixel into an image of ``size`` (width, height) that is zero elsewhere."""
    width, height = size
    image = dr.zeros(mi.TensorXf, (height, width, 3))
    dr.scatter(image.array, dr.gather(mi.Color3f, rows.array, dr.arange(mi.UInt32, dr.width(pixels))), pixels)
    return image
