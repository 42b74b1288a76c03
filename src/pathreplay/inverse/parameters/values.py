"""Conversion of values in a job (numbers, colours, image and volume files) to arrays in the shape of the parameter."""

from __future__ import annotations

from collections.abc import Mapping
from math import prod
from pathlib import Path

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pathreplay.errors import PathreplayError
from pathreplay.inverse.caustics.heights import caustic_heights
from pathreplay.inverse.caustics.optics import Optics
from pathreplay.inverse.config.parameter_options import ImageValue, TransportStart, Value
from pathreplay.inverse.images.io import Image, find_image, read_image, resized, with_channels
from pathreplay.inverse.parameters.grids import Array, resampled
from pathreplay.scenes.parameters import SceneValue, get_array, is_transform
from pathreplay.scenes.stored import form_of
from pathreplay.scenes.volume_files import load_volume

Arrays = Mapping[str, Array]
"""Arrays by key of the variable."""


def make_value(key: str, like: SceneValue, value: Value, base: Path) -> Array:
    """Convert a value of a job to an array.

    A number fills all entries. A list is the colour of all texels, or contains all entries of a flat array. An image is
    resampled to the size of the texture and converted to its channels. A volume is resampled to the size of the grid.

    Args:
        key: key of the parameter.
        like: decoded Dr.Jit value of the parameter in the scene, which defines the shape.
        value: the value in the job.
        base: folder that relative paths start from.

    Raises:
        PathreplayError: the value does not fit the parameter, or the file is missing, unreadable or not finite.
    """
    if is_transform(like):
        raise PathreplayError(
            f"Parameter '{key}' is a matrix and takes no value; set it in the scene, or displace it as a pose"
        )
    current = get_array(like)
    if isinstance(value, (int, float)):
        return np.full_like(current, value)
    if isinstance(value, list):
        given = np.array(value, dtype=np.float32)
        width = current.shape[-1]
        if len(given) != width:
            raise PathreplayError(
                f"Value of '{key}' has {len(given)} numbers, but the parameter takes {width}; list {width}, or give one"
            )
        return np.broadcast_to(given, current.shape).copy()
    if current.ndim == 4 and isinstance(value, str):
        path = base / value
        data = load_volume(path).data
        if data.shape[3] != current.shape[3]:
            channels = f"{data.shape[3]} channels, but '{key}' has {current.shape[3]}"
            raise PathreplayError(f"Volume {path} has {channels}; convert the volume")
        return resampled(data, current.shape)
    picture = value if isinstance(value, ImageValue) else ImageValue(image=value)
    if current.ndim != 3:
        raise PathreplayError(
            f"Value of '{key}' is the image '{picture.image}', but the parameter is not a texture "
            f"(shape {current.shape}); give numbers"
        )
    image = read_image(find_image(picture.image, base), raw=picture.raw)
    adapted = adapted_image(f"Image '{picture.image}'", image, f"'{key}' has", current.shape[2])
    return resized(adapted, current.shape[0], current.shape[1], crop=picture.fit == "crop")


def make_heights(key: str, shape: tuple[int, ...], value: TransportStart, base: Path) -> Array:
    """Compute a height map whose caustic is an image (see `caustic_heights`).

    Args:
        key: key of the parameter.
        shape: shape of the parameter.
        value: image and optics.
        base: folder that relative paths start from.

    Raises:
        PathreplayError: the parameter is not a height map, the image is missing, unreadable or not finite, or no
            surface can direct the light to the image.
    """
    if len(shape) != 3 or shape[2] != 1 or min(shape[:2]) < 2:
        raise PathreplayError(
            f"Parameter '{key}' of shape {shape} is not a height map, so that 'transport' does not apply; give it the "
            "shape [rows, columns, 1]"
        )
    image = adapted_image(
        f"Image '{value.transport}'", read_image(find_image(value.transport, base), raw=value.raw), f"'{key}' has", 1
    )
    if value.fit == "crop":
        image = resized(image, shape[0], shape[1], crop=True)
    try:
        optics = Optics(**value.model_dump(exclude={"transport", "floor", "fit", "raw"}))
        return caustic_heights(image, optics, (shape[0], shape[1]), value.floor)
    except PathreplayError as error:
        raise PathreplayError(f"Parameter '{key}': {error}") from None


def seen(params: mi.SceneParameters, key: str) -> SceneValue:
    """Return the decoded value of a scene parameter (see `Form`). Jobs contain, optimise and save decoded values."""
    return form_of(params, key).see(params[key])


def adapted_image(name: str, image: Image, other: str, channels: int) -> Image:
    """Convert an image to a number of channels.

    Args:
        name: name of the image in error messages.
        image: the image.
        other: words before the required number of channels in the error message, such as "sensor 'a' renders".
        channels: required number of channels.

    Raises:
        PathreplayError: the conversion is not defined, or the image is not finite.
    """
    adapted = with_channels(image, channels)
    if adapted is None:
        raise PathreplayError(f"{name} has {image.shape[2]} channels, but {other} {channels}; convert it")
    require_finite_array(name, adapted)
    return adapted


def split(x: NDArray[np.floating], shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Array]:
    """Split a flat array into consecutive arrays of the given shapes, by key."""
    parts = np.split(x, np.cumsum([prod(shape) for shape in shapes.values()])[:-1])
    return {k: part.astype(np.float32).reshape(shapes[k]) for k, part in zip(shapes, parts, strict=True)}


def require_finite_array(name: str, array: Array) -> None:
    """Raise PathreplayError if an entry is NaN or infinite, and name the first such entry in the message."""
    bad = ~np.isfinite(array)
    if bad.any():
        first = tuple(int(i) for i in np.argwhere(bad)[0])
        raise PathreplayError(
            f"{name} holds {int(bad.sum())} NaN or infinite values, the first ({array[first]}) at index {first}; "
            "repair it first"
        )
