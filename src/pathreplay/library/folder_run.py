"""Writes the folder of a run: checkpoints and the live page during the run, and the report at its end."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pathreplay.errors import PathreplayError
from pathreplay.inverse.images.io import Image, alike
from pathreplay.inverse.loop.checkpoint import Run
from pathreplay.inverse.loop.events import Event
from pathreplay.inverse.loop.loop import ended, render_views
from pathreplay.inverse.loop.verdict import verdict_of
from pathreplay.inverse.problem.feasibility import require_finite_loss
from pathreplay.inverse.problem.problem import Problem
from pathreplay.platform.interrupts import Stop
from pathreplay.report.live_page import Previews
from pathreplay.report.result import RunResult, has_results, outcome_of, result_files, result_of
from pathreplay.runs.run_folder import Job, RunFolder, create_run_folder
from pathreplay.runs.saving import Saving, first_files, go_on, saved_targets


class FolderRun:
    """Writes a run folder; ``observe`` receives all events of the run.

    Args:
        job: the job, with the config of the problem.
        problem: the problem.
        run: the run before its first iteration. If a folder is resumed, the run is restored from its checkpoint.
        stop: request to stop the run, which the stop button of the live page sets.
        output: the new folder; a number is appended if it exists.
        home: folder to which a relative ``output`` refers.
        resumed: the folder to resume; None creates a new folder.

    Raises:
        PathreplayError: the folder cannot be created or is damaged, the run has ended, or the initial loss is not
            finite.
    """

    def __init__(
        self, job: Job, problem: Problem, run: Run, stop: Stop, output: Path, home: Path, resumed: RunFolder | None
    ) -> None:
        self._job, self._problem, self._run, self._stop, self._is_new = job, problem, run, stop, resumed is None
        if resumed is None:
            self.folder, self._before = _begun(output, home, job, problem, run)
        else:
            self.folder, self._before = resumed, _went_on(resumed, problem, run)
        self._saving = Saving(self.folder, run, problem.config.checkpoint_every)
        self.previews = Previews(self.folder, problem.config, problem, run, self._before, stop)

    @property
    def remedy(self) -> str:
        """Return the message for an aborted run, with the command that resumes it."""
        return f"aborted; resume from the last checkpoint with: {self.folder.resume_command()}"

    def observe(self, event: Event) -> None:
        """Write the checkpoint, page and previews that are due after an event.

        Raises PathreplayError if the folder has disappeared or cannot be written.
        """
        self._saving.observe(event)
        with self._problem.computing():
            self.previews.observe(event)

    @contextmanager
    def kept(self) -> Iterator[None]:
        """Save a checkpoint if the iterations in this block end early, by an error or because the generator is closed.

        A new folder is removed if the first iteration fails. A resumed folder is never removed.
        """
        try:
            yield
        except GeneratorExit:
            self._saving.close()
            raise
        except PathreplayError as error:
            if self._is_new and not self._run.history and not self._stop.aborted:
                self.folder.remove()
            elif self._saving.rescued() and not self._stop.aborted:
                remedy = f"all completed iterations are saved, resume with: {self.folder.resume_command()}"
                raise PathreplayError(f"{error}; {remedy}") from error
            raise

    def finish(self) -> RunResult:
        """Write values, images and report at the end of the run. Raises the same errors as `observe`."""
        problem = self._problem
        with problem.computing():
            run = ended(problem, self._run)
            verdict = verdict_of(problem, run, self._stop.by is not None)
            after = render_views(problem, run.values)
            theirs = render_views(problem, run.baseline.values) if run.baseline else {}
        outcome = outcome_of(self._job, self.folder.name, problem, run, self._before, after, theirs, verdict)
        files = result_files(outcome, self.previews.finished(after))
        problem.disk.rest()
        self.folder.write(files)
        return result_of(outcome, self._stop.by)


def with_saved_targets(folder: Path, problem: Problem) -> Problem:
    """Return a problem with the targets and weights of the run in a folder, so that the resumed run continues exactly.

    Targets that were rendered again by several threads differ in the last bits, because the order of sums varies.

    Raises:
        PathreplayError: the targets or weights of the problem differ from those of the run by more than rounding.
    """
    saved = saved_targets(folder)
    for view in problem.views:
        pairs = (saved.images.get(view.name), view.target), (saved.weights.get(view.name), view.weight)
        if not all(alike(*pair) for pair in pairs):
            raise PathreplayError(
                f"Run {folder} has another target or weight of view '{view.name}' than the problem; use the original "
                "targets, or start a new run"
            )
    return problem.with_targets(saved)


def _begun(output: Path, home: Path, job: Job, problem: Problem, run: Run) -> tuple[RunFolder, dict[str, Image]]:
    """Create the folder of a run. Returns the folder and the images at the initial values by view name."""
    with problem.computing():
        before = render_views(problem, run.values)
    for view in problem.views:
        require_finite_loss(problem.loss, view.name, view.target, view.weight, before[view.name])
    return create_run_folder(output, job, first_files(problem, before, run), home), before


def _went_on(folder: RunFolder, problem: Problem, run: Run) -> dict[str, Image]:
    config = problem.config
    held = {v.key for v in problem.variables} if config.stages else set()  # a stage may have frozen any variable
    before = go_on(folder.path, problem, run, held)
    # A run that has taken all its iterations can still lack its results, for example because the disk was full. It is
    # resumed only to write them.
    if not has_results(folder.path, len(run.history)):
        return before
    name = f"Run {folder.name}"
    if run.optimiser.finished:
        remedy = "lower the optimizer's tolerance"
        if not folder.in_python:
            remedy = "lower 'tolerance' in its config (Python: that of the optimizer)"
        raise PathreplayError(f"{name} has terminated ({run.optimiser.finished}); {remedy}")
    if len(run.history) >= config.iterations:
        remedy = "raise 'steps'" if folder.in_python else "raise 'iterations' in its config (Python: 'steps')"
        raise PathreplayError(f"{name} has all its {len(run.history)} iterations; {remedy}")
    return before
