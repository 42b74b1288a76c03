"""The film: how samples become an image, how an adjoint image becomes one per ray, and how large pictures are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import drjit as dr
import mitsuba as mi

from pathreplay.errors import PathreplayError
from pathreplay.integrators.camera_pass import Pass, Rays
from pathreplay.platform import memory
from pathreplay.platform.registration import mitsuba_integrator

# Dr.Jit counts the samples of one kernel in 32 bits.
MOST_SAMPLES = 2**32 - 1
# Bytes, measured (peak of the process over 2048 x 2048 pixels, LLVM): a rendering, its derivative and their files take
# 127 a pixel. Samples take next to none.
_A_PIXEL = 128


def splat(view: Pass, rays: Rays, L: mi.Spectrum, valid: mi.Bool) -> mi.TensorXf:
    """The image that radiances ``L`` (and ``valid``, for alpha: one each per ray) give under the film's filter.

    Differentiable in ``L``. Also takes tangents for radiances, and gives that of the image.
    """
    film = view.sensor.film()
    block = film.create_block()
    # Dr.Jit adds up the samples of a pixel before they are written, which pays only where there are some.
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
    """δL of each ray: ``grad_in`` (the adjoint of the image), taken back through filter, weights and their division."""
    with dr.resume_grad():
        L = dr.full(mi.Spectrum, 1.0, dr.width(rays.position))  # rays may all be the same
        dr.enable_grad(L)
        image = splat(view, rays, L, mi.Bool(True))
        dr.set_grad(image, grad_in)
        dr.enqueue(dr.ADMode.Backward, image)
        dr.traverse(dr.ADMode.Backward)
        δL = dr.grad(L)
    view.sensor.film().clear()  # of the ones that were splatted
    return δL


def film_size(sensor: mi.Sensor) -> tuple[int, int]:
    """Width and height of what is rendered: the crop window, and the film's border where it samples one.

    Raises PathreplayError if the film has no pixel.
    """
    film = sensor.film()
    border = 2 * int(film.rfilter().border_size()) if film.sample_border() else 0
    width, height = (int(n) for n in film.crop_size())
    if width < 1 or height < 1:
        raise PathreplayError(f"The film of sensor '{sensor.id()}' is {width} x {height}; give it at least one pixel")
    return width + border, height + border


def require_film(sensor: mi.Sensor, name: str, spp: Mapping[str, int], also: int = 0) -> None:
    """Return quietly if Dr.Jit takes the samples of a sensor's film at once, and memory what is rendered of it.

    ``spp`` (samples per pixel, by the key that asks for them); ``also`` are bytes for other things. Raises
    PathreplayError that names the sensor as ``name`` and, of samples, the key and the largest number that would do.
    """
    width, height = film_size(sensor)
    pixels = width * height
    for key, count in spp.items():
        if pixels * count > MOST_SAMPLES:
            remedy = f"'{key}' up to {MOST_SAMPLES // pixels}" if pixels <= MOST_SAMPLES else "a smaller film"
            raise PathreplayError(
                f"'{key}' is {count}: with {name} of {width} x {height} pixels that is {pixels * count} samples, "
                f"beyond the {MOST_SAMPLES} that Dr.Jit takes at once; take {remedy}"
            )
    thing = f"Rendering {name} of {width} x {height} pixels"
    memory.require(pixels * _A_PIXEL + also, thing, "take a smaller film or fewer sensors")


def fit_film(sensor: mi.Sensor, shape: Sequence[int]) -> None:
    """Give the film of a sensor the size of a picture (height, width, ...), if it has another and no crop window."""
    size = mi.ScalarVector2u(int(shape[1]), int(shape[0]))
    if tuple(sensor.film().crop_size()) != tuple(size):
        params = mi.traverse(sensor)
        params["film.size"] = size
        params.update()


def make_ready(sensor: mi.Sensor) -> None:
    """Give a sensor now what it is given when it is first rendered: storage of its film, and a state of its sampler.

    Recorded passes hold all sensors of a scene, and have to be recorded again when one of them changes.
    """
    sensor.film().prepare([])
    sensor.sampler().seed(0, 1)  # as `mi.render` leaves it


def picture_shape(sensor: mi.Sensor) -> tuple[int, int, int]:
    """Height, width and channels of the pictures that a sensor's film develops."""
    film = sensor.film()
    film.prepare([])  # without storage a film does not tell its channels
    width, height = (int(n) for n in film.crop_size())
    return height, width, film.bitmap().channel_count()
