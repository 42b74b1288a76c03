"""Check TGA files, because Mitsuba decodes run-length packets without testing whether they exceed the image.

The format has no magic number at its beginning. Mitsuba recognises a TGA by the footer of version 2.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import BinaryIO

from pathreplay.errors import PathreplayError

_HEAD = struct.Struct("<BBB9xHHBx")
_END = b"TRUEVISION-XFILE.\0"
_MOST = 2**15 - 1
"""Largest width and height in pixels. Mitsuba reads width and height as signed numbers."""
_RUNS = {10: (24, 32), 11: (8,)}
"""Run-length encoded image types (10: colour, 11: grey) -> possible bits per pixel."""


def is_tga(file: BinaryIO) -> bool:
    """Return whether a file ends with the footer of a TGA. Moves the file position."""
    length = file.seek(0, os.SEEK_END)
    file.seek(max(0, length - len(_END)))
    return file.read() == _END


def tga_size(data: bytes) -> tuple[int, int]:
    """Parse width and height in the header. Raises struct.error for a truncated header."""
    return _HEAD.unpack_from(data)[3:5]


def require_sound_tga(path: Path) -> None:
    """Raise PathreplayError if a TGA is too wide or too high, or its packets contain too few or too many pixels.

    Other files are ignored. Mitsuba itself detects other damage.
    """
    with path.open("rb") as file:
        if not is_tga(file):
            return
        file.seek(0)
        skipped, colours, kind, width, height, bits = _HEAD.unpack(file.read(_HEAD.size))
        if colours:  # a TGA with a palette, which Mitsuba rejects, or another format
            return
        if max(width, height) > _MOST:
            raise PathreplayError(
                f"Image {path} is {width} x {height}, and the limit for TGA files is {_MOST} per side"
            )
        if bits not in _RUNS.get(kind, ()):
            return
        file.seek(skipped, os.SEEK_CUR)
        pixels, pixel = width * height, bits // 8
        filled = _filled(file.read(pixels * (1 + pixel)), pixels, pixel)
    if filled != pixels:
        what = f"its packets hold {filled} pixels and its header claims {pixels}"
        raise PathreplayError(f"Image {path} is a damaged TGA: {what}; replace the file")


def _filled(data: bytes, pixels: int, pixel: int) -> int:
    """Count the pixels in the packets of a file, until the count reaches ``pixels``.

    The lower seven bits of the first byte of a packet are the number of pixels minus one. If the highest bit of this
    byte is set, a single pixel follows, which is repeated. Otherwise, all pixels follow. Each pixel has ``pixel``
    bytes. Truncated packets do not count.
    """
    at = filled = 0
    while filled < pixels and at < len(data):
        count = (data[at] & 127) + 1
        at += 1 + pixel * (1 if data[at] & 128 else count)
        if at > len(data):
            break
        filled += count
    return filled
