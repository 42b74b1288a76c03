"""A capture: pictures and the cameras that took them, as a `transforms.json` of NeRF, instant-ngp or Nerfstudio has it.

There, cameras look along -z with x to the right, and lengths are pixels; Mitsuba's look along z with x to the left, and
have a field of view.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import mitsuba as mi
import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from pathreplay.errors import PathreplayError, shown
from pathreplay.files import MISSING, file_names, file_problem
from pathreplay.inverse.config import Capture

MOST_BYTES = 64 * 2**20
ENDINGS = (".png", ".jpg", ".jpeg", ".exr")
"""Of pictures that are named without one, as NeRF's own scenes do it."""
DISTORTIONS = ("k1", "k2", "k3", "k4", "p1", "p2")
MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE")
STRAIGHT = 1e-3
"""How far the axes of a camera may be from unit length and right angles."""
OFF = 0.5
"""Pixels by which a picture's border may be off because its pixels are taken for squares."""
FACING = np.diag([-1.0, 1.0, -1.0, 1.0])
"""From Mitsuba's camera to OpenGL's."""

Row = Annotated[list[Annotated[FiniteFloat, Field(gt=-1e9, lt=1e9)]], Field(min_length=4, max_length=4)]


Length = Annotated[FiniteFloat, Field(gt=1e-3, lt=1e6)]
Place = Annotated[FiniteFloat, Field(gt=-1e6, lt=1e6)]


class _Lens(BaseModel):
    """Intrinsics; those of a frame take the place of the file's."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    camera_model: str | None = None
    camera_angle_x: Annotated[FiniteFloat, Field(gt=1e-3, lt=math.pi - 1e-3)] | None = None
    fl_x: Length | None = None
    fl_y: Length | None = None
    cx: Place | None = None
    cy: Place | None = None
    w: Length | None = None
    h: Length | None = None
    is_fisheye: bool = False
    k1: FiniteFloat = 0.0
    k2: FiniteFloat = 0.0
    k3: FiniteFloat = 0.0
    k4: FiniteFloat = 0.0
    p1: FiniteFloat = 0.0
    p2: FiniteFloat = 0.0


class _Frame(_Lens):
    file_path: str
    mask_path: str | None = None
    transform_matrix: Annotated[list[Row], Field(min_length=4, max_length=4)]


class _Transforms(_Lens):
    frames: Annotated[list[_Frame], Field(min_length=1)]


@dataclass(frozen=True)
class Shot:
    """A picture, its mask where there is one, and its camera as a dictionary of Mitsuba's."""

    image: Path
    mask: Path | None
    camera: dict[str, Any]


def read_capture(capture: Capture, base: Path, size_of: Callable[[Path], tuple[int, int]]) -> dict[str, Shot]:
    """The shots of a capture by name, in the order of the file; ``size_of`` gives width and height of a picture.

    Raises PathreplayError for what cannot be read, for lenses that are no pinholes, and for cameras that are no rigid
    motions.
    """
    path = base / capture.transforms
    found = _read(path)
    images = [_picture(frame.file_path, path) for frame in found.frames]
    names = _names([frame.file_path for frame in found.frames])
    fields, shots = set(_Lens.model_fields), {}
    for name, frame, image in zip(names, found.frames, images, strict=True):
        own = frame.model_dump(include=fields, exclude_unset=True)
        lens = found.model_dump(include=fields) | own
        if own.get("camera_angle_x") is not None and own.get("fl_x") is None:
            lens |= {"fl_x": None, "fl_y": None}
        camera = _camera(f"{path}: frame {shown(frame.file_path)}", lens, frame, size_of(image), capture.width)
        mask = None if frame.mask_path is None else _picture(frame.mask_path, path)
        shots[name] = Shot(image, mask, {**camera, "id": name})
    return shots


def _read(path: Path) -> _Transforms:
    if (problem := file_problem(path, MOST_BYTES)) == MISSING:
        raise PathreplayError(f"No capture {path}; give the path of a transforms.json")
    if problem:
        raise PathreplayError(f"Capture {path} {problem}; give the path of a transforms.json")
    try:
        return _Transforms.model_validate_json(path.read_bytes())
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        what = f"'{where}': {first['msg'].lower()}" if where else first["msg"]
        raise PathreplayError(f"Capture {path} is no transforms.json as we know it ({what}); mend it there") from None


def _picture(name: str, path: Path) -> Path:
    image = path.parent / name
    if image.name and not image.suffix:
        named = [image.with_name(image.name + ending) for ending in ENDINGS]
        image = next((path for path in named if not file_problem(path)), image)
    if problem := file_problem(image):
        raise PathreplayError(f"Capture {path}: picture {shown(name)} {problem}; correct the path or create the file")
    return image


def _names(files: list[str]) -> list[str]:
    """A name for each picture, fit for a sensor and a file: that of its file, with folders where two are the same."""
    names = [Path(file).stem for file in files]
    if len(set(names)) < len(names):
        names = [str(Path(file).with_suffix("")) for file in files]
    words = [re.sub(r"[^A-Za-z0-9_-]+", "_", name).strip("_-") or "view" for name in names]
    if len(set(words)) < len(words):
        twice = next(word for word in words if words.count(word) > 1)
        raise PathreplayError(f"The capture has two pictures that would both be called '{twice}'; remove or rename one")
    return list(file_names(words).values())


def _camera(
    where: str, lens: dict[str, Any], frame: _Frame, size: tuple[int, int], width: int | None
) -> dict[str, Any]:
    if lens["is_fisheye"]:
        raise PathreplayError(f"{where} is a fisheye's; undistort it to a PINHOLE first")
    if (model := lens["camera_model"]) is not None and model not in MODELS:
        raise PathreplayError(f"{where} has the camera_model {shown(model)}; undistort it to a PINHOLE first")
    if bent := {name: lens[name] for name in DISTORTIONS if lens[name]}:
        told = ", ".join(f"{name} = {value:g}" for name, value in bent.items())
        raise PathreplayError(f"{where} is distorted ({told}); undistort its picture first, and set these to 0")
    w, h = (size[i] if lens[key] is None else lens[key] for i, key in enumerate("wh"))
    if abs(w * size[1] - h * size[0]) > OFF * max(w, h):
        raise PathreplayError(
            f"{where} is said to be {w:g} x {h:g}, and its picture is {size[0]} x {size[1]}; correct w and h"
        )
    if lens["fl_x"] is not None:
        fov = 2 * math.atan(w / (2 * lens["fl_x"]))
        if lens["fl_y"] is not None and abs(lens["fl_y"] / lens["fl_x"] - 1) * h / 2 > OFF:
            raise PathreplayError(
                f"{where} has pixels that are no squares (fl_x = {lens['fl_x']:g}, fl_y = {lens['fl_y']:g}); resample "
                "its picture, and make them equal"
            )
    elif lens["camera_angle_x"] is not None:
        fov = lens["camera_angle_x"]
    else:
        raise PathreplayError(f"{where} has neither fl_x nor camera_angle_x; add one of them")
    matrix = np.array(frame.transform_matrix)
    axes = matrix[:3, :3]
    if (
        np.abs(axes.T @ axes - np.eye(3)).max() > STRAIGHT
        or np.linalg.det(axes) < 0
        or (matrix[3] != [0, 0, 0, 1]).any()
    ):
        raise PathreplayError(f"{where} has a transform_matrix that is no rotation and translation; correct it")
    columns = size[0] if width is None else width
    rows = max(1, round(columns * size[1] / size[0]))
    return {
        "type": "perspective",
        "fov": math.degrees(fov),
        "fov_axis": "x",
        "near_clip": 1e-3,
        "far_clip": 1e5,
        "principal_point_offset_x": 0.0 if lens["cx"] is None else 0.5 - lens["cx"] / w,
        "principal_point_offset_y": 0.0 if lens["cy"] is None else 0.5 - lens["cy"] / h,
        "to_world": mi.ScalarTransform4f((matrix @ FACING).tolist()),
        "film": {
            "type": "hdrfilm",
            "width": columns,
            "height": rows,
            "pixel_format": "rgb",
            "rfilter": {"type": "box"},
        },
    }
