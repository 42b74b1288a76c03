"""Hostile meshes: PLY, OBJ and serialized files that are cut short or tell of vertices that are not there."""

from __future__ import annotations

import struct
import zlib

import numpy as np

from .assets import VERTICES, binary_ply, obj, ply, serialized
from .case import CHECK, OPTIMIZE, Action, add, recipe
from .room import Room
from .values import pick, spoiled

KIND = "mesh"
NAN, FAR = float("nan"), float("inf")


def _meets(rng: np.random.Generator) -> Action:
    return Action(argv=pick(rng, (CHECK, OPTIMIZE)))


def _file(name: str, file: str, data: bytes | str, *, refused: bool = True) -> None:
    def spoil(room: Room, rng: np.random.Generator) -> Action:
        room.write(file, data)
        return _meets(rng)

    add(KIND, name, spoil, refused=refused)


def _head(vertices: int | str, faces: int | str, index: str = "uchar int", form: str = "binary_little_endian") -> bytes:
    return (
        f"ply\nformat {form} 1.0\nelement vertex {vertices}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {faces}\nproperty list {index} vertex_indices\nend_header\n"
    ).encode()


FOUR = b"".join(struct.pack("<3f", *v) for v in VERTICES)
TRIANGLE = struct.pack("<B3i", 3, 0, 1, 2)

for _index in (4, 1000, 2**31 - 1, -1, -(2**31)):
    _file(f"binary PLY with a face of vertex {_index}", "sheet.ply", binary_ply(faces=[(0, 1, _index)]))
    _file(f"PLY with a face of vertex {_index}", "sheet.ply", ply(faces=[(0, 1, _index)]))
for _index in (0, 4, 1000, 2**31 - 1, -5, -(2**31)):
    _file(f"OBJ with a face of vertex {_index}", "tile.obj", obj(faces=[(1, 2, _index)]))
for _bad in (NAN, FAR):
    _file(f"binary PLY with a vertex at {_bad}", "sheet.ply", binary_ply([*VERTICES[:3], (0, 0, _bad)]))
    _file(f"OBJ with a vertex at {_bad}", "tile.obj", obj([(_bad, 0, 0), (1, 0, 0), (0, 1, 0)]))
_file(
    "PLY with vertices at 3e38",
    "sheet.ply",
    binary_ply([(3e38, 0, 0), (-3e38, 0, 0), (0, 3e38, 0), (0, 0, 0)]),
    refused=False,
)
_file("PLY with all vertices in one place", "sheet.ply", binary_ply([(0, 0, 3)] * 4), refused=False)
_file("PLY without faces", "sheet.ply", binary_ply(faces=[]), refused=False)
_file("PLY with faces of five", "sheet.ply", binary_ply(faces=[(0, 1, 2, 3, 0)]), refused=False)
_file("PLY with faces of two", "sheet.ply", binary_ply(faces=[(0, 1)]), refused=False)
_file("PLY with faces of none", "sheet.ply", binary_ply(faces=[()]), refused=False)
_file("PLY that tells of 4e9 vertices", "sheet.ply", _head(4_000_000_000, 1) + FOUR + TRIANGLE)
_file("PLY that tells of 1e30 vertices", "sheet.ply", _head(10**30, 1) + FOUR + TRIANGLE)
_file("PLY that tells of -1 vertices", "sheet.ply", _head(-1, 1) + FOUR + TRIANGLE)
_file("PLY that tells of 2e9 faces", "sheet.ply", _head(4, 2_000_000_000) + FOUR + TRIANGLE)
_file("PLY that tells of x vertices", "sheet.ply", _head("x", 1) + FOUR + TRIANGLE)
_file("PLY of another list", "sheet.ply", _head(4, 1, "float double") + FOUR + TRIANGLE)
_file("PLY of unknown types", "sheet.ply", _head(4, 1, "uchar quad") + FOUR + TRIANGLE)
_file("PLY in an unknown form", "sheet.ply", _head(4, 1, form="base64") + FOUR + TRIANGLE)
_file("PLY of large lists", "sheet.ply", _head(4, 1, "int int") + FOUR + struct.pack("<i", 2**31 - 1))
_file("PLY without an end of its head", "sheet.ply", ply().split("end_header")[0])
_file("PLY with a head of 1 MB", "sheet.ply", b"ply\n" + b"comment x\n" * 100_000)
_file("PLY cut in its body", "sheet.ply", binary_ply()[:-7])
_file("PLY cut in its vertices", "sheet.ply", binary_ply()[:-40])
_file("PLY that is text", "sheet.ply", "This is no mesh.\n")
_file("PLY of garbage", "sheet.ply", bytes(range(256)) * 40)
_file("PLY that is an OBJ", "sheet.ply", obj())
_file("PLY without vertices", "sheet.ply", _head(0, 0), refused=False)
_file("PLY of faces without vertices", "sheet.ply", _head(0, 1) + TRIANGLE)
_file("OBJ of nothing", "tile.obj", "", refused=False)
_file("OBJ of text", "tile.obj", "This is no mesh.\n", refused=False)
_file("OBJ of garbage", "tile.obj", bytes(range(256)) * 40, refused=False)
_file("OBJ that is a PLY", "tile.obj", binary_ply(), refused=False)
_file("OBJ without vertices", "tile.obj", "f 1 2 3\n")
_file("OBJ with texture coordinates that are not there", "tile.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/7 2/8 3/9\n")
_file("OBJ with normals that are not there", "tile.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1//7 2//8 3//9\n")
_file("OBJ with a face of one", "tile.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1\n", refused=False)
_file("OBJ with half a vertex", "tile.obj", "v 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", refused=False)
_file("OBJ with words for numbers", "tile.obj", "v a b c\nf x y z\n")
_file("OBJ with a line of 1 MB", "tile.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf " + "1 " * 500_000 + "\n", refused=False)


def _serialized(name: str, data: bytes, *, options: str = "", refused: bool = True) -> None:
    def spoil(room: Room, rng: np.random.Generator) -> Action:
        room.write("mesh.serialized", data)
        room.into_scene(f'<shape type="serialized"><string name="filename" value="mesh.serialized"/>{options}</shape>')
        return _meets(rng)

    add(KIND, f"serialized: {name}", spoil, refused=refused)


def _body(vertices: int, faces: int, indices: tuple[int, ...], flags: int = 0x1000, behind: bytes = b"") -> bytes:
    body = struct.pack("<I", flags) + b"m\0" + struct.pack("<QQ", vertices, faces)
    body += np.array(VERTICES, "<f4").tobytes() + np.array(indices, "<u4").tobytes() + behind
    return struct.pack("<HH", 0x041C, 4) + zlib.compress(body) + struct.pack("<QI", 0, 1)


_serialized("nothing", b"")
_serialized("text", b"This is no mesh.\n" * 10)
_serialized("cut short", serialized()[:-20])
_serialized("of version 9", serialized()[:2] + b"\x09\x00" + serialized()[4:])
_serialized("shape 7", serialized(), options='<integer name="shape_index" value="7"/>')
_serialized("shape -1", serialized(), options='<integer name="shape_index" value="-1"/>')
_serialized("4e9 vertices", _body(4_000_000_000, 1, (0, 1, 2)))
_serialized("a face of vertex 1000", _body(4, 1, (0, 1, 1000)))
# Mitsuba reads no further than the faces, so that it does not see the checksum (the 4 bytes before the table).
_damaged = _body(4, 1, (0, 1, 1000), behind=b"more")
_serialized("a face of vertex 1000, a wrong checksum", _damaged[:-16] + bytes(4) + _damaged[-12:])
_serialized("1e6 shapes", serialized()[:-4] + struct.pack("<I", 10**6))
_serialized("unknown flags", _body(4, 1, (0, 1, 2), 0xFFFFFFFF), refused=False)


@recipe(KIND, fuzz=True)
def spoiled_ply(room: Room, rng: np.random.Generator) -> Action:
    room.write("sheet.ply", spoiled(pick(rng, (binary_ply(), ply().encode())), rng))
    return _meets(rng)


@recipe(KIND, fuzz=True)
def spoiled_obj(room: Room, rng: np.random.Generator) -> Action:
    room.write("tile.obj", spoiled(obj().encode(), rng))
    return _meets(rng)


@recipe(KIND, fuzz=True)
def spoiled_serialized(room: Room, rng: np.random.Generator) -> Action:
    room.write("mesh.serialized", spoiled(serialized(), rng))
    room.into_scene('<shape type="serialized"><string name="filename" value="mesh.serialized"/></shape>')
    return _meets(rng)
