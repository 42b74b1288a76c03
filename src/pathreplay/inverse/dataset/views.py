"""The views of a job: its sensors by name, those that are held out, and how much each counts."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError, shown
from pathreplay.inverse.config.schema import Config
from pathreplay.inverse.images.io import Image
from pathreplay.platform.files import file_names


@dataclass(frozen=True)
class View:
    """One sensor and the picture that it should see (linear, height x width x channels)."""

    name: str
    sensor: int
    target: Image
    weight: Image | None = None
    """How much pixels count (height x width x 1, with the mean 1); None: all the same."""
    is_test: bool = False
    """It is only looked at in the end, and never learned from."""
    share: float = 1.0
    """How much it counts; of the views that are learned from the mean is 1."""


def sensors_of(scene: mi.Scene, wanted: list[int | str] | None) -> dict[str, int]:
    """The wanted sensors of the scene: readable unique name, fit for a file -> index."""
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
        raise PathreplayError("'sensors' is empty; name one, or leave the key out for all of them")
    return chosen


def _place(item: int | str, ids: list[str], names: list[str]) -> int:
    """The index of a sensor that is named, or given by its number."""
    index = next((each.index(item) for each in (ids, names) if item in each), item)
    if not isinstance(index, int) or not 0 <= index < len(names):
        raise PathreplayError(
            f"No sensor {shown(item)} in the scene; it has {', '.join(names)} (0 to {len(names) - 1})"
        )
    return index


def held_out_of(scene: mi.Scene, sensors: dict[str, int], config: Config, shots: list[str]) -> set[str]:
    """The names of the views that are not learned from: those that the job names, and every so many of ``shots``."""
    everywhere = sensors_of(scene, None)
    ids = [sensor.id() for sensor in scene.sensors()]
    places = {_place(item, ids, list(everywhere)) for item in config.test_views}
    found = {name for name, index in sensors.items() if index in places}
    every = None if config.capture is None else config.capture.test_every
    if len(found) < len(places):
        other = next(name for name, index in everywhere.items() if index in places and name not in found)
        raise PathreplayError(
            f"test_views: sensor '{other}' is not among 'sensors'; add it there, or leave it out here"
        )
    regular = set(shots[::every]) if every else set()
    found |= {name for name, index in sensors.items() if ids[index] in regular}
    if len(found) == len(sensors):
        raise PathreplayError("Every sensor of the job is held out; leave one to learn from")
    return found


def shares_of(scene: mi.Scene, sensors: dict[str, int], config: Config, test_views: set[str]) -> dict[str, float]:
    """How much each view counts, by name."""
    names = named_views(scene, sensors, list(config.view_weights), "view_weights")
    if out := set(names) & test_views:
        raise PathreplayError(f"view_weights: view '{min(out)}' is held out, and counts for nothing; leave it out here")
    given = dict(zip(names, config.view_weights.values(), strict=True))
    shares = {name: given.get(name, 1.0) for name in sensors}
    mean = float(np.mean([share for name, share in shares.items() if name not in test_views]))
    return {name: share / mean for name, share in shares.items()}


def named_views(scene: mi.Scene, sensors: dict[str, int], wanted: Sequence[int | str], key: str) -> list[str]:
    """The names of views that a key asks for. Raises PathreplayError for what is no view of the job."""
    everywhere, ids = list(sensors_of(scene, None)), [sensor.id() for sensor in scene.sensors()]
    names = {index: name for name, index in sensors.items()}
    places = [_place(item, ids, everywhere) for item in wanted]
    for place in places:
        if place not in names:
            raise PathreplayError(f"{key}: sensor '{everywhere[place]}' is not among 'sensors'; add it there")
    return [names[place] for place in places]
