"""One optimisation job, as the command ``pathreplay optimize`` and Python start it: whole, or by its iterations."""

from __future__ import annotations

import gc
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import get_args

from pathreplay.errors import PathreplayError, shown
from pathreplay.inverse.config.executor_options import ExecutorName
from pathreplay.inverse.config.schema import Config, load_config
from pathreplay.jobs.session import Optimization
from pathreplay.report.result import RunResult
from pathreplay.runs.run_folder import Job, RunFolder, new_output, open_run_folder


def optimize(
    config: str | Path | Config | None = None,
    *,
    resume: str | Path | None = None,
    output: str | Path | None = None,
    progress: bool = True,
    define: Sequence[str] = (),
    executor: str | None = None,
) -> RunResult:
    """Recover the parameters that a job names, and write its run folder.

    Args:
        config: path of a TOML or YAML file, or a Config (relative paths in it start at the current folder).
        resume: run folder of an earlier, unfinished run, to go on with; excludes ``config`` and ``output``.
        output: run folder to make; the default is the config's ``output``, else ``runs/<name of the config>``. Where it
            exists, a number is appended: an earlier run is never touched.
        progress: draw a progress bar on stderr (lines, now and then, where that is no terminal), or in a notebook.
        define: changes of what the file says, each ``KEY=VALUE`` (see docs/optimize.md).
        executor: who computes, ``local`` or ``ray``, whatever the config says, also where a run is gone on with.

    The first Ctrl-C, SIGTERM or SIGHUP ends the run after the current iteration with everything written; a Ctrl-C after
    that aborts (KeyboardInterrupt). Until the run folder is there, signals do what they did before. With
    ``deterministic`` all that is computed is computed by one thread, whatever was set; that comes back afterwards.

    Raises:
        PathreplayError: anything in the job that cannot work, told before the first iteration; a full disk; a run
            folder that is in use, damaged, or vanishes.
    """
    try:
        with iterate(
            config, resume=resume, output=output, progress=progress, define=define, executor=executor
        ) as session:
            for _ in session:
                pass
            return session.stop()
    finally:
        # Python finds the scene only by its collector, and Dr.Jit traces calls through every scene that is alive.
        gc.collect()


def iterate(
    config: str | Path | Config | None = None,
    *,
    resume: str | Path | None = None,
    output: str | Path | None = None,
    progress: bool = False,
    define: Sequence[str] = (),
    executor: str | None = None,
) -> Optimization:
    """Optimise a job iteration by iteration: a loop over it gives a `State` after each.

    Arguments, signals and errors are those of `optimize`; the config is checked now, the rest when the first state is
    asked for. See `Optimization` for how it ends.
    """
    if executor is not None and executor not in get_args(ExecutorName):
        raise PathreplayError(f"executor is {shown(executor)}; give one of {', '.join(get_args(ExecutorName))}")
    job, path, resumed = _started(config, resume, output, tuple(define))
    if executor is not None:
        job = replace(job, config=job.config.model_copy(update={"executor": executor}))
    return Optimization(job, path, resumed, progress)


def _started(
    config: str | Path | Config | None, resume: str | Path | None, output: str | Path | None, changes: tuple[str, ...]
) -> tuple[Job, Path, RunFolder | None]:
    """The job, where its run folder shall be, and the one that is gone on with."""
    if resume is not None:
        if config is not None or output is not None or changes:
            raise PathreplayError(
                "--resume takes config and output from the run folder; leave CONFIG, --output and --set out"
            )
        job, folder = open_run_folder(Path(resume))
        return job, folder.given, folder
    if config is None:
        raise PathreplayError("Nothing to do: give a config file, or --resume RUN_FOLDER")
    if not isinstance(config, (str, Path, Config)):
        raise PathreplayError(
            f"config is a {type(config).__name__}; give the path of a TOML or YAML file, or make_config of a dictionary"
        )
    if isinstance(config, Config):
        if changes:
            raise PathreplayError("define changes what a file says; give make_config the values that you want")
        job = Job(config, None, Path.cwd())
    else:
        job = Job(load_config(Path(config), changes), Path(config), Path(config).parent.absolute(), changes)
    return job, new_output(job.config.output if output is None else output, job.source), None
