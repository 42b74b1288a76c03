"""The optimisation loop: evaluate loss and gradient, step, and project. Runs can be interrupted and resumed."""

from __future__ import annotations

import time
from collections.abc import Generator, Iterable, Iterator
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.optimizer_options import Optimizer
from pathreplay.inverse.config.schedules import rate
from pathreplay.inverse.config.schema import ITERATION, JUDGEMENT, PICTURE
from pathreplay.inverse.config.stage_options import place
from pathreplay.inverse.dataset.views import View
from pathreplay.inverse.images.io import Image
from pathreplay.inverse.loop import noise
from pathreplay.inverse.loop.batches import batch
from pathreplay.inverse.loop.checkpoint import Entry, Run
from pathreplay.inverse.loop.events import (
    Entered,
    Event,
    Finished,
    LowSNR,
    NonFinite,
    Refined,
    Started,
    Stepped,
    Stopped,
)
from pathreplay.inverse.loop.movement import parts_of
from pathreplay.inverse.loop.second_order import draw_of, observe
from pathreplay.inverse.objective.evaluate import (
    Evaluate,
    Evaluation,
    Evaluator,
    Executor,
    Local,
    Shard,
    Total,
    release,
    total,
)
from pathreplay.inverse.objective.stages import Part, part_at, restore_films
from pathreplay.inverse.optim.adaptive import DrJitOptimiser, Optimiser
from pathreplay.inverse.optim.averaging import Averaged
from pathreplay.inverse.optim.lbfgs import LineSearch, Search
from pathreplay.inverse.optim.levenberg_marquardt import LevenbergMarquardt
from pathreplay.inverse.parameters.exposures import EXPOSURE, exposed, with_held_out
from pathreplay.inverse.parameters.grids import resampled
from pathreplay.inverse.parameters.mesh import Surface
from pathreplay.inverse.parameters.values import Array, Arrays
from pathreplay.inverse.parameters.variables import decoded, latent_bounds, latents
from pathreplay.inverse.problem.problem import Problem, detach, errors_of, put_values, sensor_of
from pathreplay.platform.interrupts import Stop
from pathreplay.scenes.parameters import get_array, to_value

# Number of times that a job with a baseline measures the image errors. The measurements take a few per cent of
# the job's time.
JUDGEMENTS = 10

# Smallest fraction of non-finite gradient entries for which an iteration counts towards `max_consecutive_nonfinite`.
HALF = 0.5


def new_run(
    problem: Problem,
    integrator: mi.Integrator,
    record: bool = True,
    optimizer: Optimizer | None = None,
    evaluate: Evaluate | None = None,
    executor: Executor | None = None,
) -> Run:
    """Make a run at the initial values of a problem.

    Args:
        problem: the problem.
        integrator: integrator of the default evaluator.
        record: whether the default evaluator records its passes as frozen functions.
        optimizer: type and options of the optimiser; default: Adam.
        evaluate: evaluation of shards in this process; default: an `Evaluator`.
        executor: executor of the shards, e.g. in other processes; default: ``evaluate`` in this process.
    """
    values = {
        v.key: np.array(v.start, np.float32) if dr.is_tensor_v(v.like) else get_array(to_value(v.like, v.start))
        for v in problem.variables
    }
    return Run(
        executor or Local(Evaluator(problem, integrator, record) if evaluate is None else evaluate),
        optimiser_of(problem, values, optimizer or Optimizer()),
        values,
        starts={v.key: parts_of(v.start, mean=True) for v in problem.variables},
    )


def optimiser_of(problem: Problem, values: Arrays, options: Optimizer, search: Search | None = None) -> Optimiser:
    """Create the optimiser of the problem's variables at these values. For ``search`` see `LineSearch`.

    Raises PathreplayError if the optimiser cannot step the variables.
    """
    values = latents(problem.variables, values)
    if options.searches:
        for v in problem.variables:
            if isinstance(v.coordinates, Surface) and v.coordinates.merges:
                # Searches need the exact gradient. For Adam, the gradient of a position does not depend on its copies.
                raise PathreplayError(
                    f"The mesh of '{v.key}' has vertices at equal positions, for which 'large_steps_lambda' cannot be "
                    f"combined with optimizer type = '{options.type}'; remove it, merge the vertices, or use 'adam'"
                )
        bounds = {v.key: latent_bounds(v) for v in problem.variables}
        if options.is_second_order and search is None:
            return LevenbergMarquardt(values, options, bounds)
        return LineSearch(values, options, bounds, search)
    uniform = [v.key for v in problem.variables if v.coordinates and v.coordinates.uniform]
    optimiser = DrJitOptimiser(values, options, uniform)
    return Averaged(optimiser) if options.options()["iterate_averaging"] else optimiser


def best_values(problem: Problem, run: Run) -> dict[str, Array]:
    """Return the resulting values of a run, which may differ from the values after its last step.

    They differ if the optimiser compares losses or averages its iterates (see `Optimiser.answer`).
    """
    return decoded(problem.variables, run.optimiser.answer(latents(problem.variables, run.values)), run.values)


def iterate(problem: Problem, run: Run, stop: Stop) -> Generator[Event, None, None]:
    """Take steps from ``len(run.history)`` to ``iterations``, and yield the events of the run.

    A run may have a baseline: a second run, by another integrator, for comparison. After each step of the run, the
    baseline takes steps until it has used as much time as the run. On a machine whose load varies, this alternation
    gives both runs equal conditions. The steps of the baseline use the learning rate and the resolutions of the run's
    current iteration. At the end, the films have the sizes of the targets.

    Args:
        problem: the problem.
        run: the run, which is changed in place.
        stop: request to stop the run, which is checked after each step.

    Raises:
        PathreplayError: the loss or a value is not finite, or gradients were not finite in
            `Config.max_consecutive_nonfinite` consecutive iterations.
    """
    config = problem.config
    yield Started(len(run.history), config.iterations)
    faint: set[str] = set()
    stage, stages = None, config.stages or []
    try:
        for i in range(len(run.history), config.iterations):
            if run.optimiser.finished:
                yield Finished(run.optimiser.finished)
                break
            if stages and place(stages, i) != stage:
                stage = place(stages, i)
                yield Entered(stage + 1, len(stages))
            yield from take_step(problem, run, i)
            if baseline := run.baseline:
                while baseline.seconds() < run.seconds():
                    take_step(problem, baseline, i)
                # Measure the image errors after the first iteration, and after each tenth of all iterations.
                if i == 0 or JUDGEMENTS * i // config.iterations < JUDGEMENTS * (i + 1) // config.iterations:
                    for measured in (run, baseline):
                        error = image_error(problem, best_values(problem, measured), i)
                        measured.history[-1] = replace(measured.history[-1], picture_error=error)
            for key, ratio in noise.ratios(run.history).items():
                if ratio < noise.FAINT and key not in faint:
                    faint.add(key)
                    yield LowSNR(key, ratio, i, run.history[-1].spp)
            yield Stepped(run.history[-1])
            require_gradients(problem, run)
            if stop.by is not None:
                break
    finally:
        restore_films(problem)
        detach(problem)
    yield Stopped(len(run.history))


def computed(problem: Problem, run: Run, stop: Stop) -> Iterator[Event]:
    """Yield the events of `iterate`. The context `Problem.computing` encloses the steps, but not the caller."""
    events = iterate(problem, run, stop)
    try:
        while True:
            with problem.computing():
                event = next(events, None)
            if event is None:
                return
            yield event
    finally:
        with problem.computing():  # the end of an incomplete iteration restores the scene
            events.close()


def require_gradients(problem: Problem, run: Run) -> None:
    """Raise PathreplayError after `max_consecutive_nonfinite` iterations in which half of a gradient was not finite."""
    most = problem.config.max_consecutive_nonfinite
    last = run.history[-most:]
    if len(last) < most:
        return
    for key in last[-1].dropped_shares:
        if all(entry.dropped_shares.get(key, 0) >= HALF for entry in last):
            raise PathreplayError(
                f"At least half of the gradient of '{key}' was NaN or infinite in iterations {last[0].iteration} to "
                f"{last[-1].iteration}; bound the parameter, change its 'initial', or raise "
                "'max_consecutive_nonfinite'"
            )


def take_step(problem: Problem, run: Run, position: int) -> list[Event]:
    """Take one step and append it to the history of the run.

    First, give the variables that the stage freezes their averaged values, and refine the grids whose next resolution
    is due, which resets their optimiser state. Then evaluate the views of the `batch` and sum the results in a fixed
    order. Each view, or each part of its samples (see `Config.parts`), has its own seed. Finally, step with the
    learning rate of the iteration (see `schedules`) and project all variables onto their bounds.

    The integrator determines which derivatives the gradient contains. Targets, bounds and random numbers are not
    differentiated.

    Args:
        problem: the problem.
        run: the run, which is changed in place.
        position: iteration that determines stage, learning rate and resolutions.

    Returns:
        Events of the step.

    Raises:
        PathreplayError: the loss or a value is not finite.
    """
    begin, i = time.perf_counter(), len(run.history)
    part = part_at(problem, position)
    _freeze(part, run)
    values, events = _refined(part, run.values, position)
    config = part.problem.config
    spp = config.spp if isinstance(config.spp, int) else noise.next_spp(config.adaptive_spp, run.history)
    shards = _shards(part, i, spp, run.optimiser)
    scale = len(part.problem.trained()) / len({shard.views for shard in shards})
    evaluations = run.executor.run(values, shards, run.learned)
    dropped: list[dict[str, int]] = []
    evaluation, noise_norms = _summed(_seen(evaluations, dropped), scale / config.parts, config.halves_samples)
    if not np.isfinite(evaluation.loss):
        raise PathreplayError(
            f"The loss is {evaluation.loss} at iteration {i}; lower the learning rates, or bound the parameters that "
            "diverged"
        )
    for shard, counts in zip(shards, dropped, strict=True):
        view = problem.views[shard.views[0]].name
        events += [NonFinite(key, view, i, count) for key, count in counts.items()]
    penalties = {v.key: v.penalty.of(values[v.key]) for v in problem.variables if v.penalty}
    gradients = evaluation.gradients
    for key, (_, slope) in penalties.items():
        if key in gradients:
            gradients[key] = gradients[key] + slope
    penalty = sum(value for value, _ in penalties.values())
    observe(part.problem, run.optimiser, values, evaluation)
    slopes = {key: parts_of(gradient) for key, gradient in gradients.items()}
    norms, sizes = _norms(gradients), {key: gradient.size for key, gradient in gradients.items()}
    release(values)
    run.whole = False
    run.values = _stepped(part, run, values, gradients, position, evaluation.loss + penalty)
    run.learned = evaluation.learned
    seconds = time.perf_counter() - begin
    entry = Entry(
        i,
        evaluation.loss,
        seconds,
        norms,
        sum(evaluation.dropped.values()),
        errors_of(problem, run.values),
        penalty=penalty,
        spp=spp,
        noise_norms=noise_norms,
        dropped_shares={key: n / (sizes[key] * len(shards)) for key, n in evaluation.dropped.items()},
        slopes=slopes,
        means={key: parts_of(run.values[key], mean=True) for key in slopes},
    )
    run.history.append(entry)
    run.whole = True
    return events


def _freeze(part: Part, run: Run) -> None:
    """Give frozen variables their averaged values, which the result then has as well."""
    if isinstance(run.optimiser, Averaged):
        frozen = set(run.optimiser.averaged) - part.moving
        variables = [v for v in part.problem.variables if v.key in frozen]
        run.values = decoded(variables, run.optimiser.freeze(latents(variables, run.values)), run.values)


def _refined(part: Part, values: Arrays, position: int) -> tuple[dict[str, Array], list[Event]]:
    """Resample grids that are due for refinement and not frozen. Returns all values, and an event per such grid."""
    moving = [v for v in part.problem.variables if v.key in part.moving]
    due = [(v, v.levels.shape_at(position)) for v in moving if v.levels]
    due = [(v, shape) for v, shape in due if values[v.key].shape != shape]
    grids = {v.key: resampled(values[v.key], shape, v.form.wraps) for v, shape in due}
    return {**values, **grids}, [Refined(v.key, shape) for v, shape in due]


def _shards(part: Part, iteration: int, spp: int, optimiser: Optimiser) -> list[Shard]:
    """Make the shards of an iteration, with `Config.parts` shards per view."""
    config, views = part.problem.config, part.problem.views
    draw, second_order = draw_of(optimiser, iteration, config.optimizer.searches)
    return [
        Shard((n,), spp // config.parts, (seed,), part.number, config.pixel_batch_size, second_order)
        for n in batch(list(part.problem.trained()), config.view_batch_size, config.seed, iteration)
        for seed in config.seeds(ITERATION, views[n].sensor, draw, config.parts)
    ]


def _norms(gradients: Arrays) -> dict[str, float]:
    return {key: float(np.linalg.norm(gradient)) for key, gradient in gradients.items()}


def _seen(evaluations: Iterable[Evaluation], dropped: list[dict[str, int]]) -> Iterator[Evaluation]:
    """Yield the evaluations, and append their counts of non-finite gradient entries to ``dropped``."""
    for evaluation in evaluations:
        dropped.append(evaluation.dropped)
        yield evaluation
        del evaluation


def _summed(evaluations: Iterator[Evaluation], scale: float, halves: bool) -> tuple[Evaluation, dict[str, float]]:
    """Sum evaluations, multiply the sum by ``scale``, and compute the noise norm of each gradient if ``halves`` is set.

    With ``halves``, the evaluations belong alternately to two halves of the samples. The noise norm of a gradient is
    |a - b| times ``scale``, where a and b are the sums over the halves.
    """
    if not halves:
        return total(evaluations, scale, owned=True), {}
    sums = Total(owned=True), Total(owned=True)
    for n, evaluation in enumerate(evaluations):
        sums[n % 2].add(evaluation)
        del evaluation
    a, b = (half.of() for half in sums)
    norms = _norms({key: a.gradients[key] - b.gradients[key] for key in a.gradients})
    return total([a, b], scale), {key: scale * norm for key, norm in norms.items()}


def _stepped(part: Part, run: Run, values: Arrays, gradients: Arrays, position: int, loss: float) -> dict[str, Array]:
    """Step the optimiser, and return the values after projection onto their bounds.

    The optimiser steps in the `coordinates` of each variable, or in the values of variables without coordinates.
    """
    config = part.problem.config
    decay, iterations = config.final_learning_rate_ratio, config.iterations
    factor = 1.0 if part.stage is None else part.stage.learning_rate_factor
    factor *= rate(config.learning_rate_schedule, position, iterations, decay, config.warmup_steps)
    moving = [v for v in part.problem.variables if v.key in gradients]
    rates = {v.key: v.learning_rate * factor for v in moving}
    others = {v.key: v.coordinates for v in moving if v.coordinates}
    latent = {key: other.latent(values[key]) for key, other in others.items()}
    slopes = {key: other.gradient(values[key], gradients[key]) for key, other in others.items()}
    now = {v.key: values[v.key] for v in moving}
    stepped = run.optimiser.step({**now, **latent}, {**gradients, **slopes}, rates, loss)
    stepped |= {key: other.values(stepped[key]) for key, other in others.items()}
    for key, value in stepped.items():
        if not np.isfinite(value.sum(dtype=np.float64)):  # a sum is finite if and only if all entries are
            raise PathreplayError(
                f"'{key}' is not finite after iteration {len(run.history)}; lower its learning rate, or bound it"
            )
    for v in moving:
        if v.bounds != (-np.inf, np.inf):
            np.clip(stepped[v.key], *v.bounds, out=stepped[v.key])
    return {**values, **{v.key: stepped[v.key] for v in moving}}


def render_views(problem: Problem, values: Arrays) -> dict[str, Image]:
    """Render all views with the job's integrator at these values. All calls use the same random numbers."""
    return {name: problem.disk.keep(image) for name, image in pictures_of(problem, values, problem.views)}


def pictures_of(
    problem: Problem, values: Arrays, views: Iterable[View], spp: int | None = None
) -> Iterator[tuple[str, Image]]:
    """Render some views as `render_views` does, with ``spp`` samples per pixel (default: ``eval_spp``).

    Yields name and image of each view. The values are set once in each scene, before the first view.
    """
    views = list(views)
    for home in {id(home): home for home, _ in map(problem.home, views)}.values():
        put_values(home, values)
    places = {view.name: n for n, view in enumerate(problem.views)}
    for view in views:
        image = _plain(problem, view, problem.config.eval_spp if spp is None else spp)
        yield view.name, exposed(values, places[view.name], image)


def _plain(problem: Problem, view: View, spp: int) -> Image:
    """Render a view at exposure 1 with the current values of the scene."""
    home, there = problem.home(view)
    return _picture(home, there, home.integrator, spp, problem.config.seeds(PICTURE, view.sensor)[0])


def ended(problem: Problem, run: Run) -> Run:
    """Return a copy of the run and its baseline with `best_values`, and fit the exposures of test views."""
    baseline = run.baseline and ended(problem, run.baseline)
    return replace(run, values=dict(with_exposures(problem, best_values(problem, run))), baseline=baseline)


def with_exposures(problem: Problem, values: Arrays) -> Arrays:
    """Fit the exposures of test views, which the run does not optimise, to their targets. Return all values."""
    if EXPOSURE not in values or not any(view.is_test for view in problem.views):
        return values
    put_values(problem, values)
    pictures = {
        n: (_plain(problem, view, problem.config.eval_spp), view.target, view.weight)
        for n, view in enumerate(problem.views)
        if view.is_test
    }
    return with_held_out(values, pictures)


def image_error(problem: Problem, values: Arrays, iteration: int) -> float:
    """Estimate the root mean square error of the training views without rendering noise.

    Two independent renderings A and B of an image I satisfy E[(A - T)(B - T)] = (I - T)², whereas E[(A - T)²] would
    include the variance of A. The result is the square root of the mean over pixels and views, or 0 if the mean is
    negative. The result includes the noise of the targets T.

    Args:
        problem: the problem.
        values: values of the variables.
        iteration: selects the random numbers.
    """
    config = problem.config
    put_values(problem, values)
    squares, views = 0.0, problem.trained()
    for n, view in views.items():
        a, b = (
            exposed(values, n, _picture(problem, view, problem.judge, config.most_spp, seed)).astype(np.float64)
            - view.target
            for seed in config.seeds(JUDGEMENT, view.sensor, iteration)
        )
        squares += view.share * float(np.mean(a * b if view.weight is None else a * b * view.weight)) / len(views)
    return float(np.sqrt(max(squares, 0.0)))


def _picture(problem: Problem, view: View, integrator: mi.Integrator, spp: int, seed: int) -> Image:
    sensor = sensor_of(problem, view)
    with dr.suspend_grad():
        image = mi.render(problem.scene, sensor=view.sensor, integrator=integrator, spp=spp, seed=mi.UInt32(seed))
    sensor.film().clear()  # frozen functions take the film as input, and a filled film would trigger a new recording
    return np.array(image, dtype=np.float32)
