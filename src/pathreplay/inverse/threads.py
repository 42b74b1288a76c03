"""One thread for all sums, so that their order, and with it every bit of a run, is the same each time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import drjit as dr
import mitsuba as mi

from pathreplay.errors import PathreplayError


@contextmanager
def one_thread(wanted: bool) -> Iterator[None]:
    """Within this block, if it is ``wanted``, Dr.Jit computes in the calling thread; what was set before comes back.

    Threads add to pixels and gradients by atomic additions, in the order in which they happen to arrive. No file of
    Mitsuba's may be read or written in the block: it would wait for other threads for ever.
    """
    if not wanted:
        yield
        return
    before = dr.thread_count()
    dr.sync_thread()
    dr.set_thread_count(1)
    try:
        yield
    finally:
        dr.sync_thread()
        dr.set_thread_count(before)


def require_one_thread_possible() -> None:
    """Raise PathreplayError where the active variant runs on a GPU, whose threads cannot be told to be one."""
    if not mi.variant().startswith("llvm"):
        raise PathreplayError(
            f"deterministic = true needs an LLVM variant, this is '{mi.variant()}': on a GPU the order of additions "
            "is random; set variant = 'llvm_ad_rgb', or leave 'deterministic' out"
        )
