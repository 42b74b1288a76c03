"""Arrays that are seldom looked at, such as the pictures of all views: in memory while there are few, then on the disk.

What is on the disk is mapped into memory, looks like any other array, and cannot be written to. The file has no name,
and goes with the process.
"""

from __future__ import annotations

import errno
import mmap
import os
import tempfile
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from pathreplay.errors import PathreplayError

ROOM = 2**28
"""Bytes of such arrays that stay in memory."""
SMALL = 2**16
"""Bytes of an array that is not worth a place of its own."""

Array = NDArray[np.float32]


class Album:
    """Keeps arrays, of which ``room`` bytes stay in memory. The folder of the file is TMPDIR, or else /var/tmp."""

    def __init__(self, room: int = ROOM) -> None:
        self.room = room
        self._file: IO[bytes] | None = None
        self._end = 0
        self._maps: list[mmap.mmap] = []

    @staticmethod
    def of(budget: int | None) -> Album:
        """One that leaves room for other things in a run that may take so many bytes."""
        return Album(ROOM if budget is None else min(ROOM, budget // 8))

    def keep(self, array: Array) -> Array:
        """The array, or one that is the same and can be read only. Raises PathreplayError where the disk is full."""
        if array.nbytes <= SMALL or array.nbytes <= self.room:
            self.room -= array.nbytes
            return array
        begin = self._end
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile(dir=_folder(), prefix="pathreplay-")
            self._file.seek(begin)
            np.ascontiguousarray(array).tofile(self._file)
            self._file.flush()
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.EDQUOT, None):
                raise
            raise PathreplayError(
                f"No space left in {_folder()} for {(begin + array.nbytes) / 1e9:.2g} GB of pictures and start values "
                "that are not held in memory: free some, or set TMPDIR to a folder on another disk"
            ) from error
        # The next one begins where a page does, as maps must.
        self._end = -(-(begin + array.nbytes) // mmap.ALLOCATIONGRANULARITY) * mmap.ALLOCATIONGRANULARITY
        pages = mmap.mmap(self._file.fileno(), array.nbytes, access=mmap.ACCESS_READ, offset=begin)
        self._maps.append(pages)
        return np.frombuffer(pages, array.dtype).reshape(array.shape)

    def rest(self) -> None:
        """Give back the memory of what was looked at: it is read again when it is wanted."""
        if hasattr(mmap, "MADV_DONTNEED"):
            for pages in self._maps:
                pages.madvise(mmap.MADV_DONTNEED)


def _folder() -> str:
    """Where the file is: /tmp is memory itself on some systems, /var/tmp is not."""
    return os.environ.get("TMPDIR") or ("/var/tmp" if Path("/var/tmp").is_dir() else tempfile.gettempdir())
