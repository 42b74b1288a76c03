"""Parameter values as the user writes them (numbers, colours, image and volume files), in the scene's shape."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.parameter_options import Picture, Value
from pathreplay.inverse.images.io import Image, find_image, read_image, resized, with_channels
from pathreplay.inverse.parameters.grids import Array, resampled
from pathreplay.scenes.parameters import get_array, is_transform
from pathreplay.scenes.stored import form_of
from pathreplay.scenes.volume_files import load_volume

Arrays = Mapping[str, Array]
"""By key of the variable, or by name."""


def make_value(key: str, like: Any, value: Value, base: Path) -> Array:
    """What the user wrote as the new value of the parameter ``key``, in the shape that it has in the scene (``like``).

    A number fills every entry; a list is a colour (repeated over a texture) or all entries of a flat array; an image is
    resampled to the texture's size, and its channels are adapted; a volume is resampled to the grid's. Relative paths
    start at ``base``.

    Raises PathreplayError where the value does not fit the parameter, or the file is missing, unreadable or not finite.
    """
    if is_transform(like):
        raise PathreplayError(
            f"Value given for the matrix '{key}'; set it in the scene, and displace the start of a pose"
        )
    current = get_array(like)
    if isinstance(value, (int, float)):
        return np.full_like(current, value)
    if isinstance(value, list):
        given = np.array(value, dtype=np.float32)
        width = current.shape[-1]
        if len(given) != width:
            raise PathreplayError(
                f"Value of '{key}' has {len(given)} numbers, the parameter takes {width}; list {width}, or give one"
            )
        return np.broadcast_to(given, current.shape).copy()
    if current.ndim == 4 and isinstance(value, str):
        path = base / value
        data = load_volume(path).data
        if data.shape[3] != current.shape[3]:
            channels = f"{data.shape[3]} channels, '{key}' has {current.shape[3]}"
            raise PathreplayError(f"Volume {path} has {channels}; convert the volume")
        return resampled(data, current.shape)
    picture = value if isinstance(value, Picture) else Picture(image=value)
    if current.ndim != 3:
        raise PathreplayError(
            f"Value of '{key}' is the image '{picture.image}', but the parameter is no texture "
            f"(shape {current.shape}); give numbers"
        )
    image = read_image(find_image(picture.image, base), raw=picture.raw)
    adapted = adapted_image(f"Image '{picture.image}'", image, f"'{key}' has", current.shape[2])
    return resized(adapted, current.shape[0], current.shape[1], crop=picture.fit == "crop")


def seen(params: mi.SceneParameters, key: str) -> Any:
    """What people see of a parameter of the scene: the kind of value that jobs take, optimise and save."""
    return form_of(params, key).see(params[key])


def adapted_image(name: str, image: Image, other: str, channels: int) -> Image:
    """The image with as many channels as an ``other`` has; raises PathreplayError if it cannot, or is not finite."""
    adapted = with_channels(image, channels)
    if adapted is None:
        raise PathreplayError(f"{name} has {image.shape[2]} channels, {other} {channels}; convert it")
    require_finite_array(name, adapted)
    return adapted


def require_finite_array(name: str, array: Array) -> None:
    """Raise PathreplayError that names the first entry that is NaN or infinite."""
    bad = ~np.isfinite(array)
    if bad.any():
        first = tuple(int(i) for i in np.argwhere(bad)[0])
        raise PathreplayError(
            f"{name} holds {int(bad.sum())} NaN or infinite values, the first ({array[first]}) at index {first}; "
            "repair it first"
        )
