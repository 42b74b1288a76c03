"""File names with wildcards, as the files of a folder that they fit, in the order in which people count."""

from __future__ import annotations

import fnmatch
import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from pathreplay.errors import PathreplayError, shown

WILD = re.compile(r"[*?\[]")
MOST_FILES = 100_000
"""Of a folder that is looked through."""


def matching(names: Iterable[str], base: Path) -> Iterator[str]:
    """Each name, or the files that fit it where it has wildcards in its last part: photos/*.png, natural order.

    Raises PathreplayError where no file fits, or wildcards are in the name of a folder.
    """
    for name in names:
        if WILD.search(name) and not _exists(base / name):
            yield from _expanded(name, base)
        else:
            yield name


def natural(name: str) -> list[int | str]:
    """By what names are sorted so that 2 comes before 10."""
    return [int(part) if part.isdecimal() else part.casefold() for part in re.split(r"(\d+)", name)]


def _expanded(name: str, base: Path) -> list[str]:
    folder, pattern = os.path.split(name)
    if WILD.search(folder):
        raise PathreplayError(f"Pattern {shown(name)} has wildcards in a folder's name; put them into the file's alone")
    found = []
    try:
        with os.scandir(base / folder) as entries:
            for count, entry in enumerate(entries):
                if count >= MOST_FILES:
                    raise PathreplayError(
                        f"Pattern {shown(name)}: its folder has more than {MOST_FILES} files; move the pictures to one "
                        "of their own"
                    )
                if fnmatch.fnmatchcase(entry.name, pattern):
                    found.append(entry.name)
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise PathreplayError(f"Pattern {shown(name)}: its folder cannot be read ({why}); correct the path") from None
    if not found:
        raise PathreplayError(f"No file fits the pattern {shown(name)} in {base / folder}; correct it")
    return [os.path.join(folder, each) for each in sorted(found, key=lambda each: (natural(each), each))]


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):
        return False
