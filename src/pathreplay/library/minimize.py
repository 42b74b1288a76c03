"""`minimize`: the optimisation loop with callbacks, progress display, an optional run folder, and the result."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path

import mitsuba as mi
import numpy as np

from pathreplay.distributed.ray_executor import crew_of, require_executor
from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.schema import Config
from pathreplay.inverse.images.io import Image
from pathreplay.inverse.loop.checkpoint import Entry, Run
from pathreplay.inverse.loop.events import Event
from pathreplay.inverse.loop.loop import ended
from pathreplay.inverse.parameters.values import Array
from pathreplay.inverse.problem import problem as inner
from pathreplay.inverse.problem.problem import put_values
from pathreplay.library.folder_run import FolderRun, with_saved_targets
from pathreplay.library.iterations import Iteration, iterations, run_of
from pathreplay.library.optimizers import Stepper, adapted, options_of, require_no_options
from pathreplay.library.problem import Problem, run_settings
from pathreplay.platform import memory
from pathreplay.platform.interrupts import Stop, stopping
from pathreplay.platform.threads import one_thread
from pathreplay.report.live_pictures import LivePictures
from pathreplay.report.notebook import NotebookPanel, progress_of
from pathreplay.report.progress import Progress
from pathreplay.report.recovered import with_scene
from pathreplay.runs.run_folder import (
    Job,
    is_empty_folder,
    new_output,
    open_run_folder,
    record_job,
    remove_empty_folder,
    require_creatable,
)
from pathreplay.types import Json


@dataclass(frozen=True, repr=False)
class Result:
    """Result of `minimize`."""

    values: dict[str, Array]
    """Values by name, including poses and derived parameters by key."""
    history: list[Entry]
    """One entry per iteration: loss, seconds, gradient norms and more."""
    stopped: str | None
    """Why the run ended early: 'a callback', 'Ctrl-C', 'SIGTERM', 'the stop button', or the reason why the optimiser
    stopped."""
    problem: Problem
    folder: Path | None = None
    """Run folder, which contains ``report.html``; None if no files were written."""

    def __repr__(self) -> str:
        stopped = "" if self.stopped is None else f", ended by {self.stopped}"
        return f"<Result: {len(self.history)} iterations, loss {self.loss:.4g}{stopped}; {', '.join(self.values)}>"

    @property
    def loss(self) -> float:
        """Return the loss of the last iteration, before its step."""
        return self.history[-1].loss if self.history else float("nan")

    def apply(self, scene: mi.Scene) -> None:
        """Set the parameters of a scene to the resulting values, which the problem's own scene already has.

        Raises PathreplayError if this is not a `mi.Scene`, lacks a parameter, or stores a parameter in a type that
        cannot hold its value. A texture that is stored with 8 bits is an example: load it with ``format = 'variant'``.
        """
        self.problem.assign(self.values, scene)

    def render(self, view: int | str = 0, spp: int | None = None) -> Image:
        """Render a view with the resulting values; see `Problem.render`."""
        return self.problem.render({v.key: self.values[v.key] for v in self.problem.built.variables}, view, spp)


def minimize(  # noqa: PLR0913 (most arguments are keyword-only)
    problem: Problem,
    optimizer: str | Mapping[str, object] | Stepper | object = None,
    steps: int | None = None,
    *,
    callbacks: Callable[[Iteration], object] | Iterable[Callable[[Iteration], object]] = (),
    progress: bool = True,
    output: str | Path | None = None,
    resume: bool = False,
    stages: Sequence[Mapping[str, object]] | None = None,
    learning_rate_schedule: str | None = None,
    final_learning_rate_ratio: float | None = None,
    warmup_steps: int | None = None,
    view_batch_size: int | None = None,
    pixel_batch_size: int | None = None,
    **settings: object,
) -> Result:
    """Minimise a problem from its initial values.

    Args:
        problem: the problem. Afterwards its scene has the resulting values.
        optimizer: ``"adam"`` (the default), ``"adamw"``, ``"sgd"``, ``"rmsprop"``, ``"l-bfgs-b"``,
            ``"levenberg-marquardt"``, or a mapping with ``type`` and options. An optimizer of `mitsuba.ad` must have no
            variables yet. Its learning rate applies to parameters without a learning rate of their own. The schedule
            and the stages scale all learning rates. Any other object needs a method ``step(values, gradients,
            learning_rates, loss) -> values``, with arrays by name. A function needs the interface of
            `scipy.optimize.minimize`, such as ``functools.partial(scipy.optimize.minimize, method="SLSQP")``. It
            supports parameters with up to 1000 entries in total.
        steps: number of iterations. Default: ``iterations`` of the problem's job, or 200.
        callbacks: a function or several, called with an `Iteration` after each step. The loop stops if one returns
            True (a Python or NumPy boolean).
        progress: show a bar on a terminal, the loss curve and images in a notebook, or lines elsewhere.
        output: run folder for checkpoints, the page of ``pathreplay watch`` and the report. If the folder exists, a
            number is appended. Default: no files are written.
        resume: resume the run in ``output`` from its last checkpoint, if the folder exists and is not empty. The folder
            then records the settings of this call.
        stages: tables of settings for parts of the run, like ``[[stages]]`` in a job; their ``iterations`` replace
            ``steps``.
        learning_rate_schedule: ``"constant"`` (the default), ``"exponential"``, ``"linear"`` or ``"cosine"``.
        final_learning_rate_ratio: final learning rate divided by the initial one.
        warmup_steps: iterations in which the learning rate increases linearly from nearly zero.
        view_batch_size: views per iteration. Default: all.
        pixel_batch_size: pixels of each view per iteration. Default: all.
        **settings: further keys of a job, such as ``checkpoint_every``, ``preview`` or ``spp`` (docs/job-reference.md).

    Returns:
        Values, history and the reason of an early end. The first Ctrl-C, SIGTERM or SIGHUP ends the
            run after the current iteration.

    Raises:
        PathreplayError: settings are invalid, loss or values are not finite, or the folder is in use, damaged, or
            belongs to another problem.
    """
    require_no_options("minimize", settings, optimizer, problem.built.config.optimizer)
    options, own = options_of(optimizer, problem.built.config.optimizer)
    settings |= {
        "stages": None if stages is None else [dict(each) if isinstance(each, Mapping) else each for each in stages],
        "learning_rate_schedule": learning_rate_schedule,
        "final_learning_rate_ratio": final_learning_rate_ratio,
        "warmup_steps": warmup_steps,
        "view_batch_size": view_batch_size,
        "pixel_batch_size": pixel_batch_size,
    }
    built = problem.configured(run_settings("minimize", steps, options, settings), "minimize")
    observers = [callbacks] if callable(callbacks) else list(callbacks)
    return _minimized(problem, built, own, observers, progress, None if output is None else Path(output), resume)


def _warn(message: str) -> None:
    """Log a message of a run without a progress bar, whose early end would otherwise look like a result."""
    mi.Log(mi.LogLevel.Warn, f"pathreplay: {message}")


def _minimized(
    problem: Problem,
    built: inner.Problem,
    own: object,
    callbacks: Sequence[Callable[[Iteration], object]],
    progress: bool,
    output: Path | None,
    resume: bool,
) -> Result:
    """Run `minimize`. ``built`` is the problem with its settings, and ``own`` the user's optimizer, if any."""
    stop = Stop()
    if built.config.executor != "local" and problem.in_memory:
        raise PathreplayError(
            f"executor = '{built.config.executor}': objects in memory cannot be sent to other processes; create the "
            "problem with load_job"
        )
    if own is not None and built.baseline is not None:
        raise PathreplayError(
            "optimizer: an object cannot step the baseline as well; give the name of an optimizer or a mapping, or "
            "remove 'baseline'"
        )
    with ExitStack() as stack:
        stack.enter_context(memory.within(built.config.budget))
        require_executor(built.config)
        bar = progress_of(progress)
        stack.enter_context(bar)
        for note in problem.notes + built.notes:
            bar.remark(note)
        in_python, opened, resumed = problem.in_memory or own is not None, None, None
        if resume and output is None:
            raise PathreplayError("resume = True needs a folder; give 'output'")
        if resume and output is not None and output.exists() and not is_empty_folder(output):
            opened, resumed = open_run_folder(output, in_python)
            stack.callback(resumed.lock.close)
            built = with_saved_targets(resumed.path, built)
        elif output is not None:
            require_creatable(new_output(output, None), Path.cwd(), None)
        run = run_of(built, stack.enter_context(crew_of(built.config, problem.base, built, bar.remark, bar.status)))
        if own is not None:
            run.optimiser = adapted(own, built, run.values)
        kept = None
        if output is not None:
            run.optimiser.state()  # raises PathreplayError if the state of the user's optimizer cannot be saved
            if resume and resumed is None:
                remove_empty_folder(output)
            job = Job(built.config, None, problem.base, in_python=in_python)
            changed = opened is not None and _settings(opened.config) != _settings(built.config)
            if opened is not None and not changed:
                job = replace(opened, config=built.config)
            kept = FolderRun(job, built, run, stop, new_output(output, None), Path.cwd(), resumed)
            stack.callback(kept.folder.lock.close)
            if changed:
                record_job(kept.folder, job)
        say, remedy = bar.say if progress else _warn, "aborted" if kept is None else kept.remedy
        stack.enter_context(stopping(say, remedy, stop))
        observers = [bar.observe, *_observers(bar, built, run, stop, kept)]
        # Change the thread pool once, see `jobs.optimize`. Callbacks may read files, which needs two threads.
        with one_thread(built.config.deterministic and not callbacks):
            for about in stack.enter_context(closing(iterations(built, run, stop, observers, kept))):
                if any([_is_true(callback(about)) for callback in callbacks]):
                    stop.by = stop.by or "a callback"
        if kept is not None:
            bar.say("writing")
            found = kept.finish().parameters
        with built.computing():
            if kept is None:
                found = with_scene(built, ended(built, run).values)
            put_values(built, {v.key: found[v.key] for v in built.variables})
    folder = None if kept is None else kept.folder.path
    stopped = run.optimiser.finished or (stop.by if len(run.history) < built.config.iterations else None)
    return Result(found, run.history, stopped, problem, folder)


def _settings(config: Config) -> Json:
    """Return the settings of a run that a resume records, which are all except where it is computed."""
    return config.model_dump(mode="json", exclude={"variant", "executor"})


def _is_true(value: object) -> bool:
    """Return whether a callback's result is True. Comparisons of arrays are booleans of NumPy."""
    return isinstance(value, (bool, np.bool_)) and bool(value)


def _observers(
    bar: Progress | NotebookPanel, built: inner.Problem, run: Run, stop: Stop, kept: FolderRun | None
) -> list[Callable[[Event], None]]:
    """Return the functions that receive the events of the run, besides the progress display.

    With a run folder, the writer of the folder receives the events. Without a run folder, a notebook gets an observer
    that renders images.
    """
    if kept is not None:
        if isinstance(bar, NotebookPanel):
            bar.follow(kept.previews.pictures, str(kept.folder.name))
        return [kept.observe]
    if not isinstance(bar, NotebookPanel):
        return []
    with built.computing():
        pictures = LivePictures(built, run, stop)
    bar.follow(pictures, "minimize")
    return [pictures.observe]
