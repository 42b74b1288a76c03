"""Runs jobs in worker processes and collects their samples; an error in a worker becomes a table row."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from .drafts import ROOT, Done, Draft
from .measures.job import Curve, Job, Machine, Point

WORKER = (sys.executable, "-m", "benchmarks.measures.worker")


@dataclass
class _Samples:
    """What a worker has reported about one method so far."""

    seeds: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    facts: dict[str, Any] = field(default_factory=dict)  # fields of `Point`
    not_finite: list[int] = field(default_factory=list)
    error: str | None = None

    def add(self, seed: int, seconds: float, finite: bool) -> None:
        """Add one gradient pass."""
        self.seeds.append(seed)
        self.seconds.append(seconds)
        self.not_finite += [] if finite else [seed]


@dataclass
class Measured:
    """Points of all measured jobs, and the distinct machines, which differ at most in their thread count."""

    points: list[Point] = field(default_factory=list)
    machines: list[Machine] = field(default_factory=list)


def run_jobs(title: str, jobs: list[Job], draft: Draft) -> Measured:
    """Run the jobs that the draft lacks, with a progress bar on stderr, and add each to the draft."""
    measured = Measured()
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    with Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True)) as progress:
        bar = progress.add_task(title, total=sum(job.passes for job in jobs))
        passed = 0
        for k, job in enumerate(jobs):
            turn = jobs[:k].count(job)
            done = draft.find(job, turn)
            if done is None:

                def show(method: str, passes: int, job: Job = job, passed: int = passed) -> None:
                    text = f"{title}: {job.scene}, depth {job.max_depth}, {method}"
                    progress.update(bar, description=text, completed=passed + min(passes, job.passes))

                result = Measured()
                _run_job(job, result, show)
                done = Done(job, turn, tuple(result.points), tuple(result.machines))
                draft.add(done)
            measured.points += done.points
            measured.machines += [machine for machine in done.machines if machine not in measured.machines]
            passed += job.passes
        progress.update(bar, description=title, completed=passed)
    return measured


def _run_job(job: Job, measured: Measured, show: Callable[[str, int], None]) -> None:
    """Run a job; if a method kills the process, run the job again without this method."""
    methods = job.methods
    while methods:
        killer = _attempt(replace(job, methods=methods), measured, show)
        methods = tuple(name for name in methods if name != killer) if killer else ()


def _attempt(job: Job, measured: Measured, show: Callable[[str, int], None]) -> str | None:
    """Run one worker process. If a method kills it, keep only the error of this method, and return the method."""
    samples = {name: _Samples() for name in job.methods}
    running, peak, passes = job.methods[0], None, 0
    # With an empty kernel cache, the peak memory of every job includes compilation, not only that of some jobs.
    with tempfile.TemporaryDirectory() as home, tempfile.TemporaryFile("w+") as stderr:
        command = [*WORKER, job.encode()]
        environment = os.environ | {"HOME": home, "DRJIT_CACHE_DIR": home}
        with subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=stderr, text=True, cwd=ROOT, env=environment
        ) as worker:
            try:
                for event in _events(worker):
                    match event:
                        case {"event": "machine", **facts}:
                            machine = Machine(**facts)
                            measured.machines += [machine] if machine not in measured.machines else []
                        case {"event": "start", "method": running}:
                            show(running, passes)
                        case {"event": "sample", "method": method, "kept": kept} as sample:
                            passes += 1
                            if kept:
                                samples[method].add(sample["seed"], sample["seconds"], sample["finite"])
                        case {"event": "error", "method": method, "message": message}:
                            samples[method].error = message
                        case {"event": "facts", "method": method, **facts}:
                            samples[method].facts = facts
                        case {"event": "peak", "mib": peak}:
                            pass
            except BaseException:
                worker.kill()
                raise
        died = worker.returncode != 0
        if died:
            stderr.seek(0)
            samples[running].error = _cause_of_death(worker.returncode, stderr.read())
    alone = len(job.methods) == 1
    for method, collected in samples.items():
        if not died or method == running:
            measured.points.append(_point(job, method, collected, peak if alone else None))
    return running if died else None


def _events(worker: subprocess.Popen[str]) -> Iterator[dict[str, Any]]:
    assert worker.stdout is not None
    for line in worker.stdout:
        if line.startswith('{"event"'):
            yield json.loads(line)


def _cause_of_death(status: int, stderr: str) -> str:
    if status < 0:
        return f"died: {signal.Signals(-status).name}"
    lines = [line for line in stderr.splitlines() if line.strip()]
    return f"ended with status {status}: {lines[-1].strip()[:200] if lines else 'no message'}"


def _point(job: Job, method: str, samples: _Samples, peak: float | None) -> Point:
    facts: dict[str, Any] = {name: tuple(f) if isinstance(f, list) else f for name, f in samples.facts.items()}
    return Point(
        scene=job.scene,
        parameters=job.parameters,
        method=method,
        max_depth=job.max_depth,
        paths=job.resolution**2 * job.spp,
        seeds=tuple(samples.seeds),
        seconds=tuple(samples.seconds),
        squared_errors=facts.pop("squared_errors", ()),
        not_finite=tuple(samples.not_finite),
        peak_mib=peak,
        error=samples.error,
        measure=job.measure,
        curves=tuple(_curve(fields) for fields in facts.pop("curves", ())),
        **facts,
    )


def _curve(fields: dict[str, Any]) -> Curve:
    return Curve(**{name: tuple(value) if isinstance(value, list) else value for name, value in fields.items()})
