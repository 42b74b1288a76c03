"""Hostile pictures by format: sizes that are claimed, heads and bodies that are spoiled, and what formats allow."""

from __future__ import annotations

import numpy as np

from .case import CHECK, OPTIMIZE, Action, add, recipe
from .picture_bytes import HUGE, claiming, exr, picture_files, pixels, radiance
from .room import JOB, Room
from .values import pick, spoiled

KIND = "picture format"

#: In the size of the room's film.
GOOD = picture_files(pixels(6, 8))
WHERE = ("target", "mask", "value", "truth", "texture")


def use(room: Room, where: str, file: str, data: bytes) -> Action:
    """Write a picture, and let the job meet it."""
    room.write(file, data)
    if where == "target":
        room.change("target.images", [file])
    elif where == "mask":
        room.change("target.masks", [file])
    elif where == "value":
        room.change("parameters.0.initial", {"image": file})
    elif where == "truth":
        room.job({**JOB, "target": {"values": {"paint.reflectance.data": {"image": file}}, "spp": 2}})
    else:
        room.edit("ball.xml", "texture.png", file)
        return Action(argv=CHECK)
    return Action(argv=OPTIMIZE)


for _file, _data in GOOD.items():
    for _where in WHERE:

        def _huge(
            room: Room, rng: np.random.Generator, file: str = _file, data: bytes = _data, where: str = _where
        ) -> Action:
            return use(room, where, file, claiming(file, data, HUGE))

        add(KIND, f"{_where}: {_file} of {HUGE[0]} x {HUGE[1]}", _huge, refused=True)

    def _good(room: Room, rng: np.random.Generator, file: str = _file, data: bytes = _data) -> Action:
        return use(room, pick(rng, WHERE), file, data)

    def _spoiled(room: Room, rng: np.random.Generator, file: str = _file, data: bytes = _data) -> Action:
        return use(room, pick(rng, WHERE), file, spoiled(data, rng))

    def _head(room: Room, rng: np.random.Generator, file: str = _file, data: bytes = _data) -> Action:
        return use(room, pick(rng, WHERE), file, spoiled(data[:40], rng) + data[40:])

    def _size(room: Room, rng: np.random.Generator, file: str = _file, data: bytes = _data) -> Action:
        size = tuple(pick(rng, (0, 1, 6, 8, 9, 1000, 65535)) for _ in range(2))
        return use(room, pick(rng, WHERE), file, claiming(file, data, size))

    add(KIND, f"{_file} as it is", _good)
    add(KIND, f"{_file}, spoiled", _spoiled, fuzz=True)
    add(KIND, f"{_file} with a spoiled head", _head, fuzz=True)
    add(KIND, f"{_file} of another size than it says", _size, fuzz=True)

for _file in ("a.jpg", "a.hdr"):

    def _large(room: Room, rng: np.random.Generator, file: str = _file) -> Action:
        return use(room, "value", file, claiming(file, GOOD[file], (5000, 6000)))

    add(KIND, f"{_file} of 5000 x 6000", _large)

PIXMAP = bytes(range(144))
ODD = {
    "PPM with a comment": ("a.ppm", b"P6\n# c\n8 6\n255\n" + PIXMAP),
    "PPM with a comment of 1 MB": ("a.ppm", b"P6\n#" + b"c" * 2**20 + b"\n8 6\n255\n" + PIXMAP),
    "PPM of 16 bit": ("a.ppm", b"P6\n8 6\n65535\n" + 2 * PIXMAP),
    "PPM of 16 bit, cut short": ("a.ppm", b"P6\n8 6\n65535\n" + PIXMAP),
    "PPM up to 7": ("a.ppm", b"P6\n8 6\n7\n" + PIXMAP),
    "PPM up to 0": ("a.ppm", b"P6\n8 6\n0\n" + PIXMAP),
    "PPM up to 99999": ("a.ppm", b"P6\n8 6\n99999\n" + 2 * PIXMAP),
    "PPM as text": ("a.ppm", b"P3\n8 6\n255\n" + b"7 " * 144),
    "PPM of -8 x 6": ("a.ppm", b"P6\n-8 6\n255\n" + PIXMAP),
    "PPM of digits": ("a.ppm", b"P6\n" + b"9" * 5000 + b" 6\n255\n" + PIXMAP),
    "PGM": ("a.pgm", b"P5 8 6 255\n" + PIXMAP[:48]),
    "bitmap of bits": ("a.pbm", b"P4 8 6\n" + PIXMAP[:6]),
    "grey PFM": ("a.pfm", b"Pf\n8 6\n1.0\n" + bytes(192)),
    "EXR of one layer": ("a.exr", exr(pixels(6, 8), "diffuse.R", "diffuse.G", "diffuse.B")),
    "EXR of half a layer": ("a.exr", exr(pixels(6, 8), "diffuse.R", "diffuse.G")),
    "EXR of two layers": ("a.exr", exr(pixels(6, 8), *(f"{layer}.{c}" for layer in "ab" for c in "RGB"))),
    "EXR of colours and a layer": ("a.exr", exr(pixels(6, 8), "R", "G", "B", "a.R", "a.G", "a.B")),
    "EXR of one channel": ("a.exr", exr(pixels(6, 8), "depth.R")),
    "GIF": ("a.gif", b"GIF89a\x08\x00\x06\x00\x80\x00\x00" + bytes(50)),
    "WebP": ("a.webp", b"RIFF\x24\x00\x00\x00WEBPVP8 " + bytes(50)),
    "JPEG of fill bytes": ("a.jpg", b"\xff\xd8" + b"\xff" * 2**20),
    "JPEG of 1e5 comments": ("a.jpg", b"\xff\xd8" + b"\xff\xfe\x00\x02" * 10**5 + GOOD["a.jpg"][2:]),
    "JPEG of a comment without length": ("a.jpg", b"\xff\xd8\xff\xfe\x00\x00" + GOOD["a.jpg"][2:]),
}
_FORMAT, _UPRIGHT = "FORMAT=32-bit_rle_rgbe", "-Y 6 +X 8"
for _name, _lines in {
    "without a format": ("SOFTWARE=x", _UPRIGHT),
    "of XYZ": ("FORMAT=32-bit_rle_xyze", _UPRIGHT),
    "of an unknown format": ("FORMAT=64-bit", _UPRIGHT),
    "exposed by 0": (f"{_FORMAT}\nEXPOSURE=0", _UPRIGHT),
    "exposed by -1": (f"{_FORMAT}\nEXPOSURE=-1", _UPRIGHT),
    "exposed by nan": (f"{_FORMAT}\nEXPOSURE=nan", _UPRIGHT),
    "exposed by 1e-300": (f"{_FORMAT}\nEXPOSURE=1e-300", _UPRIGHT),
    "exposed by much": (f"{_FORMAT}\nEXPOSURE=much", _UPRIGHT),
    "from the bottom": (_FORMAT, "+Y 6 +X 8"),
    "from the right": (_FORMAT, "-Y 6 -X 8"),
    "by columns": (_FORMAT, "+X 8 -Y 6"),
    "of two heights": (_FORMAT, "-Y 6 +Y 8"),
    "of a negative size": (_FORMAT, "-Y -6 +X 8"),
    "with a head of 1 MB": (_FORMAT + "\n" + "A=b\n" * 2**18, _UPRIGHT),
}.items():
    ODD[f"HDR {_name}"] = ("a.hdr", radiance(pixels(6, 8), "\n\n".join(_lines)))

for _name, (_file, _data) in ODD.items():

    def _odd(room: Room, rng: np.random.Generator, file: str = _file, data: bytes = _data) -> Action:
        return use(room, pick(rng, WHERE[:4]), file, data)

    add(KIND, _name, _odd)


@recipe(KIND, fuzz=True)
def an_ending_that_is_not_the_formats(room: Room, rng: np.random.Generator) -> Action:
    name = pick(rng, tuple(GOOD))
    return use(room, pick(rng, WHERE), "b" + pick(rng, (".png", ".jpg", ".tga", ".hdr", ".exr", "")), GOOD[name])
