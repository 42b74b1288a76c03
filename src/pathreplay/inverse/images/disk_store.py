"""Store for rarely used arrays, such as images. Arrays that exceed a memory budget are kept on disk.

Arrays on disk are read-only memory maps of one unnamed temporary file, which is removed when the process ends.
"""

from __future__ import annotations

import errno
import mmap
import os
import tempfile
import weakref
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from pathreplay.errors import PathreplayError

ROOM = 2**28
"""Default memory budget in bytes."""
SMALL = 2**16
"""Arrays up to this size in bytes always stay in memory."""

Array = NDArray[np.float32]


class DiskStore:
    """Keeps up to ``room`` bytes of arrays in memory, and other arrays in a file in TMPDIR (default: /var/tmp)."""

    def __init__(self, room: int = ROOM) -> None:
        self.room = room
        self._file: IO[bytes] | None = None
        self._end = 0
        self._maps: list[mmap.mmap] = []

    @staticmethod
    def of(budget: int | None) -> DiskStore:
        """Make a store of at most ``budget`` / 8 bytes in memory. ``budget`` is the run's memory limit, or None."""
        return DiskStore(ROOM if budget is None else min(ROOM, budget // 8))

    def keep(self, array: Array) -> Array:
        """Return the array itself if it fits into memory, or a read-only copy on disk.

        Raises PathreplayError if the disk is full.
        """
        if array.nbytes <= SMALL or array.nbytes <= self.room:
            self.room -= array.nbytes
            return array
        begin = self._end
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile(dir=_folder(), prefix="pathreplay-")
                weakref.finalize(self, self._file.close)
            self._file.seek(begin)
            np.ascontiguousarray(array).tofile(self._file)
            self._file.flush()
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.EDQUOT, None):
                raise
            raise PathreplayError(
                f"No space left in {_folder()} for {(begin + array.nbytes) / 1e9:.2g} GB of images and initial values "
                "that are kept on disk; free some space, or set TMPDIR to a folder on another disk"
            ) from error
        # Memory maps must begin at a page boundary.
        self._end = -(-(begin + array.nbytes) // mmap.ALLOCATIONGRANULARITY) * mmap.ALLOCATIONGRANULARITY
        pages = mmap.mmap(self._file.fileno(), array.nbytes, access=mmap.ACCESS_READ, offset=begin)
        self._maps.append(pages)
        return np.frombuffer(pages, array.dtype).reshape(array.shape)

    def rest(self) -> None:
        """Release the memory of the mapped pages, which are read from disk again on the next access."""
        if hasattr(mmap, "MADV_DONTNEED"):
            for pages in self._maps:
                pages.madvise(mmap.MADV_DONTNEED)


def _folder() -> str:
    """Return the folder of the file. /var/tmp is preferred to /tmp, which is in memory on some machines."""
    return os.environ.get("TMPDIR") or ("/var/tmp" if Path("/var/tmp").is_dir() else tempfile.gettempdir())
