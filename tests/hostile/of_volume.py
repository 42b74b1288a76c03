"""Hostile volumes: .vol, .vdb and .nvdb files that are cut short, of wrong sizes, or no volumes at all."""

from __future__ import annotations

import struct

import numpy as np

from .case import OPTIMIZE, Action, add, recipe
from .room import ODD_FILES, RENDERED, Room
from .values import pick, spoiled

KIND = "volume"

MEDIUM = """<shape type="cube" id="box"><bsdf type="null"/><medium type="heterogeneous" name="interior">
  <volume type="gridvolume" name="sigma_t"><string name="filename" value="cloud.vol"/></volume></medium></shape>"""

READ = "from pathreplay.scenes.volume_files import load_volume; load_volume({file!r}, {grid!r})"


def vol(
    size: tuple[int, int, int, int] = (2, 2, 2, 1),
    *,
    values: bytes = struct.pack("<8f", *range(8)),
    box: tuple[float, ...] = (0, 0, 0, 1, 1, 1),
    encoding: int = 1,
    magic: bytes = b"VOL\x03",
) -> bytes:
    """A `.vol` file whose head may lie."""
    return struct.pack("<4s5i6f", magic, encoding, *size, *box) + values


NAN = float("nan")
VOL_FILES: dict[str, bytes] = {
    "empty": b"",
    "only the magic number": b"VOL\x03",
    "half a head": vol()[:30],
    "no values": vol(values=b""),
    "cut short": vol()[:-3],
    "too long": vol() + b"more",
    "2e9 voxels": vol((2**31 - 1, 1, 1, 1)),
    "overflowing to eight voxels": vol((2**16, 2**16, 1, 1)),
    "voxels below zero": vol((-2, -2, 2, 1)),
    "no voxels": vol((0, 2, 2, 1), values=b""),
    "no channels": vol((2, 2, 2, 0)),
    "5 channels": vol((1, 1, 2, 5), values=bytes(40)),
    "of version 2": vol(magic=b"VOL\x02"),
    "of another magic number": vol(magic=b"LOV\x03"),
    "of half precision": vol(encoding=2),
    "of encoding 99": vol(encoding=99),
    "of NaN": vol(values=struct.pack("<8f", *[NAN] * 8)),
    "of infinity": vol(values=struct.pack("<8f", *[float("inf")] * 8)),
    "below zero": vol(values=struct.pack("<8f", *[-1.0] * 8)),
    "of 3e38": vol(values=struct.pack("<8f", *[3e38] * 8)),
    "a box of NaN": vol(box=(NAN,) * 6),
    "a box upside down": vol(box=(1, 1, 1, 0, 0, 0)),
    "a box of nothing": vol(box=(0, 0, 0, 0, 0, 0)),
    "text": b"This is no volume.\n" * 20,
}
#: Our reader takes these: a value is the user's business, or a place that is not looked at.
READABLE = {"5 channels", "below zero", "a box upside down", "a box of nothing", "a box of NaN"}


def in_scene(room: Room, rng: np.random.Generator) -> Action:
    """Let the scene hold the volume, and recover its values, or check them."""
    room.into_scene(MEDIUM)
    key = "box.interior_medium.sigma_t.data"
    room.change("parameters.0", {"key": key, "initial": 0.5, "lower": 0.0})
    return Action(argv=pick(rng, (OPTIMIZE, ("check", "ball.xml", "--param", key, "--seeds", "2", "--spp", "1"))))


def as_value(room: Room, file: str) -> Action:
    """Let a good scene start at the volume."""
    room.into_scene(MEDIUM)
    room.change("parameters.0", {"key": "box.interior_medium.sigma_t.data", "initial": file, "lower": 0.0}, RENDERED)
    room.edit("job.toml", "paint.reflectance.data", "box.interior_medium.sigma_t.data")
    return Action(argv=OPTIMIZE)


for _name, _data in VOL_FILES.items():

    def _scene(room: Room, rng: np.random.Generator, data: bytes = _data) -> Action:
        room.write("cloud.vol", data)
        return in_scene(room, rng)

    def _value(room: Room, rng: np.random.Generator, data: bytes = _data) -> Action:
        room.write("start.vol", data)
        return as_value(room, "start.vol")

    def _read(room: Room, rng: np.random.Generator, data: bytes = _data) -> Action:
        room.write("start.vol", data)
        return Action(script=READ.format(file="start.vol", grid=None))

    add(KIND, f".vol in a scene: {_name}", _scene)
    add(KIND, f".vol as a value: {_name}", _value, refused=_name not in READABLE)
    add(KIND, f".vol in Python: {_name}", _read, refused=_name not in READABLE)

for _odd in ODD_FILES:
    for _ending in ("vol", "vdb", "nvdb"):

        def _odd_volume(room: Room, rng: np.random.Generator, odd: str = _odd, name: str = f"odd.{_ending}") -> Action:
            room.odd_file(name, odd)
            return pick(rng, (as_value(room, name), Action(script=READ.format(file=name, grid=None))))

        add(KIND, f".{_ending} is {_odd}", _odd_volume, refused=True)


@recipe(KIND, refused=True)
def a_scene_with_a_volume_that_is_a_fifo(room: Room, rng: np.random.Generator) -> Action:
    room.odd_file("cloud.vol", "fifo")
    return in_scene(room, rng)


@recipe(KIND, fuzz=True)
def a_spoiled_vdb(room: Room, rng: np.random.Generator) -> Action:
    room.write("bad.vdb", spoiled((room / "two.vdb").read_bytes(), rng))
    return Action(script=READ.format(file="bad.vdb", grid=pick(rng, ("density", "heat", None, ""))))


@recipe(KIND, fuzz=True)
def a_spoiled_nvdb(room: Room, rng: np.random.Generator) -> Action:
    room.write("bad.nvdb", spoiled((room / pick(rng, ("two.nvdb", "raw.nvdb"))).read_bytes(), rng))
    return Action(script=READ.format(file="bad.nvdb", grid=pick(rng, ("density", "heat", None, ""))))


@recipe(KIND, fuzz=True)
def a_spoiled_head_of_an_nvdb(room: Room, rng: np.random.Generator) -> Action:
    data = bytearray((room / pick(rng, ("two.nvdb", "raw.nvdb"))).read_bytes())
    for place in rng.integers(8, 900, size=int(rng.integers(1, 9))):
        data[int(place)] = int(rng.integers(256))
    room.write("bad.nvdb", bytes(data))
    return Action(script=READ.format(file="bad.nvdb", grid="density"))


@recipe(KIND, refused=True, fuzz=True)
def an_nvdb_of_garbage(room: Room, rng: np.random.Generator) -> Action:
    head = pick(rng, (b"", b"NanoVDB0", b"NanoVDB1", b"NanoVDB2"))
    room.write("bad.nvdb", head + rng.bytes(int(rng.integers(1, 5000))))
    return Action(script=READ.format(file="bad.nvdb", grid=None))


@recipe(KIND, refused=True, fuzz=True)
def a_vdb_of_garbage(room: Room, rng: np.random.Generator) -> Action:
    head = pick(rng, (b"", b" BDV\0\0\0\0", b" BDV\0\0\0\0\xe0\0\0\0"))
    room.write("bad.vdb", head + rng.bytes(int(rng.integers(1, 5000))))
    return Action(script=READ.format(file="bad.vdb", grid=None))
