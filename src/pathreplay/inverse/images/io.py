"""Images in and out: always linear radiance in memory, whatever the file holds.

8- and 16-bit files (PNG, JPEG, BMP, TGA, PPM) are taken as sRGB encoded and are decoded; EXR, HDR and PFM are taken as
linear. Written PNGs are sRGB encoded after multiplication with an exposure; written EXRs are linear float32.
"""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import mitsuba as mi
import numpy as np
import OpenEXR
import PIL.Image
from numpy.typing import NDArray

from pathreplay.errors import PathreplayError
from pathreplay.platform.files import file_problem
from pathreplay.platform.threads import spare_thread
from pathreplay.scenes.descriptions import one_line
from pathreplay.scenes.image_files import (
    MOST_HEAD,
    MOST_PIXELS,
    PixmapHead,
    RadianceHead,
    pixmap_head,
    radiance_head,
    require_readable_picture,
    size_of_picture,
)

Image = NDArray[np.float32]
"""Linear pixels, shape (height, width, channels)."""

_ORIENTATION = 274
"""Exif's tag of that name."""

SAMPLE = "matplotlib:"
"""Prefix of a picture that matplotlib ships, e.g. ``matplotlib:grace_hopper.jpg``."""


def find_image(name: str, base: Path) -> Path:
    """Path of an image file: relative to ``base``, or one of matplotlib's sample pictures."""
    if name.startswith(SAMPLE):
        from matplotlib import cbook

        path = Path(cbook.get_sample_data(name[len(SAMPLE) :], asfileobj=False))
    else:
        path = base / name
    if problem := file_problem(path):
        raise PathreplayError(f"No image file '{name}': {path} {problem}; correct the path or create the file")
    return path


def read_image(path: Path, *, raw: bool = False, pixels: int = MOST_PIXELS) -> Image:
    """Read an image as linear float32 (height, width, channels); ``raw`` keeps stored values (normal maps, masks).

    Raises PathreplayError where there is no image in the file, or one of more than so many ``pixels``.
    """
    require_readable_picture(path, pixels)
    try:
        with spare_thread():
            bitmap, arranged = _opened(path)
            if raw:
                bitmap.set_srgb_gamma(False)
            found = arranged(_linear(bitmap))
    except (RuntimeError, ValueError, MemoryError) as error:
        raise PathreplayError(f"Image {path} cannot be read: {one_line(error)}") from None
    return found[:, :, None] if found.ndim == 2 else found


def _linear(bitmap: mi.Bitmap) -> Image:
    """The pixels, decoded where they are sRGB."""
    formats = mi.Bitmap.PixelFormat
    if bitmap.pixel_format() in (formats.XYZ, formats.XYZA):
        bitmap = bitmap.convert(pixel_format=formats.RGB if bitmap.channel_count() == 3 else formats.RGBA)
    # Others are as they should be; and Mitsuba converts channels by their names, which are not always those of colours.
    if bitmap.srgb_gamma() or bitmap.component_format() in (mi.Struct.Type.UInt8, mi.Struct.Type.UInt16):
        bitmap = bitmap.convert(component_format=mi.Struct.Type.Float32, srgb_gamma=False)
    return np.asarray(bitmap).astype(np.float32, copy=False)


def _opened(path: Path) -> tuple[mi.Bitmap, Callable[[Image], Image]]:
    """A picture as it is stored, and what makes of its pixels what they mean."""
    with path.open("rb") as file:
        magic = file.read(2)
        if magic in (b"P5", b"P6"):
            return _pixmap(file, pixmap_head(magic + file.read(MOST_HEAD))), lambda image: image
        if magic == b"#?":
            return _radiance(file, radiance_head(magic + file.read(MOST_HEAD)))
    return mi.Bitmap(str(path)), lambda image: image


def _pixmap(file: BinaryIO, head: PixmapHead) -> mi.Bitmap:
    """A PGM or PPM, of which Mitsuba knows neither comments nor the order of bytes."""
    file.seek(head.length)
    stored = np.dtype(">u2" if head.highest > 255 else np.uint8)
    count = head.width * head.height * head.channels
    data = file.read(count * stored.itemsize)
    if len(data) < count * stored.itemsize:
        raise ValueError("it is cut short")
    values = np.frombuffer(data, stored).reshape(head.height, head.width, head.channels)
    if head.highest in (255, 65535):
        values = values.astype(stored.newbyteorder("="))
    else:
        values = np.minimum(np.rint(values * np.float32(65535 / head.highest)), 65535).astype(np.uint16)
    bitmap = mi.Bitmap(values)
    bitmap.set_srgb_gamma(True)
    return bitmap


def _radiance(file: BinaryIO, head: RadianceHead) -> tuple[mi.Bitmap, Callable[[Image], Image]]:
    """A Radiance picture, of which Mitsuba knows neither the exposure nor other orders than the usual one."""
    lines, columns = head.counts
    kind = "xyze" if head.xyz else "rgbe"
    file.seek(head.length)
    stream = mi.MemoryStream()
    stream.write(f"#?RADIANCE\nFORMAT=32-bit_rle_{kind}\n\n-Y {lines} +X {columns}\n".encode())
    stream.write(file.read(8 * lines * (columns + 1)))  # twice what runs of single pixels take
    stream.seek(0)

    def arranged(image: Image) -> Image:
        flipped = [n for n in (0, 1) if head.signs[n] != {"Y": "-", "X": "+"}[head.axes[n]]]
        image = np.flip(image, tuple(flipped)) / np.float32(head.exposure)
        return image.transpose(1, 0, 2) if head.axes == "XY" else image

    return mi.Bitmap(stream), arranged


def picture_size(path: Path) -> tuple[int, int]:
    """Width and height of a picture, by the head of the file. Raises PathreplayError where that is no picture's."""
    if (size := size_of_picture(path)) is None:
        raise PathreplayError(f"Image {path} is of no format that is read; take PNG, JPEG, EXR, HDR or PFM")
    return size


def oddities(path: Path) -> list[str]:
    """What a picture says of itself that is not looked at, in words that follow its name."""
    found = []
    # What is wrong with it is told by who reads it; and of large pictures Pillow warns.
    with contextlib.suppress(Exception), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with PIL.Image.open(path) as picture:
            profile = picture.info.get("icc_profile") or b""
            if profile and b"sRGB" not in profile and "sRGB".encode("utf-16-be") not in profile:
                found.append(
                    "has a colour profile (ICC) that is not sRGB's: it is ignored, and its numbers taken as sRGB"
                )
            if picture.getexif().get(_ORIENTATION, 1) != 1:
                found.append("is to be turned (Exif): it is taken as it is stored")
    return found


def with_channels(image: Image, channels: int) -> Image | None:
    """The image with that many channels: alpha is dropped, grey repeated, colour averaged by luminance; else None."""
    have = image.shape[2]
    if have in (2, 4) and channels in (1, 3):
        image, have = image[:, :, : have - 1], have - 1
    if have == channels:
        return image
    if have == 1:
        return np.repeat(image, channels, axis=2)
    if have == 3 and channels == 1:
        return (image @ LUMINANCE)[:, :, None].astype(np.float32)
    return None


def over_black(image: Image, path: Path) -> Image:
    """What is seen of an image with alpha over black, which is what renderers show where nothing is; alpha stays.

    EXR files hold their colours like that already; others hold them as if they were opaque.
    """
    if image.shape[2] not in (2, 4) or path.suffix.lower() == ".exr":
        return image
    return np.concatenate([image[:, :, :-1] * image[:, :, -1:], image[:, :, -1:]], axis=2)


def unpremultiplied(image: Image) -> Image:
    """The colours of an image with alpha, which is over black, as if it were opaque. Alpha stays."""
    alpha = image[:, :, -1:]
    colours = np.divide(image[:, :, :-1], alpha, out=np.zeros_like(image[:, :, :-1]), where=alpha > 0)
    return np.concatenate([colours, alpha], axis=2)


def over(image: Image, behind: Image) -> Image:
    """An image with alpha, which is over black, before a picture (of one channel, or as many): without alpha."""
    return image[:, :, :-1] + (1 - image[:, :, -1:]) * behind


def transparent_share(image: Image) -> float:
    """The share of pixels through which a background would be seen; 0 without alpha."""
    return float((image[:, :, -1] < 1).mean()) if image.shape[2] in (2, 4) else 0.0


# Rec. 709 luminance of linear RGB.
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)


def resized(image: Image, height: int, width: int, *, crop: bool = False) -> Image:
    """Resample (Lanczos, clamped to the image's own range); ``crop`` first cuts the middle to the new aspect."""
    if crop:
        h, w = image.shape[:2]
        keep_h, keep_w = min(h, round(w * height / width)), min(w, round(h * width / height))
        top, left = (h - keep_h) // 2, (w - keep_w) // 2
        image = image[top : top + keep_h, left : left + keep_w]
    if image.shape[:2] == (height, width):
        return image
    bitmap = mi.Bitmap(np.ascontiguousarray(image))
    own_range = (float(image.min()), float(image.max()))
    result = np.array(bitmap.resample(mi.ScalarVector2u(width, height), clamp=own_range), dtype=np.float32)
    return result.reshape(height, width, image.shape[2])


def exr_bytes(image: Image) -> bytes:
    """The image as a float32 OpenEXR file with the channels Y, YA, RGB or RGBA (more of them: 0000, 0001, …), zipped.

    Not by Mitsuba, which waits for its pool of threads to write one: for ever, where that has a single thread.
    """
    count = image.shape[2]
    names = {1: ["Y"], 2: ["Y", "A"], 3: ["R", "G", "B"], 4: ["R", "G", "B", "A"]}.get(
        count, [f"{i:04d}" for i in range(count)]
    )
    channels = {name: np.ascontiguousarray(image[:, :, i], np.float32) for i, name in enumerate(names)}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    buffer = io.BytesIO()
    with OpenEXR.File(header, channels, num_threads=0) as file:
        file.write(buffer)
    return buffer.getvalue()


def png_bytes(image: Image, exposure: float = 1.0) -> bytes:
    """The image times ``exposure`` as an 8-bit sRGB PNG file."""
    shown = np.clip((image[:, :, :1] if image.shape[2] == 2 else image) * exposure, 0, 1).astype(np.float32)
    bitmap = mi.Bitmap(np.ascontiguousarray(shown))
    # Through memory, so that the disk is touched in one place (run_folder), which handles a full one.
    stream = mi.MemoryStream()
    bitmap.convert(component_format=mi.Struct.Type.UInt8, srgb_gamma=True).write(stream, mi.Bitmap.FileFormat.PNG)
    return bytes(stream.raw_buffer())


def encoded(linear: NDArray[np.floating]) -> NDArray[np.floating]:
    """sRGB of linear radiance, both from 0 to 1."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-8) ** (1 / 2.4) - 0.055)


def displayed(image: Image, exposure: float) -> NDArray[np.floating]:
    """The colours of an image (one channel, or three) times ``exposure``, as a display shows them: from 0 to 1."""
    colours = image[:, :, : 1 if image.shape[2] < 3 else 3].astype(np.float64)
    return encoded(np.clip(colours * exposure, 0, 1))


def exposure_for(image: Image) -> float:
    """Exposure under which 98 % of the pixels stay below white (1 for a black picture)."""
    level = float(np.quantile(image[..., :3].max(axis=2), 0.98))
    return 1.0 / level if level > 0 else 1.0


def difference(image: Image, target: Image) -> Image:
    """Signed difference as a picture: luminance above the target in red, below in blue, equal in black."""
    delta = (with_channels(image, 1) - with_channels(target, 1))[:, :, 0]  # type: ignore[operator]
    zero = np.zeros_like(delta)
    return np.stack([np.maximum(delta, 0), zero, np.maximum(-delta, 0)], axis=2).astype(np.float32)
