"""Loops that solve a problem: the one of Mitsuba's tutorials, and that of pathreplay. An iteration uses one view.

Both minimise the mean squared difference by Adam, with the same rates (fractions of a parameter's range), samples and
bounds. The plain loop takes the views in turn, as the tutorials do; pathreplay has `view_batch_size = 1`. Options of
Adam are each side's defaults: they differ in beta_2, 0.999 and 0.99.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

import pathreplay

from .problem import Task, Values, sensor_index, to_array
from .problems import PROBLEMS, Kind

SEEDS = 2**16
"""Seeds of the iterations of a run."""


class Loop(Protocol):
    """A loop at some iteration."""

    def step(self) -> None:
        """Take one iteration, which may still be computed when this returns."""

    def values(self) -> Values:
        """Wait for the iterations, and return the values."""

    def reset(self) -> None:
        """Return to the initial values; compiled kernels are kept."""


class Plain:
    """`mi.render`, a loss, `dr.backward`, Adam and clipping."""

    def __init__(self, task: Task, rate: float, spp: int, seed: int, integrator: str) -> None:
        self.task, self.rate, self.spp, self.seed = task, rate, spp, seed
        self.integrator = mi.load_dict({"type": integrator, **task.problem.limits})
        self.views = [sensor_index(task.scene, name) for name in task.problem.train]
        self.targets = [mi.TensorXf(target) for target in task.targets]
        self.params = mi.traverse(task.scene)
        self.reset()

    def reset(self) -> None:
        """See `Loop`."""
        unknowns = self.task.problem.unknowns
        smooth = any(unknown.large_steps for unknown in unknowns.values())
        self.optimizer = mi.ad.Adam(lr=self.rate, uniform=smooth)
        self.steps: dict[str, mi.ad.LargeSteps] = {}
        for name, unknown in unknowns.items():
            start = self.task.initial(name)
            value = mi.TensorXf(start) if unknown.shape else type(self.task.stored[name])(start)
            if unknown.large_steps:
                faces = self.params[name.replace("vertex_positions", "faces")]
                self.steps[name] = mi.ad.LargeSteps(value, faces, unknown.large_steps)
                value = self.steps[name].to_differential(value)
            self.optimizer[name] = value
            self.optimizer.set_learning_rate({name: self.rate * unknown.unit})
        self.count = 0

    def step(self) -> None:
        """See `Loop`."""
        self._differentiate(self.count % len(self.views), self.seed * SEEDS + self.count)
        self.optimizer.step()
        for name, unknown in self.task.problem.unknowns.items():
            if not unknown.large_steps:
                self.optimizer[name] = dr.clip(self.optimizer[name], unknown.lower, unknown.upper)
        self.count += 1

    def _differentiate(self, turn: int, seed: int) -> None:
        """Add the gradient of a view to the optimizer's values."""
        self._apply()
        dr.backward(self._loss(turn, seed, self.params))

    def _loss(self, turn: int, seed: int, params: mi.SceneParameters | None) -> mi.Float:
        view = self.views[turn]
        image = mi.render(self.task.scene, params, sensor=view, integrator=self.integrator, spp=self.spp, seed=seed)
        return dr.mean(dr.square(image - self.targets[turn]), axis=None)

    def values(self) -> Values:
        """See `Loop`."""
        dr.sync_thread()
        return {name: to_array(self._decoded(name)) for name in self.task.problem.unknowns}

    def _decoded(self, name: str) -> Any:
        value = self.optimizer[name]
        return self.steps[name].from_differential(value) if name in self.steps else value

    def _apply(self, instead: Mapping[str, Any] | None = None) -> None:
        """Set the scene's parameters, some of them to other values than the optimizer's."""
        problem, values = self.task.problem, {**dict(self.optimizer.items()), **(instead or {})}
        for name, unknown in problem.unknowns.items():
            if not unknown.shape:
                self.params[name] = self._decoded(name) if name in self.steps else values[name]
        for key, made in problem.derived.items():
            first = self.task.first[key]
            self.params[key] = made.function(type(first)(first), *(values[name] for name in made.of))
        self.params.update()


class Differences(Plain):
    """The plain loop with central differences, two images with the same random numbers for each number."""

    STEP = 0.002
    """Half the distance of the two images, as a fraction of the parameter's range."""

    def _differentiate(self, turn: int, seed: int) -> None:
        for name, unknown in self.task.problem.unknowns.items():
            value, gradient = np.array(dr.detach(self.optimizer[name])), []
            kind = type(self.optimizer[name])
            for k in range(value.size):
                losses = []
                for sign in (1, -1):
                    moved = value.copy()
                    moved.flat[k] += sign * self.STEP * unknown.unit
                    self._apply({name: kind(moved)})
                    losses.append(self._loss(turn, seed, None))
                gradient.append((losses[0] - losses[1]).array[0] / (2 * self.STEP * unknown.unit))
            dr.set_grad(self.optimizer[name], kind(np.reshape(gradient, value.shape).astype(np.float32)))


class Own:
    """`pathreplay.init` and `pathreplay.step`."""

    def __init__(
        self, task: Task, rate: float, spp: int, seed: int, of_grids: Mapping[str, Any] | None = None, **settings: Any
    ) -> None:
        self.problem = _problem(task, rate, spp, seed, of_grids or {})
        self.first = self.state = pathreplay.init(self.problem, **{"view_batch_size": 1, **settings})

    def reset(self) -> None:
        """See `Loop`."""
        self.state = self.first

    def step(self) -> None:
        """See `Loop`."""
        self.state = pathreplay.step(self.problem, self.state)

    def values(self) -> Values:
        """See `Loop`."""
        return {name: np.array(value) for name, value in self.state.values.items()}


def _problem(task: Task, rate: float, spp: int, seed: int, of_grids: Mapping[str, Any]) -> pathreplay.Problem:
    problem = task.problem
    task.restore()  # a derived parameter is computed from its value in the scene
    parameters = {
        name: pathreplay.Parameter(
            initial=task.initial(name) if unknown.shape or isinstance(unknown.initial, np.ndarray) else unknown.initial,
            bounds=(None, None) if unknown.large_steps else (unknown.lower, unknown.upper),
            learning_rate=rate * unknown.unit,
            shape=unknown.shape or None,
            large_steps_lambda=unknown.large_steps or None,
            **(of_grids if name in task.stored and len(dr.shape(task.stored[name])) > 2 else {}),
        )
        for name, unknown in problem.unknowns.items()
    }
    return pathreplay.Problem(
        task.scene,
        parameters,
        [pathreplay.View(name, target) for name, target in zip(problem.train, task.targets, strict=True)],
        derived={key: pathreplay.Derived(made.function, made.of) for key, made in problem.derived.items()},
        integrator={"type": "pathreplay", **problem.limits},
        spp=spp,
        seed=seed,
    )


@dataclass(frozen=True)
class Entry:
    """A named way to solve a problem."""

    begin: Callable[[Task, float, int, int], Loop]
    """Task, learning rate, samples per pixel and seed -> a loop at its initial values."""
    applies: Callable[[Kind], bool] = lambda kind: True
    warm_up: int = 1
    """Iterations per training view before the clock starts. They compile kernels, and pathreplay records its own."""


def plain(integrator: str) -> Entry:
    """The plain loop with one of Mitsuba's integrators."""
    return Entry(
        lambda task, rate, spp, seed: Plain(task, rate, spp, seed, integrator),
        lambda kind: integrator in kind.integrators,
    )


def differences(integrator: str) -> Entry:
    """The plain loop without an adjoint."""
    return Entry(
        lambda task, rate, spp, seed: Differences(task, rate, spp, seed, integrator),
        lambda kind: integrator in kind.integrators,
    )


def own(of_grids: Mapping[str, Any] | None = None, few: bool = False, **settings: Any) -> Entry:
    """This project, with options of textures and volumes, and settings of `pathreplay.init`."""
    return Entry(
        lambda task, rate, spp, seed: Own(task, rate, spp, seed, of_grids or {}, **settings),
        lambda kind: (of_grids is None or kind.has_grid) and (kind.few or not few),
        warm_up=3,
    )


#: All ways, by the name that tables give them: an integrator, and what is done with it.
ENTRIES: dict[str, Entry] = {
    **{f"{name}, plain loop": plain(name) for name in ("prb", "prbvolpath", "prb_projective")},
    "path, central difference": differences("path"),
    "pathreplay": own(),
    "pathreplay, last iterate": own(optimizer={"type": "adam", "iterate_averaging": False}),
    "pathreplay, pyramid": own(of_grids={"pyramid": True}),
    "pathreplay, Levenberg-Marquardt": own(few=True, optimizer="levenberg-marquardt", view_batch_size=None),
}


def entries_of(problem: str) -> tuple[str, ...]:
    """Names of the entries that solve this problem, Mitsuba's first."""
    return tuple(name for name, entry in ENTRIES.items() if entry.applies(PROBLEMS[problem]))
