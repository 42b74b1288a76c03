"""A running job as an iterator that can be stopped or closed."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import TracebackType

from pathreplay.distributed.ray_executor import crew_of, require_executor
from pathreplay.errors import PathreplayError
from pathreplay.inverse.objective.reached import require_possible
from pathreplay.inverse.problem.problem import build_problem
from pathreplay.library.folder_run import FolderRun
from pathreplay.library.iterations import Iteration, iterations, run_of
from pathreplay.platform import backend, memory
from pathreplay.platform.device import require_order
from pathreplay.platform.interrupts import Stop, stopping, undisturbed
from pathreplay.report.notebook import NotebookPanel, progress_of
from pathreplay.report.result import RunResult
from pathreplay.runs.run_folder import Job, RunFolder, require_creatable
from pathreplay.runs.saving import saved_targets


class Optimization:
    """A running job: iterating over it yields an `Iteration` after each step.

    The scene is loaded when the first iteration is requested. At the end of the loop, all results are written and
    ``result`` is set. `stop` ends the run early and also writes all results. `close` ends the run and writes a
    checkpoint to resume from, but no results. Leaving a ``with`` block calls `close`. If the object is deleted, for
    example after a loop that was left early, the run also ends with a checkpoint. `pathreplay.optimize` describes the
    effect of signals.
    """

    def __init__(self, job: Job, output: Path, resumed: RunFolder | None, progress: bool) -> None:
        self._stop = Stop()
        self._iterations = _iterations(job, output, Path.cwd(), resumed, progress, self._stop)
        self._resumed = resumed
        self.deterministic = job.config.deterministic
        self.result: RunResult | None = None

    def __iter__(self) -> Iterator[Iteration]:
        return self

    def __next__(self) -> Iteration:
        self._resumed = None  # from now on, the generator releases the lock of the resumed folder
        try:
            return next(self._iterations)
        except StopIteration as end:
            self.result = end.value or self.result
            raise

    def __enter__(self) -> Optimization:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """End the run with a checkpoint, but without results."""
        self._iterations.close()
        if self._resumed is not None:  # the generator has not started
            self._resumed.lock.close()

    def stop(self) -> RunResult:
        """End the run after at least one iteration, and write all results.

        Raises the same errors as the loop, and PathreplayError if the run was closed before.
        """
        self._stop.by = self._stop.by or "stop()"
        for _ in self:
            pass
        if self.result is None:
            raise PathreplayError("The optimization was closed; resume it from its run folder: iterate(resume=...)")
        return self.result


def _iterations(
    job: Job, output: Path, home: Path, resumed: RunFolder | None, progress: bool, stop: Stop
) -> Generator[Iteration, None, RunResult]:
    """Run a job: yield its iterations and return the result. A relative ``output`` refers to ``home``."""
    config = job.config
    with ExitStack() as stack:
        if resumed is None:
            require_creatable(output, home, job.source)
        else:
            stack.callback(resumed.lock.close)
        stack.enter_context(memory.within(config.budget))
        require_executor(config)
        with undisturbed():
            variant = backend.set_variant(config.variant)
        if config.deterministic:
            require_order(variant)
        if config.variant is None and variant != backend.default_variant():
            # The command line would resume and export the run in the default variant.
            config = config.model_copy(update={"variant": variant})
            job = replace(job, config=config, content=None)
        bar = progress_of(progress)
        stack.enter_context(bar)
        bar.say("preparing")
        problem = build_problem(config, job.base, None if resumed is None else saved_targets(resumed.path))
        require_possible(problem)
        for note in problem.notes:
            bar.note(note)
        pool = stack.enter_context(crew_of(problem.config, job.base, problem, bar.remark, bar.status))
        run = run_of(problem, pool)
        kept = FolderRun(replace(job, config=problem.config), problem, run, stop, output, home, resumed)
        stack.callback(kept.folder.lock.close)
        stack.enter_context(stopping(bar.say, kept.remedy, stop))
        if isinstance(bar, NotebookPanel):
            bar.follow(kept.previews.pictures, str(kept.folder.name))
        yield from iterations(problem, run, stop, (bar.observe, kept.observe), kept)
        bar.say("writing")
        return kept.finish()
