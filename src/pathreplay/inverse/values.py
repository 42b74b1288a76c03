"""Parameter values as the user writes them (numbers, colours, image files), in the shape that the scene wants."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config import Picture, Value
from pathreplay.inverse.images import find_image, read_image, resized, with_channels
from pathreplay.parameters import get_array, is_transform

Array = NDArray[np.float32]


def make_value(key: str, like: Any, value: Value, base: Path) -> Array:
    """What the user wrote as the new value of the parameter ``key``, in the shape that it has in the scene (``like``).

    A number fills every entry; a list is a colour (repeated over a texture) or all entries of a flat array; an image is
    resampled to the texture's size, and its channels are adapted. ``base`` is where relative image paths start.

    Raises:
        PathreplayError: the value does not fit the parameter, or the image is missing, unreadable or not finite.
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
    picture = value if isinstance(value, Picture) else Picture(image=value)
    if current.ndim != 3:
        raise PathreplayError(
            f"Value of '{key}' is the image '{picture.image}', but the parameter is no texture "
            f"(shape {current.shape}); give numbers"
        )
    image = read_image(find_image(picture.image, base), raw=picture.raw)
    adapted = with_channels(image, current.shape[2])
    if adapted is None:
        raise PathreplayError(
            f"Image '{picture.image}' has {image.shape[2]} channels, '{key}' has {current.shape[2]}; convert the image"
        )
    require_finite_array(f"Image '{picture.image}'", adapted)
    return resized(adapted, current.shape[0], current.shape[1], crop=picture.fit == "crop")


def require_finite_array(name: str, array: Array) -> None:
    """Raise PathreplayError that names the first entry that is NaN or infinite."""
    bad = ~np.isfinite(array)
    if bad.any():
        first = tuple(int(i) for i in np.argwhere(bad)[0])
        raise PathreplayError(
            f"{name} holds {int(bad.sum())} NaN or infinite values, the first ({array[first]}) at index {first}; "
            "repair it first"
        )
