"""Files that the user names: only regular ones are opened, since pipes and devices block or never end."""

from __future__ import annotations

import os
import stat
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
