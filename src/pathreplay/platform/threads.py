"""How many threads Dr.Jit's pool has for a while: a second one to read files, or a single one for all sums."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager

import drjit as dr


def spare_thread() -> AbstractContextManager[None]:
    """Within this block, in which Mitsuba reads files, the pool has at least two threads.

    Mitsuba 3.9 hands the blocks of an EXR to the pool and waits without helping. In a pool of one, which a process gets
    that may use a single core (`taskset -c 0`, small containers), nobody else is there to do them. Writing has the same
    fault; we write without Mitsuba (see `exr_bytes`).
    """
    return _threads(max(2, dr.thread_count()))


def one_thread(wanted: bool) -> AbstractContextManager[None]:
    """Within this block, if it is ``wanted``, Dr.Jit computes in a single thread, with the same bits each time.

    Threads add to pixels and gradients by atomic additions, in the order in which they happen to arrive. No file of
    Mitsuba's may be read or written in the block: see `spare_thread`.
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
