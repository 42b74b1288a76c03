"""The pictures that a run folder keeps for going on, targets and start: whether they can be what the run wrote."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import mitsuba as mi

from pathreplay.errors import PathreplayError
from pathreplay.files import file_problem
from pathreplay.inverse.images import Image, read_image
from pathreplay.inverse.problem import View
from pathreplay.inverse.values import require_finite_array
from pathreplay.render.film import picture_shape


def saved_picture(path: Path) -> Image:
    """`read_image` of a picture that the run folder should hold; raises PathreplayError where it does not."""
    if problem := file_problem(path):
        raise PathreplayError(f"{path} {problem}; start the job from its config")
    return read_image(path)


def require_pictures(
    folder: Path, kind: str, scene: mi.Scene, views: Sequence[View], pictures: Mapping[str, Image]
) -> None:
    """Raise PathreplayError unless the pictures of that ``kind`` fit the films of the views and are finite."""
    for view in views:
        wanted = picture_shape(scene.sensors()[view.sensor])
        path = folder / f"images/{kind}-{view.name}.exr"
        if pictures[view.name].shape != wanted:
            raise PathreplayError(
                f"{path} has shape {pictures[view.name].shape} (height, width, channels), sensor '{view.name}' renders "
                f"{wanted}; start the job from its config"
            )
        require_finite_array(str(path), pictures[view.name])
