"""The lock of a run folder: one process writes at a time, and the system releases the lock when this process ends."""

from __future__ import annotations

import contextlib
import os
import re
import socket
import stat
import weakref
from pathlib import Path

from pathreplay.errors import PathreplayError

try:
    import fcntl
except ImportError:  # Windows: no lock; see docs/optimize.md
    fcntl = None  # type: ignore[assignment]

LOCK = "lock"


class FolderLock:
    """Locks a file in ``folder`` from construction to `close`, or until the object is deleted.

    The lock is an advisory lock on the file (flock). The system releases the lock when the process ends for any reason.
    The file remains after the lock is released, and does not block other processes. If the file system or the operating
    system does not support flock, nothing is locked.

    Raises PathreplayError if another process or thread holds the lock, or if the folder cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        path = folder / LOCK
        flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
        try:
            self._file = os.open(path, flags, 0o644)
        except OSError as error:
            raise PathreplayError(
                f"Lock file {path} cannot be opened ({error.strerror}); make the folder writable, or remove the file"
            ) from None
        self._closing = weakref.finalize(self, os.close, self._file)
        self._closing.atexit = False  # a run can still write its checkpoint when the interpreter ends
        try:
            self._take(folder, path)
        except BaseException:
            self.close()
            raise

    def _take(self, folder: Path, path: Path) -> None:
        about = os.fstat(self._file)
        if not stat.S_ISREG(about.st_mode) or about.st_nlink != 1:
            raise PathreplayError(f"Lock file {path} is not a regular file with a single link; remove it")
        if fcntl is None:
            return
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            match = re.fullmatch(r"(\d+) ([\w.-]+)\s*", os.pread(self._file, 200, 0).decode("ascii", "replace"))
            holder = f"process {match[1]} on {match[2]}" if match else "another process"
            raise PathreplayError(
                f"Run folder {folder} is in use by {holder}; wait until it ends, or stop it with Ctrl-C or "
                "SIGTERM, then resume"
            ) from None
        except OSError:
            return  # the file system does not support locks
        with contextlib.suppress(OSError):  # the lock is valid even if the disk is full
            os.ftruncate(self._file, 0)
            os.pwrite(self._file, f"{os.getpid()} {socket.gethostname()}\n".encode(), 0)

    def close(self) -> None:
        """Release the lock; a second call does nothing."""
        self._closing()
