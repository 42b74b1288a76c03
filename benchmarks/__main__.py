"""The command line: `python -m benchmarks [TASK ...] [--quick] [--save]`, and `python -m benchmarks report`."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from . import attached, depth, events, media, records, supergrid, surface
from .report import EVIDENCE, fill
from .runner import ROOT, run_jobs
from .tables import footnote

TASKS = {task.TITLE: task for task in (surface, depth, attached, media, events, supergrid)}


def main(
    tasks: Annotated[list[str] | None, typer.Argument(help=f"{', '.join(TASKS)}, or report. Default: all.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Smaller and fewer: to see that it works.")] = False,
    save: Annotated[bool, typer.Option("--save", help="Keep the samples under benchmarks/results/.")] = False,
) -> None:
    """Measure gradients next to Mitsuba's own; `report` puts the saved results into docs/evidence.md."""
    wanted = tasks or list(TASKS)
    if wanted == ["report"]:
        missing = fill({name: task.table for name, task in TASKS.items()})
        typer.echo(f"{EVIDENCE.relative_to(ROOT)}: not measured: {', '.join(missing) or 'nothing'}")
        return
    unknown = [name for name in wanted if name not in TASKS]
    if unknown:
        _fail(f"there is no task {unknown[0]!r}: use {', '.join(TASKS)}, or report alone")
    if quick and save:
        _fail("--save keeps full runs only: leave out --quick")
    for name in wanted:
        task = TASKS[name]
        load = records.load_average()
        measured = run_jobs(name, task.jobs(quick))
        command = f"python -m benchmarks {name}" + (" --quick" if quick else "")
        record = records.make_record(name, command, load, measured)
        typer.echo(f"\n## {name}\n\n{task.table(record)}\n\n{footnote(record)}")
        if save:
            typer.echo(f"\nSaved as {records.save(record).relative_to(ROOT)}")


def _fail(message: str) -> None:
    print(f"benchmarks: error: {message}", file=sys.stderr)
    raise typer.Exit(2)


if __name__ == "__main__":
    typer.run(main)
