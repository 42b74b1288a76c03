"""Hostile captures: transforms.json, models of COLMAP's, masks, patterns, and what is asked of their views."""

from __future__ import annotations

import io
import json
import shutil
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .assets import png
from .case import Action, add, recipe
from .room import JOB, ODD_FILES, Room
from .values import ESCAPE, TEXTS, VALUES, pick, spoiled

KIND = "capture"

MODEL = Path(__file__).resolve().parents[1] / "data" / "colmap"
NAMES = tuple(f"sub/shot {k}.png" for k in range(7))
PLACE = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]
FRAMES: list[dict[str, Any]] = [{"file_path": f"{k}.png", "transform_matrix": PLACE} for k in range(3)]
LISTED: dict[str, Any] = {"camera_angle_x": 0.7, "frames": FRAMES}

#: Jobs that work, with a capture of either kind and with a pattern.
CAPTURED: dict[str, Any] = {key: value for key, value in JOB.items() if key != "target"} | {
    "capture": {"transforms": "photos/transforms.json", "test_every": 3},
    "exposure": {},
}
MODELLED = {**CAPTURED, "capture": {"colmap": "sparse/0", "images": "images", "width": 8, "test_every": 3}}
PATTERN = {**JOB, "target": {"images": "photos/0.p*"}}

KEYS: dict[str, Mapping[str, Any]] = {
    **dict.fromkeys(
        "capture capture.transforms capture.masks capture.images capture.width capture.test_every exposure "
        "exposure.white_balance exposure.reference exposure.fix_scale exposure.learning_rate view_weights "
        "view_weights.1 "
        "target target.alpha sensors test_views".split(),
        CAPTURED,
    ),
    "capture.colmap": MODELLED,
    "target.images": PATTERN,
    "target.masks": PATTERN,
}


def _photos(room: Room, listed: Any = LISTED, job: Mapping[str, Any] = CAPTURED) -> None:
    """A capture of three pictures, listed like this."""
    (room / "photos").mkdir()
    for k in range(3):
        room.write(f"photos/{k}.png", png(6, 8))
    room.write("photos/transforms.json", listed if isinstance(listed, bytes) else json.dumps(listed))
    room.job(job)


def _model(room: Room, kind: str = "binary") -> None:
    """A model of seven pictures."""
    shutil.copytree(MODEL / kind, room / "sparse" / "0")
    for name in NAMES:
        path = room / "images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(png(80, 120))
    room.job(MODELLED)


@recipe(KIND, fuzz=True)
def a_hostile_value_in_a_job_with_a_capture(room: Room, rng: np.random.Generator) -> None:
    key = pick(rng, tuple(KEYS))
    _photos(room)
    if KEYS[key] is MODELLED:
        _model(room)
    room.change(key, pick(rng, VALUES), KEYS[key])


@recipe(KIND, fuzz=True)
def a_hostile_text_in_a_job_with_a_capture(room: Room, rng: np.random.Generator) -> None:
    key = pick(rng, tuple(KEYS))
    _photos(room)
    if KEYS[key] is MODELLED:
        _model(room)
    room.change(key, pick(rng, TEXTS), KEYS[key])


# ------------------------------------------------------------------------------
#  transforms.json
# ------------------------------------------------------------------------------


def _listed(name: str, listed: Any, *, refused: bool = True) -> None:
    add(KIND, f"transforms.json: {name}", lambda room, rng: _photos(room, listed), refused=refused)


def _framed(name: str, frame: dict[str, Any], *, refused: bool = True) -> None:
    _listed(name, {**LISTED, "frames": [{**FRAMES[0], **frame}, *FRAMES[1:]]}, refused=refused)


_listed("as it should be", LISTED, refused=False)
_listed("empty", b"")
_listed("a number", 3)
_listed("deep", b"[" * 100_000)
_listed("deep in a frame", b'{"frames": [{"file_path": ' + b"[" * 50_000)
_listed("not UTF-8", json.dumps(LISTED).encode("utf-16"))
_listed("no frames", {**LISTED, "frames": []})
_listed("frames by name", {**LISTED, "frames": {"a": FRAMES[0]}})
_listed("the same frame twice", {**LISTED, "frames": [FRAMES[0]] * 2})
_listed(
    "100 000 frames of nothing", {**LISTED, "frames": [{"file_path": "no.png", "transform_matrix": PLACE}] * 100_000}
)
_listed("a field of view of pi", {**LISTED, "camera_angle_x": 3.15})
_listed("a focal length of nothing", {**LISTED, "fl_x": 1e-300})
_listed("a focal length of infinity", json.dumps({**LISTED, "fl_x": 7}).replace("7", "Infinity").encode())
_listed("a lens that bends a million times", {**LISTED, "k1": 1e5, "fl_x": 9, "k2": -1e5}, refused=False)
_listed("a lens that shows nothing", {**LISTED, "cx": 9e5, "fl_x": 9, "k1": 0.1})
_listed("a fisheye that folds", {**LISTED, "is_fisheye": True, "fl_x": 2, "k1": -5}, refused=False)
_listed("a lens of nobody", {**LISTED, "camera_model": ESCAPE})
_listed("a picture a million wide", {**LISTED, "w": 999_999, "h": 1})
_listed("a principal point far away", {**LISTED, "cx": -9e5, "cy": 9e5}, refused=False)
_framed("a matrix of zero", {"transform_matrix": [[0] * 4] * 4})
_framed("a matrix of texts", {"transform_matrix": [["1"] * 4] * 4})
_framed("a matrix of 1e30", {"transform_matrix": [[1e30] * 4] * 4})
_framed("a matrix of three rows", {"transform_matrix": PLACE[:3]})
_framed("a camera at 1e8", {"transform_matrix": [*PLACE[:2], [0, 0, 1, 1e8], PLACE[3]]}, refused=False)
_framed("a picture outside", {"file_path": "../../outside/precious"})
_framed("a device", {"file_path": "/dev/zero"})
_framed("a folder", {"file_path": "."})
_framed("a name of 1 MB", {"file_path": "x" * 2**20})
_framed("a name with NUL", {"file_path": "0\0.png"})
_framed("a name of control characters", {"file_path": ESCAPE})
_framed("a mask that is not there", {"mask_path": "mask.png"})
_framed("a mask that is a device", {"mask_path": "/dev/zero"})
_framed("the list itself as a mask", {"mask_path": "transforms.json"})

for _odd in ODD_FILES:

    def _odd_list(room: Room, rng: np.random.Generator, odd: str = _odd) -> None:
        _photos(room)
        room.odd_file("photos/transforms.json", odd)

    def _odd_picture(room: Room, rng: np.random.Generator, odd: str = _odd) -> None:
        _photos(room)
        room.odd_file("photos/1.png", odd)

    add(KIND, f"transforms.json is {_odd}", _odd_list, refused=True)
    add(KIND, f"a picture of a capture is {_odd}", _odd_picture, refused=True)


@recipe(KIND, fuzz=True)
def transforms_with_spoiled_bytes(room: Room, rng: np.random.Generator) -> None:
    _photos(room, spoiled(json.dumps(LISTED).encode(), rng))


@recipe(KIND, refused=True)
def pictures_of_two_shapes_and_one_said_size(room: Room, rng: np.random.Generator) -> None:
    _photos(room, {**LISTED, "w": 8, "h": 6})
    room.write("photos/2.png", png(8, 8))


@recipe(KIND, refused=True)
def all_views_held_out(room: Room, rng: np.random.Generator) -> None:
    _photos(room, job={**CAPTURED, "test_views": ["0", "1", "2"]})


@recipe(KIND, refused=True)
def renderings_of_a_billion_columns(room: Room, rng: np.random.Generator) -> None:
    _photos(room, job={**CAPTURED, "capture": {"transforms": "photos/transforms.json", "width": 10**9}})


@recipe(KIND, refused=True)
def black_masks(room: Room, rng: np.random.Generator) -> None:
    _photos(room, job={**CAPTURED, "capture": {"transforms": "photos/transforms.json", "masks": "masks"}})
    (room / "masks").mkdir()
    for k in range(3):
        from PIL import Image

        stream = io.BytesIO()
        Image.new("L", (8, 6)).save(stream, "PNG")
        room.write(f"masks/{k}.png.png", stream.getvalue())


# ------------------------------------------------------------------------------
#  COLMAP
# ------------------------------------------------------------------------------


def _patched(
    name: str, file: str, change: Callable[[bytes], bytes], *, kind: str = "binary", refused: bool = True
) -> None:
    def spoil(room: Room, rng: np.random.Generator) -> None:
        _model(room, kind)
        room.write(f"sparse/0/{file}", change((MODEL / kind / file).read_bytes()))

    add(KIND, f"COLMAP: {name}", spoil, refused=refused)


_patched("as it should be", "images.bin", lambda data: data, refused=False)
_patched("no image", "images.bin", lambda data: bytes(8))
_patched("no camera", "cameras.bin", lambda data: bytes(8))
_patched("2^64 images", "images.bin", lambda data: b"\xff" * 8 + data[8:])
_patched("2^64 cameras", "cameras.bin", lambda data: b"\xff" * 8 + data[8:])
_patched("2^64 points", "images.bin", lambda data: data[:87] + b"\xff" * 8 + data[95:])
_patched("a name without end", "images.bin", lambda data: data[:72] + b"x" * 2**20)
_patched("a name that leads outside", "images.bin", lambda data: data[:72] + b"../../outside/precious" + data[86:])
_patched("a quaternion of zero", "images.bin", lambda data: data[:12] + bytes(32) + data[44:])
_patched("a place of NaN", "images.bin", lambda data: data[:44] + struct.pack("<d", float("nan")) + data[52:])
_patched("a camera of 2^64 pixels", "cameras.bin", lambda data: data[:16] + b"\xff" * 16 + data[32:])
_patched("a focal length of -1e300", "cameras.bin", lambda data: data[:32] + struct.pack("<d", -1e300) + data[40:])
_patched("a line without end", "images.txt", lambda data: data + b"9 " * 2**20, kind="text")
_patched("zeros", "images.txt", lambda data: bytes(2**16), kind="text")
_patched("numbers of 10 000 digits", "cameras.txt", lambda data: b"9" * 10_000 + b" PINHOLE 8 6 1 1 4 3\n", kind="text")
_patched("a model of control characters", "cameras.txt", lambda data: b"1 \x1b[2J 8 6 1 1\n", kind="text")

for _odd in ODD_FILES:

    def _odd_model(room: Room, rng: np.random.Generator, odd: str = _odd) -> None:
        _model(room)
        room.odd_file("sparse/0/images.bin", odd)

    add(KIND, f"COLMAP: images.bin is {_odd}", _odd_model, refused=True)


@recipe(KIND, fuzz=True)
def a_spoiled_model(room: Room, rng: np.random.Generator) -> None:
    kind, ending = pick(rng, (("binary", "bin"), ("text", "txt")))
    _model(room, kind)
    name = f"{pick(rng, ('cameras', 'images'))}.{ending}"
    room.write(f"sparse/0/{name}", spoiled((MODEL / kind / name).read_bytes(), rng))


# ------------------------------------------------------------------------------
#  Patterns, and what pictures say of themselves
# ------------------------------------------------------------------------------

PATTERNS = {
    "*": True,
    "**": True,
    "**/*": True,
    "/dev/*": True,
    "/proc/self/*": True,
    "../outside/*": True,
    "[": True,
    "[!": True,
    "[]": True,
    "photos/": True,
    "photos/[z-a].png": True,
    "photos/" + "*a" * 200 + "b": True,
    "photos/*\0": True,
    "?" * 10_000: True,
    ESCAPE + "*": True,
    "photos/0.p*": False,
}
for _pattern, _refused in PATTERNS.items():

    def _patterned(room: Room, rng: np.random.Generator, pattern: str = _pattern) -> None:
        _photos(room)
        room.change("target.images", pattern)

    add(KIND, f"pattern {_pattern[:30]!r} ({len(_pattern)})", _patterned, refused=_refused)


@recipe(KIND, refused=True)
def a_pattern_that_finds_a_pipe(room: Room, rng: np.random.Generator) -> None:
    room.odd_file("one.exr", "fifo")
    room.change("target.images", "on*.exr")


@recipe(KIND, fuzz=True)
def a_spoiled_colour_profile(room: Room, rng: np.random.Generator) -> Action | None:
    from PIL import Image

    stream, exif = io.BytesIO(), Image.Exif()
    exif[274] = 6
    Image.new("RGB", (8, 6)).save(stream, "PNG", icc_profile=b"\xff" * 3000, exif=exif)
    room.write("t.png", spoiled(stream.getvalue(), rng))
    room.change("target.images", ["t.png"])
    return None


@recipe(KIND, refused=True)
def a_sky_that_is_behind_pictures_and_to_be_found(room: Room, rng: np.random.Generator) -> None:
    room.write("t.png", png(6, 8, "RGBA"))
    room.job({**JOB, "target": {"images": ["t.png"], "alpha": "scene"}, "parameters": [{"key": "sky.radiance.value"}]})
