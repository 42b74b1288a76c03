"""Read a `transforms.json` of NeRF, instant-ngp or Nerfstudio.

The cameras of the file look along -z with x to the right and y up. Focal lengths are in pixels.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from pathreplay.errors import PathreplayError, shown
from pathreplay.inverse.dataset.photos import Photo
from pathreplay.inverse.dataset.undistortion import OFF, Lens
from pathreplay.platform.files import MISSING, file_problem
from pathreplay.types import Json

MOST_BYTES = 64 * 2**20
ENDINGS = (".png", ".jpg", ".jpeg", ".exr")
"""Suffixes to try for images that are named without a suffix, as in the original NeRF scenes."""
STRAIGHT = 1e-3
"""Tolerance on the orthonormality of the axes of a camera."""
FOCAL = ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y")
"""Fields that give the focal lengths. A frame that has one of them uses none of the file."""
MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "OPENCV_FISHEYE")

Row = Annotated[list[Annotated[FiniteFloat, Field(gt=-1e9, lt=1e9)]], Field(min_length=4, max_length=4)]
Angle = Annotated[FiniteFloat, Field(gt=1e-3, lt=math.pi - 1e-3)]
Length = Annotated[FiniteFloat, Field(gt=1e-3, lt=1e6)]
Bounded = Annotated[FiniteFloat, Field(gt=-1e6, lt=1e6)]


class _Intrinsics(BaseModel):
    """Camera intrinsics. Values of a frame override values of the file."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    camera_model: str | None = None
    camera_angle_x: Angle | None = None
    camera_angle_y: Angle | None = None
    fl_x: Length | None = None
    fl_y: Length | None = None
    cx: Bounded | None = None
    cy: Bounded | None = None
    w: Length | None = None
    h: Length | None = None
    is_fisheye: bool = False
    k1: Bounded = 0.0
    k2: Bounded = 0.0
    k3: Bounded = 0.0
    k4: Bounded = 0.0
    p1: Bounded = 0.0
    p2: Bounded = 0.0


class _Frame(_Intrinsics):
    file_path: str
    mask_path: str | None = None
    transform_matrix: Annotated[list[Row], Field(min_length=4, max_length=4)]


class _Transforms(_Intrinsics):
    frames: Annotated[list[_Frame], Field(min_length=1)]


def photos_of_json(
    path: Path, size_of: Callable[[Path], tuple[int, int]], missing: list[str] | None = None
) -> list[Photo]:
    """Read the photos of a transforms.json, in the order of the file.

    Args:
        path: the file.
        size_of: returns the width and height of an image file.
        missing: list to which the names of missing images are added. The frames of these images are left out. If the
            list is None, a missing image is an error.

    Raises:
        PathreplayError: a file cannot be read, or the capture is inconsistent or not supported.
    """
    transforms = _read(path)
    fields, photos = set(_Intrinsics.model_fields), []
    for frame in transforms.frames:
        if missing is not None and file_problem(_path(frame.file_path, path)) == MISSING:
            missing.append(frame.file_path)
            continue
        image = _picture(frame.file_path, path)
        own = frame.model_dump(include=fields, exclude_unset=True)
        table = transforms.model_dump(include=fields)
        if any(own.get(key) is not None for key in FOCAL):
            table |= dict.fromkeys(FOCAL)
        table |= own
        where = f"{path}: frame {shown(frame.file_path)}"
        mask = None if frame.mask_path is None else _picture(frame.mask_path, path)
        lens = _lens(where, table, size_of(image))
        photos.append(Photo(where, frame.file_path, image, mask, lens, _place(where, frame.transform_matrix)))
    return photos


def _place(where: str, rows: list[list[float]]) -> np.ndarray:
    """Return the camera-to-world matrix. Raises PathreplayError if it is not a rigid motion."""
    place = np.array(rows)
    if (reason := _why_not_rigid(place)) is not None:
        raise PathreplayError(f"{where} has a transform_matrix that is not a rigid motion ({reason}); correct it")
    return place


def _why_not_rigid(place: np.ndarray) -> str | None:
    """Return why a matrix is not a rigid motion, or None if it is one."""
    axes, last = place[:3, :3], place[3].tolist()
    products = axes.T @ axes
    lengths = np.sqrt(products.diagonal())
    if last != [0, 0, 0, 1]:
        return f"its last row is {last}"
    if np.abs(lengths**2 - 1).max() > STRAIGHT:
        return f"its axes have the lengths {', '.join(f'{length:.4g}' for length in lengths)}"
    if np.abs(products - np.eye(3)).max() > STRAIGHT:
        return "its axes are not at right angles"
    return "it contains a reflection" if np.linalg.det(axes) < 0 else None


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
        raise PathreplayError(f"Capture {path} is not a valid transforms.json ({what}); correct it there") from None


def _path(name: str, path: Path) -> Path:
    image = path.parent / name
    if image.name and not image.suffix:
        named = [image.with_name(image.name + ending) for ending in ENDINGS]
        image = next((path for path in named if not file_problem(path)), image)
    return image


def _picture(name: str, path: Path) -> Path:
    image = _path(name, path)
    if problem := file_problem(image):
        raise PathreplayError(f"Capture {path}: image {shown(name)} {problem}; correct the path or create the file")
    return image


def _lens(where: str, table: Json, size: tuple[int, int]) -> Lens:
    if (model := table["camera_model"]) is not None and model not in MODELS:
        raise PathreplayError(
            f"{where} has the unsupported camera_model {shown(model)}; undistort its image to a PINHOLE camera first"
        )
    fisheye = table["is_fisheye"] or model == "OPENCV_FISHEYE"
    if table["k4"] and not fisheye:
        raise PathreplayError(
            f"{where} has k4 = {table['k4']:g}, which OpenCV and Nerfstudio define differently; undistort its image "
            "first, and set k4 to 0"
        )
    w, h = (size[i] if table[key] is None else table[key] for i, key in enumerate("wh"))
    if abs(w * size[1] - h * size[0]) > OFF * max(w, h):
        raise PathreplayError(
            f"{where} is {w:g} x {h:g} in the capture, but its file is {size[0]} x {size[1]}; correct w and h"
        )
    fx, fy = _focal(table, "x", w), _focal(table, "y", h)
    fx, fy = fx or fy, fy or fx
    if fx is None or fy is None:
        raise PathreplayError(f"{where} has none of {', '.join(FOCAL[:-1])} and {FOCAL[-1]}; add one of them")
    cx, cy = (half / 2 if table[key] is None else table[key] for key, half in (("cx", w), ("cy", h)))
    ks = tuple(table[f"k{i}"] for i in (1, 2, 3, 4))
    radial = (*ks, 0.0, 0.0) if fisheye else (*ks[:3], 0.0, 0.0, 0.0)
    return Lens(w, h, fx, fy, cx, cy, radial, (0.0, 0.0) if fisheye else (table["p1"], table["p2"]), fisheye)


def _focal(table: Json, axis: str, size: float) -> float | None:
    """Return the focal length along an axis in pixels, or None if neither it nor the angle of view is given."""
    focal, angle = table[f"fl_{axis}"], table[f"camera_angle_{axis}"]
    return size / (2 * math.tan(angle / 2)) if focal is None and angle is not None else focal
