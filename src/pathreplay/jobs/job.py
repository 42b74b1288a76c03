"""Starts jobs for ``pathreplay optimize`` and for Python: `optimize` runs a whole job, `iterate` one step at a time."""

from __future__ import annotations

import gc
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import get_args

from pathreplay.errors import PathreplayError, shown
from pathreplay.inverse.config.executor_options import ExecutorName
from pathreplay.inverse.config.schema import Config, read_config
from pathreplay.jobs.session import Optimization
from pathreplay.platform.threads import one_thread
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
    """Recover the parameters of a job, and write its run folder.

    The first Ctrl-C, SIGTERM or SIGHUP ends the run after the current iteration, with all results written. A further
    Ctrl-C aborts the run (KeyboardInterrupt). Until the run folder exists, signals keep their previous handlers. A
    ``deterministic`` job uses a single thread; the previous number of threads is restored afterwards.

    Args:
        config: path of a TOML or YAML file, or a Config, whose relative paths refer to the current folder.
        resume: run folder of an earlier, unfinished run to continue; excludes ``config`` and ``output``.
        output: run folder to create; default: the config's ``output``, or ``runs/<name of the config>`` if it has none.
            If the folder exists, a number is appended: an earlier run is never touched.
        progress: show a progress bar in a notebook or on stderr (periodic lines if stderr is not a terminal).
        define: changes to the config file, each ``KEY=VALUE`` (see docs/optimize.md).
        executor: ``local`` or ``ray``; overrides the config, also for a resumed run.

    Returns:
        Parameters, errors, history and image metrics of the run; all of it is also in the run folder.

    Raises:
        PathreplayError: the job cannot work (raised before the first iteration), the disk is full, or the run folder is
            in use, is damaged, or disappears.
    """
    try:
        with iterate(
            config, resume=resume, output=output, progress=progress, define=define, executor=executor
        ) as session:
            # Change the thread pool once instead of once per iteration. If Dr.Jit 1.5 removes a thread at the moment at
            # which the thread goes to sleep, the thread misses the wake-up call, and the process waits forever.
            with one_thread(session.deterministic):
                for _ in session:
                    pass
                return session.stop()
    finally:
        # Free the scene, which is part of a reference cycle: Dr.Jit traces virtual calls through every scene in memory.
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
    """Run a job step by step: iterating over the result yields an `Iteration` after each step.

    Arguments, the effect of signals, and errors are the same as for `optimize`. The config is checked immediately, and
    everything else when the first iteration is requested. `Optimization` describes the ways to end the run.
    """
    if executor is not None and executor not in get_args(ExecutorName):
        raise PathreplayError(f"executor is {shown(executor)}; use one of {', '.join(get_args(ExecutorName))}")
    job, path, resumed = _started(config, resume, output, tuple(define))
    if executor is not None:
        job = replace(job, config=job.config.model_copy(update={"executor": executor}))
    return Optimization(job, path, resumed, progress)


def _started(
    config: str | Path | Config | None, resume: str | Path | None, output: str | Path | None, changes: tuple[str, ...]
) -> tuple[Job, Path, RunFolder | None]:
    """Return the job, the path of its run folder, and the run folder to resume (None for a new run)."""
    if resume is not None:
        if config is not None or output is not None or changes:
            raise PathreplayError(
                "--resume takes config and output from the run folder; omit CONFIG, --output and --set"
            )
        job, folder = open_run_folder(Path(resume))
        return job, folder.given, folder
    if config is None:
        raise PathreplayError("Nothing to do: give a config file, or --resume RUN_FOLDER")
    if not isinstance(config, (str, Path, Config)):
        raise PathreplayError(
            f"config is a {type(config).__name__}; give the path of a TOML or YAML file, or make_config(dictionary)"
        )
    if isinstance(config, Config):
        if changes:
            raise PathreplayError("define changes a config file; for a Config, pass the values to make_config instead")
        job = Job(config, None, Path.cwd())
    else:
        path = Path(config)
        checked, content = read_config(path, changes)
        job = Job(checked, path, path.parent.absolute(), changes, content=content)
    return job, new_output(job.config.output if output is None else output, job.source), None
