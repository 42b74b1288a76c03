"""Renders a scene with any integrator, in as many passes as the sampler and memory require, and encodes the image."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError, shown
from pathreplay.integrators.film.image import MOST_SAMPLES, require_film
from pathreplay.integrators.parts import rounded, split
from pathreplay.inverse.images.io import Image, exr_bytes, png_bytes
from pathreplay.platform import memory
from pathreplay.platform.progress_bar import Told
from pathreplay.scenes.descriptions import errors_as

# Samples per pass of the `independent` sampler. Passes take a few seconds, so that Ctrl-C takes effect soon.
_A_PASS = 2**24
# Bytes per sample during a pass. Each sample has two copies of the state of its random number generator.
_A_SAMPLE = 64
# Largest width and height in pixels. A larger size is probably a typo. Mitsuba would at best raise an error.
_LARGEST_SIDE = 2**16


@dataclass(frozen=True)
class Rendering:
    """A rendered image with linear pixels (height, width, channels).

    ``channels`` are the names of the channels: R, G, B, A or Y for colours, and the names of AOVs.
    """

    image: Image
    channels: tuple[str, ...]
    spp: int
    """Number of samples per pixel that were taken; samplers may round up."""


def find_sensor(scene: mi.Scene, wanted: str | None) -> mi.Sensor:
    """Return the sensor with the given id or index; None: the first. Raises PathreplayError if it does not exist."""
    sensors = scene.sensors()
    if not sensors:
        raise PathreplayError("The scene has no sensor; add one")
    ids = [sensor.id() for sensor in sensors]
    if wanted is None:
        return sensors[0]
    if wanted in ids:
        return sensors[ids.index(wanted)]
    if not re.fullmatch(r"\d{1,9}", wanted) or int(wanted) >= len(sensors):
        raise PathreplayError(
            f"No sensor {shown(wanted)} in the scene; it has {', '.join(ids)} (0 to {len(sensors) - 1})"
        )
    return sensors[int(wanted)]


def set_size(sensor: mi.Sensor, size: str) -> None:
    """Resize the sensor's film to 'WIDTHxHEIGHT', or to 'WIDTH', which keeps the aspect ratio.

    Raises PathreplayError if ``size`` is not a valid size, or if the film is cropped.
    """
    film = sensor.film()
    width, height = (int(n) for n in film.size())
    if (width, height) != tuple(int(n) for n in film.crop_size()):
        raise PathreplayError(f"--size {size}: the film of sensor '{sensor.id()}' is cropped; change the scene instead")
    match = re.fullmatch(r"(\d{1,9})(?:x(\d{1,9}))?", size)
    new = (0, 0)
    if match:
        columns = int(match[1])
        new = columns, int(match[2]) if match[2] else max(1, round(columns * height / width))
    if not all(1 <= n <= _LARGEST_SIDE for n in new):
        raise PathreplayError(
            f"--size {shown(size)} is not a size; give WIDTHxHEIGHT in pixels, each up to {_LARGEST_SIDE}"
        )
    params = mi.traverse(sensor)
    params["film.size"] = mi.ScalarVector2u(*new)
    params.update()


def passes(sensor: mi.Sensor, spp: int) -> list[int]:
    """Return the samples per pixel of each pass. Their sum is ``spp``, or more if the sampler rounds up.

    Samplers other than `independent` stratify the samples of a pixel. With these samplers, several passes are used only
    if all samples at once would exceed Dr.Jit's limit or the memory. Each pass then has a power of four samples per
    pixel, which all samplers accept.

    Raises PathreplayError if the image does not fit into memory.
    """
    require_film(sensor, f"sensor '{sensor.id()}'", {})
    pixels = math.prod(int(n) for n in sensor.film().crop_size())
    most = max(1, min(MOST_SAMPLES, memory.available() // 2 // _A_SAMPLE) // pixels)
    sampler = sensor.sampler()
    alone = sampler.class_name() == "IndependentSampler"
    return split(sampler, spp, min(most, max(1, _A_PASS // pixels)) if alone else most)


def render(
    scene: mi.Scene, sensor: mi.Sensor, integrator: mi.Integrator, spp: int, seed: int = 0, tell: Told | None = None
) -> Rendering:
    """Render the mean of all `passes`. An image of a single pass equals that of `mi.render` with the same seed.

    Args:
        scene: scene to render.
        sensor: sensor of the scene.
        integrator: any integrator.
        spp: samples per pixel, which some samplers round up.
        seed: seed of the first pass, from which the seeds of further passes are derived.
        tell: receives the number of completed passes and of all passes.

    Raises:
        PathreplayError: the integrator cannot render the scene.
    """
    counts = passes(sensor, spp)
    total = np.zeros(())
    done = 0
    for i, count in enumerate(counts):
        number = seed if i == 0 else int(np.random.SeedSequence([seed, i]).generate_state(1)[0])
        with dr.suspend_grad(), errors_as("The scene cannot be rendered"):
            image = mi.render(scene, sensor=sensor, integrator=integrator, spp=count, seed=number)
            taken = rounded(sensor.sampler(), count)
            total = total + np.array(image, np.float64) * taken
        done += taken
        if tell:
            tell(i + 1, len(counts))
    names = tuple(field.name for field in sensor.film().bitmap().struct_())
    picture = (total / done).astype(np.float32)
    picture = picture[:, :, None] if picture.ndim == 2 else picture
    # The film lists names of colours before names of AOVs. An image that has only AOVs has fewer channels than names.
    return Rendering(picture, names[len(names) - picture.shape[2] :], done)


def file_bytes(rendering: Rendering, ending: str) -> bytes:
    """Encode the image as '.exr' (32 bit, linear, named channels) or '.png' (8 bit, sRGB, clipped to 0 to 1).

    Raises PathreplayError for a PNG with channels other than colour and alpha.
    """
    if ending == ".png":
        colours = [name for name in rendering.channels if name in ("R", "G", "B", "A", "Y")]
        if len(colours) != len(rendering.channels):
            other = next(name for name in rendering.channels if name not in colours)
            raise PathreplayError(f"A PNG file only holds colours, and the image has the channel '{other}'; use .exr")
        return png_bytes(rendering.image)
    return exr_bytes(rendering.image, rendering.channels)
