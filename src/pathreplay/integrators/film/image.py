"""Images of a film: splatting of samples, its adjoint, and checks of film sizes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

import drjit as dr
import mitsuba as mi

from pathreplay.errors import PathreplayError
from pathreplay.integrators.camera_pass import Pass, Rays
from pathreplay.platform import memory
from pathreplay.platform.registration import mitsuba_integrator

X = TypeVar("X", bound=dr.ArrayBase)

# Dr.Jit counts the samples of one kernel in 32 bits.
MOST_SAMPLES = 2**32 - 1
# Bytes per pixel. An image, its derivative and their files take 127 bytes per pixel, measured as the peak memory of the
# process for 2048 x 2048 pixels on LLVM. The memory of samples is negligible.
_A_PIXEL = 128


def splat(view: Pass, rays: Rays, L: mi.Spectrum, valid: mi.Bool) -> mi.TensorXf:
    """Splat the radiance ``L`` and the alpha mask ``valid`` of each ray with the film's filter; return the image.

    Differentiable in ``L``. Since the image is linear in ``L``, tangents of radiance give the tangent of the image.
    """
    film = view.sensor.film()
    block = film.create_block()
    # Summing the samples of a pixel before they are written pays off only for several samples per pixel.
    block.set_coalesce(block.coalesce() and rays.spp >= 4)
    mitsuba_integrator()._splat_to_block(
        block,
        film,
        rays.position,
        value=L * rays.weight,
        weight=1.0,
        alpha=dr.select(valid, mi.Float(1), mi.Float(0)),
        aovs=[],
        wavelengths=rays.ray.wavelengths,
    )
    film.put_block(block)
    return film.develop()


def adjoint(view: Pass, rays: Rays, grad_in: mi.TensorXf) -> mi.Spectrum:
    """Return δL of each ray: the adjoint ``grad_in`` of the image, propagated back through filter and normalisation."""
    unit = dr.full(mi.Spectrum, 1.0, dr.width(rays.position))  # one entry, and so one adjoint, per ray
    δL = transposed(lambda L: splat(view, rays, L, mi.Bool(True)), unit, grad_in)
    view.sensor.film().clear()  # remove the unit radiance that `splat` has added
    return δL


def transposed(linear: Callable[[X], mi.TensorXf], x: X, adjoint: mi.TensorXf) -> X:
    """Return the adjoint of the argument ``x`` of a linear function, given the ``adjoint`` of its value."""
    with dr.resume_grad():
        dr.enable_grad(x)
        value = linear(x)
        dr.set_grad(value, adjoint)
        dr.enqueue(dr.ADMode.Backward, value)
        dr.traverse(dr.ADMode.Backward)
        return dr.grad(x)


def film_size(sensor: mi.Sensor) -> tuple[int, int]:
    """Return width and height of the rendered area: the crop window, with the border if the film samples it.

    Raises PathreplayError if the film has no pixel.
    """
    film = sensor.film()
    border = 2 * int(film.rfilter().border_size()) if film.sample_border() else 0
    width, height = (int(n) for n in film.crop_size())
    if width < 1 or height < 1:
        raise PathreplayError(f"The film of sensor '{sensor.id()}' is {width} x {height}; give it at least one pixel")
    return width + border, height + border


def require_film(sensor: mi.Sensor, name: str, spp: Mapping[str, int], also: int = 0) -> None:
    """Check that Dr.Jit can process all samples of a sensor in one kernel, and that memory suffices for its images.

    ``spp`` maps configuration keys to their samples per pixel. ``also`` is the number of bytes that are needed in
    addition to the images.

    Raises PathreplayError if one of the checks fails. The message calls the sensor ``name`` and states the remedy.
    """
    width, height = film_size(sensor)
    pixels = width * height
    for key, count in spp.items():
        if pixels * count > MOST_SAMPLES:
            remedy = f"'{key}' up to {MOST_SAMPLES // pixels}" if pixels <= MOST_SAMPLES else "a smaller film"
            raise PathreplayError(
                f"'{key}' is {count}: with {name} of {width} x {height} pixels that is {pixels * count} samples, "
                f"more than the {MOST_SAMPLES} that Dr.Jit can process at once; take {remedy}"
            )
    thing = f"Rendering {name} of {width} x {height} pixels"
    memory.require(pixels * _A_PIXEL + also, thing, "take a smaller film or fewer sensors")


def fit_film(sensor: mi.Sensor, shape: Sequence[int]) -> None:
    """Resize the film of a sensor to an image of shape (height, width, ...), unless its crop window has that size."""
    size = mi.ScalarVector2u(int(shape[1]), int(shape[0]))
    if tuple(sensor.film().crop_size()) != tuple(size):
        params = mi.traverse(sensor)
        params["film.size"] = size
        params.update()


def make_ready(sensor: mi.Sensor) -> None:
    """Initialise the film storage and the sampler state of a sensor, as its first rendering would.

    A pass recorded by `dr.freeze` depends on all sensors of the scene. The first rendering with a sensor would change
    the sensor, so that the pass would have to be recorded again.
    """
    sensor.film().prepare([])
    sensor.sampler().seed(0, 1)  # the state in which `mi.render` leaves the sampler


def picture_shape(sensor: mi.Sensor) -> tuple[int, int, int]:
    """Return height, width and number of channels of the images of a sensor."""
    film = sensor.film()
    film.prepare([])  # the number of channels is known only after this
    width, height = (int(n) for n in film.crop_size())
    return height, width, film.bitmap().channel_count()
