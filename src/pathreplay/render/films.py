"""How many pixels a sensor renders, how many samples of them Dr.Jit takes at once, and what memory they need."""

from __future__ import annotations

import mitsuba as mi

from pathreplay import memory
from pathreplay.errors import PathreplayError

# Dr.Jit counts the samples of one kernel in 32 bits.
MOST_SAMPLES = 2**32 - 1
# Bytes, measured (peak of the process over 2048 x 2048 pixels, LLVM): a rendering, its derivative and their files take
# 127 a pixel. Samples take next to none.
_A_PIXEL = 128


def film_size(sensor: mi.Sensor) -> tuple[int, int]:
    """Width and height of what is rendered: the crop window, and the film's border where it samples one.

    Raises:
        PathreplayError: the film has no pixel.
    """
    film = sensor.film()
    border = 2 * int(film.rfilter().border_size()) if film.sample_border() else 0
    width, height = (int(n) for n in film.crop_size())
    if width < 1 or height < 1:
        raise PathreplayError(f"The film of sensor '{sensor.id()}' is {width} x {height}; give it at least one pixel")
    return width + border, height + border


def require_samples(key: str, spp: int, size: tuple[int, int], sensor: str) -> None:
    """Return quietly if Dr.Jit takes ``spp`` samples for each pixel of a film of that size at once.

    Raises:
        PathreplayError: it does not; names ``key``, what stands there, and the largest number that would do.
    """
    width, height = size
    pixels = width * height
    if pixels * spp <= MOST_SAMPLES:
        return
    way_out = f"'{key}' up to {MOST_SAMPLES // pixels}" if pixels <= MOST_SAMPLES else "a smaller film"
    raise PathreplayError(
        f"'{key}' is {spp}: with {sensor} of {width} x {height} pixels that is {pixels * spp} samples, beyond the "
        f"{MOST_SAMPLES} that Dr.Jit takes at once; take {way_out}"
    )


def require_memory(size: tuple[int, int], sensor: str, also: int = 0) -> None:
    """Return quietly if a film of that size can be rendered and differentiated with the memory that is left.

    Raises:
        PathreplayError: it cannot, or not with ``also`` bytes for other things.
    """
    width, height = size
    needed = width * height * _A_PIXEL + also
    memory.require(needed, f"Rendering {sensor} of {width} x {height} pixels", "take a smaller film or fewer sensors")


def picture_shape(sensor: mi.Sensor) -> tuple[int, int, int]:
    """Height, width and channels of the pictures that a sensor's film develops."""
    film = sensor.film()
    film.prepare([])  # without storage a film does not tell its channels
    width, height = (int(n) for n in film.crop_size())
    return height, width, film.bitmap().channel_count()
