"""The optimisation loop of jobs and `minimize`: runs the iterations and passes their events to observers."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path

import mitsuba as mi

from pathreplay.distributed.ray_executor import RayExecutor, WorkerPool
from pathreplay.errors import PathreplayError, require_count, shown
from pathreplay.inverse.config.schema import Plugin
from pathreplay.inverse.dataset.views import View
from pathreplay.inverse.images.io import Image
from pathreplay.inverse.loop.checkpoint import Entry, Run
from pathreplay.inverse.loop.events import Event, Stepped
from pathreplay.inverse.loop.loop import best_values, computed, new_run, pictures_of
from pathreplay.inverse.objective.stages import evaluator_of
from pathreplay.inverse.parameters.values import Array, Arrays
from pathreplay.inverse.problem.problem import Problem
from pathreplay.library.folder_run import FolderRun
from pathreplay.platform.interrupts import Stop


@dataclass(frozen=True)
class Iteration:
    """Snapshot of a run after an iteration. It does not change when the run continues."""

    entry: Entry
    """Entry of the history."""
    values: Mapping[str, Array]
    """Values by name, as if the run ended now. A pose has ``KEY:translation`` and ``KEY:rotation``."""
    views: tuple[str, ...]
    """Names of the views."""
    folder: Path | None
    """Run folder, if there is one."""
    _problem: Problem = field(repr=False)

    @property
    def number(self) -> int:
        """Return the index of the iteration, from 0."""
        return self.entry.iteration

    @property
    def loss(self) -> float:
        """Return the loss before the step, without regularizers."""
        return self.entry.loss

    @property
    def gradient_norms(self) -> Mapping[str, float]:
        """Return the L2 norms of the gradients, by name."""
        return self.entry.gradient_norms

    @property
    def errors(self) -> Mapping[str, float]:
        """Return the RMS errors after the step, by name, for all parameters whose true value is known."""
        return self.entry.errors

    def render(self, view: int | str = 0, spp: int | None = None) -> Image:
        """Render a view with these values. The run is not affected.

        Args:
            view: index or name of the view.
            spp: samples per pixel; default: ``eval_spp``.

        Returns:
            Linear pixels (height, width, channels).

        Raises:
            PathreplayError: the view does not exist.
        """
        return rendered(self._problem, self.values, view, spp)


def rendered(problem: Problem, values: Arrays, view: int | str, spp: int | None) -> Image:
    """Render a view with these values. The view is given by its index or name, or by the id of its sensor.

    Raises PathreplayError if there is no such view, or ``spp`` is not a positive integer.
    """
    if spp is not None:
        require_count("spp", spp, 1)
    places = {name: n for n, each in enumerate(problem.views) for name in (n, n - len(problem.views), each.name)}
    ids = [_sensor_id(problem, each) for each in problem.views]
    place = places.get(view)
    if place is None and isinstance(view, str) and ids.count(view) == 1:
        place = ids.index(view)
    if place is not None:
        with problem.computing():
            ((_, image),) = pictures_of(problem, values, [problem.views[place]], spp)
            return image
    raise PathreplayError(f"No view {shown(view)}; there are {', '.join(each.name for each in problem.views)}")


def _sensor_id(problem: Problem, view: View) -> str:
    """Return the id of a view's sensor, which is not the view's name if it contains unusual characters."""
    home, there = problem.home(view)
    return str(home.scene.sensors()[there.sensor].id())


def run_of(problem: Problem, pool: WorkerPool | None = None) -> Run:
    """Create the run of a problem at the initial values, with the run of the baseline if there is one.

    Args:
        problem: the problem.
        pool: Ray actors that evaluate the problem; None evaluates in this process.

    Returns:
        The run before its first iteration.
    """
    config = problem.config
    run = _run(problem, problem.integrator, config.integrator, pool)
    if problem.baseline is not None and config.baseline is not None:
        run.baseline = _run(problem, problem.baseline, config.baseline, pool, baseline=True)
    return run


def _run(
    problem: Problem, integrator: mi.Integrator, plugin: Plugin, pool: WorkerPool | None, baseline: bool = False
) -> Run:
    executor = None if pool is None else RayExecutor(pool, [view.name for view in problem.views], baseline)
    evaluate = evaluator_of(problem, integrator, plugin) if executor is None else None
    return new_run(problem, integrator, optimizer=problem.config.optimizer, executor=executor, evaluate=evaluate)


def iterations(
    problem: Problem,
    run: Run,
    stop: Stop,
    observers: Sequence[Callable[[Event], None]],
    kept: FolderRun | None = None,
) -> Generator[Iteration, None, None]:
    """Run the optimisation loop.

    Args:
        problem: the problem.
        run: the run of the problem, which is modified.
        stop: request to stop after the current iteration.
        observers: functions that receive every event, before the iteration is yielded.
        kept: writer of the run folder. It is also an observer, and saves a checkpoint when the generator is closed.

    Yields:
        Each iteration.

    Raises:
        PathreplayError: the loop fails (see `inverse.loop.loop.iterate`), or an observer fails.
    """
    names = tuple(view.name for view in problem.views)
    folder = None if kept is None else kept.folder.path
    with nullcontext() if kept is None else kept.kept():
        for event in computed(problem, run, stop):
            for observe in observers:
                observe(event)
            problem.disk.rest()
            if isinstance(event, Stepped):
                yield Iteration(event.entry, best_values(problem, run), names, folder, problem)
