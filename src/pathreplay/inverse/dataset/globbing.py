"""Expand file names with wildcards, in natural order."""

from __future__ import annotations

import fnmatch
import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from pathreplay.errors import PathreplayError, shown

WILD = re.compile(r"[*?\[]")
MOST_FILES = 100_000
"""Largest number of files in a folder that is searched."""


def matching(names: Iterable[str], base: Path) -> Iterator[str]:
    """Yield file names. A name with wildcards in its last part (photos/*.png) yields matching files in natural order.

    Hidden files, whose names begin with a dot, match only patterns that begin with a dot.

    Raises PathreplayError if no file matches a pattern, or if the name of a folder has wildcards.
    """
    for name in names:
        if WILD.search(name) and not os.path.exists(base / name):
            yield from _expanded(name, base)
        else:
            yield name


def natural(name: str) -> list[int | str]:
    """Return a sort key for natural order, in which 2 comes before 10."""
    return [int(part) if part.isdecimal() else part.casefold() for part in re.split(r"(\d+)", name)]


def _expanded(name: str, base: Path) -> list[str]:
    folder, pattern = os.path.split(name)
    if WILD.search(folder):
        raise PathreplayError(f"Pattern {shown(name)} has wildcards in a folder name; use them in the file name only")
    names = []
    try:
        with os.scandir(base / folder) as entries:
            for count, entry in enumerate(entries):
                if count >= MOST_FILES:
                    raise PathreplayError(
                        f"Pattern {shown(name)}: its folder has more than {MOST_FILES} files; move the images to a "
                        "separate folder"
                    )
                # As in a shell, hidden files (such as ._a.png, which macOS adds) match only patterns of hidden files.
                if entry.name.startswith(".") and not pattern.startswith("."):
                    continue
                if fnmatch.fnmatchcase(entry.name, pattern):
                    names.append(entry.name)
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise PathreplayError(f"Pattern {shown(name)}: its folder cannot be read ({why}); correct the path") from None
    if not names:
        raise PathreplayError(f"No file matches the pattern {shown(name)} in {base / folder}; correct it")
    return [os.path.join(folder, file) for file in sorted(names, key=lambda file: (natural(file), file))]
