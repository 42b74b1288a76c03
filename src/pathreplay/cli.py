"""The commands, thin: each one reads its arguments, calls the room that does the work, and prints what came back.

Exit status: 0 when the command did what it was asked and liked what it saw, 1 when it did but did not like it (a
gradient that fails its check, a machine on which nothing runs), 2 when the user has to mend something first. Heavy
modules are imported inside the commands, so that `pathreplay --help` answers at once.
"""

from __future__ import annotations

import errno
import sys
from typing import Annotated, NoReturn

import typer

from pathreplay.errors import PathreplayError

app = typer.Typer(
    name="pathreplay",
    help="Differentiable light transport on Mitsuba 3: check gradients, recover scenes from pictures.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from pathreplay import __version__

        typer.echo(f"pathreplay {__version__}")
        raise typer.Exit()


@app.callback()
def _global_options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and end.")
    ] = False,
) -> None:
    """Options that hold for every command."""


@app.command()
def doctor() -> None:
    """Say what runs on this machine, and the way out for what does not."""
    from rich.console import Console

    from pathreplay.doctor import examine

    with Console(stderr=True).status("Trying every libLLVM and every variant ..."):
        report = examine()
    report.print()
    raise typer.Exit(0 if report.works else 1)


def _fail(message: str) -> NoReturn:
    # Plain stderr, one line: neither markup nor wrapping may touch a path or a parameter key.
    print("pathreplay: error: " + " ".join(message.split()), file=sys.stderr)
    raise SystemExit(2)


def main() -> None:
    """Run the command line; the entry point `pathreplay`."""
    try:
        app()
    except PathreplayError as error:
        _fail(str(error))
    except MemoryError:
        _fail("out of memory: lower the resolution, the samples per pixel or the number of views")
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        _fail(f"no space left on the disk for {error.filename or 'the output'}: free some space, or write elsewhere")


if __name__ == "__main__":
    main()
