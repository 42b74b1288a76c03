"""What the user sees while a job runs: one bar with loss and remaining time, on stderr."""

from __future__ import annotations

import contextlib
import sys
from types import TracebackType
from typing import IO, Any, cast

import rich.progress
from rich.console import Console


class _Forgiving:
    """Stderr, or silence once it is gone: a terminal that closes may not end the writing of what was found."""

    def __init__(self) -> None:
        self._stream = sys.stderr

    def write(self, text: str) -> int:
        with contextlib.suppress(OSError):
            return self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError):
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


class Progress:
    """A progress bar, or silence; use as a context manager."""

    def __init__(self, shown: bool) -> None:
        self._bar = rich.progress.Progress(
            rich.progress.TextColumn("{task.description}"),
            rich.progress.BarColumn(),
            rich.progress.MofNCompleteColumn(),
            rich.progress.TextColumn("{task.fields[loss]}"),
            rich.progress.TimeElapsedColumn(),
            rich.progress.TextColumn("left"),
            rich.progress.TimeRemainingColumn(),
            console=Console(file=cast(IO[str], _Forgiving())),
            disable=not shown,
        )
        self._task = self._bar.add_task("optimize", total=None, loss="")

    def __enter__(self) -> Progress:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def say(self, text: str) -> None:
        """Name what is going on now."""
        self._bar.update(self._task, description=text)

    def note(self, text: str) -> None:
        """One line that stays, above the bar."""
        self._bar.console.print(f"pathreplay: {text}", markup=False, highlight=False, soft_wrap=True)

    def start(self, done: int, total: int) -> None:
        """Begin to count iterations."""
        self._bar.reset(self._task, total=total, completed=done, description="optimizing", loss="")

    def advance(self, loss: float) -> None:
        """One iteration is done."""
        self._bar.update(self._task, advance=1, loss=f"loss {loss:.4g}")
