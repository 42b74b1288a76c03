"""Views of a job: named sensors, test views and weights."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral

import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError, shown
from pathreplay.inverse.images.io import Image
from pathreplay.platform.files import file_names


@dataclass(frozen=True)
class View:
    """A sensor and its target image."""

    name: str
    sensor: int
    """Index of the sensor in the scene."""
    target: Image
    """Linear image, shape (height, width, channels)."""
    weight: Image | None = None
    """Weights of the pixels with mean 1, shape (height, width, 1); None weights all equally."""
    is_test: bool = False
    """Whether this is a test view, which is not part of the loss."""
    share: float = 1.0
    """Weight of the view in the loss. The weights of the training views have the mean 1."""


def sensors_of(scene: mi.Scene, wanted: list[int | str] | None) -> dict[str, int]:
    """Select sensors of a scene.

    Args:
        scene: the scene.
        wanted: ids or indices; None selects all.

    Returns:
        The index of each sensor, by a unique name that is valid as a file name.

    Raises:
        PathreplayError: a sensor does not exist, or no sensor is selected.
    """
    available = scene.sensors()
    if not available:
        raise PathreplayError("The scene has no sensor; add one")
    ids = [sensor.id() for sensor in available]
    names = [s if re.fullmatch(r"[A-Za-z0-9][\w-]*", s or "") else f"view-{i}" for i, s in enumerate(ids)]
    if len(set(names)) < len(names):
        names = [f"view-{i}" for i in range(len(available))]
    names = list(file_names(names).values())
    if wanted is None:
        return {name: i for i, name in enumerate(names)}
    chosen = {names[index]: index for index in (_place(item, ids, names) for item in wanted)}
    if not chosen:
        raise PathreplayError("'sensors' is empty; name a sensor, or remove the key to use all of them")
    return chosen


def _place(item: int | str, ids: list[str], names: list[str]) -> int:
    """Return the index of the sensor ``item``, which is an id, a name or an index."""
    index = next((known.index(item) for known in (ids, names) if item in known), item)
    if isinstance(index, Integral) or (isinstance(index, str) and index.isdecimal()):  # keys of tables are text
        index = int(index)
    if not isinstance(index, int) or not 0 <= index < len(names):
        raise PathreplayError(
            f"No sensor {shown(item)} in the scene; it has {', '.join(names)} (0 to {len(names) - 1})"
        )
    return index


def test_views_of(scene: mi.Scene, sensors: dict[str, int], named: Sequence[int | str], shots: list[str]) -> set[str]:
    """Return the names of the test views: the sensors ``named`` by the job, and sensors whose id is in ``shots``."""
    available = sensors_of(scene, None)
    ids = [sensor.id() for sensor in scene.sensors()]
    indices = {_place(item, ids, list(available)) for item in named}
    names = {name for name, index in sensors.items() if index in indices}
    if len(names) < len(indices):
        other = next(name for name, index in available.items() if index in indices and name not in names)
        raise PathreplayError(
            f"test_views: sensor '{other}' is not among 'sensors'; add it there, or remove it from 'test_views'"
        )
    names |= {name for name, index in sensors.items() if ids[index] in shots}
    if len(names) == len(sensors):
        raise PathreplayError("Every sensor of the job is a test view; leave at least one for training")
    return names


def shares_of(
    scene: mi.Scene, sensors: dict[str, int], weights: Mapping[str, float], test_views: set[str]
) -> dict[str, float]:
    """Return the weight of each view by name; the mean over the training views is 1."""
    names = named_views(scene, sensors, list(weights), "view_weights")
    if out := set(names) & test_views:
        raise PathreplayError(f"view_weights: '{min(out)}' is a test view and has no weight; remove it here")
    given = dict(zip(names, weights.values(), strict=True))
    shares = {name: given.get(name, 1.0) for name in sensors}
    mean = float(np.mean([share for name, share in shares.items() if name not in test_views]))
    return {name: share / mean for name, share in shares.items()}


def named_views(scene: mi.Scene, sensors: dict[str, int], wanted: Sequence[int | str], key: str) -> list[str]:
    """Return the names of the views that belong to sensors given by id, name or index.

    ``wanted`` contains the sensors, and ``key`` is the key of the job that lists them, for messages. Raises
    PathreplayError if a sensor has no view.
    """
    available, ids = list(sensors_of(scene, None)), [sensor.id() for sensor in scene.sensors()]
    names = {index: name for name, index in sensors.items()}
    indices = [_place(item, ids, available) for item in wanted]
    for chosen in indices:
        if chosen not in names:
            raise PathreplayError(f"{key}: sensor '{available[chosen]}' is not among 'sensors'; add it there")
    return [names[chosen] for chosen in indices]
