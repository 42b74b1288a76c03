"""The progress display in a notebook: a single output that is updated while a job runs."""

from __future__ import annotations

import contextlib
import sys
import time
from typing import Any

from pathreplay.errors import plain_line
from pathreplay.inverse.loop.events import Event, Notes, Started, Stepped
from pathreplay.report.live_pictures import LivePictures
from pathreplay.report.pages.page import View
from pathreplay.report.pages.panel import Panel
from pathreplay.report.progress import Progress

# Minimum seconds between two updates, because each update sends the whole output to the browser.
PAUSE_S = 1.0
MOST_NOTES = 8


def in_notebook() -> bool:
    """Return whether this process is the kernel of a notebook, which can show HTML."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return getattr(shell, "kernel", None) is not None


class NotebookPanel:
    """Shows the progress of a job in a notebook, with the interface of `Progress`.

    The panel is a context manager. The last state of the panel stays visible after the block.
    """

    def __init__(self) -> None:
        from IPython.display import HTML, display

        self._html, self._title, self._status = HTML, "optimize", "preparing"
        self._wanted = self._before = 0
        self._lines: list[str] = []
        self._notes = Notes()
        self._pictures: LivePictures | None = None
        self._views: tuple[int, tuple[View, ...]] = -1, ()
        self._begin = self._told = time.monotonic()
        self._handle: Any = display(self._html(self._panel().html()), display_id=True)

    def __enter__(self) -> NotebookPanel:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._status = "ended" if kind is None else f"ended by {kind.__name__}"
        self._draw()

    def follow(self, pictures: LivePictures, title: str) -> None:
        """Show the images and losses of a run from now on."""
        self._pictures, self._title = pictures, title

    def say(self, text: str) -> None:
        self._status = text
        self._draw()

    def status(self, text: str) -> None:
        self._status = f"optimizing: {text}"

    def remark(self, text: str) -> None:
        """Add a permanent line; see `note`."""
        self.note(text)

    def note(self, text: str) -> None:
        """Add a permanent line. Only the last `MOST_NOTES` lines are shown."""
        self._lines = [*self._lines, plain_line(text)][-MOST_NOTES:]
        self._draw()

    def observe(self, event: Event) -> None:
        if isinstance(event, Started):
            self._begin, self._before, self._wanted = time.monotonic(), event.done, event.wanted
            self.say("optimizing")
        elif isinstance(event, Stepped):
            if time.monotonic() - self._told >= PAUSE_S or event.entry.iteration + 1 == self._wanted:
                self._draw()
        elif note := self._notes.of(event):
            self.note(note)

    def _draw(self) -> None:
        with contextlib.suppress(OSError, RuntimeError):  # the front end is gone, or a signal interrupted the output
            self._handle.update(self._html(self._panel().html()))
        self._told = time.monotonic()

    def _panel(self) -> Panel:
        if self._pictures is not None and self._pictures.shown_at != self._views[0]:
            self._views = self._pictures.shown_at, self._pictures.small()
        losses = self._pictures.losses() if self._pictures else ()
        return Panel(
            self._title,
            self._status,
            len(losses),
            self._wanted,
            self._left(len(losses)),
            losses,
            self._views[1],
            tuple(self._lines),
        )

    def _left(self, done: int) -> str:
        steps = done - self._before
        if not 0 < steps or done == self._wanted:
            return ""
        return f"about {(time.monotonic() - self._begin) / steps * (self._wanted - done):.0f} s left"


def progress_of(shown: bool) -> Progress | NotebookPanel:
    """Create the progress display: a panel in a notebook, otherwise a bar or lines; silent unless ``shown`` is set."""
    return NotebookPanel() if shown and in_notebook() else Progress(shown)
