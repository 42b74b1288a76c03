"""What an inverse problem consists of, and its loaded form: targets, initial values, error in held-out views."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.platform.traversal import traversed
from pathreplay.scenes.loading import load_scene_for
from pathreplay.scenes.parameters import to_value
from pathreplay.scenes.stored import form_of

from ..scenes.parts import SceneDict

Values = dict[str, np.ndarray]

#: Seed of all targets and held-out images; loops count from zero.
SEED = 2**31


@dataclass(frozen=True)
class Unknown:
    """A parameter of the scene, or a free array from which scene parameters are derived.

    ``upper - lower`` is the unit of its learning rates, so that no rate is chosen for a single parameter.
    """

    initial: float | tuple[float, ...] | np.ndarray
    lower: float
    upper: float
    shape: tuple[int, ...] = ()
    """Of a free array; () for a parameter of the scene."""
    large_steps: float = 0.0
    """Lambda of Large Steps, for vertices, which have no bounds then."""

    @property
    def unit(self) -> float:
        return self.upper - self.lower


@dataclass(frozen=True)
class Made:
    """A scene parameter computed from free arrays: ``function(value in the scene, *arrays)``."""

    function: Callable[..., Any]
    of: tuple[str, ...]


@dataclass(frozen=True)
class Problem:
    """A scene that has the true values, and what is unknown about it."""

    scene: SceneDict
    unknowns: Mapping[str, Unknown]
    train: tuple[str, ...]  # ids of sensors
    held_out: tuple[str, ...]
    limits: Mapping[str, int]  # max_depth and rr_depth of all integrators
    derived: Mapping[str, Made] = field(default_factory=dict)
    derived_held_out: Mapping[str, Made] = field(default_factory=dict)  # parameters of held-out sensors
    judge: str = "path"  # Mitsuba's integrator that renders targets and held-out images
    target_paths: int = 2**21  # of each target
    judge_paths: int = 2**18  # of each held-out image
    seen: SceneDict | None = None  # the scene that the targets show, if no values of ``scene`` give it


class Task:
    """A loaded problem, which all loops share."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.integrator = mi.load_dict({"type": problem.judge, **problem.limits})
        if problem.seen is not None:
            self.targets, self.wanted = self._images(mi.load_dict(problem.seen, optimize=False))
        keys = [*(key for key, unknown in problem.unknowns.items() if not unknown.shape), *problem.derived]
        self.scene, _ = load_scene_for(problem.scene, keys)
        if problem.seen is None:
            self.targets, self.wanted = self._images(self.scene)
        self.params = traversed(self.scene)
        made = {**problem.derived, **problem.derived_held_out}
        self.first = {key: _copied(self.params[key]) for key in made}
        self.forms = {key: form_of(self.params, key) for key in problem.unknowns if key in self.params}
        self.stored = {key: _copied(self.params[key]) for key in self.forms}

    def initial(self, name: str) -> np.ndarray:
        """The initial value of an unknown in the shape that Mitsuba stores."""
        unknown = self.problem.unknowns[name]
        shape = unknown.shape or np.shape(to_array(self.stored[name]))
        start = np.asarray(unknown.initial, np.float32)
        return np.array(np.broadcast_to(start, shape), np.float32)

    def put(self, values: Values) -> None:
        """Set the scene's parameters, held-out sensors included."""
        problem = self.problem
        for key, stored in self.stored.items():
            given = values[key]
            same = given.shape == np.shape(to_array(stored))
            self.params[key] = to_value(stored, given) if same else self.forms[key].store(mi.TensorXf(given))
        for key, made in {**problem.derived, **problem.derived_held_out}.items():
            free = (mi.TensorXf(values[name]) for name in made.of)
            self.params[key] = made.function(_copied(self.first[key]), *free)
        self.params.update()

    def restore(self) -> None:
        """Set the scene's parameters to those of the loaded scene, from which derived ones are computed."""
        for key, value in {**self.stored, **self.first}.items():
            self.params[key] = _copied(value)
        self.params.update()

    def error(self, values: Values) -> float:
        """The mean over held-out views of the root mean square difference over the root mean square of the target.

        Images and targets have the same random numbers, so that their noise cancels as the values approach the truth.
        """
        self.put(values)
        images = [self._image(self.scene, name, self.problem.judge_paths) for name in self.problem.held_out]
        pairs = zip(images, self.wanted, strict=True)
        return float(np.mean([np.sqrt(np.mean((a - b) ** 2) / np.mean(b**2)) for a, b in pairs]))

    def _images(self, scene: mi.Scene) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Targets of the training views, and of the held-out views."""
        targets = [self._image(scene, name, self.problem.target_paths, SEED + 1) for name in self.problem.train]
        return targets, [self._image(scene, name, self.problem.judge_paths) for name in self.problem.held_out]

    def _image(self, scene: mi.Scene, name: str, paths: int, seed: int = SEED) -> np.ndarray:
        index = sensor_index(scene, name)
        spp = max(1, paths // int(np.prod(scene.sensors()[index].film().crop_size())))
        with dr.suspend_grad():
            image = mi.render(scene, sensor=index, integrator=self.integrator, spp=spp, seed=seed)
        return np.array(image, np.float64)


def sensor_index(scene: mi.Scene, name: str) -> int:
    """Index of the sensor with this id."""
    return [sensor.id() for sensor in scene.sensors()].index(name)


def to_array(value: Any) -> np.ndarray:
    """A parameter in the shape that loops give its values."""
    array = np.array(dr.detach(value))
    return array if dr.is_tensor_v(value) or array.ndim < 2 else array[..., 0]


def _copied(value: Any) -> Any:
    return type(value)(dr.detach(value))
