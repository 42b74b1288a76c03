"""Reports the processor, and changes the size of Dr.Jit's thread pool temporarily.

Mitsuba needs at least two threads to read files. Sums are reproducible only with a single thread.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import drjit as dr


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def processor_name() -> str:
    """Return the name of the processor if the system reports it, otherwise the machine type."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def spare_thread() -> AbstractContextManager[None]:
    """Use at least two threads within this block, in which Mitsuba reads files.

    Mitsuba 3.9 submits the blocks of an EXR file to the pool, and the submitting thread only waits. A process that is
    restricted to a single core (`taskset -c 0`, small containers) has a pool of one thread, which would wait forever.
    Mitsuba's EXR writer has the same defect, so `exr_bytes` writes EXR files without Mitsuba.
    """
    return _threads(max(2, dr.thread_count()))


def one_thread(wanted: bool) -> AbstractContextManager[None]:
    """If ``wanted``, use a single thread within this block, so that results are reproducible bit by bit.

    Several threads add to pixels and gradients atomically, in random order. Mitsuba must not read or write files in
    this block; see `spare_thread`.
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
