"""Read captures (images with camera poses) from a `transforms.json` or a COLMAP model, and make Mitsuba sensors.

The cameras of `Photo` look along -z with x to the right, and are specified by focal lengths in pixels. Mitsuba's
cameras look along +z with x to the left, and are specified by a field of view.
"""

from __future__ import annotations

import functools
import hashlib
import math
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError, shown
from pathreplay.inverse.config.target_options import Capture
from pathreplay.inverse.dataset.colmap import photos_of_colmap
from pathreplay.inverse.dataset.photos import Photo
from pathreplay.inverse.dataset.transforms_json import photos_of_json
from pathreplay.inverse.dataset.undistortion import Lens
from pathreplay.platform.files import file_names, file_problem
from pathreplay.types import SceneDict

FACING = np.diag([-1.0, 1.0, -1.0, 1.0])
"""Transform from Mitsuba's to OpenGL's camera axes."""


@dataclass(frozen=True)
class Shot:
    """An image of a capture with its camera."""

    image: Path
    mask: Path | None
    camera: SceneDict
    """Mitsuba dictionary of a pinhole camera."""
    lens: Lens | None = None
    """Distortion to remove from the image; None for a pinhole camera."""


def read_capture(
    capture: Capture, base: Path, size_of: Callable[[Path], tuple[int, int]], pixel_format: str = "rgb"
) -> dict[str, Shot]:
    """Read a capture.

    Args:
        capture: table of the capture in the job.
        base: folder that relative paths start from.
        size_of: returns the width and height of an image file.
        pixel_format: pixel format of the films.

    Returns:
        The images with their cameras (`Shot`), by name, in the order of the capture.

    Raises:
        PathreplayError: a file cannot be read, a lens model is not supported, or a camera pose is not rigid.
    """
    size_of = functools.cache(size_of)
    masks = None if capture.masks is None else base / capture.masks
    if capture.colmap is not None:
        images = None if capture.images is None else base / capture.images
        photos = photos_of_colmap(base / capture.colmap, images, masks, size_of)
    else:
        photos = photos_of_json(base / capture.source, size_of)
        if masks is not None:
            photos = [replace(photo, mask=_mask(photo, masks)) for photo in photos]
            _require_own_masks(photos)
    shots = {}
    for name, photo in zip(view_names([photo.name for photo in photos]), photos, strict=True):
        camera = _camera(photo, size_of(photo.image), capture, pixel_format)
        lens = None if photo.lens.is_pinhole else photo.lens
        shots[name] = Shot(photo.image, photo.mask, {**camera, "id": name}, lens)
    return shots


def fingerprint(shots: Iterable[Shot]) -> str:
    """Hash the cameras, names and sizes of a capture (SHA-256, hexadecimal)."""
    known = [
        ({**shot.camera, "to_world": np.array(shot.camera["to_world"].matrix).tolist()}, shot.lens) for shot in shots
    ]
    return hashlib.sha256(repr(known).encode()).hexdigest()


def _mask(photo: Photo, masks: Path) -> Path:
    """Find the mask of a photo: the photo's file name with '.png' appended, or with '.png' in place of its suffix.

    For the photo images/left/1.png, the folders images/left, left and . of the masks are searched, in this order.
    """
    image = photo.image.name
    folders = [part for part in Path(photo.name).parent.parts if part not in ("/", "..")]
    names = [f"{image}.png", f"{photo.image.stem}.png"]
    places = [masks.joinpath(*folders[k:], name) for k in range(len(folders) + 1) for name in names]
    mask = next((place for place in places if not file_problem(place)), None)
    if mask is None:
        raise PathreplayError(f"{photo.where}: capture.masks {masks} has no {image}.png; correct it, or add the file")
    return mask


def _require_own_masks(photos: list[Photo]) -> None:
    """Raise PathreplayError if two photos of different subfolders would share a mask."""
    owners: dict[Path | None, Photo] = {}
    for photo in photos:
        other = owners.setdefault(photo.mask, photo)
        if other.image != photo.image:
            raise PathreplayError(
                f"capture.masks: {photo.mask} would be the mask of both {other.name} and {photo.name}; put masks into "
                "the subfolders of the photos"
            )


def view_names(files: list[str]) -> list[str]:
    """Make a unique name for each image, which is valid as the name of a sensor and of a file.

    The names are the stems of the file names, or the paths if two images have the same stem.
    """
    names = [Path(file).stem for file in files]
    if len(set(names)) < len(names):
        names = [str(Path(file).with_suffix("")) for file in files]
    words = [re.sub(r"[^A-Za-z0-9_-]+", "_", name).strip("_-") or "view" for name in names]
    if len(set(words)) < len(words):
        twice = next(word for word in words if words.count(word) > 1)
        first, other = [file for file, word in zip(files, words, strict=True) if word == twice][:2]
        raise PathreplayError(
            f"The images {shown(first)} and {shown(other)} of the capture would both get the name '{twice}'; remove or "
            "rename one"
        )
    return list(file_names(words).values())


def _camera(photo: Photo, size: tuple[int, int], capture: Capture, pixel_format: str) -> SceneDict:
    """Make the Mitsuba dictionary of the pinhole camera of a photo."""
    columns = size[0] if capture.width is None else capture.width
    rows = max(1, round(columns * size[1] / size[0]))
    return pinhole_camera(photo.lens, photo.place, (columns, rows), capture.near_clip, pixel_format)


def pinhole_camera(
    lens: Lens, place: np.ndarray, size: tuple[int, int], near_clip: float, pixel_format: str = "rgb"
) -> SceneDict:
    """Make the Mitsuba dictionary of a camera without distortion.

    Args:
        lens: focal length, principal point and image size in pixels of the photo. Its distortion is ignored.
        place: camera-to-world matrix (4 x 4), in the OpenGL convention.
        size: width and height of the film.
        near_clip: near clipping distance.
        pixel_format: pixel format of the film.
    """
    columns, rows = size
    return {
        "type": "perspective",
        "fov": math.degrees(2 * math.atan(lens.w / (2 * lens.fx))),
        "fov_axis": "x",
        "near_clip": near_clip,
        "far_clip": 1e5,
        "principal_point_offset_x": 0.5 - lens.cx / lens.w,
        "principal_point_offset_y": 0.5 - lens.cy / lens.h,
        "to_world": mi.ScalarTransform4f((place @ FACING).tolist()),
        "film": {
            "type": "hdrfilm",
            "width": columns,
            "height": rows,
            "pixel_format": pixel_format,
            "rfilter": {"type": "box"},
        },
    }


def put_inside(scene: mi.Scene, names: set[str], medium: str) -> None:
    """Put cameras of the capture, by name, inside a medium of the scene.

    Raises PathreplayError if no shape of the scene bounds a medium with this id.
    """
    bounded = [shape.interior_medium() for shape in scene.shapes()] + [s.exterior_medium() for s in scene.shapes()]
    media = {each.id(): each for each in bounded if each is not None}
    if medium not in media:
        raise PathreplayError(
            f"capture.medium '{medium}' is the id of no medium of the scene; it has {', '.join(media) or 'none'}"
        )
    for sensor in scene.sensors():
        if sensor.id() in names:
            sensor.set_medium(media[medium])
