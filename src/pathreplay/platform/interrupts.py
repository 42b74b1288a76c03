"""Signals that ask a command, or the run that it does, to end: Ctrl-C, a scheduler's SIGTERM, a terminal's SIGHUP."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import Any

from pathreplay.errors import PathreplayError

ENDING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

# Two signals that are closer than this are one wish to end: the second may not disturb what the first one set going.
ONE_WISH_S = 1.0

_raised_at: list[float] = []  # when a signal last raised something


def raise_once(error: BaseException) -> None:
    """Raise ``error``, unless a signal has raised one a moment ago: that one is on its way out."""
    now = time.monotonic()
    if _raised_at and now - _raised_at[-1] < ONE_WISH_S:
        return
    _raised_at[:] = [now]
    raise error


class Interrupted(KeyboardInterrupt):
    """A signal ended the command. ``number`` is the signal's."""

    def __init__(self, number: int) -> None:
        super().__init__(f"ended by {name_of(number)}")
        self.number = number


def name_of(number: int) -> str:
    """The signal as users know it."""
    return "Ctrl-C" if number == signal.SIGINT else signal.Signals(number).name


@contextmanager
def handled(handle: Callable[[int, FrameType | None], Any], keep: Callable[[], bool] = lambda: False) -> Iterator[None]:
    """Within this block ``handle`` gets the signals of `ENDING`; in threads other than the main one nothing happens.

    SIGTERM and SIGHUP stay ignored where the parent process ignores them (nohup). Handlers come back at the end,
    unless ``keep`` says that it is the end of the process.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # signals belong to the main thread
        return
    before = {number: signal.getsignal(number) for number in ENDING}
    ours = [n for n, old in before.items() if old is not None and (n == signal.SIGINT or old != signal.SIG_IGN)]
    try:
        for number in ours:
            signal.signal(number, handle)
        yield
    finally:
        if not keep():
            for number in ours:
                signal.signal(number, before[number])


@contextmanager
def raised() -> Iterator[None]:
    """Around a command: each of the signals raises `Interrupted`, also where a library made another error of it.

    Once that has happened the signals keep their handlers: the process is about to end, in peace.
    """
    numbers: list[int] = []

    def handle(number: int, frame: FrameType | None) -> None:
        numbers.append(number)
        raise_once(Interrupted(number))

    with handled(handle, keep=lambda: bool(numbers)):
        try:
            yield
        except (RuntimeError, ImportError, SystemError):
            if numbers:  # Dr.Jit turns what is raised while it traces into errors of its own
                raise Interrupted(numbers[0]) from None
            raise


@contextmanager
def undisturbed() -> Iterator[None]:
    """Within this short block signals wait for its end, by an error too; then each comes as often as it was sent."""
    late: list[int] = []
    try:
        with handled(lambda number, frame: late.append(number)):
            yield
    finally:
        for number in late:
            signal.raise_signal(number)


@dataclass
class Stop:
    """Tells a run to end when it has done what is under way."""

    by: str | None = None
    """Who asked for it: 'Ctrl-C', 'SIGTERM' or 'SIGHUP'; None if nobody did."""
    aborted: bool = False


@contextmanager
def stopping(say: Callable[[str], None], way_out: str, stop: Stop | None = None) -> Iterator[Stop]:
    """Within this block a first signal asks for a stop, and a second one that is a Ctrl-C raises KeyboardInterrupt.

    SIGTERM and SIGHUP only ask, however often they come: schedulers and terminals send them more than once. ``say`` is
    told what is going on; ``way_out`` is the message of the KeyboardInterrupt; ``stop`` is what is asked, if it is
    there before.
    """
    stop = Stop() if stop is None else stop

    def handle(number: int, frame: FrameType | None) -> None:
        if stop.by is None:
            stop.by = name_of(number)
            say(f"{stop.by}: stopping after this iteration (Ctrl-C aborts)")
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
