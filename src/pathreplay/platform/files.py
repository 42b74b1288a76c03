"""Files and their names: which of the user's are opened, since pipes and devices block, and how ours are called."""

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
    """Why ``path`` cannot be read as a file, to stand behind its name in a message; "" for one that can.

    Follows symbolic links. ``most_bytes`` is the size beyond which the file cannot be what it is taken for.
    """
    try:
        found = os.stat(path)
    except (FileNotFoundError, NotADirectoryError):
        return MISSING
    except (OSError, ValueError) as error:  # a name that is too long, a folder that may not be entered, a NUL
        return f"cannot be reached ({getattr(error, 'strerror', None) or error})"
    if not stat.S_ISREG(found.st_mode):
        return _KINDS.get(stat.S_IFMT(found.st_mode), "is no regular file")
    if not os.access(path, os.R_OK):
        return "may not be read (its permissions)"
    if most_bytes is not None and found.st_size > most_bytes:
        return f"has {found.st_size} bytes, more than the {most_bytes} that are read"
    return ""


# Bytes. File systems take 255 in all; words in front, an ending and the mark of an unfinished file are added to this.
LONGEST = 150


def file_names(names: Iterable[str]) -> dict[str, str]:
    """Each name -> the file name (without ending) that stands for it; no two are the same, whatever their capitals.

    Letters, digits, ``_``, ``.`` and ``-`` stay, other characters become ``_``. A name that is too long is cut. Where
    two names would meet, or one was cut, a short hash of the name follows.
    """
    safe = {name: re.sub(r"[^\w.-]", "_", name) for name in names}
    # Some file systems ignore capitals: casefold.
    met = Counter(text.casefold() for text in safe.values())
    for name, text in safe.items():
        cut = text.encode()[:LONGEST].decode(errors="ignore")
        if met[text.casefold()] > 1 or cut != text:
            safe[name] = f"{cut}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"
    return safe
