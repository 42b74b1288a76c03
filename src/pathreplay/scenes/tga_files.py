"""A look into TGA files before Mitsuba reads them, which unpacks runs without asking whether they end with the picture.

The format has no mark at its beginning. Mitsuba takes for a TGA what ends with the mark of the second version.
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
"""Pixels in a row, or rows. Mitsuba takes the number as signed."""
_RUNS = {10: (24, 32), 11: (8,)}
"""Types of picture that are packed, colour and grey, and the bits that a pixel of theirs may have."""


def is_tga(file: BinaryIO) -> bool:
    """Whether a file ends as a TGA. Moves in the file."""
    length = file.seek(0, os.SEEK_END)
    file.seek(max(0, length - len(_END)))
    return file.read() == _END


def tga_size(data: bytes) -> tuple[int, int]:
    """Width and height, by the head. Raises struct.error."""
    return _HEAD.unpack_from(data)[3:5]


def require_sound_tga(path: Path) -> None:
    """Raise PathreplayError for a TGA that is too wide or too high, and for one of runs that do not fill the picture.

    Other files are left alone, and what else can be wrong with a TGA is left to Mitsuba, which sees it.
    """
    with path.open("rb") as file:
        if not is_tga(file):
            return
        file.seek(0)
        skipped, colours, kind, width, height, bits = _HEAD.unpack(file.read(_HEAD.size))
        if colours:  # a palette, which Mitsuba refuses; or the second byte of another format's mark
            return
        if max(width, height) > _MOST:
            raise PathreplayError(f"Image {path} is {width} x {height}, and TGA files of up to {_MOST} a side are read")
        if bits not in _RUNS.get(kind, ()):
            return
        file.seek(skipped, os.SEEK_CUR)
        pixels, pixel = width * height, bits // 8
        found = _filled(file.read(pixels * (1 + pixel)), pixels, pixel)
    if found != pixels:
        what = f"its packets are of {found} pixels and its head is of {pixels}"
        raise PathreplayError(f"Image {path} is a damaged TGA: {what}; replace the file")


def _filled(data: bytes, pixels: int, pixel: int) -> int:
    """Number of pixels in the packets of a file; counting ends once there are ``pixels`` or more.

    A packet is a byte, with the number of its pixels less one, and then these pixels, of ``pixel`` bytes each, or where
    the highest bit of the byte is set a single one for all. Ends with the last that is whole.
    """
    at = found = 0
    while found < pixels and at < len(data):
        count = (data[at] & 127) + 1
        at += 1 + pixel * (1 if data[at] & 128 else count)
        if at > len(data):
            break
        found += count
    return found
