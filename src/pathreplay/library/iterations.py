"""The iterations of a run, one after the other, as jobs and `minimize` loop over them."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path

import mitsuba as mi

from pathreplay.distributed.ray_executor import RayExecutor, WorkerPool
from pathreplay.errors import PathreplayError, shown
from pathreplay.inverse.config.schema import Plugin
from pathreplay.inverse.dataset import views
from pathreplay.inverse.images.io import Image
from pathreplay.inverse.loop.checkpoint import Entry, Run
from pathreplay.inverse.loop.events import Event, Stepped
from pathreplay.inverse.loop.loop import best_values, computed, new_run, picture_of
from pathreplay.inverse.objective.evaluate import computing
from pathreplay.inverse.objective.stages import evaluator_of
from pathreplay.inverse.parameters.values import Array, Arrays
from pathreplay.inverse.problem.problem import Problem
from pathreplay.library.folder_run import FolderRun
from pathreplay.platform.interrupts import Stop


@dataclass(frozen=True)
class Iteration:
    """A run after one of its iterations. Nothing in it changes when the run goes on."""

    entry: Entry
    """What the history says of it."""
    values: Mapping[str, Array]
    """After the step, by name, decoded; of poses ``KEY:translation`` and ``KEY:rotation``."""
    views: tuple[str, ...]
    """Names of the views."""
    folder: Path | None
    """Of the run; None where it has none."""
    _problem: Problem = field(repr=False)

    @property
    def number(self) -> int:
        """From 0."""
        return self.entry.iteration

    @property
    def loss(self) -> float:
        """Before the step, without regularizers."""
        return self.entry.loss

    @property
    def gradient_norms(self) -> Mapping[str, float]:
        """L2 norms of the gradients that were stepped by, by name."""
        return self.entry.gradient_norms

    @property
    def errors(self) -> Mapping[str, float]:
        """Root mean square errors after the step, by name, where the truth is known."""
        return self.entry.errors

    def render(self, view: int | str = 0, spp: int | None = None) -> Image:
        """Render a view with these values, without changing what comes after.

        Args:
            view: its place or its name.
            spp: samples per pixel; None: ``eval_spp``.

        Returns:
            Linear pixels (height, width, channels).

        Raises:
            PathreplayError: there is no such view.
        """
        return rendered(self._problem, self.values, view, spp)


def rendered(problem: Problem, values: Arrays, view: int | str, spp: int | None) -> Image:
    """The image of a view, by its place or its name, with these values. Raises PathreplayError for another view."""
    about = view_of(problem, view)
    with computing(problem.config):
        return picture_of(problem, problem.config, values, about, spp)


def view_of(problem: Problem, view: int | str) -> views.View:
    """The view of that place or name. Raises PathreplayError if there is none."""
    for n, each in enumerate(problem.views):
        if view in (n, n - len(problem.views), each.name):
            return each
    raise PathreplayError(f"No view {shown(view)}; there are {', '.join(each.name for each in problem.views)}")


def run_of(problem: Problem, pool: WorkerPool | None = None) -> Run:
    """The run of a problem, and that of its baseline, at their start; in this process, if there is no ``pool``."""
    config = problem.config
    run = _run(problem, problem.integrator, config.integrator, pool)
    if problem.baseline is not None and config.baseline is not None:
        run.baseline = _run(problem, problem.baseline, config.baseline, pool, baseline=True)
    return run


def _run(
    problem: Problem, integrator: mi.Integrator, plugin: Plugin, pool: WorkerPool | None, baseline: bool = False
) -> Run:
    config = problem.config
    if pool is not None:
        executor = RayExecutor(pool, [view.name for view in problem.views], baseline)
        return new_run(problem, integrator, optimizer=config.optimizer, executor=executor)
    evaluate = evaluator_of(problem, config, integrator, plugin)
    return new_run(problem, integrator, optimizer=config.optimizer, evaluate=evaluate)


def iterations(
    problem: Problem,
    run: Run,
    stop: Stop,
    observers: Sequence[Callable[[Event], None]],
    kept: FolderRun | None = None,
) -> Generator[Iteration, None, None]:
    """Take all steps of a run; observers are told of everything before what they hear of is yielded.

    ``kept`` is its folder, an observer among these, which saves what was done when the generator is closed.
    Raises as `inverse.loop.loop.iterate` and the observers do.
    """
    names = tuple(view.name for view in problem.views)
    folder = None if kept is None else kept.folder.path
    with nullcontext() if kept is None else kept.kept():
        for event in computed(problem, problem.config, run, stop):
            for observe in observers:
                observe(event)
            problem.album.rest()
            if isinstance(event, Stepped):
                yield Iteration(event.entry, best_values(problem, run), names, folder, problem)
