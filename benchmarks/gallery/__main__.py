"""The command line of the gallery."""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

from pathreplay.errors import PathreplayError

from ..drafts import ROOT
from . import __doc__ as DESCRIPTION
from .entries import ENTRIES
from .page import IMAGES, PAGE, image_of, page, read_record, write_record
from .runs import require_idle, reused, run

RUNS = ROOT / "runs" / "gallery"


def option(key: str) -> str:
    """Return the option that gives a checkout of an entry: its name in the entry is that of the repository."""
    return f"--{key.lower().replace('_', '-')}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.gallery", description=(DESCRIPTION or "").split("\n")[0]
    )
    known = {entry.name: entry for entry in ENTRIES}
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"{', '.join(known)}. Default: all.")
    parser.add_argument("--busy", action="store_true", help="run on a busy machine, too")
    parser.add_argument("--reuse", action="store_true", help="run nothing; use the last finished runs")
    parser.add_argument("--page", action="store_true", help="run and draw nothing; write the page from the record")
    parser.add_argument("--runs", type=Path, default=RUNS, metavar="FOLDER", help="folder of the runs")
    for key in dict.fromkeys(key for entry in ENTRIES for key in entry.checkouts):
        text = "checkout of this repository, for the examples that need it"
        parser.add_argument(option(key), dest=key, type=Path, metavar="FOLDER", help=text)
    given = parser.parse_args(arguments)
    runs = given.runs.absolute()
    for name in given.names:
        if name not in known:
            raise PathreplayError(f"there is no entry {name!r}; use {', '.join(known)}")
    for name in () if given.page else given.names or known:
        entry = known[name]
        checkouts = {key: getattr(given, key) for key in entry.checkouts}
        if given.reuse:
            found = reused(entry, runs)
        elif None in checkouts.values():
            options = " ".join(f"{option(key)} FOLDER" for key in checkouts)
            print(f"{name} is skipped, because its data is in other repositories; add {options}")
            continue
        else:
            if not given.busy:
                require_idle(name)
            print(f"{name}: {' && '.join(entry.commands)}", flush=True)
            shutil.rmtree(runs / name, ignore_errors=True)
            found = run(entry, runs, [folder.absolute() for folder in checkouts.values()])
        IMAGES.mkdir(parents=True, exist_ok=True)
        (IMAGES / f"{name}.png").write_bytes(image_of(entry, runs / name))
        write_record(read_record() | {name: found})
    PAGE.write_text(page(read_record()), encoding="utf-8")
    print(f"written: {PAGE}")


if __name__ == "__main__":
    try:
        main()
    except PathreplayError as error:
        print(f"benchmarks.gallery: error: {error}", file=sys.stderr)
        sys.exit(2)
