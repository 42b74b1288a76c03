"""How a run is stopped: by the first signal after the iteration that is under way, by a second Ctrl-C at once."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from pathreplay.errors import PathreplayError
from pathreplay.interrupts import handled, name_of, raise_once


class Stop:
    """Tells the loop to end after the iteration that is under way, and by whom that was asked for."""

    def __init__(self) -> None:
        self.number: int | None = None
        self.aborted = False

    def wanted(self) -> bool:
        return self.number is not None

    def by(self) -> str | None:
        """'Ctrl-C', 'SIGTERM' or 'SIGHUP'; None if nobody asked."""
        return None if self.number is None else name_of(self.number)


@contextmanager
def stopping(say: Callable[[str], None], way_out: str) -> Iterator[Stop]:
    """Within this block a first signal asks for a stop, and a second one that is a Ctrl-C raises KeyboardInterrupt.

    SIGTERM and SIGHUP only ask, however often they come: schedulers and terminals send them more than once. ``say`` is
    told what is going on; ``way_out`` is the message of the KeyboardInterrupt.
    """
    stop = Stop()

    def handle(number: int, frame: FrameType | None) -> None:
        if stop.number is None:
            stop.number = number
            say(f"{name_of(number)}: stopping after this iteration (Ctrl-C aborts)")
        elif number == signal.SIGINT:
            stop.aborted = True
            raise_once(KeyboardInterrupt(way_out))

    with handled(handle):
        try:
            yield stop
        except (RuntimeError, PathreplayError):
            if stop.aborted:  # Dr.Jit turns what is raised while it traces into errors of its own
                raise KeyboardInterrupt(way_out) from None
            raise
