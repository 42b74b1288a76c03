"""Read and write images. In memory, images are always linear radiance.

Files with 8 or 16 bits (PNG, JPEG, BMP, TGA, PPM) are decoded from sRGB; EXR, HDR and PFM are linear. PNGs are written
as sRGB after multiplication by an exposure, EXRs as linear float32.
"""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Callable, Mapping, Sequence
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
"""Exif tag of the image orientation."""

SAMPLE = "matplotlib:"
"""Prefix of the sample images of matplotlib, e.g. ``matplotlib:grace_hopper.jpg``."""


def find_image(name: str, base: Path) -> Path:
    """Return the path of an image: a file relative to ``base``, or a sample image of matplotlib.

    Raises PathreplayError if there is no such file.
    """
    if name.startswith(SAMPLE):
        from matplotlib import cbook

        path = Path(cbook.get_sample_data(name[len(SAMPLE) :], asfileobj=False))
    else:
        path = base / name
    if problem := file_problem(path):
        raise PathreplayError(f"No image file '{name}': {path} {problem}; correct the path or create the file")
    return path


def read_image(path: Path, *, raw: bool = False, pixels: int = MOST_PIXELS) -> Image:
    """Read an image.

    Args:
        path: the file.
        raw: keep the stored values instead of decoding sRGB (for normal maps and masks).
        pixels: largest number of pixels to accept.

    Returns:
        Linear float32 values of shape (height, width, channels).

    Raises:
        PathreplayError: the file is not a readable image, or has more than ``pixels`` pixels.
    """
    require_readable_picture(path, pixels)
    try:
        with spare_thread():
            bitmap, arranged = _opened(path)
            if raw:
                bitmap.set_srgb_gamma(False)
            image = arranged(_linear(bitmap))
    except (RuntimeError, ValueError, MemoryError) as error:
        raise PathreplayError(f"Image {path} cannot be read: {one_line(error)}; repair or replace it") from None
    return image[:, :, None] if image.ndim == 2 else image


def _linear(bitmap: mi.Bitmap) -> Image:
    """Return the linear pixels of a bitmap, after decoding sRGB if necessary."""
    bitmap = in_rgb(bitmap)
    # Linear bitmaps of floats are not converted, because Mitsuba's conversion relies on the names of channels.
    if bitmap.srgb_gamma() or bitmap.component_format() in (mi.Struct.Type.UInt8, mi.Struct.Type.UInt16):
        bitmap = bitmap.convert(component_format=mi.Struct.Type.Float32, srgb_gamma=False)
    return np.asarray(bitmap).astype(np.float32, copy=False)


def in_rgb(bitmap: mi.Bitmap) -> mi.Bitmap:
    """Convert a bitmap in XYZ to RGB; return any other bitmap."""
    formats = mi.Bitmap.PixelFormat
    if bitmap.pixel_format() not in (formats.XYZ, formats.XYZA):
        return bitmap
    return bitmap.convert(pixel_format=formats.RGB if bitmap.channel_count() == 3 else formats.RGBA)


def _opened(path: Path) -> tuple[mi.Bitmap, Callable[[Image], Image]]:
    """Return the bitmap of a file, and a function that orients and scales the decoded pixels."""
    with path.open("rb") as file:
        magic = file.read(2)
        if magic == b"#?":
            return _radiance(file, radiance_head(magic + file.read(MOST_HEAD)))
        bitmap = None
        if magic in (b"P5", b"P6"):
            bitmap = _pixmap(file, pixmap_head(magic + file.read(MOST_HEAD)))
        elif magic == b"BM":
            bitmap = _from_palette(path)
    return mi.Bitmap(str(path)) if bitmap is None else bitmap, lambda image: image


def _from_palette(path: Path) -> mi.Bitmap | None:
    """Read a BMP file with a palette of colours, which Mitsuba's reader ignores; return None for any other file."""
    # Mitsuba reports errors. Pillow's warnings about large images are irrelevant here.
    with contextlib.suppress(OSError), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with PIL.Image.open(path) as picture:
            if picture.mode == "P":
                bitmap = mi.Bitmap(np.array(picture.convert("RGB")))
                bitmap.set_srgb_gamma(True)
                return bitmap
    return None


def _pixmap(file: BinaryIO, head: PixmapHead) -> mi.Bitmap:
    """Read a PGM or PPM file. Mitsuba's reader supports neither comments nor big-endian 16-bit values."""
    file.seek(head.length)
    stored = np.dtype(">u2" if head.highest > 255 else np.uint8)
    count = head.width * head.height * head.channels
    data = file.read(count * stored.itemsize)
    if len(data) < count * stored.itemsize:
        raise ValueError("it is truncated")
    values = np.frombuffer(data, stored).reshape(head.height, head.width, head.channels)
    if head.highest in (255, 65535):
        values = values.astype(stored.newbyteorder("="))
    else:
        values = np.minimum(np.rint(values * np.float32(65535 / head.highest)), 65535).astype(np.uint16)
    bitmap = mi.Bitmap(values)
    bitmap.set_srgb_gamma(True)
    return bitmap


def _radiance(file: BinaryIO, head: RadianceHead) -> tuple[mi.Bitmap, Callable[[Image], Image]]:
    """Read a Radiance HDR file. Mitsuba's reader supports neither EXPOSURE nor scanline orders other than -Y +X."""
    lines, columns = head.counts
    kind = "xyze" if head.xyz else "rgbe"
    file.seek(head.length)
    stream = mi.MemoryStream()
    stream.write(f"#?RADIANCE\nFORMAT=32-bit_rle_{kind}\n\n-Y {lines} +X {columns}\n".encode())
    stream.write(file.read(8 * lines * (columns + 1)))  # no valid run-length encoding is longer
    stream.seek(0)

    def arranged(image: Image) -> Image:
        flipped = [n for n in (0, 1) if head.signs[n] != {"Y": "-", "X": "+"}[head.axes[n]]]
        image = np.flip(image, tuple(flipped)) / np.float32(head.exposure)
        return image.transpose(1, 0, 2) if head.axes == "XY" else image

    return mi.Bitmap(stream), arranged


def picture_size(path: Path) -> tuple[int, int]:
    """Read the width and height of an image from its header. Raises PathreplayError for unknown formats."""
    if (size := size_of_picture(path)) is None:
        raise PathreplayError(f"Image {path} has an unsupported format; use PNG, JPEG, EXR, HDR or PFM")
    return size


def notes_on_metadata(what: str, files: Mapping[str, Path]) -> list[str]:
    """Return a line for the user per kind of ignored metadata, such as an Exif orientation.

    ``what`` says what the images are, and ``files`` contains their paths by name.
    """
    odd: dict[str, list[str]] = {}
    for name, path in files.items():
        for oddity in _oddities(path):
            odd.setdefault(oddity, []).append(name)
    notes = []
    for oddity, (first, *others) in odd.items():
        more = f" (and {len(others)} other{'s' if len(others) > 1 else ''})" if others else ""
        notes.append(f"{what} '{first}'{more} {oddity}")
    return notes


def _oddities(path: Path) -> list[str]:
    """Describe ignored metadata of an image. Each description is a predicate whose subject is the image."""
    notes = []
    # `read_image` reports errors. Pillow's warnings about large images are irrelevant here.
    with contextlib.suppress(Exception), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with PIL.Image.open(path) as picture:
            profile = picture.info.get("icc_profile") or b""
            if profile and b"sRGB" not in profile and "sRGB".encode("utf-16-be") not in profile:
                notes.append("has an ICC colour profile other than sRGB: it is ignored, and values are decoded as sRGB")
            if picture.getexif().get(_ORIENTATION, 1) != 1:
                notes.append("has an Exif orientation: it is ignored, and pixels are used as stored")
    return notes


def colours_of(channels: int) -> int:
    """Return how many of the channels of an image are colours. With two or four channels, the last one is alpha."""
    return channels - (channels in (2, 4))


def with_channels(image: Image, channels: int) -> Image | None:
    """Convert an image to another number of channels.

    Alpha is dropped, grey is repeated, and colour is converted to luminance. Returns None for other conversions.
    """
    have = image.shape[2]
    if have in (2, 4) and channels in (1, 3):
        image, have = image[:, :, : have - 1], have - 1
    if have == channels:
        return image
    if have == 1 and channels not in (2, 4):
        return np.repeat(image, channels, axis=2)
    if have == 3 and channels == 1:
        return (image @ LUMINANCE)[:, :, None].astype(np.float32)
    return None


def over_black(image: Image, path: Path) -> Image:
    """Premultiply the colours of an image from a file by alpha, as in rendered images.

    EXR files already store premultiplied colours, and are returned unchanged. All other formats store straight alpha.
    """
    if image.shape[2] not in (2, 4) or path.suffix.lower() == ".exr":
        return image
    return np.concatenate([image[:, :, :-1] * image[:, :, -1:], image[:, :, -1:]], axis=2)


def unpremultiplied(image: Image) -> Image:
    """Divide premultiplied colours by alpha, and keep alpha. Colours become 0 where alpha is 0."""
    alpha = image[:, :, -1:]
    colours = np.divide(image[:, :, :-1], alpha, out=np.zeros_like(image[:, :, :-1]), where=alpha > 0)
    return np.concatenate([colours, alpha], axis=2)


def over(image: Image, behind: Image) -> Image:
    """Composite an image with premultiplied alpha over ``behind``. Neither ``behind`` nor the result has alpha."""
    return image[:, :, :-1] + (1 - image[:, :, -1:]) * behind


def transparent_share(image: Image) -> float:
    """Return the fraction of pixels with alpha below 1; 0 without an alpha channel."""
    return float((image[:, :, -1] < 1).mean()) if image.shape[2] in (2, 4) else 0.0


# Rec. 709 luminance weights of linear RGB.
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)


def resized(image: Image, height: int, width: int, *, crop: bool = False) -> Image:
    """Resample an image with a Lanczos filter, and clamp the result to the value range of the image.

    With ``crop``, the borders of the image are first cropped to obtain the new aspect ratio.
    """
    if crop:
        h, w = image.shape[:2]
        keep_h, keep_w = min(h, max(1, round(w * height / width))), min(w, max(1, round(h * width / height)))
        top, left = (h - keep_h) // 2, (w - keep_w) // 2
        image = image[top : top + keep_h, left : left + keep_w]
    if image.shape[:2] == (height, width):
        return image
    bitmap = mi.Bitmap(np.ascontiguousarray(image))
    own_range = (float(image.min()), float(image.max()))
    result = np.array(bitmap.resample(mi.ScalarVector2u(width, height), clamp=own_range), dtype=np.float32)
    return result.reshape(height, width, image.shape[2])


def exr_bytes(image: Image, names: Sequence[str] = ()) -> bytes:
    """Encode an image as a ZIP-compressed float32 OpenEXR file.

    By default, the channels are Y, YA, RGB or RGBA, or more than four channels with the names 0000, 0001, and so on.
    Mitsuba's writer is not used, because it waits for its thread pool and deadlocks if the pool has a single thread.
    """
    count = image.shape[2]
    names = names or {1: "Y", 2: "YA", 3: "RGB", 4: "RGBA"}.get(count) or [f"{i:04d}" for i in range(count)]
    channels = {name: np.ascontiguousarray(image[:, :, i], np.float32) for i, name in enumerate(names)}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    buffer = io.BytesIO()
    with OpenEXR.File(header, channels, num_threads=0) as file:
        file.write(buffer)
    return buffer.getvalue()


def png_bytes(image: Image, exposure: float = 1.0) -> bytes:
    """Encode the colours of an image times ``exposure`` as an 8-bit sRGB PNG file.

    Of four channels, the last is alpha, by which the colours are premultiplied. PNG files store straight colours.
    """
    if image.shape[2] == 4:
        straight = unpremultiplied(image)
        shown = np.concatenate([straight[:, :, :3] * exposure, straight[:, :, 3:]], axis=2)
    else:
        shown = (image[:, :, :1] if image.shape[2] == 2 else image) * exposure
    shown = np.clip(shown, 0, 1).astype(np.float32)
    bitmap = mi.Bitmap(np.ascontiguousarray(shown))
    # Encode in memory: the callers write the file, and handle a full disk.
    stream = mi.MemoryStream()
    bitmap.convert(component_format=mi.Struct.Type.UInt8, srgb_gamma=True).write(stream, mi.Bitmap.FileFormat.PNG)
    return bytes(stream.raw_buffer())


def encoded(linear: NDArray[np.floating]) -> NDArray[np.floating]:
    """Encode linear radiance in [0, 1] as sRGB values in [0, 1]."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-8) ** (1 / 2.4) - 0.055)


def displayed(image: Image, exposure: float) -> NDArray[np.floating]:
    """Multiply an image by ``exposure``, drop alpha, clip to [0, 1] and encode as sRGB, as a display shows it."""
    return encoded(np.clip(_colours(image).astype(np.float64) * exposure, 0, 1))


def _colours(image: Image) -> Image:
    """Return the first channel of one or two channels, or the first three of more."""
    return image[:, :, : 1 if image.shape[2] < 3 else 3]


def levels(image: Image, weight: Image | None = None) -> NDArray[np.floating]:
    """Return the largest colour channel of each pixel, as a vector. Pixels of ``weight`` zero are left out."""
    largest = _colours(image).max(axis=2)
    return largest.ravel() if weight is None else largest[weight[:, :, 0] > 0]


def exposure_for(largest: NDArray[np.floating]) -> float:
    """Return the exposure at which 98 % of the pixels with these `levels` are below white (1 for a black image)."""
    level = float(np.quantile(largest, 0.98))
    return 1.0 / level if level > 0 else 1.0


def alike(saved: Image | None, given: Image | None) -> bool:
    """Return whether two images are equal up to rounding. None equals only None."""
    if saved is None or given is None:
        return saved is given
    if saved.shape != given.shape:
        return False
    largest = float(np.abs(saved).max(initial=1))
    return np.allclose(given, saved, rtol=1e-4, atol=1e-5 * largest)


def difference(image: Image, target: Image) -> Image:
    """Make an image of the signed luminance difference: red above the target, blue below, black where equal."""
    delta = (with_channels(image, 1) - with_channels(target, 1))[:, :, 0]  # type: ignore[operator]
    zero = np.zeros_like(delta)
    return np.stack([np.maximum(delta, 0), zero, np.maximum(-delta, 0)], axis=2).astype(np.float32)
