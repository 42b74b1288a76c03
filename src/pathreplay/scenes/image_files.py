"""Read the headers of image files, for size and storage format, before any pixel is decoded.

A file of a few hundred bytes can claim four billion pixels, and a decoder would allocate memory for all of them.
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
"""Default limit on the number of pixels of an image."""
_A_PIXEL = 32
"""Bytes per pixel while an image is read: the stored format, and two copies in single precision."""
MOST_HEAD = 2**16
"""Largest size of a text header in bytes."""
_MOST_PARTS = 2**12
"""Largest number of JPEG segments or EXR attributes before the size. Real files have about twenty."""

_GAP = rb"(?:\s|#[^\n]*\n)+"
_PIXMAP = re.compile(rb"P([56])" + _GAP + rb"(\d{1,10})" + _GAP + rb"(\d{1,10})" + _GAP + rb"(\d{1,5})\s")
_RESOLUTION = re.compile(r"([+-])([XY]) (\d{1,10}) ([+-])([XY]) (\d{1,10})")


@dataclass(frozen=True)
class PixmapHead:
    """The header of a binary PGM or PPM file."""

    channels: int
    width: int
    height: int
    highest: int
    """Value of white."""
    length: int
    """Length of the header in bytes."""


@dataclass(frozen=True)
class RadianceHead:
    """The header of a Radiance HDR image."""

    axes: str
    """Order of the axes in the file: YX if scanlines are rows, XY if scanlines are columns."""
    signs: str
    """Signs of the axes, in the order of ``axes``. Y is negative for rows from top to bottom, X is positive for columns
    from left to right."""
    counts: tuple[int, int]
    """Number of scanlines, and of pixels per scanline."""
    exposure: float
    """Factor by which the stored values were multiplied."""
    xyz: bool
    """Whether the values are CIE XYZ instead of RGB."""
    length: int
    """Length of the header in bytes."""


def pixmap_head(data: bytes) -> PixmapHead:
    """Parse the header of a PGM or PPM file, including comments. Raises ValueError for an invalid header."""
    if not (match := _PIXMAP.match(data)) or not 0 < int(match[4]) < 2**16:
        raise ValueError("it has no PGM or PPM header")
    width, height, highest = (int(match[n]) for n in (2, 3, 4))
    return PixmapHead(1 if match[1] == b"5" else 3, width, height, highest, match.end())


def radiance_head(data: bytes) -> RadianceHead:
    """Parse a Radiance header: text lines, an empty line, and the resolution. Raises ValueError for invalid headers."""
    text, gap, rest = data.partition(b"\n\n")
    resolution, end, _ = rest.partition(b"\n")
    match = _RESOLUTION.fullmatch(resolution.decode("latin-1"))
    if not match or match[2] == match[5]:
        raise ValueError("it has no Radiance header")
    exposure, xyz = 1.0, False
    for line in text.decode("latin-1").split("\n")[1:]:
        name, _, value = line.partition("=")
        if name == "EXPOSURE":  # the factors of several EXPOSURE lines are multiplied
            exposure *= float(value)
        elif name == "FORMAT":
            xyz = value.strip() == "32-bit_rle_xyze"
            if not xyz and value.strip() != "32-bit_rle_rgbe":
                raise ValueError(f"its FORMAT is {value.strip()}, neither 32-bit_rle_rgbe nor 32-bit_rle_xyze")
    if not (isfinite(exposure) and exposure > 0):
        raise ValueError(f"its EXPOSURE is {exposure:g}")
    counts = int(match[3]), int(match[6])
    return RadianceHead(
        match[2] + match[5], match[1] + match[4], counts, exposure, xyz, len(text + gap + resolution + end)
    )


def size_of_picture(path: Path) -> tuple[int, int] | None:
    """Read width and height from the header of a file; return None for an unknown format.

    Raises PathreplayError if the format is known and the header contains no size.
    """
    try:
        with path.open("rb") as file:
            return _size(file, file.read(MOST_HEAD), path)
    except (OSError, ValueError, IndexError, struct.error):
        raise PathreplayError(f"Image {path} has a damaged header without a size; replace the file") from None


def require_readable_picture(path: Path, pixels: int = MOST_PIXELS) -> None:
    """Raise PathreplayError if an image has no pixels, has more than ``pixels`` pixels, or does not fit into memory.

    A damaged TGA file also raises PathreplayError; see `require_sound_tga`.
    """
    size = size_of_picture(path)
    if size is None:
        return  # the reader reports unknown formats
    what = f"Image {path} is {size[0]} x {size[1]}"
    if not prod(size):
        raise PathreplayError(f"{what}, which has no pixels; replace the file")
    if prod(size) > pixels:
        raise PathreplayError(f"{what}, and the limit is {pixels} pixels; scale it down")
    memory.require(prod(size) * _A_PIXEL, f"{what}, and", "scale it down")
    require_sound_tga(path)


def _size(file: BinaryIO, data: bytes, path: Path) -> tuple[int, int] | None:
    """Parse width and height. Raises struct.error, ValueError or IndexError for a damaged header."""
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        return struct.unpack_from(">II", data, 16)
    if data[:2] == b"\xff\xd8":
        return _jpeg_size(file)
    if data[:4] == b"\x76\x2f\x31\x01":
        return _exr_size(file)
    if data[:2] == b"BM":
        old = struct.unpack_from("<I", data, 14)[0] == 12  # headers of this version (OS/2) have 16-bit sizes
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
    """Skip segments up to the frame header of a JPEG, and parse the size there."""
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
    """Parse the size in the attribute ``dataWindow``.

    Each attribute consists of its name, its type, the length of its value, and the value.
    """
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
    """Read a zero-terminated string of at most 255 bytes."""
    begin, text = file.tell(), file.read(256).split(b"\0")[0]
    file.seek(begin + len(text) + 1)
    return text
