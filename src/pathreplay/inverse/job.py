"""One optimisation job from config to report: the function behind ``pathreplay optimize``."""

from __future__ import annotations

import gc
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from pathreplay import backend
from pathreplay.errors import PathreplayError
from pathreplay.interrupts import stopping, undisturbed
from pathreplay.inverse.checkpoint import Run
from pathreplay.inverse.config import Config, load_config
from pathreplay.inverse.images import Image
from pathreplay.inverse.limits import require_finite_loss
from pathreplay.inverse.loop import iterate, new_run, render_views, with_exposures
from pathreplay.inverse.outcome import resume_command
from pathreplay.inverse.problem import Problem, build_problem
from pathreplay.inverse.progress import Progress
from pathreplay.inverse.result import RunResult, outcome_of, result_files, result_of
from pathreplay.inverse.run_folder import Job, RunFolder, create_run_folder, new_output, open_run_folder
from pathreplay.inverse.saving import Saving, first_files, go_on, saved_targets
from pathreplay.scenes.descriptions import told
from pathreplay.threads import one_thread


def optimize(
    config: str | Path | Config | None = None,
    *,
    resume: str | Path | None = None,
    output: str | Path | None = None,
    progress: bool = True,
    define: Sequence[str] = (),
) -> RunResult:
    """Recover the parameters that a job names, and write its run folder.

    Args:
        config: path of a TOML file, or a Config (relative paths in it start at the current folder).
        resume: run folder of an earlier, unfinished run, to go on with; excludes ``config`` and ``output``.
        output: run folder to make; the default is the config's ``output``, else ``runs/<name of the config>``. Where it
            exists, a number is appended: an earlier run is never touched.
        progress: draw a progress bar on stderr (lines, now and then, where that is no terminal).
        define: changes of what the file says, each ``KEY=VALUE`` (see docs/optimize.md).

    The first Ctrl-C, SIGTERM or SIGHUP ends the run after the current iteration with everything written; a Ctrl-C after
    that aborts (KeyboardInterrupt). Until the run folder is there, signals do what they did before. With
    ``deterministic`` all that is computed is computed by one thread, whatever was set; that comes back afterwards.

    Raises:
        PathreplayError: anything in the job that cannot work, told before the first iteration; a full disk; a run
            folder that is in use, damaged, or vanishes.
    """
    try:
        return _run(*_started(config, resume, output, tuple(define)), progress)
    finally:
        # Python finds the scene only by its collector, and Dr.Jit traces calls through every scene that is alive.
        gc.collect()


def _run(job: Job, output: Path, resumed: RunFolder | None, progress: bool) -> RunResult:
    config = job.config
    with ExitStack() as stack:
        if resumed is not None:
            stack.callback(resumed.lock.close)
        with undisturbed():
            variant = backend.set_variant(config.variant)
        if config.deterministic and not variant.startswith("llvm"):
            raise PathreplayError(
                f"deterministic = true needs an LLVM variant, this is '{variant}': on a GPU the order of additions "
                "is random; set variant = 'llvm_ad_rgb', or leave 'deterministic' out"
            )
        bar = stack.enter_context(Progress(progress))
        bar.say("preparing")
        problem = build_problem(config, job.base, None if resumed is None else saved_targets(resumed.path))
        for note in problem.notes:
            bar.note(note)
        run = new_run(problem, problem.integrator, not config.deterministic, config.optimizer)
        if problem.rival is not None:
            run.rival = new_run(problem, problem.rival, not config.deterministic, config.optimizer)
        if resumed is None:
            folder, before = _begun(output, job, problem, run)
            stack.callback(folder.lock.close)
        else:
            folder, before = resumed, _went_on(resumed, config, problem, run)
        way_out = f"aborted; go on from the last checkpoint with: {resume_command(folder.path)}"
        stop = stack.enter_context(stopping(bar.say, way_out))
        saving = Saving(folder, run, config.checkpoint_every)
        try:
            with _computing(config):
                for event in iterate(problem, config, run, stop):
                    bar.observe(event)
                    saving.observe(event)
        except PathreplayError:
            # A new folder goes again where not even the first iteration can be done; one that is resumed never does.
            if resumed is None and not run.history and not stop.aborted:
                folder.remove()
            raise
        bar.say("writing")
        with _computing(config):
            for each in filter(None, (run, run.rival)):
                each.values = dict(with_exposures(problem, config, each.values))
            after = render_views(problem, config, run.values)
            theirs = render_views(problem, config, run.rival.values) if run.rival else {}
        outcome = outcome_of(job, folder.path, problem, run, before, after, theirs)
        folder.write(result_files(outcome))
        return result_of(outcome, stop.by)


@contextmanager
def _computing(config: Config) -> Iterator[None]:
    """Around what the job's integrators do: in one thread if that is wanted, and their errors told."""
    names = config.integrator.type if config.rival is None else f"{config.integrator.type}' or '{config.rival.type}"
    with one_thread(config.deterministic), told(f"Integrator '{names}' cannot do this job"):
        yield


def _begun(output: Path, job: Job, problem: Problem, run: Run) -> tuple[RunFolder, dict[str, Image]]:
    """A new folder for a run, and the pictures of its start."""
    with _computing(job.config):
        before = render_views(problem, job.config, run.values)
    for view in problem.views:
        require_finite_loss(problem.loss, view.name, view.target, view.weight, before[view.name])
    return create_run_folder(output, job, first_files(problem, before, run)), before


def _went_on(folder: RunFolder, config: Config, problem: Problem, run: Run) -> dict[str, Image]:
    before = go_on(folder.path, problem, run)
    # All iterations but no report: the disk was full at the end. Then only the end is done again.
    if len(run.history) >= config.iterations and (folder.path / "report.html").exists():
        raise PathreplayError(
            f"Run {folder.path} has all its {len(run.history)} iterations; raise 'iterations' in its config"
        )
    return before


def _started(
    config: str | Path | Config | None, resume: str | Path | None, output: str | Path | None, changes: tuple[str, ...]
) -> tuple[Job, Path, RunFolder | None]:
    """The job, where its run folder shall be, and the one that is gone on with."""
    if resume is not None:
        if config is not None or output is not None or changes:
            raise PathreplayError(
                "--resume takes config and output from the run folder; leave CONFIG, --output and -D out"
            )
        job, folder = open_run_folder(Path(resume))
        return job, folder.path, folder
    if config is None:
        raise PathreplayError("Nothing to do: give a config file, or --resume RUN_FOLDER")
    if not isinstance(config, (str, Path, Config)):
        raise PathreplayError(
            f"config is a {type(config).__name__}; give the path of a TOML file, or make_config of a dictionary"
        )
    if isinstance(config, Config):
        if changes:
            raise PathreplayError("define changes what a file says; give make_config the values that you want")
        job = Job(config, None, Path.cwd())
    else:
        job = Job(load_config(Path(config), changes), Path(config), Path(config).parent, changes)
    return job, new_output(job.config.output if output is None else output, job.source), None
