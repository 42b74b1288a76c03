"""Finds the sensors of views, and converts targets and weights to arrays that fit the films of these sensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.integrators.film.image import picture_shape
from pathreplay.inverse.dataset.targets import Targets, as_weight
from pathreplay.inverse.dataset.views import sensors_of
from pathreplay.inverse.images.io import Image, find_image, in_rgb, over_black, read_image
from pathreplay.inverse.parameters.values import adapted_image
from pathreplay.library.descriptions import View


def by_name(scene: mi.Scene, views: Sequence[View]) -> dict[str, View]:
    """Return views by sensor name. Raises PathreplayError if two views have the same sensor, or there is no view."""
    found: dict[str, View] = {}
    for view in views:
        name = next(iter(sensors_of(scene, [view.sensor])))
        if name in found:
            raise PathreplayError(f"views: sensor {view.sensor!r} is named twice; give each view a sensor of its own")
        found[name] = view
    if not found:
        raise PathreplayError("views: there is none; give a View")
    return found


def targets_of(scene: mi.Scene, views: Mapping[str, View]) -> Targets:
    """Convert targets and weights to arrays. Raises PathreplayError if they do not fit the films."""
    images, weights = {}, {}
    sensors = sensors_of(scene, list(views))
    for name, view in views.items():
        height, width, channels = picture_shape(scene.sensors()[sensors[name]])
        what = f"Target of sensor '{name}'"
        image = _pixels(what, view.target)
        if image.shape[:2] != (height, width):
            raise PathreplayError(
                f"{what} is {image.shape[1]} x {image.shape[0]}, but its film is {width} x {height}; resize the image "
                "or the film"
            )
        images[name] = adapted_image(what, image, "the film has", channels)
        if view.weight is not None:
            what = f"Weight of sensor '{name}'"
            mask = _pixels(what, view.weight, stored=True)
            if mask.shape[:2] != (height, width):
                raise PathreplayError(f"{what} has the shape {mask.shape}; give ({height}, {width})")
            weights[name] = as_weight("the weight", adapted_image(what, mask, "a weight has", 1), name)
    return Targets(images, weights)


def _pixels(what: str, value: object, *, stored: bool = False) -> Image:
    """Convert an image to pixels (height, width, channels). Raises PathreplayError if this is impossible.

    Pixels are linear, and their colours premultiplied by alpha. With ``stored``, the values of files and bitmaps are
    kept as they are, like the values of masks in a job.
    """
    if isinstance(value, (str, Path)):
        path = find_image(str(value), Path())
        return read_image(path, raw=True) if stored else over_black(read_image(path), path)
    if isinstance(value, mi.Bitmap):
        value = _floats(value, stored)
    if value is None:
        raise PathreplayError(f"{what} is missing; give an array, a mi.Bitmap or a file")
    try:
        plain = np.asarray(value)
        coded = not stored and plain.dtype.kind in "biuc"
        image = np.array(plain.real if coded else plain, np.float32)
    except (TypeError, ValueError) as error:
        raise PathreplayError(f"{what} is not an image ({error}); give an array, a mi.Bitmap or a file") from None
    if coded:
        raise PathreplayError(
            f"{what} is an array of {plain.dtype}, whose encoding is unknown; give mi.Bitmap(array) of 8- or 16-bit "
            "integers, which is decoded from sRGB, or an array of linear floats"
        )
    image = image[:, :, None] if image.ndim == 2 else image
    if image.ndim != 3:
        raise PathreplayError(f"{what} has the shape {image.shape}; give (height, width, channels)")
    return image


def _floats(bitmap: mi.Bitmap, stored: bool) -> mi.Bitmap:
    """Convert a bitmap to floats; for ``stored`` see `_pixels`. Bitmaps of PNG files have straight alpha."""
    transform, bitmap = mi.Bitmap.AlphaTransform.Empty, in_rgb(bitmap)
    # Mitsuba marks bitmaps of 16-bit files as sRGB, but not those of 16-bit arrays.
    if stored or bitmap.component_format() == mi.Struct.Type.UInt16:
        bitmap = mi.Bitmap(bitmap)
        bitmap.set_srgb_gamma(not stored)
    if not stored and bitmap.has_alpha() and not bitmap.premultiplied_alpha():
        transform = mi.Bitmap.AlphaTransform.Premultiply
    return bitmap.convert(component_format=mi.Struct.Type.Float32, srgb_gamma=False, alpha_transform=transform)
