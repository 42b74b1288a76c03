"""The pictures that a run folder keeps for going on, targets and start: whether they can be what the run wrote."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import mitsuba as mi

from pathreplay.errors import PathreplayError
from pathreplay.inverse.images import Image
from pathreplay.inverse.problem import View
from pathreplay.inverse.values import require_finite_array


def regular_file(path: Path) -> Path:
    """The path itself; raises PathreplayError where there is no file, or a pipe or device in its place."""
    if not path.is_file():
        raise PathreplayError(f"{path} is missing or no file; start the job from its config")
    return path


def require_pictures(
    folder: Path, kind: str, scene: mi.Scene, views: Sequence[View], pictures: Mapping[str, Image]
) -> None:
    """Raise PathreplayError unless the pictures of that ``kind`` fit the films of the views and are finite."""
    for view in views:
        film = scene.sensors()[view.sensor].film()
        film.prepare([])  # without storage a film does not tell its channels
        width, height = (int(n) for n in film.crop_size())
        wanted = (height, width, film.bitmap().channel_count())
        path = folder / f"images/{kind}-{view.name}.exr"
        if pictures[view.name].shape != wanted:
            raise PathreplayError(
                f"{path} has shape {pictures[view.name].shape} (height, width, channels), sensor '{view.name}' renders "
                f"{wanted}; start the job from its config"
            )
        require_finite_array(str(path), pictures[view.name])
