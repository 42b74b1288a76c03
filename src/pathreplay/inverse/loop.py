"""The optimisation loop: evaluate, step, project; interruptible and resumable, and what it tells of itself."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.interrupts import Stop
from pathreplay.inverse.batches import batch
from pathreplay.inverse.checkpoint import Entry, Run
from pathreplay.inverse.config import ITERATION, JUDGEMENT, PICTURE, Config
from pathreplay.inverse.evaluate import Evaluator, Local, Shard, total
from pathreplay.inverse.exposures import EXPOSURE, exposed, with_held_out
from pathreplay.inverse.grids import resampled, rmse
from pathreplay.inverse.images import Image
from pathreplay.inverse.optimiser import DrJitOptimiser
from pathreplay.inverse.optimizer_options import Optimizer
from pathreplay.inverse.problem import Problem, pose_errors, put_values
from pathreplay.inverse.schedules import rate
from pathreplay.inverse.values import Array, Arrays
from pathreplay.scenes.parameters import get_array, to_value

# How often the pictures are judged in a job with a rival: enough for a curve, at some per cent of its time.
JUDGEMENTS = 10


@dataclass(frozen=True)
class Started:
    """Iterations begin: so many are done, of so many."""

    done: int
    wanted: int


@dataclass(frozen=True)
class Refined:
    """A grid goes on in another resolution."""

    key: str
    shape: tuple[int, ...]


@dataclass(frozen=True)
class Stepped:
    """An iteration is done."""

    entry: Entry


@dataclass(frozen=True)
class Stopped:
    """No more iterations: so many are done."""

    done: int


Event = Started | Refined | Stepped | Stopped


def new_run(
    problem: Problem, integrator: mi.Integrator, record: bool = True, optimizer: Optimizer | None = None
) -> Run:
    """A run at the problem's start values, in this process."""
    values = {v.key: get_array(to_value(v.like, v.start)) for v in problem.variables}
    return Run(
        Local(Evaluator(problem, integrator, record)),
        DrJitOptimiser(
            values, optimizer, [v.key for v in problem.variables if v.coordinates and v.coordinates.uniform]
        ),
        values,
    )


def iterate(problem: Problem, config: Config, run: Run, stop: Stop) -> Iterator[Event]:
    """Take steps from ``len(run.history)`` to ``config.iterations``; yields what happens, for observers.

    After each step the run's rival takes as many as bring it to the same number of seconds. Taking turns, both have the
    same share of a machine whose load changes. Its learning rate and resolutions are those of the job's iteration.
    """
    yield Started(len(run.history), config.iterations)
    for i in range(len(run.history), config.iterations):
        yield from take_step(problem, config, run, i)
        if rival := run.rival:
            while rival.seconds() < run.seconds():
                take_step(problem, config, rival, i)
            # Due after the first iteration, and after those with which a tenth of them is done.
            if i == 0 or JUDGEMENTS * i // config.iterations < JUDGEMENTS * (i + 1) // config.iterations:
                for each in (run, rival):
                    error = judged(problem, config, each.values, i)
                    each.history[-1] = replace(each.history[-1], picture_error=error)
        yield Stepped(run.history[-1])
        if stop.by is not None:
            break
    yield Stopped(len(run.history))


def take_step(problem: Problem, config: Config, run: Run, position: int) -> list[Refined]:
    """One step, with the learning rates and resolutions of iteration ``position``; adds an entry to the history.

    Evaluate the views of its `batch`, a shard with a seed of its own for each, and sum in their order; step with the
    learning rate of that iteration (see `schedules`), project every variable into its bounds. A grid whose next
    resolution is due is interpolated before that, and returned; the optimiser starts anew on it. What is differentiated
    is decided by the integrator; targets, bounds and the seeds' choice of paths are not.

    Raises PathreplayError where the loss is no longer finite.
    """
    begin, i = time.perf_counter(), len(run.history)
    refined = []
    for v in problem.variables:
        if v.levels and run.values[v.key].shape != (shape := v.levels.shape_at(position)):
            run.values[v.key] = resampled(run.values[v.key], shape)
            refined.append(Refined(v.key, shape))
    shards = [
        Shard((n,), config.spp, config.seeds(ITERATION, problem.views[n].sensor, i)[:1])
        for n in batch(problem, config, i)
    ]
    found = total(run.executor.run(run.values, shards, run.learned)).of(len(problem.trained()) / len(shards))
    if not np.isfinite(found.loss):
        raise PathreplayError(
            f"The loss is {found.loss} at iteration {i}; lower the learning rates, or bound the parameters that ran "
            "away"
        )
    penalties = {v.key: v.penalty.of(run.values[v.key]) for v in problem.variables if v.penalty}
    gradients = found.gradients | {key: found.gradients[key] + slope for key, (_, slope) in penalties.items()}
    schedule, decay = config.learning_rate_schedule, config.learning_rate_decay
    factor = rate(schedule, position, config.iterations, decay, config.warm_up)
    rates = {v.key: v.learning_rate * factor for v in problem.variables}
    stepped = _stepped(problem, run, gradients, rates)
    for key, value in stepped.items():
        if not np.isfinite(value).all():
            raise PathreplayError(
                f"'{key}' is no finite number after iteration {i}; lower its learning rate, or bound it"
            )
    run.values = {v.key: np.clip(stepped[v.key], *v.bounds) for v in problem.variables}
    run.learned = found.learned
    seconds = time.perf_counter() - begin
    norms = {key: float(np.linalg.norm(gradient)) for key, gradient in gradients.items()}
    errors = {v.key: rmse(run.values[v.key], v.truth) for v in problem.variables if v.truth is not None}
    errors |= pose_errors(problem, run.values)
    penalty = sum(value for value, _ in penalties.values())
    run.history.append(Entry(i, found.loss, seconds, norms, found.dropped, errors, penalty=penalty))
    return refined


def _stepped(problem: Problem, run: Run, gradients: Arrays, rates: dict[str, float]) -> dict[str, Array]:
    """The values after a step of the optimiser, which is taken in the coordinates of each variable."""
    others = {v.key: v.coordinates for v in problem.variables if v.coordinates}
    latent = {key: other.latent(run.values[key]) for key, other in others.items()}
    slopes = {key: other.gradient(run.values[key], gradients[key]) for key, other in others.items()}
    stepped = run.optimiser.step({**run.values, **latent}, {**gradients, **slopes}, rates)
    return stepped | {key: other.values(stepped[key]) for key, other in others.items()}


def render_views(problem: Problem, config: Config, values: Arrays) -> dict[str, Image]:
    """Pictures of all views with these values in the scene, by the job's integrator; same noise at every call."""
    put_values(problem, values)
    spp = config.picture_spp
    return {
        v.name: exposed(
            values, n, _picture(problem, v.sensor, problem.integrator, spp, config.seeds(PICTURE, v.sensor)[0])
        )
        for n, v in enumerate(problem.views)
    }


def with_exposures(problem: Problem, config: Config, values: Arrays) -> Arrays:
    """The values, with the exposures of held-out views: nothing was learned from them, so that they are fitted now."""
    if EXPOSURE not in values or not any(view.held_out for view in problem.views):
        return values
    put_values(problem, values)
    spp, of = config.picture_spp, problem.integrator
    pictures = {
        n: (_picture(problem, v.sensor, of, spp, config.seeds(PICTURE, v.sensor)[0]), v.target, v.weight)
        for n, v in enumerate(problem.views)
        if v.held_out
    }
    return with_held_out(values, pictures)


def judged(problem: Problem, config: Config, values: Arrays, iteration: int) -> float:
    """Root mean square error of the pictures with these values in the scene, without the noise of rendering them.

    With two independent renderings A and B of a view, E[(A - T)(B - T)] = (I - T)², where a square would add the
    variance; the mean over pixels and views that are learned from is taken before the
    root (negative ones count as zero). The noise of the targets stays in.
    """
    put_values(problem, values)
    squares, views = 0.0, problem.trained()
    for n, view in views.items():
        a, b = (
            exposed(values, n, _picture(problem, view.sensor, problem.judge, config.spp, seed)).astype(np.float64)
            - view.target
            for seed in config.seeds(JUDGEMENT, view.sensor, iteration)
        )
        squares += view.share * float(np.mean(a * b if view.weight is None else a * b * view.weight)) / len(views)
    return float(np.sqrt(max(squares, 0.0)))


def _picture(problem: Problem, sensor: int, integrator: mi.Integrator, spp: int, seed: int) -> Image:
    with dr.suspend_grad():
        image = mi.render(problem.scene, sensor=sensor, integrator=integrator, spp=spp, seed=mi.UInt32(seed))
    return np.array(image, dtype=np.float32)
