"""Change the size of Dr.Jit's thread pool temporarily: two threads for reading files, one for reproducible sums."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager

import drjit as dr


def spare_thread() -> AbstractContextManager[None]:
    """Within this block, in which Mitsuba reads files, the pool has at least two threads.

    Mitsuba 3.9 submits the blocks of an EXR file to the pool and waits for them without helping. A process restricted
    to a single core (`taskset -c 0`, small containers) gets a pool of one thread, in which nothing executes them.
    Writing has the same defect; we write without Mitsuba (see `exr_bytes`).
    """
    return _threads(max(2, dr.thread_count()))


def one_thread(wanted: bool) -> AbstractContextManager[None]:
    """Within this block, if ``wanted``, Dr.Jit computes in a single thread and results are reproducible bit for bit.

    Threads add to pixels and gradients atomically, in random order. Mitsuba must not read or write files in this block:
    see `spare_thread`.
    """
    return _threads(1 if wanted else dr.thread_count())


@contextmanager
def _threads(count: int) -> Iterator[None]:
    before = dr.thread_count()
    if count == before:
        yield
        return
    dr.sync_thread()
    dr.set_thread_count(count)
    try:
        yield
    finally:
        dr.sync_thread()
        dr.set_thread_count(before)
