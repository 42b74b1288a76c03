"""Signals that request the end of a command or run: Ctrl-C, a scheduler's SIGTERM, a terminal's SIGHUP."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

from pathreplay.errors import PathreplayError

ENDING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

# Interval in seconds within which several signals count as one, so that a second signal does not interrupt the reaction
# to the first signal.
ONE_WISH_S = 1.0
SOON_S = 0.05
"""Seconds after which a signal is repeated if Python has ignored the exception of its handler: see `handled`."""

_raised_at: list[float] = []  # time at which a signal handler last raised an exception


def raise_once(error: BaseException) -> None:
    """Raise ``error``, unless this function raised an exception less than `ONE_WISH_S` seconds ago.

    Within this time, the earlier exception may still be propagating, and ``error`` would replace it.
    """
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
    """Return the name of a signal for messages to the user."""
    return "Ctrl-C" if number == signal.SIGINT else signal.Signals(number).name


@dataclass(eq=False)
class _Block:
    """An active block of `handled`: its handler, and the handlers to restore at its end, by signal number."""

    handle: Callable[[int, FrameType | None], object]
    before: dict[int, Callable[[int, FrameType | None], object] | int]

    def restore(self) -> None:
        """Restore the handlers. A later block that is still active restores them in place of the handler of this."""
        for number, handler in self.before.items():
            later = next((block for block in _blocks if block.before.get(number) is self.handle), None)
            if later is None:
                signal.signal(number, handler)
            else:
                later.before[number] = handler


_blocks: list[_Block] = []  # the active blocks; blocks of generators can end in any order
_hooks: list[Callable[[sys.UnraisableHookArgs], object]] = []  # the hook that `_repeat` replaces during blocks


def _repeat(args: sys.UnraisableHookArgs) -> None:
    """Repeat the signal whose exception Python has ignored. Pass all other ignored exceptions on."""
    if not isinstance(args.exc_value, KeyboardInterrupt):
        _hooks[0](args)
        return
    number = args.exc_value.number if isinstance(args.exc_value, Interrupted) else signal.SIGINT

    def again() -> None:
        _raised_at.clear()
        if _blocks:
            signal.raise_signal(number)

    timer = threading.Timer(SOON_S, again)
    timer.daemon = True
    timer.start()


@contextmanager
def handled(
    handle: Callable[[int, FrameType | None], object], keep: Callable[[], bool] = lambda: False
) -> Iterator[None]:
    """Call ``handle`` for each signal in `ENDING` within this block. Outside of the main thread, do nothing.

    If the parent process ignores SIGTERM or SIGHUP (nohup), this process also ignores the signal. The previous handlers
    are restored at the end of the block, unless ``keep`` returns True because the process is about to exit. Several
    blocks can end in any order; signals call the handler of the block that was entered last.

    Python ignores an exception of ``handle`` if the signal arrives within a destructor or a callback of a weak
    reference. If the exception is a KeyboardInterrupt, the signal is repeated soon after, unless all blocks have ended.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread can set handlers
        return
    known = {number: signal.getsignal(number) for number in ENDING}
    before = {n: old for n, old in known.items() if old is not None and (n == signal.SIGINT or old != signal.SIG_IGN)}
    block = _Block(handle, before)
    if not _blocks:
        _hooks[:], sys.unraisablehook = [sys.unraisablehook], _repeat
    _blocks.append(block)
    try:
        for number in before:
            signal.signal(number, handle)
        yield
    finally:
        _blocks.remove(block)
        if not _blocks and sys.unraisablehook is _repeat:
            sys.unraisablehook = _hooks[0]
        if not keep():
            block.restore()


@contextmanager
def raised() -> Iterator[None]:
    """Make each signal raise `Interrupted` within this block.

    If a library converts this exception to another, the block still raises `Interrupted`. After a signal, the handlers
    stay in place until the process ends, so that further signals cannot kill the process.
    """
    numbers: list[int] = []

    def handle(number: int, frame: FrameType | None) -> None:
        numbers.append(number)
        raise_once(Interrupted(number))

    with handled(handle, keep=lambda: bool(numbers)):
        try:
            yield
        except (RuntimeError, ImportError, SystemError):
            if numbers:  # Dr.Jit was tracing, and has replaced the `Interrupted` by this exception
                raise Interrupted(numbers[0]) from None
            raise


@contextmanager
def undisturbed() -> Iterator[None]:
    """Defer signals until this short block ends, normally or by an exception, and then raise each signal again."""
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
    """Source of the request, such as 'Ctrl-C', 'SIGTERM', 'the stop button' or 'a callback'; None without a request."""
    aborted: bool = False
    """Whether a second Ctrl-C has aborted the run."""


@contextmanager
def stopping(say: Callable[[str], None], remedy: str, stop: Stop | None = None) -> Iterator[Stop]:
    """Request a stop at the first signal within this block, and raise KeyboardInterrupt at a later Ctrl-C.

    SIGTERM and SIGHUP only request a stop, however often they arrive: schedulers and terminals send them repeatedly.

    Args:
        say: receives status messages.
        remedy: message of the KeyboardInterrupt.
        stop: the request to set; default: a new one.

    Yields:
        The request.
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
            if stop.aborted:  # Dr.Jit was tracing, and has replaced the KeyboardInterrupt by this exception
                raise KeyboardInterrupt(remedy) from None
            raise
