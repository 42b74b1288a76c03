"""One optimisation job from config to report: the function behind ``pathreplay optimize``."""

from __future__ import annotations

import gc
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from pathreplay import backend
from pathreplay.errors import PathreplayError
from pathreplay.interrupts import undisturbed
from pathreplay.inverse.checkpoint import Run
from pathreplay.inverse.config import Config, load_config
from pathreplay.inverse.images import Image
from pathreplay.inverse.limits import require_finite_loss
from pathreplay.inverse.loop import iterate, new_run, render_views
from pathreplay.inverse.outcome import resume_command
from pathreplay.inverse.problem import Problem, build_problem
from pathreplay.inverse.progress import Progress
from pathreplay.inverse.result import RunResult, outcome_of, result_files, result_of
from pathreplay.inverse.run_folder import RunFolder, create_run_folder, default_output, open_run_folder, require_output
from pathreplay.inverse.saving import Saving, first_files, go_on, saved_targets
from pathreplay.inverse.stopping import Stop, stopping
from pathreplay.scenes.descriptions import told
from pathreplay.threads import one_thread, require_one_thread_possible


def optimize(
    config: str | Path | Config | None = None,
    *,
    resume: str | Path | None = None,
    output: str | Path | None = None,
    progress: bool = True,
) -> RunResult:
    """Recover the parameters that a job names, and write its run folder.

    Args:
        config: path of a TOML file, or a Config (relative paths in it start at the current folder).
        resume: run folder of an earlier, unfinished run, to go on with; excludes ``config`` and ``output``.
        output: run folder to make; the default is the config's ``output``, else ``runs/<name of the config>``. Where it
            exists, a number is appended: an earlier run is never touched.
        progress: draw a progress bar on stderr (lines, now and then, where that is no terminal).

    The first Ctrl-C, SIGTERM or SIGHUP ends the run after the current iteration with everything written; a Ctrl-C after
    that aborts (KeyboardInterrupt). Until the run folder is there, signals do what they did before. With
    ``deterministic`` all that is computed is computed by one thread, whatever was set; that comes back afterwards.

    Raises:
        PathreplayError: anything in the job that cannot work, told before the first iteration; a full disk; a run
            folder that is in use, damaged, or vanishes.
    """
    try:
        return _run(config, resume, output, progress)
    finally:
        # Python finds the scene only by its collector, and Dr.Jit traces calls through every scene that is alive.
        gc.collect()


def _run(
    config: str | Path | Config | None, resume: str | Path | None, output: str | Path | None, progress: bool
) -> RunResult:
    with ExitStack() as stack:
        start = _resumed(resume, config, output) if resume is not None else _fresh(config, output)
        if start.folder is not None:
            stack.callback(start.folder.close)
        with undisturbed():
            backend.set_variant(start.config.variant)
        if start.config.deterministic:
            require_one_thread_possible()
        bar = stack.enter_context(Progress(progress))
        bar.say("preparing")
        targets = None if start.folder is None else saved_targets(start.folder.path)
        problem = build_problem(start.config, start.base, targets)
        for note in problem.notes:
            bar.note(note)
        record = not start.config.deterministic
        run = new_run(problem, problem.integrator, record)
        if problem.rival is not None:
            run.rival = new_run(problem, problem.rival, record)
        before, folder = (
            _begun(start, problem, run) if start.folder is None else _went_on(start, start.folder, problem, run)
        )
        stack.callback(folder.close)
        way_out = f"aborted; go on from the last checkpoint with: {resume_command(folder.path)}"
        stop = stack.enter_context(stopping(bar.say, way_out))
        _iterate(start, folder, problem, run, stop, bar)
        bar.say("writing")
        with one_thread(start.config.deterministic), told(_failing(start.config)):
            after = render_views(problem, start.config, run.values)
            theirs = render_views(problem, start.config, run.rival.values) if run.rival else {}
        outcome = outcome_of(start.config, start.source, folder.path, problem, run, before, after, theirs)
        folder.write(result_files(outcome))
        return result_of(outcome, stop.by())


def _begun(start: _Start, problem: Problem, run: Run) -> tuple[dict[str, Image], RunFolder]:
    """The pictures of a run at its start, and a new folder for it."""
    with one_thread(start.config.deterministic), told(_failing(start.config)):
        before = render_views(problem, start.config, run.values)
    for view in problem.views:
        require_finite_loss(problem.loss, view.name, view.target, before[view.name])
    files = first_files(problem, before, run)
    return before, create_run_folder(start.output, start.config, start.source, start.base, files)


def _went_on(start: _Start, folder: RunFolder, problem: Problem, run: Run) -> tuple[dict[str, Image], RunFolder]:
    before = go_on(folder.path, problem, run)
    # All iterations but no report: the disk was full at the end. Then only the end is done again.
    if len(run.history) >= start.config.iterations and (folder.path / "report.html").exists():
        raise PathreplayError(
            f"Run {folder.path} has all its {len(run.history)} iterations; raise 'iterations' in its config"
        )
    return before, folder


def _iterate(start: _Start, folder: RunFolder, problem: Problem, run: Run, stop: Stop, bar: Progress) -> None:
    """Do the iterations that are left, with a checkpoint now and then and one at the end.

    A new folder goes again where not even the first iteration can be done; one that is resumed never does.
    """
    config = start.config
    saving = Saving(folder, run, config.checkpoint_every)
    try:
        with one_thread(config.deterministic), told(_failing(config)):
            iterate(problem, config, run, stop, (bar, saving))
    except PathreplayError:
        if start.folder is None and not run.history and not stop.aborted:
            folder.remove()
        raise


def _failing(config: Config) -> str:
    names = config.integrator.type if config.rival is None else f"{config.integrator.type}' or '{config.rival.type}"
    return f"Integrator '{names}' cannot do this job"


@dataclass(frozen=True)
class _Start:
    config: Config
    source: Path | None
    base: Path
    output: Path
    folder: RunFolder | None
    """That is gone on with."""


def _fresh(config: str | Path | Config | None, output: str | Path | None) -> _Start:
    if config is None:
        raise PathreplayError("Nothing to do: give a config file, or --resume RUN_FOLDER")
    if not isinstance(config, (str, Path, Config)):
        raise PathreplayError(
            f"config is a {type(config).__name__}; give the path of a TOML file, or make_config of a dictionary"
        )
    source = None if isinstance(config, Config) else Path(config)
    job = config if isinstance(config, Config) else load_config(Path(config))
    base = Path.cwd() if source is None else source.parent
    wanted = job.output if output is None else output
    return _Start(job, source, base, default_output(source) if wanted is None else require_output(wanted), None)


def _resumed(resume: str | Path, config: object, output: object) -> _Start:
    if config is not None or output is not None:
        raise PathreplayError("--resume takes config and output from the run folder; leave CONFIG and --output out")
    folder, job, source = open_run_folder(Path(resume))
    return _Start(job, None if source is None else Path(source), folder.origin, folder.path, folder)
