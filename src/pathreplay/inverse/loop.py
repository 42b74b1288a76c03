"""The optimisation loop: render, compare, differentiate, step, project; interruptible and resumable."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.opt import Adam

from pathreplay.errors import PathreplayError
from pathreplay.inverse.checkpoint import Entry
from pathreplay.inverse.config import Config
from pathreplay.inverse.grids import resampled, rmse
from pathreplay.inverse.images import Image
from pathreplay.inverse.passes import NotRecordable, Passes
from pathreplay.inverse.problem import ITERATION, JUDGEMENT, PICTURE, Problem, seeds
from pathreplay.inverse.stopping import Stop
from pathreplay.scenes.parameters import get_array, to_value

# Adam's second moment remembers about 1 / (1 - beta_2) steps. Its usual 0.999 outlasts a whole run of a few hundred.
BETA_1, BETA_2 = 0.9, 0.99

# How often the pictures are judged in a job with a rival: enough for a curve, at some per cent of its time.
JUDGEMENTS = 10


@dataclass(frozen=True)
class Run:
    """An optimisation under way: who differentiates, Adam with the variables, and what happened so far."""

    passes: Passes
    adam: Adam
    history: list[Entry]

    def seconds(self) -> float:
        return sum(entry.seconds for entry in self.history)


def new_run(problem: Problem, integrator: mi.Integrator, record: bool = True) -> Run:
    """A run at the problem's start values."""
    adam = Adam(lr=1.0, beta_1=BETA_1, beta_2=BETA_2)
    for variable in problem.variables:
        adam[variable.key] = to_value(variable.like, variable.start)
    return Run(Passes(problem, integrator, record), adam, [])


def put_values(problem: Problem, adam: Adam) -> None:
    """Give the scene the values that Adam holds."""
    for key, value in scene_values(problem, adam).items():
        problem.params[key] = value
    problem.params.update()


def scene_values(problem: Problem, adam: Adam) -> dict[str, Any]:
    """The scene's parameters, by key and as Mitsuba stores them, for what Adam holds; poses become transforms."""
    names = {name for pose in problem.poses for name in pose.parts().values()}
    plain = {v.key: v.form.store(adam[v.key]) for v in problem.variables if v.key not in names}
    return plain | {pose.key: pose.value(adam) for pose in problem.poses}


def iterate(
    problem: Problem, config: Config, run: Run, rival: Run | None, stop: Stop, after: Callable[[Entry], None]
) -> None:
    """Take steps from ``len(run.history)`` to ``config.iterations``; ``after`` is called at the end of each.

    After each step the ``rival`` takes as many as bring it to the same number of seconds. Taking turns, both have the
    same share of a machine whose load changes. Its learning rate and resolutions are those of the job's iteration.
    """
    for i in range(len(run.history), config.iterations):
        take_step(problem, config, run, i)
        if rival is not None:
            while rival.seconds() < run.seconds():
                take_step(problem, config, rival, i)
            if _due(i, config.iterations):
                for each in (run, rival):
                    put_values(problem, each.adam)
                    each.history[-1] = replace(each.history[-1], picture_error=judged(problem, config, i))
        after(run.history[-1])
        if stop.wanted():
            break
    put_values(problem, run.adam)


def take_step(problem: Problem, config: Config, run: Run, position: int) -> None:
    """One step, with the learning rates and resolutions of iteration ``position``; adds an entry to the history.

    Render every view with a seed of its own, back-propagate the mean of the losses (see `Passes`), step Adam with the
    learning rate lr·decay^(position / iterations), project every variable into its bounds. A grid whose next resolution
    is due is interpolated before that, and Adam starts anew on it. What is differentiated is decided by the integrator;
    targets, bounds and the seeds' choice of paths are not.

    Raises:
        PathreplayError: the loss is no longer finite.
    """
    begin, i, adam = time.perf_counter(), len(run.history), run.adam
    _refine(problem, adam, position)
    numbers = [seeds(config.seed, ITERATION, i, view.sensor)[0] for view in problem.views]
    value = _differentiated(problem, run, numbers, config.spp)
    norms, dropped = _gradients(adam)
    if not np.isfinite(value):
        raise PathreplayError(
            f"The loss is {value} at iteration {i}; lower the learning rates, or bound the parameters that ran away"
        )
    _set_rates(problem, config, adam, position)
    adam.step()
    _project(problem, adam)
    run.history.append(Entry(i, value, time.perf_counter() - begin, norms, dropped, errors(problem, adam)))


def _differentiated(problem: Problem, run: Run, numbers: list[int], spp: int) -> float:
    """The loss at the values that Adam holds; its gradient is added to them."""
    put_values(problem, run.adam)
    try:
        return run.passes(numbers, spp)
    except NotRecordable:
        for value in run.adam.values():
            dr.clear_grad(value)
        put_values(problem, run.adam)
        return run.passes(numbers, spp)


def render_views(problem: Problem, config: Config) -> dict[str, Image]:
    """Pictures of all views with the scene as it is now, by the job's integrator; same noise at every call."""
    pictures: dict[str, Image] = {}
    for view in problem.views:
        seed, _ = seeds(config.seed, PICTURE, 0, view.sensor)
        with dr.suspend_grad():
            image = mi.render(
                problem.scene,
                sensor=view.sensor,
                integrator=problem.integrator,
                spp=config.picture_spp,
                seed=mi.UInt32(seed),
            )
        pictures[view.name] = np.array(image, dtype=np.float32)
    return pictures


def errors(problem: Problem, adam: Adam) -> dict[str, float]:
    """Root mean square error of each variable whose truth is known."""
    return {v.key: rmse(get_array(adam[v.key]), v.truth) for v in problem.variables if v.truth is not None}


def judged(problem: Problem, config: Config, iteration: int) -> float:
    """Root mean square error of the pictures of the scene as it is now, without the noise of rendering them.

    With two independent renderings A and B of a view, E[(A - T)(B - T)] = (I - T)², where a square would add the
    variance; the mean over pixels and views is taken before the root (negative ones count as zero). The noise of the
    targets stays in.
    """
    total = 0.0
    for view in problem.views:
        gaps = []
        for seed in seeds(config.seed, JUDGEMENT, iteration, view.sensor):
            with dr.suspend_grad():
                image = mi.render(
                    problem.scene, sensor=view.sensor, integrator=problem.judge, spp=config.spp, seed=mi.UInt32(seed)
                )
            gaps.append(np.array(image, dtype=np.float64) - view.target)
        total += float(np.mean(gaps[0] * gaps[1])) / len(problem.views)
    return float(np.sqrt(max(total, 0.0)))


def _due(i: int, iterations: int) -> bool:
    """Whether a judgement is due: after the first iteration, and after those with which a tenth of them is done."""
    return i == 0 or JUDGEMENTS * i // iterations < JUDGEMENTS * (i + 1) // iterations


def _refine(problem: Problem, adam: Adam, position: int) -> None:
    for variable in problem.variables:
        if variable.levels is None:
            continue
        value, shape = adam[variable.key], variable.levels.shape_at(position)
        if tuple(value.shape) != shape:
            # Of another shape: Adam forgets its moments, which belong to cells of another size.
            adam[variable.key] = type(value)(resampled(get_array(value), shape))


def _gradients(adam: Adam) -> tuple[dict[str, float], int]:
    """Norm per variable; non-finite entries are zeroed, so that one bad path does not end a long run, and counted."""
    norms: dict[str, float] = {}
    dropped = 0
    for key, value in adam.items():
        gradient = get_array(dr.grad(value))
        fine = np.isfinite(gradient)
        if not fine.all():
            gradient = np.where(fine, gradient, 0)
            dr.set_grad(value, to_value(value, gradient))
            dropped += int((~fine).sum())
        norms[key] = float(np.linalg.norm(gradient))
    return norms, dropped


def _set_rates(problem: Problem, config: Config, adam: Adam, position: int) -> None:
    decay = config.learning_rate_decay ** (position / config.iterations)
    # Opaque: as a literal the changing rate would be compiled into the kernel anew in every iteration.
    adam.set_learning_rate({v.key: dr.opaque(mi.Float, v.learning_rate * decay) for v in problem.variables})


def _project(problem: Problem, adam: Adam) -> None:
    for variable in problem.variables:
        value = adam[variable.key]
        if variable.lower is not None:
            value = dr.maximum(value, variable.lower)
        if variable.upper is not None:
            value = dr.minimum(value, variable.upper)
        adam[variable.key] = value
