"""Watch the function calls within a block, and restore the profiler that was there before."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def calls_noted(note: Callable[[FrameType], None]) -> Iterator[None]:
    """Call ``note`` with the frame of each Python function that is called."""
    before = sys.getprofile()
    sys.setprofile(lambda frame, event, _: note(frame) if event == "call" else None)
    try:
        yield
    finally:
        sys.setprofile(before)
