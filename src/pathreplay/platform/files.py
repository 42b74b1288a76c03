"""Checks of user files before they are opened (pipes and devices would block), and safe names for output files."""

from __future__ import annotations

import hashlib
import os
import re
import stat
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

MISSING = "does not exist"

_KINDS = {
    stat.S_IFDIR: "is a folder",
    stat.S_IFIFO: "is a pipe",
    stat.S_IFSOCK: "is a socket",
    stat.S_IFCHR: "is a device",
    stat.S_IFBLK: "is a device",
}


def file_problem(path: str | Path, most_bytes: int | None = None) -> str:
    """Return why ``path`` cannot be read as a file, as the predicate of an error message, or "".

    Symbolic links are followed. A file of more than ``most_bytes`` counts as unreadable, because no valid file of the
    expected kind is that large.
    """
    try:
        status = os.stat(path)
    except (FileNotFoundError, NotADirectoryError):
        return MISSING
    except (OSError, ValueError) as error:  # name too long, folder without search permission, or a NUL character
        return f"cannot be reached ({getattr(error, 'strerror', None) or error})"
    if not stat.S_ISREG(status.st_mode):
        return _KINDS.get(stat.S_IFMT(status.st_mode), "is not a regular file")
    if not os.access(path, os.R_OK):
        return "cannot be read (its permissions)"
    if most_bytes is not None and status.st_size > most_bytes:
        return f"has {status.st_size} bytes, more than the limit of {most_bytes}"
    return ""


# Largest number of bytes of a file name here. File systems allow 255 bytes. The remaining bytes are reserved for a
# prefix and suffixes.
LONGEST = 150


def file_names(names: Iterable[str]) -> dict[str, str]:
    """Return a file name (without suffix) for each name; the file names differ even if case is ignored.

    Letters, digits, ``_``, ``.`` and ``-`` stay; other characters become ``_``. Long names are truncated. A short hash
    of the name is appended to a file name that was truncated or would collide with another file name.
    """
    safe = {name: re.sub(r"[^\w.-]", "_", name) for name in names}
    # Names are compared with `casefold`, because some file systems ignore case.
    met = Counter(text.casefold() for text in safe.values())
    for name, text in safe.items():
        cut = text.encode()[:LONGEST].decode(errors="ignore")
        if met[text.casefold()] > 1 or cut != text:
            safe[name] = f"{cut}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"
    return safe
