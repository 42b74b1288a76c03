"""The optimisation loop: evaluate, step, project; interruptible and resumable."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.optimizer_options import Optimizer
from pathreplay.inverse.config.schedules import rate
from pathreplay.inverse.config.schema import ITERATION, JUDGEMENT, PICTURE, Config
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
from pathreplay.inverse.objective.evaluate import (
    Evaluate,
    Evaluation,
    Evaluator,
    Executor,
    Local,
    Shard,
    Total,
    computing,
    release,
    total,
)
from pathreplay.inverse.objective.stages import Part, part_at
from pathreplay.inverse.optim.adaptive import DrJitOptimiser, Optimiser
from pathreplay.inverse.optim.lbfgs import LineSearch
from pathreplay.inverse.parameters.exposures import EXPOSURE, exposed, with_held_out
from pathreplay.inverse.parameters.grids import resampled
from pathreplay.inverse.parameters.values import Array, Arrays
from pathreplay.inverse.problem.problem import Problem, errors_of, put_values, sensor_of
from pathreplay.platform.interrupts import Stop
from pathreplay.scenes.parameters import get_array, to_value

# How often the pictures are judged in a job with a baseline: enough for a curve, at some per cent of its time.
JUDGEMENTS = 10

# Of a gradient's entries, that were not finite: with less, the others still lead the way.
HALF = 0.5


def new_run(
    problem: Problem,
    integrator: mi.Integrator,
    record: bool = True,
    optimizer: Optimizer | None = None,
    evaluate: Evaluate | None = None,
    executor: Executor | None = None,
) -> Run:
    """A run at the problem's start values, in this process; ``evaluate`` is what does it, if not an `Evaluator`.

    Or ``executor``, in others.
    """
    values = {
        v.key: np.array(v.start, np.float32) if dr.is_tensor_v(v.like) else get_array(to_value(v.like, v.start))
        for v in problem.variables
    }
    return Run(
        executor or Local(Evaluator(problem, integrator, record) if evaluate is None else evaluate),
        _optimiser(problem, values, optimizer or Optimizer()),
        values,
    )


def _optimiser(problem: Problem, values: Arrays, options: Optimizer) -> Optimiser:
    if options.searches:
        free = -np.inf, np.inf  # other coordinates have their own ways to hold bounds
        bounds = {v.key: free if v.coordinates else v.bounds for v in problem.variables}
        return LineSearch(values, options, bounds)
    uniform = [v.key for v in problem.variables if v.coordinates and v.coordinates.uniform]
    return DrJitOptimiser(values, options, uniform)


def best_values(problem: Problem, run: Run) -> dict[str, Array]:
    """The values that a run has come to: after its last step, or at the best one of a line search."""
    found = run.optimiser.answer()
    for v in problem.variables:
        if v.coordinates and v.key in found:
            found[v.key] = v.coordinates.values(found[v.key])
    # Values of a run are within their bounds.
    return {v.key: np.clip(found[v.key], *v.bounds) if v.key in found else run.values[v.key] for v in problem.variables}


def iterate(problem: Problem, config: Config, run: Run, stop: Stop) -> Iterator[Event]:
    """Take steps from ``len(run.history)`` to ``config.iterations``; yields what happens, for observers.

    After each step the run's baseline takes as many as bring it to the same number of seconds. In turns, both have the
    same share of a machine whose load changes. Its learning rate and resolutions are those of the job's iteration.

    Raises PathreplayError where loss or values are no longer finite, and after `Config.max_consecutive_nonfinite`.
    """
    yield Started(len(run.history), config.iterations)
    faint: set[str] = set()
    stage, stages = None, config.stages or []
    for i in range(len(run.history), config.iterations):
        if run.optimiser.finished:
            yield Finished(run.optimiser.finished)
            break
        if stages and place(stages, i) != stage:
            stage = place(stages, i)
            yield Entered(stage + 1, len(stages))
        yield from take_step(problem, config, run, i)
        if baseline := run.baseline:
            while baseline.seconds() < run.seconds():
                take_step(problem, config, baseline, i)
            # Due after the first iteration, and after those with which a tenth of them is done.
            if i == 0 or JUDGEMENTS * i // config.iterations < JUDGEMENTS * (i + 1) // config.iterations:
                for each in (run, baseline):
                    error = judged(problem, config, each.values, i)
                    each.history[-1] = replace(each.history[-1], picture_error=error)
        for key, ratio in noise.ratios(run.history).items():
            if ratio < noise.FAINT and key not in faint:
                faint.add(key)
                yield LowSNR(key, ratio, i, run.history[-1].spp)
        yield Stepped(run.history[-1])
        _require_gradients(config, run)
        if stop.by is not None:
            break
    yield Stopped(len(run.history))


def computed(problem: Problem, config: Config, run: Run, stop: Stop) -> Iterator[Event]:
    """The events of `iterate`, computed as the job wants it, while whoever looks on is free to compute as they want."""
    events = iterate(problem, config, run, stop)
    while True:
        with computing(config):
            event = next(events, None)
        if event is None:
            return
        yield event


def _require_gradients(config: Config, run: Run) -> None:
    """Raise PathreplayError if half of a gradient and more was not finite in so many iterations in a row."""
    last = run.history[-config.max_consecutive_nonfinite :]
    if len(last) < config.max_consecutive_nonfinite:
        return
    for key in last[-1].dropped_shares:
        if all(entry.dropped_shares.get(key, 0) >= HALF for entry in last):
            raise PathreplayError(
                f"The gradient of '{key}' was NaN or infinite, half of it or more, in iterations {last[0].iteration} "
                f"to {last[-1].iteration}; bound it, start it elsewhere, or raise 'max_consecutive_nonfinite'"
            )


def take_step(problem: Problem, config: Config, run: Run, position: int) -> list[Event]:
    """One step, with the learning rates and resolutions of iteration ``position``; adds an entry to the history.

    Evaluate the views of its `batch`, a shard with a seed of its own for each (or parts of it, see `Config.parts`), and
    sum in their order; step with the learning rate of that iteration (see `schedules`), project every variable into its
    bounds. A grid that moves, and whose next resolution is due, is interpolated before that; the optimiser starts anew
    on it. What is differentiated is decided by the integrator; targets, bounds and the seeds' choice of paths are not.

    Returns what there is to tell. Raises PathreplayError where the loss is no longer finite.
    """
    begin, i = time.perf_counter(), len(run.history)
    part = part_at(problem, config, position)
    values, told = _refined(part, run.values, position)
    asked, halves = part.config.spp, part.config.halves_samples
    spp = asked if isinstance(asked, int) else noise.next_spp(config.adaptive_spp, run.history)
    shards = _shards(part, i, spp)
    share = len(part.problem.trained()) / len({shard.views for shard in shards})
    evaluations = run.executor.run(values, shards, run.learned)
    dropped: list[dict[str, int]] = []
    found, noise_norms = _summed(_seen(evaluations, dropped), share / part.config.parts, halves)
    if not np.isfinite(found.loss):
        raise PathreplayError(
            f"The loss is {found.loss} at iteration {i}; lower the learning rates, or bound the parameters that ran "
            "away"
        )
    for shard, counts in zip(shards, dropped, strict=True):
        view = problem.views[shard.views[0]].name
        told += [NonFinite(key, view, i, count) for key, count in counts.items()]
    penalties = {v.key: v.penalty.of(values[v.key]) for v in problem.variables if v.penalty}
    gradients = found.gradients
    for key, (_, slope) in penalties.items():
        if key in gradients:
            gradients[key] = gradients[key] + slope
    penalty = sum(value for value, _ in penalties.values())
    slopes = {key: parts_of(gradient) for key, gradient in gradients.items()}
    norms, sizes = _norms(gradients), {key: gradient.size for key, gradient in gradients.items()}
    release(values)
    run.whole = False
    run.values = _stepped(part, run, values, gradients, position, found.loss + penalty)
    run.learned = found.learned
    seconds = time.perf_counter() - begin
    entry = Entry(
        i,
        found.loss,
        seconds,
        norms,
        sum(found.dropped.values()),
        errors_of(problem, run.values),
        penalty=penalty,
        spp=spp,
        noise_norms=noise_norms,
        dropped_shares={key: n / (sizes[key] * len(shards)) for key, n in found.dropped.items()},
        slopes=slopes,
        means={key: parts_of(run.values[key], mean=True) for key in slopes},
    )
    run.history.append(entry)
    run.whole = True
    return told


def _refined(part: Part, values: Arrays, position: int) -> tuple[dict[str, Array], list[Event]]:
    """The values, where the next resolution is due in that, and the grids that are; those that are held can wait."""
    moving = [v for v in part.problem.variables if v.key in part.moving]
    due = {v.key: v.levels.shape_at(position) for v in moving if v.levels}
    due = {key: shape for key, shape in due.items() if values[key].shape != shape}
    grids = {key: resampled(values[key], shape) for key, shape in due.items()}
    return {**values, **grids}, [Refined(key, shape) for key, shape in due.items()]


def _shards(part: Part, iteration: int, spp: int) -> list[Shard]:
    """What an iteration evaluates: its views, one after the other, each whole or in parts (see `Config.parts`)."""
    same = 0 if part.config.optimizer.searches else iteration
    config, views = part.config, part.problem.views
    return [
        Shard((n,), spp // config.parts, (seed,), part.number, config.pixel_batch_size)
        for n in batch(part.problem, config, iteration)
        for seed in config.seeds(ITERATION, views[n].sensor, same, config.parts)
    ]


def _norms(gradients: Arrays) -> dict[str, float]:
    return {key: float(np.linalg.norm(gradient)) for key, gradient in gradients.items()}


def _seen(evaluations: Iterable[Evaluation], dropped: list[dict[str, int]]) -> Iterator[Evaluation]:
    """The evaluations, while what they dropped is noted."""
    for each in evaluations:
        dropped.append(each.dropped)
        yield each
        del each


def _summed(evaluations: Iterator[Evaluation], share: float, halves: bool) -> tuple[Evaluation, dict[str, float]]:
    """The sum times ``share``; and where they are of two halves, in turn, |a - b| of their sums, of each gradient."""
    if not halves:
        return total(evaluations, share, owned=True), {}
    sums = Total(owned=True), Total(owned=True)
    for n, each in enumerate(evaluations):
        sums[n % 2].add(each)
        del each
    a, b = (each.of() for each in sums)
    norms = _norms({key: a.gradients[key] - b.gradients[key] for key in a.gradients})
    return total([a, b], share), {key: share * norm for key, norm in norms.items()}


def _stepped(part: Part, run: Run, values: Arrays, gradients: Arrays, position: int, loss: float) -> dict[str, Array]:
    """The values after a step of the optimiser, taken in the coordinates of each variable, and held within bounds."""
    config = part.config
    decay, iterations = config.final_learning_rate_ratio, config.iterations
    factor = part.factor * rate(config.learning_rate_schedule, position, iterations, decay, config.warmup_steps)
    moving = [v for v in part.problem.variables if v.key in gradients]
    rates = {v.key: v.learning_rate * factor for v in moving}
    others = {v.key: v.coordinates for v in moving if v.coordinates}
    latent = {key: other.latent(values[key]) for key, other in others.items()}
    slopes = {key: other.gradient(values[key], gradients[key]) for key, other in others.items()}
    now = {v.key: values[v.key] for v in moving}
    stepped = run.optimiser.step({**now, **latent}, {**gradients, **slopes}, rates, loss)
    stepped |= {key: other.values(stepped[key]) for key, other in others.items()}
    for key, value in stepped.items():
        if not np.isfinite(value.sum(dtype=np.float64)):  # which is where all is
            raise PathreplayError(
                f"'{key}' is no finite number after iteration {len(run.history)}; lower its learning rate, or bound it"
            )
    for v in moving:
        if v.bounds != (-np.inf, np.inf):
            np.clip(stepped[v.key], *v.bounds, out=stepped[v.key])
    return {**values, **{v.key: stepped[v.key] for v in moving}}


def render_views(problem: Problem, config: Config, values: Arrays) -> dict[str, Image]:
    """Pictures of all views with these values in the scene, by the job's integrator; same noise at every call."""
    return {view.name: problem.album.keep(picture_of(problem, config, values, view)) for view in problem.views}


def picture_of(problem: Problem, config: Config, values: Arrays, view: View, spp: int | None = None) -> Image:
    """One of them, with so many samples per pixel."""
    put_values(problem, values)
    at = next(n for n, each in enumerate(problem.views) if each.name == view.name)
    return exposed(values, at, _plain(problem, config, view, config.eval_spp if spp is None else spp))


def _plain(problem: Problem, config: Config, view: View, spp: int) -> Image:
    """At the exposure 1, with the values that the scene has."""
    return _picture(problem, view, problem.integrator, spp, config.seeds(PICTURE, view.sensor)[0])


def with_exposures(problem: Problem, config: Config, values: Arrays) -> Arrays:
    """The values, with the exposures of held-out views: nothing was learned from them, so that they are fitted now."""
    if EXPOSURE not in values or not any(view.is_test for view in problem.views):
        return values
    put_values(problem, values)
    pictures = {
        n: (_plain(problem, config, view, config.eval_spp), view.target, view.weight)
        for n, view in enumerate(problem.views)
        if view.is_test
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
    sensor.film().clear()  # recorded passes hold it, and would be recorded again
    return np.array(image, dtype=np.float32)
