"""A picture of a scene by any integrator: in as many passes as sampler and memory ask for, and as one file."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import OpenEXR

from pathreplay.errors import PathreplayError, shown
from pathreplay.integrators.film.image import MOST_SAMPLES, require_film
from pathreplay.integrators.parts import rounded, split
from pathreplay.inverse.images.io import Image, png_bytes
from pathreplay.platform import memory
from pathreplay.scenes.descriptions import told

# Samples of a pass: some seconds, so that a bar moves and a Ctrl-C is heard. Only where samples do not know each other.
_A_PASS = 2**24
# Bytes of a sample while a pass is under way: the state of its random numbers, twice.
_A_SAMPLE = 64
# Larger pictures are a slip of the keyboard, and films of that size end in Mitsuba's own error at best.
_LARGEST_SIDE = 2**16

Told = Callable[[int, int], None]
"""Is told how many passes are done, of how many."""


@dataclass(frozen=True)
class Rendering:
    """Linear pixels (height, width, channels), and the names of the channels: R, G, B, A, Y, or those of an AOV."""

    image: Image
    channels: tuple[str, ...]
    spp: int
    """Samples per pixel that were taken: samplers may round up."""


def find_sensor(scene: mi.Scene, wanted: str | None) -> mi.Sensor:
    """The sensor with that id or number, or the first. Raises PathreplayError where there is none."""
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
    """Give the sensor's film another size: 'WIDTHxHEIGHT', or 'WIDTH' alone, which keeps the proportions.

    Raises PathreplayError for what is no size, and where the film is cropped.
    """
    film = sensor.film()
    width, height = (int(n) for n in film.size())
    if (width, height) != tuple(int(n) for n in film.crop_size()):
        raise PathreplayError(f"--size {size}: the film of sensor '{sensor.id()}' is cropped; change the scene instead")
    found = re.fullmatch(r"(\d{1,9})(?:x(\d{1,9}))?", size)
    new = (0, 0)
    if found:
        columns = int(found[1])
        new = columns, int(found[2]) if found[2] else max(1, round(columns * height / width))
    if not all(1 <= n <= _LARGEST_SIDE for n in new):
        raise PathreplayError(
            f"--size {shown(size)} is no size; give WIDTHxHEIGHT in pixels, each up to {_LARGEST_SIDE}"
        )
    params = mi.traverse(sensor)
    params["film.size"] = mi.ScalarVector2u(*new)
    params.update()


def passes(sensor: mi.Sensor, spp: int) -> list[int]:
    """Samples per pixel of each pass; together they are ``spp``, or more where the sampler rounds up.

    Samplers other than `independent` place the samples of a pixel by each other: they are split only where Dr.Jit or
    memory could not hold them at once, into passes of a power of four, which all of them take. Raises PathreplayError
    for pictures that do not fit the memory.
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
    """The mean of all `passes`; the first has the seed itself, so that one pass is `mi.render` with that seed.

    Raises PathreplayError for what the integrator cannot do.
    """
    counts = passes(sensor, spp)
    total: Any = 0.0
    done = 0
    for i, count in enumerate(counts):
        number = seed if i == 0 else int(np.random.SeedSequence([seed, i]).generate_state(1)[0])
        with dr.suspend_grad(), told("The scene cannot be rendered"):
            image = mi.render(scene, sensor=sensor, integrator=integrator, spp=count, seed=number)
            taken = rounded(sensor.sampler(), count)
            total = total + np.array(image, np.float64) * taken
        done += taken
        if tell:
            tell(i + 1, len(counts))
    names = tuple(field.name for field in sensor.film().bitmap().struct_())
    picture = (total / done).astype(np.float32)
    picture = picture[:, :, None] if picture.ndim == 2 else picture
    # Of integrators that give AOVs alone the picture has no colours, and the film has.
    return Rendering(picture, names[len(names) - picture.shape[2] :], done)


def file_bytes(rendering: Rendering, ending: str) -> bytes:
    """The picture as a file: '.exr' (32 bit, linear, all channels by name) or '.png' (8 bit, sRGB, from 0 to 1).

    Raises PathreplayError for another ending, and for a PNG of more than colours and alpha.
    """
    if ending == ".png":
        colours = [name for name in rendering.channels if name in ("R", "G", "B", "A", "Y")]
        if len(colours) != len(rendering.channels):
            other = next(name for name in rendering.channels if name not in colours)
            raise PathreplayError(
                f"A PNG file holds colours only, and the picture has the channel '{other}'; take .exr"
            )
        return png_bytes(rendering.image)
    channels = {n: np.ascontiguousarray(rendering.image[:, :, i]) for i, n in enumerate(rendering.channels)}
    buffer = io.BytesIO()
    # Not by Mitsuba: see `exr_bytes`.
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, channels, num_threads=0) as file:
        file.write(buffer)
    return buffer.getvalue()
