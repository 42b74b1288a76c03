"""Sensors that several views share, so that one recorded pass is replayed for all of these views.

A pass that `dr.freeze` has recorded with one sensor of a scene cannot be replayed with another. The static perspective
cameras of a capture differ only in arrays, however. A shared sensor is an additional camera, outside of the scene. It
gets copies of the arrays of a view's camera before each pass.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable

import drjit as dr
import mitsuba as mi

from pathreplay.integrators.camera_pass import Which
from pathreplay.integrators.film.image import fit_film
from pathreplay.integrators.film.sample import PINHOLE
from pathreplay.inverse.problem.problem import Problem
from pathreplay.platform.owned_arrays import owned

_NUMBERS = ("x_fov", "principal_point_offset_x", "principal_point_offset_y")
"""Parameters that `perspective` stores as arrays, besides ``to_world``. Others are constants of kernels."""


class SharedSensors:
    """Groups the training views of a problem: views of the same kind can share recorded passes.

    Args:
        problem: the problem.
        moving: variables that are differentiated.
        reached: indices of the views that these variables affect.
    """

    def __init__(self, problem: Problem, moving: frozenset[str], reached: set[int]) -> None:
        self._problem = problem
        self._shared: dict[int, tuple[mi.Sensor, mi.Sensor]] = {}
        """By view: the sensor of the first view of the same kind, and the shared sensor. They have the same film."""
        moved = {problem.params.properties[key][2] for key in problem.moves(moving)}
        alike: defaultdict[Hashable, list[int]] = defaultdict(list)
        for n, view in problem.trained().items():
            sensor = problem.scene.sensors()[view.sensor]
            if sensor not in moved and _is_known(sensor):
                size = tuple(view.target.shape)  # of the film, once a pass has begun
                alike[_constants(sensor), size, view.weight is None, n in reached].append(n)
        for views in alike.values():
            if len(views) > 1:
                first = problem.scene.sensors()[problem.views[views[0]].sensor]
                self._shared |= dict.fromkeys(views, (first, _like(first)))

    @property
    def count(self) -> int:
        """Number of kinds of training views."""
        return len({self.kind(n) for n in self._problem.trained()})

    def kind(self, view: int) -> Which:
        """Return the kind of a view: the shared sensor, or the index of the view's own sensor."""
        return self._shared[view][1] if view in self._shared else self._problem.views[view].sensor

    def of(self, view: int) -> Which:
        """Return the sensor of a recorded pass: the shared sensor with the arrays of the view, or the view's sensor."""
        about = self._problem.views[view]
        if view not in self._shared:
            return about.sensor
        first, shared = self._shared[view]
        fit_film(first, about.target.shape)  # the update below adapts the shared sensor to the film
        values, params = mi.traverse(self._problem.scene.sensors()[about.sensor]), mi.traverse(shared)
        # If the sensors shared an array, a recording would treat it as a single input.
        numbers, place = [owned(values[key]) for key in _NUMBERS], values["to_world"]
        matrix = owned(place.matrix)
        dr.eval(numbers, matrix)
        for key, number in zip(_NUMBERS, numbers, strict=True):
            params[key] = number
        params["to_world"] = type(place)(matrix)
        params.update()
        shared.film().prepare([])  # what an earlier pass has left in the film is an input of recordings, too
        return shared


def _is_known(sensor: mi.Sensor) -> bool:
    """Return whether `_constants` describes all constants of a sensor."""
    # Random numbers depend on the seed of a pass. The seed of an `independent` sampler itself may therefore differ.
    parts = sensor.class_name(), sensor.film().class_name(), sensor.sampler().class_name()
    return parts == (PINHOLE, "HDRFilm", "IndependentSampler")


def _constants(sensor: mi.Sensor) -> Hashable:
    """Return what kernels treat as constants of a perspective camera."""
    film, rfilter = sensor.film(), sensor.film().rfilter()
    # str(film) contains rounded parameters of the filter. The radius and values of the filter are therefore added.
    radius = float(rfilter.radius())
    weights = tuple(rfilter.eval(mi.Float([0, 0.3 * radius, 0.6 * radius])).numpy().tolist())
    numbers = sensor.near_clip(), sensor.far_clip(), sensor.shutter_open(), sensor.shutter_open_time()
    return str(film), radius, weights, numbers, sensor.get_medium()


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
