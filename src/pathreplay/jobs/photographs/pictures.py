"""Prepares photos for a job: resamples them to pinhole cameras with square pixels and to the size of the targets."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import PIL.Image

from pathreplay.errors import PathreplayError
from pathreplay.inverse.dataset.capture import view_names
from pathreplay.inverse.dataset.photos import Photo
from pathreplay.inverse.dataset.undistortion import Lens
from pathreplay.inverse.images.io import (
    Image,
    exr_bytes,
    over_black,
    png_bytes,
    read_image,
    transparent_share,
    with_channels,
)
from pathreplay.inverse.parameters.values import adapted_image
from pathreplay.types import Json

PIXELS = 46_000
"""Number of pixels of a prepared image, unless its width is given."""
PREFIX = "view_"
"""Beginning of the names of cameras, by which a job selects them."""
BLOCK = 8
"""Width and height are multiples of this number, so that stages can downscale films."""


@dataclass(frozen=True)
class Frame:
    """The pinhole camera of a prepared image: size, focal length and principal point in pixels, and pose."""

    name: str
    width: int
    height: int
    focal: float
    cx: float
    cy: float
    place: np.ndarray
    """4 x 4 camera-to-world matrix in the OpenGL convention."""

    @property
    def lens(self) -> Lens:
        """The camera as a lens without distortion."""
        return Lens(self.width, self.height, self.focal, self.focal, self.cx, self.cy)


@dataclass(frozen=True)
class Prepared:
    """A prepared image, linear, with its camera."""

    frame: Frame
    image: Image
    weight: Image | None
    """1 where the photo has data, shape (height, width, 1); None if it has data everywhere."""
    transparent: bool
    """Whether the photo has transparent pixels, which are black in ``image``."""
    suffix: str

    def files(self) -> dict[str, bytes]:
        """Return the content of the files of the image and its mask, by name."""
        name = self.frame.name
        data = exr_bytes(self.image) if self.suffix == ".exr" else png_bytes(self.image)
        files = {f"images/{name}{self.suffix}": data}
        if self.weight is not None:
            stream = io.BytesIO()
            PIL.Image.fromarray(np.rint(self.weight[:, :, 0] * 255).astype(np.uint8)).save(stream, "PNG")
            files[f"masks/{name}.png"] = stream.getvalue()
        return files

    def entry(self) -> Json:
        """Return the entry of the image in a transforms.json."""
        frame = self.frame
        table: Json = {
            "file_path": f"images/{frame.name}{self.suffix}",
            "w": frame.width, "h": frame.height, "fl_x": frame.focal, "fl_y": frame.focal,
            "cx": frame.cx, "cy": frame.cy, "transform_matrix": frame.place.tolist(),
        }  # fmt: skip
        if self.weight is not None:
            table["mask_path"] = f"masks/{frame.name}.png"
        return table


def frames_of(photos: Sequence[Photo], width: int | None) -> list[Frame]:
    """Choose size and camera of each prepared image.

    Args:
        photos: the photos.
        width: width of the images in pixels, rounded to a multiple of `BLOCK`; None: images of about `PIXELS` pixels.

    Raises:
        PathreplayError: an image would have less than `BLOCK` pixels in width or height.
    """
    frames = []
    for name, photo in zip(view_names([photo.name for photo in photos]), photos, strict=True):
        lens = photo.lens
        wanted = math.sqrt(PIXELS * lens.w / lens.h) if width is None else width
        columns = max(BLOCK, round(min(wanted, lens.w) / BLOCK) * BLOCK)
        scale = columns / lens.w
        high = lens.h * scale * lens.fx / lens.fy  # height of the image after its pixels are made square
        rows = int(high + 1e-6) // BLOCK * BLOCK
        if rows < BLOCK:
            raise PathreplayError(
                f"{photo.where} has only {high:.0f} rows at a width of {columns}; give a larger width"
            )
        focal, cy = lens.fx * scale, lens.cy * scale * lens.fx / lens.fy - (high - rows) / 2
        frames.append(Frame(f"{PREFIX}{name}", columns, rows, focal, lens.cx * scale, cy, photo.place))
    return frames


def prepare(photo: Photo, frame: Frame) -> Prepared:
    """Read a photo and resample it to the camera of ``frame``.

    Raises PathreplayError if the photo cannot be read, is not finite, or has an unsupported number of channels.
    """
    image = read_image(photo.image)
    transparent = transparent_share(image) > 0
    colours = adapted_image(f"Image {photo.image}", over_black(image, photo.image), "a photo has", 3)
    counts = np.ones((*colours.shape[:2], 1), np.float32)
    if photo.mask is not None:
        counts = _mask(photo, colours.shape[:2])
    resampled, valid = _resampled(np.concatenate([colours, counts], axis=2), photo.lens, frame)
    weight = resampled[:, :, 3:].clip(0, 1) * valid
    if not weight.any():
        raise PathreplayError(f"{photo.where} has no pixels left after undistortion; correct k1, k2, ... or its mask")
    suffix = ".exr" if photo.image.suffix.lower() in (".exr", ".hdr", ".pfm") else ".png"
    whole = bool((weight > 1 - 1e-3).all())
    return Prepared(frame, resampled[:, :, :3] * valid, None if whole else weight, transparent, suffix)


def _mask(photo: Photo, shape: tuple[int, int]) -> Image:
    assert photo.mask is not None
    mask = with_channels(read_image(photo.mask, raw=True), 1)
    if mask is None or mask.shape[:2] != shape:
        raise PathreplayError(f"{photo.where}: its mask {photo.mask} does not have the size of the image; correct it")
    return mask


def _resampled(image: Image, lens: Lens, frame: Frame) -> tuple[Image, Image]:
    """Resample an image to a pinhole camera; return it with a mask of the pixels that have data."""
    coarse = max(1, int(lens.fx / frame.focal * image.shape[1] / lens.w))
    rows, columns = (n // coarse * coarse for n in image.shape[:2])
    blocks = image[:rows, :columns].reshape(rows // coarse, coarse, columns // coarse, coarse, -1)
    small = blocks.mean(axis=(1, 3), dtype=np.float32)
    u, v = np.meshgrid(np.arange(frame.width) + 0.5, np.arange(frame.height) + 0.5)
    extent = image.shape[1] / coarse, image.shape[0] / coarse
    return lens.sampled(small, (u - frame.cx) / frame.focal, (v - frame.cy) / frame.focal, extent)
