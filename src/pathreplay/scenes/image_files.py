"""The heads of picture files: how large a picture is, before anything of it is unpacked, and how it is stored.

A file of some hundred bytes can claim four thousand million pixels, and who unpacks it takes memory for all of them.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from math import isfinite, prod
from pathlib import Path
from typing import BinaryIO

from pathreplay.errors import PathreplayError
from pathreplay.platform import memory
from pathreplay.scenes.tga_files import is_tga, require_sound_tga, tga_size

MOST_PIXELS = 2**27
"""Of a picture that is brought to another size."""
_A_PIXEL = 32
"""Bytes for each pixel while a picture is read: as it is stored, and as single floats, which are copied once."""
MOST_HEAD = 2**16
"""Bytes in which a head of text has to end."""
_MOST_PARTS = 2**12
"""Segments of a JPEG, or attributes of an EXR, before the size. Real files have some twenty."""

_GAP = rb"(?:\s|#[^\n]*\n)+"
_PIXMAP = re.compile(rb"P([56])" + _GAP + rb"(\d{1,10})" + _GAP + rb"(\d{1,10})" + _GAP + rb"(\d{1,5})\s")
_RESOLUTION = re.compile(r"([+-])([XY]) (\d{1,10}) ([+-])([XY]) (\d{1,10})")


@dataclass(frozen=True)
class PixmapHead:
    """Of a binary PGM or PPM."""

    channels: int
    width: int
    height: int
    highest: int
    """The value of white."""
    length: int
    """Bytes of the head."""


@dataclass(frozen=True)
class RadianceHead:
    """Of a Radiance HDR picture."""

    axes: str
    """Of the scanlines and of the pixels in them: YX or XY."""
    signs: str
    """Of both. Rows from top to bottom have -Y, columns from left to right +X."""
    counts: tuple[int, int]
    """Of scanlines, and of the pixels in one."""
    exposure: float
    """What the values were multiplied by."""
    xyz: bool
    """Whether they are CIE XYZ, not RGB."""
    length: int
    """Bytes of the head."""


def pixmap_head(data: bytes) -> PixmapHead:
    """The head of a PGM or PPM, with comments. Raises ValueError."""
    if not (found := _PIXMAP.match(data)) or not 0 < int(found[4]) < 2**16:
        raise ValueError("its head is no PGM's and no PPM's")
    width, height, highest = (int(found[n]) for n in (2, 3, 4))
    return PixmapHead(1 if found[1] == b"5" else 3, width, height, highest, found.end())


def radiance_head(data: bytes) -> RadianceHead:
    """The head of a Radiance picture: lines, an empty one, and the resolution. Raises ValueError."""
    text, gap, rest = data.partition(b"\n\n")
    resolution, end, _ = rest.partition(b"\n")
    found = _RESOLUTION.fullmatch(resolution.decode("latin-1"))
    if not found or found[2] == found[5]:
        raise ValueError("its head is no Radiance picture's")
    exposure, xyz = 1.0, False
    for line in text.decode("latin-1").split("\n")[1:]:
        name, _, value = line.partition("=")
        if name == "EXPOSURE":  # several are multiplied
            exposure *= float(value)
        elif name == "FORMAT":
            xyz = value.strip() == "32-bit_rle_xyze"
            if not xyz and value.strip() != "32-bit_rle_rgbe":
                raise ValueError(f"its FORMAT is {value.strip()}, neither 32-bit_rle_rgbe nor 32-bit_rle_xyze")
    if not (isfinite(exposure) and exposure > 0):
        raise ValueError(f"its EXPOSURE is {exposure:g}")
    counts = int(found[3]), int(found[6])
    return RadianceHead(
        found[2] + found[5], found[1] + found[4], counts, exposure, xyz, len(text + gap + resolution + end)
    )


def size_of_picture(path: Path) -> tuple[int, int] | None:
    """Width and height by the head of a file; None where that is of no format that we know.

    Raises PathreplayError where it is of a format that we know, and tells no size.
    """
    try:
        with path.open("rb") as file:
            return _size(file, file.read(MOST_HEAD), path)
    except (OSError, ValueError, IndexError, struct.error):
        raise PathreplayError(f"Image {path} has a damaged head, which tells no size; replace the file") from None


def require_readable_picture(path: Path, pixels: int = MOST_PIXELS) -> None:
    """Raise PathreplayError for a picture without pixels, with more than ``pixels``, or too large for the memory.

    Also for a TGA that Mitsuba would unpack beyond its last pixel.
    """
    size = size_of_picture(path)
    if size is None:
        return  # who reads it says what is wrong
    what = f"Image {path} is {size[0]} x {size[1]}"
    if not prod(size):
        raise PathreplayError(f"{what}, which is no picture; replace the file")
    if prod(size) > pixels:
        raise PathreplayError(f"{what}, and images of up to {pixels} pixels are read; scale it down")
    memory.require(prod(size) * _A_PIXEL, f"{what}, and", "scale it down")
    require_sound_tga(path)


def _size(file: BinaryIO, data: bytes, path: Path) -> tuple[int, int] | None:
    """Raises struct.error, ValueError or IndexError where a head is damaged."""
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        return struct.unpack_from(">II", data, 16)
    if data[:2] == b"\xff\xd8":
        return _jpeg_size(file)
    if data[:4] == b"\x76\x2f\x31\x01":
        return _exr_size(file)
    if data[:2] == b"BM":
        old = struct.unpack_from("<I", data, 14)[0] == 12  # a head of OS/2
        width, height = struct.unpack_from("<HH" if old else "<ii", data, 18)
        return abs(width), abs(height)
    if data[:2] in (b"P5", b"P6"):
        pixmap = pixmap_head(data)
        return pixmap.width, pixmap.height
    if data[:2] in (b"PF", b"Pf"):
        width, height = data.split(maxsplit=3)[1:3]
        return int(width), int(height)
    if data[:2] == b"#?":
        radiance = radiance_head(data)
        return radiance.counts if radiance.axes == "XY" else radiance.counts[::-1]
    if path.suffix.lower() == ".tga" or is_tga(file):
        return tga_size(data)
    return None


def _jpeg_size(file: BinaryIO) -> tuple[int, int]:
    """By the frame's head, which follows other segments."""
    file.seek(2)
    for _ in range(_MOST_PARTS):
        if file.read(1) != b"\xff":
            break
        while (kind := file.read(1)[0]) == 0xFF:
            pass
        (length,) = struct.unpack(">H", file.read(2))
        if 0xC0 <= kind <= 0xCF and kind not in (0xC4, 0xC8, 0xCC):
            _, height, width = struct.unpack(">BHH", file.read(5))
            return width, height
        file.seek(length - 2, 1)
    raise ValueError


def _exr_size(file: BinaryIO) -> tuple[int, int]:
    """By the data window, one of the attributes of the first head: name, type, length of the value, value."""
    file.seek(8)
    for _ in range(_MOST_PARTS):
        name, kind = _text(file), _text(file)
        (length,) = struct.unpack("<i", file.read(4))
        if (name, kind) == (b"dataWindow", b"box2i"):
            x0, y0, x1, y1 = struct.unpack("<iiii", file.read(16))
            return max(x1 - x0 + 1, 0), max(y1 - y0 + 1, 0)
        file.seek(length, 1)
    raise ValueError


def _text(file: BinaryIO) -> bytes:
    """Up to a zero, which comes soon."""
    begin, text = file.tell(), file.read(256).split(b"\0")[0]
    file.seek(begin + len(text) + 1)
    return text
