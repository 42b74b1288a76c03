"""Lends Mitsuba a second thread while it reads files: with a pool of one it waits for ever at an EXR.

Mitsuba 3.9 hands the blocks of an EXR to Dr.Jit's pool and waits without helping. In a pool of one, which a process
gets that may use a single core (`taskset -c 0`, small containers), nobody else is there to do them. Writing has the
same fault; we write without Mitsuba (see `exr_bytes`).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import drjit as dr


@contextmanager
def spare_thread() -> Iterator[None]:
    """Within this block Dr.Jit's pool has at least two threads; afterwards it has as many as before."""
    before = dr.thread_count()
    if before > 1:
        yield
        return
    dr.set_thread_count(2)
    try:
        yield
    finally:
        dr.set_thread_count(before)
