"""Sensors that several views share, so that one recorded pass is replayed for all of these views.

A pass that `dr.freeze` has recorded with one sensor of a scene cannot be replayed with another. The static perspective
cameras of a capture differ only in arrays, however. A shared sensor is an additional camera, outside of the scene. It
gets copies of the arrays of a view's camera before each pass.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable

import mitsuba as mi

from pathreplay.integrators.camera_pass import Which
from pathreplay.integrators.film.image import fit_film
from pathreplay.inverse.problem.problem import Problem
from pathreplay.platform.owned_arrays import owned

_NUMBERS = ("x_fov", "principal_point_offset_x", "principal_point_offset_y")
"""Parameters that `perspective` stores as arrays, besides ``to_world``. Others are constants of kernels."""


class SharedSensors:
    """Groups the views of a problem by their kind: views of the same kind can share recorded passes.

    Args:
        problem: the problem. The films of its sensors have the sizes of the target images.
        moving: variables that are differentiated.
    """

    def __init__(self, problem: Problem, moving: frozenset[str]) -> None:
        self._problem = problem
        reached = problem.reached(moving)
        moved = {problem.params.properties[key][2] for key in problem.moves(moving)}
        kinds: list[Hashable] = []
        first: dict[Hashable, mi.Sensor] = {}
        for n, view in enumerate(problem.views):
            sensor = problem.scene.sensors()[view.sensor]
            constants = None if sensor in moved else _constants(sensor)
            kinds.append(view.sensor if constants is None else (constants, view.weight is None, n in reached))
            first.setdefault(kinds[-1], sensor)
        common = {kind for kind, views in Counter(kinds).items() if views > 1 and not isinstance(kind, int)}
        self._kinds = [kind if kind in common else view.sensor for kind, view in zip(kinds, problem.views, strict=True)]
        """What several views have in common, or the index of the sensor of a view."""
        self._shared = {kind: (first[kind], _like(first[kind])) for kind in common}
        """The sensor of the first view of each kind, and the shared sensor. They have the same film."""

    @property
    def count(self) -> int:
        """Number of kinds."""
        return len(set(self._kinds))

    def kind(self, view: int) -> Hashable:
        """Return the kind of a view."""
        return self._kinds[view]

    def of(self, view: int) -> Which:
        """Return the sensor of a recorded pass: the shared sensor with the arrays of the view, or the view's sensor."""
        about = self._problem.views[view]
        if self._kinds[view] not in self._shared:
            return about.sensor
        first, shared = self._shared[self._kinds[view]]
        fit_film(first, about.target.shape)  # the update below adapts the shared sensor to the film
        values, params = mi.traverse(self._problem.scene.sensors()[about.sensor]), mi.traverse(shared)
        # If the sensors shared an array, a recording would treat it as a single input.
        for key in _NUMBERS:
            params[key] = owned(values[key])
        place = values["to_world"]
        params["to_world"] = type(place)(owned(place.matrix))
        params.update()
        shared.film().prepare([])  # what an earlier pass has left in the film is an input of recordings, too
        return shared


def _constants(sensor: mi.Sensor) -> Hashable:
    """Return what kernels treat as constants of a sensor, or None if it is of a type whose constants are not known."""
    film, rfilter = sensor.film(), sensor.film().rfilter()
    if sensor.class_name() != "PerspectiveCamera" or film.class_name() != "HDRFilm":
        return None
    # The description of a film rounds the parameters of its filter.
    shape = tuple(float(rfilter.eval(rfilter.radius() * x)[0]) for x in (0, 0.3, 0.6))
    numbers = sensor.near_clip(), sensor.far_clip(), sensor.shutter_open(), sensor.shutter_open_time()
    return str(film), rfilter.radius(), shape, str(sensor.sampler()), numbers, sensor.get_medium()


def _like(sensor: mi.Sensor) -> mi.Sensor:
    """Create a perspective camera with the film, the sampler and the constants of another."""
    shared = mi.load_dict(
        {
            "type": "perspective",
            "id": sensor.id(),
            "film": sensor.film(),
            "sampler": sensor.sampler(),
            "near_clip": sensor.near_clip(),
            "far_clip": sensor.far_clip(),
            "shutter_open": sensor.shutter_open(),
            "shutter_close": sensor.shutter_open() + sensor.shutter_open_time(),
        }
    )
    if (medium := sensor.get_medium()) is not None:
        shared.set_medium(medium)
    return shared
