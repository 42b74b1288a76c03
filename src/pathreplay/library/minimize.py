"""Minimisation of a problem: steps, callbacks, a folder where one is asked for, and the result."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi

from pathreplay.distributed.ray_executor import crew_of, require_executor
from pathreplay.errors import PathreplayError
from pathreplay.inverse.images.io import Image
from pathreplay.inverse.loop.checkpoint import Entry, Run
from pathreplay.inverse.loop.events import Event
from pathreplay.inverse.loop.loop import ended
from pathreplay.inverse.objective.evaluate import computing
from pathreplay.inverse.parameters.values import Array
from pathreplay.inverse.problem import problem as inner
from pathreplay.inverse.problem.problem import put_values
from pathreplay.library.folder_run import FolderRun, require_targets
from pathreplay.library.iterations import Iteration, iterations, run_of
from pathreplay.library.optimizers import Stepper, adapted, options_of
from pathreplay.library.problem import Problem
from pathreplay.platform import memory
from pathreplay.platform.interrupts import Stop, stopping
from pathreplay.report.live_pictures import LivePictures
from pathreplay.report.notebook import NotebookPanel, progress_of
from pathreplay.report.progress import Progress
from pathreplay.report.recovered import with_scene
from pathreplay.runs.run_folder import Job, new_output, open_run_folder


@dataclass(frozen=True, repr=False)
class Result:
    """What a minimisation came to."""

    values: dict[str, Array]
    """By name; poses and derived parameters by their keys, too."""
    history: list[Entry]
    """One entry for each iteration: loss, seconds, norms of gradients, ..."""
    stopped: str | None
    """Who ended it early: a callback, 'Ctrl-C', or the optimiser, and why."""
    problem: Problem
    folder: Path | None = None
    """What was written: the report, ``report.html``, is in it."""

    def __repr__(self) -> str:
        """Short: a notebook prints it."""
        stopped = "" if self.stopped is None else f", ended by {self.stopped}"
        return f"<Result: {len(self.history)} iterations, loss {self.loss:.4g}{stopped}; {', '.join(self.values)}>"

    @property
    def loss(self) -> float:
        """Of the last iteration, before its step."""
        return self.history[-1].loss if self.history else float("nan")

    def apply(self, scene: mi.Scene) -> None:
        """Give a scene with these parameters the values that were found; that of the problem has them."""
        self.problem.assign(self.values, scene)

    def render(self, view: int | str = 0, spp: int | None = None) -> Image:
        """The image of a view (height, width, channels; linear) with these values: see `Problem.render`."""
        return self.problem.render({v.key: self.values[v.key] for v in self.problem.built.variables}, view, spp)


def minimize(  # noqa: PLR0913 (of which most are keywords)
    problem: Problem,
    optimizer: str | Mapping[str, Any] | Stepper | Any = None,
    steps: int | None = None,
    *,
    callbacks: Iterable[Callable[[Iteration], Any]] = (),
    progress: bool = True,
    output: str | Path | None = None,
    resume: bool = False,
    stages: Sequence[Mapping[str, Any]] | None = None,
    learning_rate_schedule: str | None = None,
    final_learning_rate_ratio: float | None = None,
    warmup_steps: int | None = None,
    view_batch_size: int | None = None,
    pixel_batch_size: int | None = None,
    **settings: Any,
) -> Result:
    """Minimise a problem from its initial values.

    Args:
        problem: what is minimised. Its scene holds the result afterwards.
        optimizer: ``"adam"`` (the default), ``"adamw"``, ``"sgd"``, ``"rmsprop"`` or ``"l-bfgs-b"``; a mapping with its
            ``type`` and options; an optimizer of `mitsuba.ad` that holds nothing yet, with learning rates of its own
            where a `Parameter` has none; any object with ``step(values, gradients, learning_rates, loss) ->
            values``, arrays by name; or a function that is called as `scipy.optimize.minimize`, such as
            ``functools.partial(scipy.optimize.minimize, method="SLSQP")``, for up to 1000 numbers.
        steps: iterations; None: those of the job that the problem comes from, or 200.
        callbacks: each is called after every step with an `Iteration`; one that returns True ends the minimisation.
        progress: show a bar on a terminal, curve and images in a notebook, and lines elsewhere.
        output: a folder for checkpoints, the page of ``pathreplay watch`` and the report, as jobs have it. Where it
            exists, a number is appended. None: nothing is written.
        resume: go on with the run in ``output`` from its last checkpoint, if there is one.
        stages: tables of settings that differ for some iterations, as ``[[stages]]`` of jobs; their ``iterations`` take
            the place of ``steps``.
        learning_rate_schedule: ``"constant"`` (the default), ``"exponential"``, ``"linear"`` or ``"cosine"``.
        final_learning_rate_ratio: learning rate at the end over that at the start.
        warmup_steps: iterations in which the learning rate grows from nearly zero.
        view_batch_size: views in an iteration; all by default.
        pixel_batch_size: pixels of each view in an iteration; all by default.
        **settings: other keys of a job that are not the problem's, such as ``checkpoint_every``, ``preview``, ``spp``.

    Returns:
        Values, history, and who ended it. A first Ctrl-C ends it after the iteration that is under way.

    Raises:
        PathreplayError: for settings that cannot work, where loss or values are no longer finite, and for a folder that
            is in use, damaged, or of another problem.
    """
    options, own = options_of(optimizer)
    given = {
        "iterations": steps,
        "stages": None if stages is None else [dict(stage) for stage in stages],
        "optimizer": options,
        "learning_rate_schedule": learning_rate_schedule,
        "final_learning_rate_ratio": final_learning_rate_ratio,
        "warmup_steps": warmup_steps,
        "view_batch_size": view_batch_size,
        "pixel_batch_size": pixel_batch_size,
        **settings,
    }
    built = problem.configured({key: value for key, value in given.items() if value is not None}, "minimize")
    return _minimized(problem, built, own, list(callbacks), progress, None if output is None else Path(output), resume)


def _minimized(
    problem: Problem,
    built: inner.Problem,
    own: Any,
    callbacks: Sequence[Callable[[Iteration], Any]],
    progress: bool,
    output: Path | None,
    resume: bool,
) -> Result:
    """See `minimize`; ``built`` has its settings, and ``own`` is an optimizer of the user's, if there is one."""
    stop = Stop()
    if built.config.executor != "local" and problem.in_memory:
        raise PathreplayError(
            f"executor = '{built.config.executor}': other processes cannot be sent what this problem holds in memory; "
            "make it with load_job, of a file"
        )
    with ExitStack() as stack:
        stack.enter_context(memory.within(built.config.budget))
        require_executor(built.config)
        bar = progress_of(progress)
        stack.enter_context(bar)
        for note in problem.notes + built.notes:
            bar.remark(note)
        run = _run(problem, built, own, stack, bar)
        kept = None
        if output is not None:
            job = Job(built.config, None, problem.base, in_python=problem.in_memory or own is not None)
            kept = _folder_run(job, built, run, stop, output, resume, stack)
        elif resume:
            raise PathreplayError("resume = True goes on with a run in a folder; give 'output'")
        stack.enter_context(stopping(bar.say, "aborted" if kept is None else kept.way_out, stop))
        observers = [bar.observe, *_observers(bar, built, run, stop, kept)]
        for about in stack.enter_context(closing(iterations(built, run, stop, observers, kept))):
            if any([callback(about) is True for callback in callbacks]):
                stop.by = stop.by or "a callback"
        if kept is not None:
            bar.say("writing")
            found = kept.finish().parameters
        with computing(built.config):
            if kept is None:
                found = with_scene(built, ended(built, built.config, run).values)
            put_values(built, {v.key: found[v.key] for v in built.variables})
    folder = None if kept is None else kept.folder.path
    return Result(found, run.history, stop.by or run.optimiser.finished or None, problem, folder)


def _run(problem: Problem, built: inner.Problem, own: Any, stack: ExitStack, bar: Progress | NotebookPanel) -> Run:
    """A run at the start, stepped by an optimizer of the user's ``own`` if there is one."""
    config = built.config
    pool = stack.enter_context(crew_of(config, problem.base, built, bar.remark, bar.status))
    run = run_of(built, pool)
    if own is not None:
        run.optimiser = adapted(own, built, run.values)
    return run


def _folder_run(
    job: Job, built: inner.Problem, run: Run, stop: Stop, output: Path, resume: bool, stack: ExitStack
) -> FolderRun:
    """The run in a folder: a new one, or the one that is there."""
    run.optimiser.state()  # an optimizer of the user's may have none that can be saved
    resumed = None
    if resume and output.exists():
        _, resumed = open_run_folder(output, job.in_python)
        stack.callback(resumed.lock.close)
        require_targets(resumed.path, built)
    kept = FolderRun(job, built, run, stop, new_output(output, None), Path.cwd(), resumed)
    stack.callback(kept.folder.lock.close)
    return kept


def _observers(
    bar: Progress | NotebookPanel, built: inner.Problem, run: Run, stop: Stop, kept: FolderRun | None
) -> list[Callable[[Event], None]]:
    """Who else is told of a run: its folder, or where there is none, but a notebook, the images in that."""
    if kept is not None:
        if isinstance(bar, NotebookPanel):
            bar.follow(kept.previews.pictures, str(kept.folder.name))
        return [kept.observe]
    if not isinstance(bar, NotebookPanel):
        return []
    with computing(built.config):
        pictures = LivePictures(built, run, stop)
    bar.follow(pictures, "minimize")
    return [pictures.observe]
