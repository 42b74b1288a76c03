"""A run, iteration by iteration: what a loop over it gives, and how it ends, whoever ends it."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType

import mitsuba as mi

from pathreplay.distributed.ray_executor import RayExecutor, WorkerPool, crew_of, require_executor
from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.schema import Config, Plugin
from pathreplay.inverse.images.io import Image
from pathreplay.inverse.loop.checkpoint import Entry, Run
from pathreplay.inverse.loop.events import Stepped
from pathreplay.inverse.loop.loop import best_values, computed, new_run, picture_of, render_views, with_exposures
from pathreplay.inverse.loop.verdict import verdict_of
from pathreplay.inverse.objective.evaluate import computing
from pathreplay.inverse.objective.reached import require_reached
from pathreplay.inverse.objective.stages import Staged, require_single_pixels, require_stages
from pathreplay.inverse.parameters.values import Array
from pathreplay.inverse.problem.feasibility import require_finite_loss
from pathreplay.inverse.problem.problem import Problem, build_problem
from pathreplay.platform import backend, memory
from pathreplay.platform.device import require_order
from pathreplay.platform.interrupts import Stop, stopping, undisturbed
from pathreplay.report.live_page import Previews
from pathreplay.report.notebook import NotebookPanel, in_notebook
from pathreplay.report.outcome import resume_command
from pathreplay.report.progress import Progress
from pathreplay.report.result import RunResult, outcome_of, result_files, result_of
from pathreplay.runs.run_folder import Job, RunFolder, create_run_folder
from pathreplay.runs.saving import Saving, first_files, go_on, saved_targets


@dataclass(frozen=True)
class State:
    """A run after an iteration. Nothing in it changes when the run goes on."""

    entry: Entry
    """What the history says of the iteration."""
    values: Mapping[str, Array]
    """Of the variables after the step, by key, as people see them; of poses ``KEY:translation``, ``KEY:rotation``."""
    views: tuple[str, ...]
    folder: Path
    _rendered: Callable[[Mapping[str, Array], str], Image] = field(repr=False)

    @property
    def iteration(self) -> int:
        """From 0."""
        return self.entry.iteration

    @property
    def loss(self) -> float:
        """Before the step."""
        return self.entry.loss

    @property
    def gradient_norms(self) -> Mapping[str, float]:
        """L2 norms of the gradients that were stepped by, by key."""
        return self.entry.gradient_norms

    @property
    def errors(self) -> Mapping[str, float]:
        """Root mean square errors after the step, where the truth is known."""
        return self.entry.errors

    def render(self, view: str | None = None) -> Image:
        """A rendering of a view (default: the first) with these values: linear, height x width x channels.

        It has ``eval_spp`` samples per pixel. Takes time, and changes nothing of what comes after. Raises
        PathreplayError where there is no such view.
        """
        name = self.views[0] if view is None else view
        if name not in self.views:
            raise PathreplayError(f"No view {name!r}; there are {', '.join(self.views)}")
        return self._rendered(self.values, name)


class Optimization:
    """A run under way, to be looped over: each iteration gives its `State`.

    The scene is loaded when the first one is asked for, and all is written when the loop has come to its end, which
    makes ``result``. Who leaves the loop before leaves a checkpoint to go on from; so does `close`, which is also the
    end of a ``with``. `stop` ends the run here, with everything written. While it runs, signals ask it to end: see
    `pathreplay.optimize`.
    """

    def __init__(self, job: Job, output: Path, resumed: RunFolder | None, progress: bool) -> None:
        self._stop = Stop()
        self._states = _states(job, output, Path.cwd(), resumed, progress, self._stop)
        self._resumed = resumed
        self.result: RunResult | None = None

    def __iter__(self) -> Iterator[State]:
        return self

    def __next__(self) -> State:
        self._resumed = None  # the generator lets go of it
        try:
            return next(self._states)
        except StopIteration as end:
            self.result = end.value or self.result
            raise

    def __enter__(self) -> Optimization:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """End it here with a checkpoint only."""
        self._states.close()
        if self._resumed is not None:  # which nobody has begun to go on with
            self._resumed.lock.close()

    def stop(self) -> RunResult:
        """End it here (after one iteration, if there was none) with everything written.

        Raises PathreplayError as the loop does, and where the run was closed before.
        """
        self._stop.by = self._stop.by or "stop()"
        for _ in self:
            pass
        if self.result is None:
            raise PathreplayError("The optimization was closed; go on with its run folder: iterate(resume=...)")
        return self.result


def _states(
    job: Job, output: Path, home: Path, resumed: RunFolder | None, progress: bool, stop: Stop
) -> Generator[State, None, RunResult]:
    """The states of a run; returns what it came to. A relative ``output`` starts at ``home``."""
    config = job.config
    with ExitStack() as stack:
        if resumed is not None:
            stack.callback(resumed.lock.close)
        stack.enter_context(memory.within(config.budget))
        require_executor(config)
        _set_variant(config)
        bar = _progress(progress)
        stack.enter_context(bar)
        bar.say("preparing")
        problem = build_problem(config, job.base, None if resumed is None else saved_targets(resumed.path))
        config = problem.config
        job = replace(job, config=config)
        require_stages(problem, config)
        require_single_pixels(problem, config)
        with computing(config):
            require_reached(problem, config)
        for note in problem.notes:
            bar.note(note)
        pool = stack.enter_context(crew_of(config, job.base, problem, bar.remark, bar.status))
        run = _run(problem, config, problem.integrator, config.integrator, pool)
        if problem.baseline is not None and config.baseline is not None:
            run.baseline = _run(problem, config, problem.baseline, config.baseline, pool, baseline=True)
        if resumed is None:
            folder, before = _begun(output, home, job, problem, run)
            stack.callback(folder.lock.close)
        else:
            folder, before = resumed, _went_on(resumed, config, problem, run)
        way_out = f"aborted; go on from the last checkpoint with: {resume_command(folder.name)}"
        stack.enter_context(stopping(bar.say, way_out, stop))
        saving = Saving(folder, run, config.checkpoint_every)
        previews = Previews(folder, config, problem, run, before, stop)
        if isinstance(bar, NotebookPanel):
            bar.follow(previews)
        look = _looker(problem, config)
        try:
            for event in computed(problem, config, run, stop):
                bar.observe(event)
                saving.observe(event)
                with computing(config):
                    previews.observe(event)
                problem.album.rest()
                if isinstance(event, Stepped):
                    views = tuple(view.name for view in problem.views)
                    yield State(event.entry, best_values(problem, run), views, folder.path, look)
        except GeneratorExit:
            saving.close()
            raise
        except PathreplayError as error:
            # A new folder goes again where not even the first iteration can be done; one that is resumed never does.
            if resumed is None and not run.history and not stop.aborted:
                folder.remove()
            elif saving.rescued() and not stop.aborted:
                way_out = f"what was done is saved, go on with: {resume_command(folder.name)}"
                raise PathreplayError(f"{error}; {way_out}") from error
            raise
        bar.say("writing")
        run = replace(run, values=best_values(problem, run))
        with computing(config):
            for each in filter(None, (run, run.baseline)):
                each.values = dict(with_exposures(problem, config, each.values))
            verdict = verdict_of(problem, run, stop.by is not None)
            after = render_views(problem, config, run.values)
            theirs = render_views(problem, config, run.baseline.values) if run.baseline else {}
        outcome = outcome_of(job, folder.name, problem, run, before, after, theirs, verdict)
        files = result_files(outcome, previews.finished(after))
        problem.album.rest()
        folder.write(files)
        return result_of(outcome, stop.by)


def _progress(shown: bool) -> Progress | NotebookPanel:
    """What tells the user how it goes, where they are."""
    return NotebookPanel() if shown and in_notebook() else Progress(shown)


def _run(
    problem: Problem,
    config: Config,
    integrator: mi.Integrator,
    plugin: Plugin,
    pool: WorkerPool | None,
    baseline: bool = False,
) -> Run:
    """A run that begins, by an integrator, which is made of that plugin; in this process, if there is no crew."""
    record = not config.deterministic
    if pool is not None:
        executor = RayExecutor(pool, [view.name for view in problem.views], baseline)
        return new_run(problem, integrator, record, config.optimizer, executor=executor)
    staged = None if config.stages is None else Staged(problem, config, integrator, plugin, record)
    return new_run(problem, integrator, record, config.optimizer, staged)


def _looker(problem: Problem, config: Config) -> Callable[[Mapping[str, Array], str], Image]:
    def look(values: Mapping[str, Array], view: str) -> Image:
        with computing(config):
            return picture_of(problem, config, values, next(v for v in problem.views if v.name == view))

    return look


def _set_variant(config: Config) -> None:
    with undisturbed():
        variant = backend.set_variant(config.variant)
    if config.deterministic:
        require_order(variant)


def _begun(output: Path, home: Path, job: Job, problem: Problem, run: Run) -> tuple[RunFolder, dict[str, Image]]:
    """A new folder for a run, and the pictures of its start."""
    with computing(job.config):
        before = render_views(problem, job.config, run.values)
    for view in problem.views:
        require_finite_loss(problem.loss, view.name, view.target, view.weight, before[view.name])
    return create_run_folder(output, job, first_files(problem, before, run), home), before


def _went_on(folder: RunFolder, config: Config, problem: Problem, run: Run) -> dict[str, Image]:
    held = {v.key for v in problem.variables} if config.stages else set()  # some of them, in some stages
    before = go_on(folder.path, problem, run, held)
    # All iterations but no report: the disk was full at the end. Then only the end is done again.
    if not (folder.path / "report.html").exists():
        return before
    if run.optimiser.finished:
        raise PathreplayError(
            f"Run {folder.name} has ended by itself ({run.optimiser.finished}); lower 'tolerance' in its config"
        )
    if len(run.history) >= config.iterations:
        raise PathreplayError(
            f"Run {folder.name} has all its {len(run.history)} iterations; raise 'iterations' in its config"
        )
    return before
