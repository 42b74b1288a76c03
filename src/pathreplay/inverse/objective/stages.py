"""Stages of a job: subsets of views and parameters, smaller films, shorter paths, and other options."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError, shown
from pathreplay.integrators.stateful import stateful
from pathreplay.inverse.config.schema import Plugin
from pathreplay.inverse.config.stage_options import Stage, place
from pathreplay.inverse.dataset.views import View
from pathreplay.inverse.images.io import Image
from pathreplay.inverse.objective.evaluate import Evaluate, Evaluation, Evaluator, Shard
from pathreplay.inverse.objective.joint import JointEvaluator
from pathreplay.inverse.objective.pixel_batches import obstacle, refused
from pathreplay.inverse.parameters.values import Arrays
from pathreplay.inverse.problem.joint import JointProblem
from pathreplay.inverse.problem.problem import Problem, sensor_of
from pathreplay.scenes import parameters
from pathreplay.scenes.descriptions import load_integrator


@dataclass(frozen=True)
class Part:
    """The problem in one stage of a job, or in the whole job if the job has no stages."""

    number: int
    stage: Stage | None
    problem: Problem
    """The problem with the options and training views of the stage. Its images are not downscaled (see `scaled`)."""
    moving: frozenset[str]
    """Variables that are differentiated and updated."""


def part_at(problem: Problem, iteration: int) -> Part:
    """Return the part (stage) that an iteration belongs to."""
    stages = problem.config.stages
    if stages is None:
        return Part(0, None, problem, frozenset(v.key for v in problem.variables))
    number = place(stages, iteration)
    return _part(problem, number, stages[number])


def parts_of(problem: Problem) -> list[Part]:
    """Return the part of each stage, or the single part of a job without stages."""
    stages = problem.config.stages
    return [_part(problem, n, stage) for n, stage in enumerate(stages)] if stages else [part_at(problem, 0)]


def _part(problem: Problem, number: int, stage: Stage) -> Part:
    names = "spp", "view_batch_size", "pixel_batch_size"
    given = {name: value for name in names if (value := getattr(stage, name)) is not None}
    seen = _views(problem, stage)
    views = problem.views
    if seen is not None:
        # Scale the weights to mean 1 over the views of the stage.
        mean = float(np.mean([view.share for view in views if view.name in seen]))
        views = tuple(replace(v, is_test=v.name not in seen, share=v.share / mean) for v in views)
    moving = frozenset(_moving(problem, stage))
    config = problem.config.model_copy(update=given)
    return Part(number, stage, replace(problem, views=views, config=config), moving)


def _views(problem: Problem, stage: Stage) -> set[str] | None:
    """Return the names of a stage's views, or None for all. Raises PathreplayError for an unknown or test view."""
    if stage.sensors is None:
        return None
    ids = {view.name: problem.scene.sensors()[view.sensor].id() for view in problem.views}
    found = set()
    for item in stage.sensors:
        named = [v for v in problem.views if item in (v.name, ids[v.name]) or item == v.sensor]
        if not named or named[0].is_test:
            why = "is a test view" if named else "is not a view of the job"
            names = ", ".join(v.name for v in problem.trained().values())
            raise PathreplayError(f"stages: sensor {shown(item)} {why}; name training views: {names}")
        found.add(named[0].name)
    return found


def _moving(problem: Problem, stage: Stage) -> list[str]:
    """Return the variables of a stage. Raises PathreplayError if a key is not a parameter of the job."""
    keys = [v.key for v in problem.variables]
    if stage.parameters is None:
        return keys
    # If a stage names a pose or a derived parameter, it optimises the variables from which the parameter is computed.
    owners: dict[str, set[str]] = {key: {key} for key in keys}
    for each in problem.made():
        for part in each.of:
            owners[part].add(each.key)
    known = dict.fromkeys(name for names in owners.values() for name in names)
    try:
        named = parameters.resolve_keys(known, stage.parameters, "the job")
    except PathreplayError as error:
        raise PathreplayError(f"stages: {error}; name parameters that the job recovers") from None
    return [key for key in keys if not owners[key].isdisjoint(named)]


def require_stages(problem: Problem) -> None:
    """Check the stages of a job.

    Raises PathreplayError if a stage cannot downscale a film, if an integrator does not support the ``max_depth`` of a
    stage, or if no stage optimises a variable.
    """
    config = problem.config
    for number, stage in enumerate(config.stages or []):
        part = _part(problem, number, stage)
        for view in part.problem.trained().values():
            _require_divisible(problem.scene.sensors()[view.sensor], view.name, stage.downscale)
        if stage.max_depth is not None:
            for plugin, made in ((config.integrator, problem.integrator), (config.baseline, problem.baseline)):
                if plugin is not None:
                    _require_description(plugin, made, stage.max_depth)
    for variable in problem.variables:
        if config.stages and not any(variable.key in _moving(problem, stage) for stage in config.stages):
            raise PathreplayError(
                f"stages: no stage optimises '{variable.key}'; name it in a stage, or remove the parameter"
            )


def require_single_pixels(problem: Problem) -> None:
    """Raise PathreplayError if pixels are batched in a view that does not support pixel batches."""
    config = problem.config
    for part in parts_of(problem):
        if part.problem.config.pixel_batch_size is None:
            continue
        for integrator, plugin in ((problem.integrator, config.integrator), (problem.baseline, config.baseline)):
            if integrator is not None and plugin is not None:
                if part.stage is not None and part.stage.max_depth is not None:
                    integrator = _integrator(plugin, part.stage.max_depth)
                _require_single_pixels(part, integrator)


def _require_single_pixels(part: Part, integrator: mi.Integrator) -> None:
    problem = part.problem
    spp = int(problem.config.spp) // problem.config.parts  # spp is a number, since pixel batches exclude "auto"
    for view in problem.trained().values():
        camera = f"{problem.scene.sensors()[view.sensor].id()}."
        why = obstacle(problem, stateful(integrator), view.sensor, spp, some=True)
        if moves := sorted(key for key in problem.moves(part.moving) if key.startswith(camera)):
            why = f"its camera moves; freeze '{moves[0]}'"
        if why:
            raise refused(view.name, why)


def _require_divisible(sensor: mi.Sensor, name: str, downscale: int) -> None:
    film = sensor.film()
    width, height = (int(n) for n in film.size())
    if downscale > 1 and (tuple(film.crop_size()) != (width, height) or film.sample_border()):
        raise PathreplayError(
            f"stages: the film of sensor '{name}' has a crop window or samples its border; remove 'downscale'"
        )
    if width % downscale or height % downscale:
        most = np.gcd(width, height)
        fit = [n for n in range(2, min(int(most), 64) + 1) if most % n == 0]
        remedy = f"use one of {', '.join(map(str, fit))}" if fit else "remove it"
        raise PathreplayError(
            f"stages: downscale = {downscale} does not divide the {width} x {height} pixels of sensor '{name}'; "
            f"{remedy}"
        )


def _require_description(plugin: Plugin, made: mi.Integrator | None, max_depth: int) -> None:
    """Raise PathreplayError if the integrator ``made`` cannot be created again with another ``max_depth``."""
    try:
        _integrator(plugin, max_depth)
    except PathreplayError as error:
        if plugin.type != type(made).__name__:
            raise
        raise PathreplayError(
            f"stages: the integrator is a {plugin.type} object, whose max_depth a stage cannot change; give a "
            "dictionary, such as {'type': 'pathreplay'}"
        ) from error


def _integrator(plugin: Plugin, max_depth: int) -> mi.Integrator:
    return load_integrator({**plugin.model_dump(), "max_depth": max_depth})


def restore_films(problem: Problem) -> None:
    """Resize the films of all views to their targets, if a stage may have downscaled the films."""
    if any(stage.downscale > 1 for stage in problem.config.stages or []):
        for view in problem.views:
            sensor_of(problem, view)


def scaled(view: View, downscale: int) -> View:
    """Downscale target and weight of a view by averaging squares of pixels. Masked pixels do not contribute."""
    if downscale == 1:
        return view
    if view.weight is None:
        return replace(view, target=_means(view.target, downscale))
    weight = _means(view.weight, downscale)
    plain, counted = _means(view.target, downscale), _means(view.target * view.weight, downscale)
    target = np.where(weight > 0, counted / np.where(weight > 0, weight, 1), plain)
    return replace(view, target=target.astype(np.float32), weight=weight)


def _means(image: Image, n: int) -> Image:
    height, width, channels = image.shape
    squares = image.reshape(height // n, n, width // n, n, channels)
    return squares.mean(axis=(1, 3), dtype=np.float64).astype(np.float32)


class Staged:
    """Evaluation function (`Evaluate`) that applies the stage of each shard, and keeps one evaluator at a time."""

    def __init__(self, problem: Problem, integrator: mi.Integrator, plugin: Plugin, record: bool = True) -> None:
        self.problem, self.integrator, self.plugin, self.record = problem, integrator, plugin, record
        self._number: int | None = None
        self._evaluate: Callable[[Arrays, Shard, Arrays], Evaluation] | None = None

    def __call__(self, values: Arrays, shard: Shard, learned: Arrays) -> Evaluation:
        if self._number != shard.stage or self._evaluate is None:
            self._evaluate, self._number = None, shard.stage  # free the previous evaluator first
            self._evaluate = self._evaluator(shard.stage)
        return self._evaluate(values, shard, learned)

    def _evaluator(self, number: int) -> Evaluator:
        stages = self.problem.config.stages or []
        stage, integrator = stages[number], self.integrator
        part = _part(self.problem, number, stage)
        if stage.max_depth is not None:
            integrator = _integrator(self.plugin, stage.max_depth)
            stateful(integrator).silence(stateful(self.integrator).warned)  # do not repeat warnings
        views = tuple(scaled(view, stage.downscale) if not view.is_test else view for view in part.problem.views)
        return Evaluator(replace(part.problem, views=views), integrator, self.record, part.moving)


def evaluator_of(problem: Problem, integrator: mi.Integrator, plugin: Plugin) -> Evaluate:
    """Create the evaluator of a job in this process. Passes are recorded unless the job is deterministic.

    Args:
        problem: the problem.
        integrator: integrator that renders and differentiates. Joint problems use the integrators of their parts.
        plugin: description of the integrator, from which stages with another ``max_depth`` create their integrators.

    Returns:
        The evaluator.

    Raises:
        PathreplayError: a joint problem has stages.
    """
    config = problem.config
    record = not config.deterministic
    if isinstance(problem, JointProblem):
        if config.stages is not None:
            raise PathreplayError("stages: joint problems do not support stages; remove them")
        return JointEvaluator(problem, [Evaluator(part, part.integrator, record) for part in problem.parts])
    if config.stages is None:
        return Evaluator(problem, integrator, record)
    return Staged(problem, integrator, plugin, record)
