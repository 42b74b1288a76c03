"""Store for rarely used arrays, such as images. Arrays that exceed a memory budget are kept on disk.

Arrays on disk are read-only memory maps of one unnamed temporary file, which is removed when the process ends.
"""

from __future__ import annotations

import errno
import mmap
import os
import tempfile
import weakref
from collections import deque
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
    """Keeps up to ``room`` bytes of arrays in memory, and other arrays in a file in a folder on disk.

    The folder is TMPDIR or /var/tmp, or the system's folder of temporary files if neither can be written.

    Arrays that nobody uses any more give their memory budget and their part of the file back.
    """

    def __init__(self, room: int = ROOM) -> None:
        self._room = room
        self._file: IO[bytes] | None = None
        self._end = 0
        self._gaps: list[tuple[int, int]] = []  # begin and end of the unused parts of the file, in order
        self._maps: weakref.WeakSet[mmap.mmap] = weakref.WeakSet()
        # The garbage collector may free an array at any time. Freed space is therefore only noted, in these queues.
        self._freed: deque[int] = deque()
        self._unmapped: deque[tuple[int, int]] = deque()

    @staticmethod
    def of(budget: int | None) -> DiskStore:
        """Make a store of at most ``budget`` / 8 bytes in memory. ``budget`` is the run's memory limit, or None."""
        return DiskStore(ROOM if budget is None else min(ROOM, budget // 8))

    def keep(self, array: Array) -> Array:
        """Return the array itself if it fits into memory, or a read-only copy on disk.

        Raises PathreplayError if the disk is full, or the file cannot be written.
        """
        if array.nbytes <= SMALL or array.nbytes <= self.room:
            self._room -= array.nbytes
            weakref.finalize(array, self._freed.append, array.nbytes).atexit = False
            return array
        # Memory maps must begin at a page boundary.
        begin, end = self._allocate(-(-array.nbytes // mmap.ALLOCATIONGRANULARITY) * mmap.ALLOCATIONGRANULARITY)
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile(dir=_folder(), prefix="pathreplay-")
                weakref.finalize(self, self._file.close)
            self._file.seek(begin)
            np.ascontiguousarray(array).tofile(self._file)
            self._file.flush()
        except OSError as error:
            self._unmapped.append((begin, end))
            size = f"{(begin + array.nbytes) / 1e9:.2g} GB of images and initial values"
            if error.errno not in (errno.ENOSPC, errno.EDQUOT, None):
                raise PathreplayError(
                    f"{size} cannot be kept on disk ({error.strerror}); set TMPDIR to a folder that can be written"
                ) from error
            raise PathreplayError(
                f"No space left in {_folder()} for {size} that are kept on disk; free some space, or set TMPDIR to a "
                "folder on another disk"
            ) from error
        pages = mmap.mmap(self._file.fileno(), array.nbytes, access=mmap.ACCESS_READ, offset=begin)
        self._maps.add(pages)
        # The map lives as long as any array that shows a part of it.
        weakref.finalize(pages, self._unmapped.append, (begin, end)).atexit = False
        return np.frombuffer(pages, array.dtype).reshape(array.shape)

    @property
    def room(self) -> int:
        """Bytes of memory that are left for arrays."""
        while self._freed:
            self._room += self._freed.popleft()
        return self._room

    def _allocate(self, size: int) -> tuple[int, int]:
        """Return begin and end of an unused part of the file: the first that is large enough, or a new one."""
        while self._unmapped:
            self._gaps.append(self._unmapped.popleft())
        joined: list[tuple[int, int]] = []
        for begin, end in sorted(self._gaps):
            if joined and joined[-1][1] == begin:
                joined[-1] = joined[-1][0], end
            else:
                joined.append((begin, end))
        if joined and joined[-1][1] == self._end:
            self._end = joined.pop()[0]
        self._gaps = joined
        for k, (begin, end) in enumerate(joined):
            if end - begin >= size:
                joined[k : k + 1] = [(begin + size, end)] if begin + size < end else []
                return begin, begin + size
        self._end += size
        return self._end - size, self._end

    def rest(self) -> None:
        """Release the memory of the mapped pages, which are read from disk again on the next access."""
        if hasattr(mmap, "MADV_DONTNEED"):
            for pages in self._maps:
                pages.madvise(mmap.MADV_DONTNEED)


def _folder() -> str:
    """Return the folder of the file. /var/tmp is preferred to /tmp, which is in memory on some machines."""
    for folder in (os.environ.get("TMPDIR"), "/var/tmp"):
        if folder and os.path.isdir(folder) and os.access(folder, os.W_OK | os.X_OK):
            return folder
    return tempfile.gettempdir()
