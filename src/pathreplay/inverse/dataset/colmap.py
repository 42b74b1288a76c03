"""Read the cameras and images of a COLMAP model in text or binary format. Points, rigs and frames are ignored.

See https://colmap.github.io/format.html for the formats. pycolmap is not used, because it takes 135 MB, requires the
points of a model, and accepts cameras whose position is NaN.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from pathreplay.errors import PathreplayError, shown
from pathreplay.inverse.dataset.photos import Photo
from pathreplay.inverse.dataset.undistortion import OFF, Lens
from pathreplay.platform.files import MISSING, file_problem

MODELS: dict[str, tuple[int, str]] = {
    "SIMPLE_PINHOLE": (0, "f cx cy"),
    "PINHOLE": (1, "fx fy cx cy"),
    "SIMPLE_RADIAL": (2, "f cx cy k1"),
    "RADIAL": (3, "f cx cy k1 k2"),
    "OPENCV": (4, "fx fy cx cy k1 k2 p1 p2"),
    "OPENCV_FISHEYE": (5, "fx fy cx cy k1 k2 k3 k4"),
    "FULL_OPENCV": (6, "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
}
"""Supported lens models: for each name, the number in binary files and the names of the parameters."""
NUMBERS = {number: name for name, (number, _) in MODELS.items()}

MOST_BYTES = 8 * 2**30
MOST_IMAGES = 100_000
LONGEST_NAME = 4096
LONGEST_LINE = 64 * 2**20
T = TypeVar("T")

UNIT = 1e-2
"""Tolerance on the length of a quaternion."""


@dataclass(frozen=True)
class _Posed:
    """An image of the model with its world-to-camera rotation (quaternion, w first) and translation."""

    number: int
    quaternion: tuple[float, ...]
    translation: tuple[float, ...]
    camera: int
    name: str


def photos_of_colmap(
    folder: Path,
    images: Path | None,
    masks: Path | None,
    size_of: Callable[[Path], tuple[int, int]],
    missing: list[str] | None = None,
) -> list[Photo]:
    """Read the photos of a COLMAP model, sorted by name.

    Args:
        folder: folder of the model.
        images: folder of the images; default: ``../../images`` relative to the model.
        masks: folder of masks. A mask is named like its image with '.png' appended, as in COLMAP.
        size_of: returns the width and height of an image file.
        missing: list to which the names of missing images are added. These images are left out. If the list is None, a
            missing image is an error.

    Raises:
        PathreplayError: a file cannot be read, or the model is inconsistent or not supported.
    """
    cameras, posed = _read(folder)
    pictures = _images_of(folder) if images is None else images
    photos = []
    for entry in sorted(posed, key=lambda entry: entry.name):
        where = f"{folder}: image {shown(entry.name)}"
        image = pictures / entry.name
        if missing is not None and file_problem(image) == MISSING:
            missing.append(entry.name)
            continue
        if problem := file_problem(image):
            raise PathreplayError(f"{where}: {image} {problem}; give the folder of the images as capture.images")
        mask = None if masks is None else masks / f"{entry.name}.png"
        if mask is not None and (problem := file_problem(mask)):
            raise PathreplayError(f"{where}: its mask {mask} {problem}; correct capture.masks, or add the file")
        if entry.camera not in cameras:
            raise PathreplayError(f"{where} refers to camera {entry.camera}, which the model lacks; repair the model")
        lens, size = cameras[entry.camera], size_of(image)
        if abs(lens.w * size[1] - lens.h * size[0]) > OFF * max(lens.w, lens.h):
            raise PathreplayError(
                f"{where} is {lens.w:g} x {lens.h:g} in the model, but its file is {size[0]} x {size[1]}; "
                "give the images of this model"
            )
        photos.append(Photo(where, entry.name, image, mask, lens, _place(where, entry)))
    return photos


def _images_of(folder: Path) -> Path:
    """Return ``../../images`` relative to a model. If the model is a symbolic link, try the link first."""
    beside = folder.absolute().parent.parent / "images"
    return beside if beside.is_dir() else folder / ".." / ".." / "images"


def _read(folder: Path) -> tuple[dict[int, Lens], list[_Posed]]:
    ending = next((e for e in (".bin", ".txt") if not file_problem(folder / f"cameras{e}")), None)
    if ending is None:
        raise PathreplayError(
            f"No COLMAP model in {folder}: it has neither cameras.bin nor cameras.txt; give the folder that contains "
            "them, such as sparse/0"
        )
    paths = [folder / f"{name}{ending}" for name in ("cameras", "images")]
    for path in paths:
        if problem := file_problem(path, MOST_BYTES):
            remedy = "; add it, since every model needs it" if problem == MISSING else "; correct it"
            raise PathreplayError(f"{path} {problem}{remedy}")
    binary = ending == ".bin"
    cameras = dict(_parsed(paths[0], _binary_cameras if binary else _text_cameras))
    posed = _parsed(paths[1], _binary_images if binary else _text_images)
    if not posed:
        raise PathreplayError(f"{paths[1]} has no images; register some in COLMAP first")
    return cameras, posed


def _parsed(path: Path, parse: Callable[[BinaryIO], Iterator[T]]) -> list[T]:
    try:
        with path.open("rb") as file:
            return list(parse(file))
    except (ValueError, OSError) as error:
        raise PathreplayError(f"{path} is not a supported COLMAP file ({error}); export the model again") from None


def _lens(model: str, width: float, height: float, parameters: list[float]) -> Lens:
    names = MODELS[model][1].split()
    if len(names) != len(parameters):
        raise ValueError(f"a {model} camera has {len(parameters)} parameters instead of {len(names)}")
    given = dict(zip(names, parameters, strict=True))
    fx, fy = (given.get(name, given.get("f", 0.0)) for name in ("fx", "fy"))
    numbers = (width, height, *parameters)
    if not all(map(math.isfinite, numbers)) or max(map(abs, numbers)) > 1e6 or min(width, height) < 1:
        raise ValueError(f"a camera of {width:g} x {height:g} has the parameters {parameters}")
    if min(fx, fy) < 1e-3:
        raise ValueError(f"a camera has the focal length {min(fx, fy):g}")
    fisheye = model == "OPENCV_FISHEYE"
    radial = tuple(given.get(f"k{i}", 0.0) for i in range(1, 7))
    tangential = given.get("p1", 0.0), given.get("p2", 0.0)
    return Lens(width, height, fx, fy, given["cx"], given["cy"], radial, tangential, fisheye)


def _known(model: str) -> str:
    if model not in MODELS:
        raise ValueError(f"it has the camera model {shown(model)}; undistort the images in COLMAP first")
    return model


def _place(where: str, posed: _Posed) -> np.ndarray:
    """Return the camera-to-world matrix of an image, with y up and view along -z (COLMAP: y down, view along +z)."""
    q, t = np.array(posed.quaternion), np.array(posed.translation)
    length = float(np.linalg.norm(q)) if np.isfinite(q).all() else math.nan
    if not abs(length - 1) < UNIT or not (np.abs(t) < 1e9).all():
        raise PathreplayError(
            f"{where} has the quaternion {posed.quaternion} and the translation {posed.translation}, which are not a "
            "valid camera pose; repair the model"
        )
    rotation = Rotation.from_quat(np.roll(q, -1)).as_matrix()  # SciPy normalises, and expects w last
    place = np.eye(4)
    place[:3, :3], place[:3, 3] = rotation.T * [1, -1, -1], -rotation.T @ t
    return place


# ------------------------------------------------------------------------------
#  Text: one line per camera, two lines per image (pose, then points)
# ------------------------------------------------------------------------------


def _lines(file: BinaryIO) -> Iterator[str]:
    while line := file.readline(LONGEST_LINE):
        if len(line) == LONGEST_LINE:
            raise ValueError(f"a line is longer than {LONGEST_LINE} bytes")
        text = line.decode("utf-8").strip("\r\n")
        if not text.lstrip().startswith("#"):
            yield text


def _text_cameras(file: BinaryIO) -> Iterator[tuple[int, Lens]]:
    for line in _lines(file):
        if words := line.split():
            if len(words) < 4:
                raise ValueError(f"it has the line {shown(line)}")
            number, model, width, height, *parameters = words
            yield int(number), _lens(_known(model), float(width), float(height), [float(word) for word in parameters])


def _text_images(file: BinaryIO) -> Iterator[_Posed]:
    lines, count = _lines(file), 0
    for line in lines:
        if not line.strip():
            continue
        words = line.split(maxsplit=9)
        if len(words) < 10 or len(words[9]) > LONGEST_NAME:
            raise ValueError(f"it has the line {shown(line)}")
        if (count := count + 1) > MOST_IMAGES:
            raise ValueError(f"it has more than {MOST_IMAGES} images")
        q, t = tuple(map(float, words[1:5])), tuple(map(float, words[5:8]))
        yield _Posed(int(words[0]), q, t, int(words[8]), words[9])
        next(lines, None)  # skip the points


# ------------------------------------------------------------------------------
#  Binary: little-endian, each list preceded by its length
# ------------------------------------------------------------------------------


def _unpacked(file: BinaryIO, layout: str) -> tuple:
    size = struct.calcsize(layout)
    data = file.read(size)
    if len(data) < size:
        raise ValueError("it is truncated")
    return struct.unpack(layout, data)


def _binary_cameras(file: BinaryIO) -> Iterator[tuple[int, Lens]]:
    (count,) = _unpacked(file, "<Q")
    if count > MOST_IMAGES:
        raise ValueError(f"it has {count} cameras")
    for _ in range(count):
        number, model, width, height = _unpacked(file, "<IiQQ")
        name = _known(NUMBERS.get(model, f"number {model}"))
        parameters = _unpacked(file, f"<{len(MODELS[name][1].split())}d")
        yield number, _lens(name, float(width), float(height), list(parameters))


def _binary_images(file: BinaryIO) -> Iterator[_Posed]:
    (count,) = _unpacked(file, "<Q")
    if count > MOST_IMAGES:
        raise ValueError(f"it has {count} images")
    end = file.seek(0, 2)
    file.seek(8)
    for _ in range(count):
        number, *pose, camera = _unpacked(file, "<I7dI")
        name = bytearray()
        while (letter := file.read(1)) not in (b"\0", b""):
            name += letter
            if len(name) > LONGEST_NAME:
                raise ValueError(f"a name is longer than {LONGEST_NAME} bytes")
        (points,) = _unpacked(file, "<Q")
        if points * 24 > end - file.tell():
            raise ValueError(f"an image has {points} points, but the file is truncated")
        file.seek(points * 24, 1)  # skip x, y and the index of each point
        yield _Posed(number, tuple(pose[:4]), tuple(pose[4:]), camera, name.decode("utf-8"))
