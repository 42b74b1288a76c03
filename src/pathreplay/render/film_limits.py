"""How many samples of a film Dr.Jit takes at once, and what memory its pictures need."""

from __future__ import annotations

from .. import memory
from ..errors import PathreplayError

# Dr.Jit counts the samples of one kernel in 32 bits.
MOST_SAMPLES = 2**32 - 1
# Bytes, measured (peak of the process over 2048 x 2048 pixels, LLVM): a rendering, its derivative and their files take
# 127 a pixel. Samples take next to none.
_A_PIXEL = 128


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
