"""The run folder as an observer: a checkpoint now and then, and one at the end."""

from __future__ import annotations

from pathreplay.inverse import checkpoint
from pathreplay.inverse.loop import Run
from pathreplay.inverse.observers import Event, Started, Stepped, Stopped
from pathreplay.inverse.run_folder import CHECKPOINT, RIVAL_CHECKPOINT, RunFolder


def checkpoints(run: Run, rival: Run | None) -> dict[str, bytes]:
    """The files from which the runs go on."""
    runs = {CHECKPOINT: run} if rival is None else {CHECKPOINT: run, RIVAL_CHECKPOINT: rival}
    return {
        name: checkpoint.save(each.values, each.optimiser.state(), each.history, each.learned)
        for name, each in runs.items()
    }


class Saving:
    """Writes the checkpoints of the runs into the folder, after every so many iterations (``every``)."""

    def __init__(self, folder: RunFolder, run: Run, rival: Run | None, every: int) -> None:
        self.folder, self.runs, self.every = folder, (run, rival), every
        self.saved = 0

    def observe(self, event: Event) -> None:
        """Raises PathreplayError where the folder is gone, or cannot be written."""
        if isinstance(event, Started):
            self.saved = event.done
        elif isinstance(event, Stepped):
            done = event.entry.iteration + 1
            self.folder.require_in_place(f"iterations {self.saved + 1} to {done} are")
            if done % self.every == 0:
                self._write(done)
        elif isinstance(event, Stopped) and event.done > self.saved:
            self._write(event.done)

    def _write(self, done: int) -> None:
        self.folder.write(checkpoints(*self.runs))
        self.saved = done
