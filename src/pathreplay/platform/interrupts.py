"""Signals that request the end of a command or run: Ctrl-C, a scheduler's SIGTERM, a terminal's SIGHUP."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

from pathreplay.errors import PathreplayError

ENDING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

# Signals within this interval count as one request: the second must not interrupt what the first one started.
ONE_WISH_S = 1.0

_raised_at: list[float] = []  # time at which a signal handler last raised an exception


def raise_once(error: BaseException) -> None:
    """Raise ``error``, unless a signal handler raised an exception a moment ago that is still propagating."""
    now = time.monotonic()
    if _raised_at and now - _raised_at[-1] < ONE_WISH_S:
        return
    _raised_at[:] = [now]
    raise error


class Interrupted(KeyboardInterrupt):
    """A signal ended the command; ``number`` is the signal number."""

    def __init__(self, number: int) -> None:
        super().__init__(f"ended by {name_of(number)}")
        self.number = number


def name_of(number: int) -> str:
    """The signal's name for users."""
    return "Ctrl-C" if number == signal.SIGINT else signal.Signals(number).name


@contextmanager
def handled(
    handle: Callable[[int, FrameType | None], object], keep: Callable[[], bool] = lambda: False
) -> Iterator[None]:
    """Within this block ``handle`` receives the signals in `ENDING`, if this is the main thread.

    SIGTERM and SIGHUP stay ignored if the parent process ignores them (nohup). The previous handlers are restored at
    the end, unless ``keep`` returns True because the process is about to exit.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread can set handlers
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
    """Make each signal raise `Interrupted` while a command runs, even if a library converts the exception.

    Once a signal has arrived, the handlers stay in place, so that nothing disturbs the end of the process.
    """
    numbers: list[int] = []

    def handle(number: int, frame: FrameType | None) -> None:
        numbers.append(number)
        raise_once(Interrupted(number))

    with handled(handle, keep=lambda: bool(numbers)):
        try:
            yield
        except (RuntimeError, ImportError, SystemError):
            if numbers:  # Dr.Jit converts exceptions raised during tracing
                raise Interrupted(numbers[0]) from None
            raise


@contextmanager
def undisturbed() -> Iterator[None]:
    """Defer signals to the end of this short block, also if it ends with an exception; each is then raised again."""
    late: list[int] = []
    try:
        with handled(lambda number, frame: late.append(number)):
            yield
    finally:
        for number in late:
            signal.raise_signal(number)


@dataclass
class Stop:
    """A request to end a run after the current iteration."""

    by: str | None = None
    """Source of the request: 'Ctrl-C', 'SIGTERM' or 'SIGHUP'; None without a request."""
    aborted: bool = False


@contextmanager
def stopping(say: Callable[[str], None], remedy: str, stop: Stop | None = None) -> Iterator[Stop]:
    """Within this block the first signal requests a stop, and a second one that is Ctrl-C raises KeyboardInterrupt.

    SIGTERM and SIGHUP only request a stop, however often they arrive: schedulers and terminals send them repeatedly.
    ``say`` receives status messages; ``remedy`` is the message of the KeyboardInterrupt; ``stop`` is the request to
    set, if the caller has one already.
    """
    stop = Stop() if stop is None else stop

    def handle(number: int, frame: FrameType | None) -> None:
        if stop.by is None:
            stop.by = name_of(number)
            say(f"{stop.by}: stopping after this iteration (Ctrl-C aborts)")
        elif number == signal.SIGINT:
            stop.aborted = True
            raise_once(KeyboardInterrupt(remedy))

    with handled(handle):
        try:
            yield stop
        except (RuntimeError, PathreplayError):
            if stop.aborted:  # Dr.Jit converts exceptions raised during tracing
                raise KeyboardInterrupt(remedy) from None
            raise
