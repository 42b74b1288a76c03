"""Pictures of every format that is read, as bytes, and the same with another size in their heads. Needs no variant."""

from __future__ import annotations

import io
import re
import struct
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
import OpenEXR
import PIL.Image

from .assets import pfm

#: The largest size that a JPEG, or a TGA, can claim, or nearly so: four thousand million pixels.
HUGE = 65500, 65400


def pixels(height: int, width: int) -> np.ndarray:
    """A smooth picture, linear."""
    y, x = np.mgrid[:height, :width]
    return np.stack([0.4 + 0.2 * np.sin(y + k * x) for k in (1, 2, 3)], axis=2).astype(np.float32)


def saved(image: np.ndarray, kind: str, **options: Any) -> bytes:
    """As Pillow writes it: the numbers times 255, whatever they mean."""
    stream = io.BytesIO()
    PIL.Image.fromarray(np.rint(image * 255).astype(np.uint8)).save(stream, kind, **options)
    return stream.getvalue()


def radiance(image: np.ndarray, head: str) -> bytes:
    """A Radiance picture without runs; the resolution is the last line of the head."""
    exponents = np.frexp(image.max(axis=2))[1]
    mantissas = image * np.exp2(8.0 - exponents)[:, :, None]
    rgbe = np.concatenate([mantissas, exponents[:, :, None] + 128.0], axis=2).astype(np.uint8)
    return f"#?RADIANCE\n{head}\n".encode() + rgbe.tobytes()


def exr(image: np.ndarray, *names: str) -> bytes:
    """An EXR with these channels: names that end in R, G or B."""
    stream = io.BytesIO()
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    channels = {name: np.ascontiguousarray(image[:, :, "RGB".index(name[-1])]) for name in names}
    with OpenEXR.File(header, channels, num_threads=0) as file:
        file.write(stream)
    return stream.getvalue()


def picture_files(image: np.ndarray) -> dict[str, bytes]:
    """By the name of a file, in the format of its ending."""
    height, width, _ = image.shape
    return {
        "a.png": saved(image, "PNG"),
        "a.jpg": saved(image, "JPEG"),
        "progressive.jpg": saved(image, "JPEG", progressive=True),
        "a.bmp": saved(image, "BMP"),
        "a.tga": saved(image, "TGA"),
        "runs.tga": saved(image, "TGA", compression="tga_rle"),
        "a.ppm": saved(image, "PPM"),
        "a.pfm": pfm(image),
        "a.hdr": radiance(image, f"FORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}"),
        "a.exr": exr(image, "R", "G", "B"),
    }


_FRAME = re.compile(rb"(\xff[\xc0-\xc2]..\x08)....", re.DOTALL)
_WINDOW = re.compile(rb"(dataWindow\0box2i\0....)" + rb"." * 16, re.DOTALL)
_TEXT = re.compile(rb"^(P.\n)\d+ \d+")
_RESOLUTION = re.compile(rb"-Y \d+ \+X \d+\n")


def _png(data: bytes, w: int, h: int) -> bytes:
    body = b"IHDR" + struct.pack(">II", w, h) + data[24:29]
    return data[:12] + body + struct.pack(">I", zlib.crc32(body)) + data[33:]


_CLAIMS: dict[str, Callable[[bytes, int, int], bytes]] = {
    "png": _png,
    "jpg": lambda data, w, h: _FRAME.sub(lambda m: m[1] + struct.pack(">HH", h, w), data, count=1),
    "bmp": lambda data, w, h: data[:18] + struct.pack("<ii", w, -h) + data[26:],
    "tga": lambda data, w, h: data[:12] + struct.pack("<HH", w, h) + data[16:],
    "ppm": lambda data, w, h: _TEXT.sub(lambda m: m[1] + b"%d %d" % (w, h), data),
    "pfm": lambda data, w, h: _TEXT.sub(lambda m: m[1] + b"%d %d" % (w, h), data),
    "hdr": lambda data, w, h: _RESOLUTION.sub(b"-Y %d +X %d\n" % (h, w), data, count=1),
    "exr": lambda data, w, h: _WINDOW.sub(lambda m: m[1] + struct.pack("<iiii", 0, 0, w - 1, h - 1), data, count=1),
}


def claiming(name: str, data: bytes, size: tuple[int, int]) -> bytes:
    """The file with another width and height in its head, and nothing else changed."""
    return _CLAIMS[name.rsplit(".", 1)[1]](data, *size)
