"""The commands that inspect saved runs: `compare`, `timelapse` and `tensorboard`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pathreplay.errors import PathreplayError
from pathreplay.platform import interrupts

Runs = Annotated[list[Path], typer.Argument(metavar="RUN...", help="Run folders.")]


def add_to(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command(short_help="Compare runs side by side.")(compare)
    app.command(short_help="Make a film of a run.")(timelapse)
    app.command(short_help="Write the history of runs for TensorBoard.")(tensorboard)


def compare(
    runs: Runs,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE.html", help="Also write a page with curves and images."),
    ] = None,
) -> None:
    """Print the results of runs and the differences of their jobs; --output writes a page with curves and images."""
    with interrupts.undisturbed():
        from pathreplay.platform.atomic_files import write_whole
        from pathreplay.report.pages.document import document
        from pathreplay.report.watch import compare as comparing
        from pathreplay.report.watch.past import pasts

    if len(runs) < 2:
        raise PathreplayError("compare needs at least two runs; name another")
    compared = pasts(runs)
    comparing.print_table(comparing.table(compared))
    if output is not None:
        write_whole(output, document(comparing.page(compared)), "--output")
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
    seconds: Annotated[float, typer.Option(min=0.1, max=600, help="Duration of the film.")] = 6.0,
) -> None:
    """Make a film of the previews of a run: the target beside the current image and textures."""
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
    """Write loss, errors and gradient norms of runs as event files; view them with: tensorboard --logdir FOLDER."""
    with interrupts.undisturbed():
        from pathreplay.platform.files import file_names
        from pathreplay.report.watch.past import pasts
        from pathreplay.report.watch.tensorboard import write_events

    found = pasts(runs)
    folders = file_names(run.name for run in found)
    for run in found:
        typer.echo(f"{run.name}: {write_events(run, output / folders[run.name])} iterations")
    typer.echo(f"view them with: tensorboard --logdir {output}")
