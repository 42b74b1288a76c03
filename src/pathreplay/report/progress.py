"""Shows the progress of a job on stderr: a bar on a terminal, periodic lines otherwise."""

from __future__ import annotations

import contextlib
import sys
import time
from typing import IO, Any, cast

import rich.progress
from rich.console import Console

from pathreplay.errors import plain_line
from pathreplay.inverse.loop.events import Event, Notes, Started, Stepped

# Minimum seconds between two lines if there is no bar. With this limit, the log of a long run stays readable.
_SECONDS = 10.0


class _Forgiving:
    """Stream that writes to stderr and ignores errors: a closed terminal must not keep a run from writing its results.

    The stream ignores write errors, a missing stderr (None in a program without a console), and the RuntimeError that
    Python raises if a signal handler prints while the interrupted code is printing.
    """

    def __init__(self) -> None:
        self._stream = sys.stderr

    def write(self, text: str) -> int:
        with contextlib.suppress(OSError, RuntimeError):
            return len(text) if self._stream is None else self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError, RuntimeError):
            if self._stream is not None:
                self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


class Progress:
    """Context manager that shows the progress of a job if ``shown`` is set, and otherwise shows nothing.

    In notebooks, `NotebookPanel` is used instead, because the progress bar of the package rich needs ipywidgets there.
    """

    def __init__(self, shown: bool) -> None:
        self._stream = cast(IO[str], _Forgiving())
        console = Console(file=self._stream, force_jupyter=False)
        self._shown, self._lines = shown, shown and not console.is_terminal
        self._notes = Notes()
        self._printed, self._begin, self._before = time.monotonic(), time.monotonic(), 0
        self._bar = rich.progress.Progress(
            rich.progress.TextColumn("{task.description}"),
            rich.progress.BarColumn(),
            rich.progress.MofNCompleteColumn(),
            rich.progress.TextColumn("{task.fields[loss]}"),
            rich.progress.TimeElapsedColumn(),
            rich.progress.TextColumn("left"),
            rich.progress.TimeRemainingColumn(),
            console=console,
            disable=not shown or self._lines,
        )
        self._task = self._bar.add_task("optimize", total=None, loss="")

    def __enter__(self) -> Progress:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def say(self, text: str) -> None:
        """Show the current phase of the job."""
        self._bar.update(self._task, description=text)
        if self._lines:
            self._print(text)

    def status(self, text: str) -> None:
        """Show a transient status, if there is a bar."""
        self._bar.update(self._task, description=f"optimizing: {text}")

    def remark(self, text: str) -> None:
        """Print a permanent line if progress is shown."""
        if self._shown:
            self.note(text)

    def note(self, text: str) -> None:
        """Print a permanent line above the bar."""
        self._bar.console.print(
            f"pathreplay: {plain_line(text)}", markup=False, highlight=False, soft_wrap=True, emoji=False
        )

    def observe(self, event: Event) -> None:
        """Show an event of the run."""
        if isinstance(event, Started):
            self.start(event.done, event.wanted)
        elif isinstance(event, Stepped):
            self.advance(event.entry.loss)
        elif self._shown and (note := self._notes.of(event)):
            self.note(note)

    def start(self, done: int, total: int) -> None:
        self._bar.reset(self._task, total=total, completed=done, description="optimizing", loss="")
        self._begin, self._before = time.monotonic(), done
        if self._lines:
            self._print(f"optimizing, iterations {done} to {total}")

    def advance(self, loss: float) -> None:
        self._bar.update(self._task, advance=1, loss=f"loss {loss:.4g}")
        if not self._lines:
            return
        task = self._bar.tasks[0]
        done, total = int(task.completed), int(task.total or 0)
        if done == self._before + 1 or done == total or time.monotonic() - self._printed >= _SECONDS:
            left = (time.monotonic() - self._begin) / max(1, done - self._before) * (total - done)
            self._print(f"iteration {done} of {total}, loss {loss:.4g}, about {left:.0f} s left")

    def _print(self, text: str) -> None:
        self._printed = time.monotonic()
        print(f"pathreplay: {text}", file=self._stream, flush=True)
