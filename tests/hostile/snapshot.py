"""What lies in a folder, and what is different later: by path, without following links or opening odd files."""

from __future__ import annotations

import hashlib
import os
import stat
from pathlib import Path

LARGE = 2**20

State = dict[str, tuple[object, ...]]


def snapshot(folder: Path) -> State:
    """Kind, size and content of everything below ``folder``, by relative path. Large files by time of change.

    Python's cache of imported modules is left out: it is there or not as the environment has it.
    """
    state: State = {}
    for where, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if name != "__pycache__"]
        for name in (*folders, *files):
            path = os.path.join(where, name)
            state[os.path.relpath(path, folder)] = _of(path)
    return state


def _of(path: str) -> tuple[object, ...]:
    info = os.lstat(path)
    if stat.S_ISLNK(info.st_mode):
        return "link", os.readlink(path)
    if not stat.S_ISREG(info.st_mode):
        return (stat.S_IFMT(info.st_mode),)
    if info.st_size > LARGE:
        return "large", info.st_size, info.st_mtime_ns
    with open(path, "rb") as file:
        return "file", info.st_size, hashlib.sha256(file.read()).hexdigest()


def difference(before: State, after: State) -> set[str]:
    """Paths that came, went or changed."""
    return {path for path in before.keys() | after.keys() if before.get(path) != after.get(path)}
