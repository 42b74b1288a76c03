"""The command line: `pathreplay bench` or `python -m benchmarks`, followed by names of tasks or by `report`."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from types import ModuleType
from typing import Annotated

import typer
from rich.console import Console

from pathreplay.errors import PathreplayError

from . import records
from .compare import compare
from .drafts import ROOT, Draft, draft_of
from .measures.job import Record
from .pages import fill, pages
from .runner import run_jobs
from .tables import footnote
from .tasks import (
    attached,
    depth,
    edges,
    events,
    gridmedium,
    iteration,
    media,
    noise,
    particles,
    quality,
    roughness,
    scale,
    startup,
    supergrid,
    surface,
    truth,
)

# Quick tasks come first, so that an interrupted run has most of the results.
_TASKS = (
    startup,
    surface,
    roughness,
    iteration,
    attached,
    edges,
    truth,
    noise,
    depth,
    events,
    particles,
    supergrid,
    gridmedium,
    media,
    scale,
    quality,
)
TASKS: dict[str, ModuleType] = {task.TITLE: task for task in _TASKS}


def main(
    tasks: Annotated[list[str] | None, typer.Argument(help=f"{', '.join(TASKS)}, or report. Default: all.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Run fewer and smaller jobs, as a test.")] = False,
    save: Annotated[bool, typer.Option("--save", help="Save the records in benchmarks/results/.")] = False,
    into: Annotated[
        Path | None, typer.Option("--into", metavar="FOLDER", help="Save the records in this folder instead.")
    ] = None,
    against: Annotated[
        Path | None,
        typer.Option(
            "--compare",
            metavar="OLD.json",
            help="Report what became slower or noisier since this record. Its task is measured again, or compared "
            "with a record NEW.json that is given in place of a task. Exit status 1 if anything became worse.",
        ),
    ] = None,
    report: Annotated[bool, typer.Option("--report", help="Then update the pages from all saved records.")] = False,
) -> None:
    """Compare gradients with Mitsuba's own; `report` writes saved records into docs/evidence.md and its figures.

    An interrupted run continues where it stopped when it is started again.
    """
    wanted = tasks or []
    folder = into or (records.RESULTS if save else None)
    if quick and folder:
        raise PathreplayError("--save and --into need a full run; omit --quick")
    if against is not None:
        _compare(against, wanted, quick, report or folder is not None)
        return
    if wanted == ["report"]:
        wanted, report = [], True
    else:
        wanted = wanted or list(TASKS)
    _require_known(wanted)
    drafts = [_run(name, quick, folder)[1] for name in wanted]
    # Discard drafts only at the end: if the third task is interrupted, the first two are not measured again.
    for draft in drafts:
        draft.discard()
    if report:
        _report()


def _require_known(names: list[str]) -> None:
    for name in names:
        if name not in TASKS:
            raise PathreplayError(f"there is no task {name!r}; use {', '.join(TASKS)}, or report alone")


def _run(name: str, quick: bool, folder: Path | None) -> tuple[Record, Draft]:
    """Measure one task, print its table, and save its record if a folder is given."""
    task, console = TASKS[name], Console(stderr=True, highlight=False, soft_wrap=True)
    draft, jobs = draft_of(name, quick), task.jobs(quick)
    ready = len(draft.contents.done)
    console.print(f"{name}: {len(jobs)} jobs, {_duration(task.TAKES[0 if quick else 1])} on two quiet cores")
    if ready:
        path = draft.path.relative_to(ROOT)
        console.print(f"{name}: continuing a run of {draft.begun}: {ready} jobs are done (to start over: rm {path})")
    load, start = records.load_average(), time.perf_counter()
    measured = run_jobs(name, jobs, draft)
    console.print(f"{name}: took {_duration(time.perf_counter() - start)}")
    if draft.stale:
        console.print(f"{name}: the code changed during the measurement; run it again for consistent results")
    command = f"pathreplay bench {name}" + (" --quick" if quick else "")
    record = records.make_record(name, command, load, measured, draft)
    typer.echo(f"\n## {name}\n\n{task.table(record)}\n\n{footnote(record)}")
    if folder:
        typer.echo(f"\nSaved as {records.save(record, folder)}")
    return record, draft


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.1f} min"


def _compare(path: Path, wanted: list[str], quick: bool, writes: bool) -> None:
    old = records.read(path)
    others = [Path(name) for name in wanted if name.endswith(".json")]
    if writes or len(others) > 1 or (others and (len(wanted) > 1 or quick)):
        raise PathreplayError("--compare OLD.json takes one NEW.json, or none (optionally --quick) to measure again")
    if others:
        new = records.read(others[0])
    else:
        if wanted not in ([], [old.task]):
            raise PathreplayError(f"{path} is a record of task {old.task!r}; compare it with a record of that task")
        _require_known([old.task])
        new, draft = _run(old.task, quick, folder=None)
        draft.discard()
    if old.task != new.task:
        raise PathreplayError(
            f"{path} is a record of task {old.task!r}, {others[0]} one of {new.task!r}; compare records of one task"
        )
    comparison = compare(old, new)
    typer.echo(f"\n{comparison.table()}")
    if comparison.worse:
        raise typer.Exit(1)


def _report() -> None:
    from . import plots

    for path in plots.draw_all():
        typer.echo(f"drawn: {path.relative_to(ROOT)}")
    missing = fill({name: task.table for name, task in TASKS.items()}, pages())
    typer.echo(f"Pages are updated; not measured: {', '.join(missing) or 'none'}")


if __name__ == "__main__":
    try:
        typer.run(main)
    except PathreplayError as error:
        print(f"benchmarks: error: {error}", file=sys.stderr)
        sys.exit(2)
