"""The commands that look at runs which are over, or nearly: `compare`, `timelapse` and `tensorboard`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pathreplay.errors import PathreplayError
from pathreplay.platform import interrupts

Runs = Annotated[list[Path], typer.Argument(metavar="RUN...", help="Run folders.")]


def add_to(app: typer.Typer) -> None:
    """Give the command line these commands."""
    app.command(short_help="Put runs side by side.")(compare)
    app.command(short_help="Make a film of a run.")(timelapse)
    app.command(short_help="Write a run's history for TensorBoard.")(tensorboard)


def compare(
    runs: Runs,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE.html", help="Also write a page with curves and pictures."),
    ] = None,
) -> None:
    """Print what runs came to, and where their jobs differ; --output writes a page with curves and pictures."""
    with interrupts.undisturbed():
        from pathreplay.platform.atomic_files import write_whole
        from pathreplay.report.pages.document import document
        from pathreplay.report.watch import compare as comparing
        from pathreplay.report.watch.past import pasts

    if len(runs) < 2:
        raise PathreplayError("compare needs two runs or more; name another")
    found = pasts(runs)
    comparing.print_table(comparing.table(found))
    if output is not None:
        write_whole(output, document(comparing.page(found)), "--output")
        typer.echo(f"page: {output}")


def timelapse(
    run: Annotated[Path, typer.Argument(help="Run folder.")],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="FILE", help="A .webp or .mp4 file (default: timelapse.webp in the run)."
        ),
    ] = None,
    view: Annotated[str | None, typer.Option(help="Name of the view (default: the first).")] = None,
    seconds: Annotated[float, typer.Option(min=0.1, max=600, help="How long it takes.")] = 6.0,
) -> None:
    """Make a film of the pictures that a run has kept: the target beside what the run saw, and textures."""
    with interrupts.undisturbed():
        from pathreplay.report.watch.timelapse import film

    path = run / "timelapse.webp" if output is None else output
    count = film(run, path, view, seconds)
    typer.echo(f"{path}: {count} frames")


def tensorboard(
    runs: Runs,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FOLDER", help="Folder for the event files.")
    ] = Path("tensorboard"),
) -> None:
    """Write loss, errors and gradients of runs as event files; then: tensorboard --logdir FOLDER."""
    with interrupts.undisturbed():
        from pathreplay.report.watch.past import pasts
        from pathreplay.report.watch.tensorboard import write_events

    for run in pasts(runs):
        typer.echo(f"{run.name}: {write_events(run, output)} iterations")
    typer.echo(f"look at them with: tensorboard --logdir {output}")
