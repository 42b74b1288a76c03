"""Hostile pictures: as targets, as textures, and as values of parameters."""

from __future__ import annotations

import struct
import zlib

import numpy as np

from .assets import pfm, png
from .case import CHECK, Action, add, recipe
from .room import ODD_FILES, RENDERED, Room
from .values import TEXTS, pick, spoiled

KIND = "picture"


def png_of(width: int, height: int, *, depth: int = 8, colour: int = 2, data: bytes = b"\0" * 100) -> bytes:
    """A PNG whose head may lie about what follows."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    head = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    body = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


def pixels(value: float, height: int = 6, width: int = 8) -> np.ndarray:
    """A grey picture with one pixel of another value."""
    picture = np.full((height, width, 3), 0.5, np.float32)
    picture[1, 2, 0] = value
    return picture


def exr_like(head: bytes) -> bytes:
    """The magic number and version of OpenEXR, and something behind them."""
    return b"\x76\x2f\x31\x01\x02\x00\x00\x00" + head


def window(x: int, y: int) -> bytes:
    """An EXR attribute with a data window from zero to there."""
    return b"dataWindow\0box2i\0" + struct.pack("<iiiii", 16, 0, 0, x, y)


# ------------------------------------------------------------------------------
#  Targets
# ------------------------------------------------------------------------------


def _target(name: str, file: str, data: bytes | str, *, refused: bool = True) -> None:
    def spoil(room: Room, rng: np.random.Generator) -> None:
        room.write(file, data)
        room.change("target.images", [file])

    add(KIND, f"target: {name}", spoil, refused=refused)


_target("of another size", "t.png", png(5, 7))
_target("a single pixel", "t.png", png(1, 1))
_target("grey", "t.png", png(6, 8, "L"), refused=False)
_target("one bit", "t.png", png(6, 8, "1"), refused=False)
_target("a palette", "t.png", png(6, 8, "P"), refused=False)
_target("with alpha", "t.png", png(6, 8, "RGBA"), refused=False)
_target("grey with alpha", "t.png", png(6, 8, "LA"), refused=False)
_target("16 bit", "t.png", png(6, 8, "I;16"), refused=False)
for _value in (float("nan"), float("inf"), -float("inf"), 3e38):
    _target(f"a pixel of {_value}", "t.pfm", pfm(pixels(_value)))
for _value in (-1.0, 0.0, 1e-40):
    _target(f"a pixel of {_value}", "t.pfm", pfm(pixels(_value)), refused=False)
_target("text", "t.png", "This is no picture.\n")
_target("a scene", "t.exr", "<scene version='3.0.0'/>")
_target("a PNG named EXR", "t.exr", png(6, 8), refused=False)
_target("a PFM named PNG", "t.png", pfm(pixels(1.0)), refused=False)
_target("cut short", "t.png", png(6, 8)[:60])
_target("PNG of 100000 x 100000", "t.png", png_of(100_000, 100_000))
_target("PNG of 2e9 x 2e9", "t.png", png_of(2**31 - 1, 2**31 - 1))
_target("PNG of 0 x 0", "t.png", png_of(0, 0))
_target("PNG of an unknown colour", "t.png", png_of(8, 6, colour=5))
_target("PFM of -8 x 6", "t.pfm", b"PF\n-8 6\n-1.0\n" + bytes(600))
_target("PFM of 2e9 x 2e9", "t.pfm", b"PF\n2000000000 2000000000\n-1.0\n" + bytes(600))
_target("PFM of nan x 6", "t.pfm", b"PF\nnan 6\n-1.0\n" + bytes(600))
_target("PFM of a scale of zero", "t.pfm", b"PF\n8 6\n0.0\n" + bytes(576), refused=False)
_target("PFM cut short", "t.pfm", pfm(pixels(1.0))[:-5])
_target("EXR of nothing", "t.exr", exr_like(b""))
_target("EXR of zeros", "t.exr", exr_like(bytes(5000)))
_target("EXR of 2e9 x 2e9", "t.exr", exr_like(window(2**31 - 2, 2**31 - 2) + b"\0"))
_target("EXR of attributes without end", "t.exr", exr_like(b"a\0string\0" + struct.pack("<i", 2**31 - 1)))
_target("HDR of garbage", "t.hdr", b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 99999999 +X 99999999\n" + bytes(60))
_target("JPEG of garbage", "t.jpg", b"\xff\xd8\xff\xe0" + bytes(500))
_target("BMP of garbage", "t.bmp", b"BM" + bytes(500))
_target("TGA of garbage", "t.tga", bytes(18) + bytes(range(256)))

for _odd in ODD_FILES:
    add(KIND, f"target: {_odd}", lambda room, rng, odd=_odd: room.odd_file("target.exr", odd), refused=True)  # type: ignore[misc]


@recipe(KIND, fuzz=True)
def a_spoiled_target(room: Room, rng: np.random.Generator) -> None:
    files = {"t.png": png(6, 8), "t.pfm": pfm(pixels(1.0)), "t.exr": (room / "target.exr").read_bytes()}
    name = pick(rng, tuple(files))
    room.write(name, spoiled(files[name], rng))
    room.change("target.images", [name])


@recipe(KIND, refused=True, fuzz=True)
def a_target_of_a_hostile_name(room: Room, rng: np.random.Generator) -> None:
    room.change("target.images", [pick(rng, ("", "matplotlib:")) + pick(rng, TEXTS)])


@recipe(KIND, refused=True)
def a_thousand_targets(room: Room, rng: np.random.Generator) -> None:
    room.change("target.images", ["target.exr"] * 1000)


# ------------------------------------------------------------------------------
#  Values and textures
# ------------------------------------------------------------------------------


def _value(name: str, file: str, data: bytes | str, *, refused: bool = True) -> None:
    def spoil(room: Room, rng: np.random.Generator) -> None:
        room.write(file, data)
        options = {"image": file, "fit": pick(rng, ("stretch", "crop")), "raw": pick(rng, (True, False))}
        if pick(rng, (True, False)):
            room.change("parameters.0.initial", options)
        else:
            room.change("target.values", {"paint.reflectance.data": options}, RENDERED)

    add(KIND, f"value: {name}", spoil, refused=refused)


_value("of NaN", "v.pfm", pfm(pixels(float("nan"))))
_value("of 3e38", "v.pfm", pfm(pixels(3e38)))
_value("text", "v.png", "no picture")
_value("empty", "v.png", "")
_value("PNG of 100000 x 100000", "v.png", png_of(100_000, 100_000))
_value("one column", "v.png", png(300, 1), refused=False)
_value("one row", "v.png", png(1, 300), refused=False)
_value("grey with alpha", "v.png", png(4, 4, "LA"), refused=False)
_value("a mesh", "v.ply", "ply\n")
_value("no ending", "v", png(4, 4), refused=False)


def _texture(name: str, data: bytes | str, *, refused: bool = True) -> None:
    def spoil(room: Room, rng: np.random.Generator) -> Action:
        room.write("texture.png", data)
        return Action(argv=pick(rng, (CHECK, ("optimize", "job.toml", "--quiet"))))

    add(KIND, f"texture: {name}", spoil, refused=refused)


_texture("text", "no picture")
_texture("PNG of 100000 x 100000", png_of(100_000, 100_000))
_texture("PNG of 0 x 0", png_of(0, 0))
_texture("cut short", png(4, 4)[:50])
_texture("a single pixel", png(1, 1), refused=False)
_texture("NaN in a PFM named PNG", pfm(pixels(float("nan"))))


@recipe(KIND, fuzz=True)
def a_spoiled_texture(room: Room, rng: np.random.Generator) -> Action:
    room.write("texture.png", spoiled(png(4, 4), rng))
    return Action(argv=CHECK)
