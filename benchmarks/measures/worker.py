"""Runs one job in this process and writes events to stdout, one JSON object per line.

`runner.py` runs `python -m benchmarks.measures.worker JOB`. A method that raises an error is reported and left out of
the following rounds. A method that kills the process can be identified by its last event, `start`.
"""

from __future__ import annotations

import importlib
import json
import os
import platform
import resource
import sys
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from pathreplay import __version__, baselines
from pathreplay.platform import backend
from pathreplay.platform.threads import processor_name, usable_cores

from .job import Job, Kind, Machine, Measure

#: Module beside this one, and class.
MEASURES: dict[Kind, tuple[str, str]] = {
    "gradient": ("passes", "Pass"),
    "image": ("passes", "Pass"),
    "events": ("passes", "Pass"),
    "light paths": ("light_paths", "LightPass"),
    "caustic": ("caustic", "Caustic"),
    "truth": ("derivative", "Derivative"),
    "noise": ("replay_error", "ReplayError"),
    "step": ("step", "Step"),
    "edges": ("edges", "EdgePass"),
    "number": ("edges", "NumberPass"),
    "cold start": ("start", "Start"),
    "warm start": ("start", "Start"),
    "flight": ("grids", "Flight"),
    "transmittance": ("grids", "Transmittance"),
    "whole run": ("scale", "WholeRun"),
    "sum": ("scale", "Sum"),
    "iterations": ("actors", "Iterations"),
    "quality": ("quality", "Quality"),
}

#: What a process may allocate: a method whose memory grows without bound dies of it before the machine swaps.
MEMORY_LIMIT_GIB = 8

_PIPE: TextIO = sys.stdout


def _take_stdout() -> TextIO:
    """Return the pipe to the parent process, and redirect all other output to stdout into stderr.

    Otherwise Mitsuba's threads would write log messages into the middle of a line.
    """
    pipe = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    return pipe


def _say(event: str, **facts: Any) -> None:
    print(json.dumps({"event": event} | facts), file=_PIPE, flush=True)


def _machine(variant: str) -> Machine:
    import drjit as dr

    return Machine(
        processor=processor_name(),
        processors=usable_cores(),
        threads=dr.thread_count(),
        system=f"{platform.system()} {platform.machine()}",
        python=platform.python_version(),
        mitsuba=version("mitsuba"),
        drjit=version("drjit"),
        pathreplay=__version__,
        libllvm=".".join(map(str, backend.loaded_version())),
        variant=variant,
    )


def peak_mib() -> float:
    """Return the largest resident size of this process so far, in MiB."""
    status = Path("/proc/self/status")
    if status.exists():  # what the system calls ru_maxrss counts the size of the process that started this one, too
        return int(status.read_text().split("VmHWM:")[1].split()[0]) / 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # KiB; bytes on macOS
    return peak / (1024 if sys.platform != "darwin" else 1024**2)


def told(error: BaseException) -> str:
    """Return the message of an exception, short enough for a table."""
    from pathreplay.scenes.descriptions import one_line

    text = one_line(error)
    if isinstance(error, MemoryError) or "out of memory" in text:
        return f"out of memory (of {MEMORY_LIMIT_GIB} GiB)"
    return text[:200]


def limit_memory() -> None:
    """Make allocations beyond `MEMORY_LIMIT_GIB` fail."""
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    wanted = MEMORY_LIMIT_GIB * 1024**3
    resource.setrlimit(resource.RLIMIT_DATA, (wanted if hard < 0 else min(wanted, hard), hard))


def _measure(job: Job) -> Measure:
    """Create the measure of a job. Its module is imported here because it needs the variant to be set."""
    module, name = MEASURES[job.measure]
    return getattr(importlib.import_module(f".{module}", __package__), name)(job)


def run(job: Job) -> None:
    """Run a job and report the events `machine`, `start`, `sample`, `error`, `facts` (fields of `Point`) and `peak`."""
    limit_memory()
    variant = backend.set_variant(None)
    baselines.register()

    import drjit as dr

    if job.threads:
        dr.set_thread_count(job.threads)
    _say("machine", **asdict(_machine(variant)))
    measure = _measure(job)
    kept: dict[str, list[Any]] = {name: [] for name in job.methods}
    spent = dict.fromkeys(job.methods, 0.0)
    for k in range(-job.warmup, job.rounds):
        if k == 0 or (k > 0 and job.restart and k % job.restart == 0):
            measure.forget()
        for method in list(kept):
            if job.patience and spent[method] > job.patience and kept[method]:
                continue
            _say("start", method=method)
            try:
                seconds, result = measure(method, seed=k % 2**32)
            except Exception as error:
                _say("error", method=method, message=told(error))
                del kept[method]
                continue
            spent[method] += seconds
            finite = bool(np.isfinite(result).all())
            _say("sample", method=method, seed=k, seconds=seconds, finite=finite, kept=k >= 0)
            if k >= 0:
                kept[method].append(result)
    for method, facts in measure.conclude(kept).items():
        _say("facts", method=method, **facts)
    _say("peak", mib=peak_mib())


if __name__ == "__main__":
    _PIPE = _take_stdout()
    run(Job.decode(sys.argv[1]))
