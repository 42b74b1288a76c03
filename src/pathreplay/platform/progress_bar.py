"""A transient progress bar on standard error, or occasional lines if standard error is not a terminal."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.text import Text

PAUSE_S = 10.0  # seconds between two lines
Told = Callable[[int, int], None]
"""Function that is called with the number of completed steps and the number of all steps."""


@contextmanager
def progress_bar(what: str, line: Callable[[int, int], str], announced: Collection[int] = (0,)) -> Iterator[Told]:
    """Yield the function that updates the bar, whose name is ``what``.

    Without a terminal, the function prints a ``line`` if the last line is `PAUSE_S` old. At the numbers of completed
    steps in ``announced``, it always prints a line.
    """
    console = Console(stderr=True, force_jupyter=False)
    if console.is_terminal:
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        with Progress(*columns, console=console, transient=True) as bar:
            task = bar.add_task(escape(what), total=None)
            yield lambda done, total: bar.update(task, completed=done, total=total)
        return
    last = time.monotonic()

    def tell(done: int, total: int) -> None:
        nonlocal last
        if done in announced or time.monotonic() - last >= PAUSE_S:
            last = time.monotonic()
            console.print(Text(f"pathreplay: {line(done, total)}"), soft_wrap=True)

    yield tell
