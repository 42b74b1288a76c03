"""Writes the initial files and periodic checkpoints of a run, and restores runs from these files."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Mapping
from pathlib import Path

from pathreplay.errors import PathreplayError
from pathreplay.integrators.film.image import picture_shape
from pathreplay.inverse.dataset.targets import Targets
from pathreplay.inverse.images.io import Image, exr_bytes, read_image
from pathreplay.inverse.loop import checkpoint
from pathreplay.inverse.loop.checkpoint import Run
from pathreplay.inverse.loop.checksums import Sums, with_sums
from pathreplay.inverse.loop.events import Event, Started, Stepped, Stopped
from pathreplay.inverse.parameters.values import require_finite_array
from pathreplay.inverse.problem.problem import Problem
from pathreplay.platform.atomic_files import Content, made
from pathreplay.platform.files import file_problem
from pathreplay.runs.run_folder import BASELINE_CHECKPOINT, CHECKPOINT, RunFolder

CAPTURE = "capture.sha256"
"""File with a hash of the capture's cameras, to detect a change of the cameras before a run is resumed."""


class Saving:
    """Writes a checkpoint of a run into its folder at intervals of ``every`` iterations, and at the end of the run."""

    def __init__(self, folder: RunFolder, run: Run, every: int) -> None:
        self.folder, self.run, self.every = folder, run, every
        self.saved = 0

    def observe(self, event: Event) -> None:
        """Write a checkpoint if one is due. Raises PathreplayError if the folder is gone or cannot be written."""
        if isinstance(event, Started):
            self.saved = event.done
        elif isinstance(event, Stepped):
            done = event.entry.iteration + 1
            self.folder.require_in_place(f"iterations {self.saved + 1} to {done} are")
            if done % self.every == 0:
                self._write(done)
        elif isinstance(event, Stopped) and event.done > self.saved:
            self._write(event.done)

    def close(self) -> None:
        """Save the iterations that are not saved yet. Raises the same errors as `observe`."""
        if self._runs_are_whole() and len(self.run.history) > self.saved:
            self._write(len(self.run.history))

    def rescued(self) -> bool:
        """Try to save the iterations before an error of the run. Return whether all iterations are saved."""
        if not self._runs_are_whole() or not self.run.history:
            return False
        with contextlib.suppress(PathreplayError):  # the caller reports the error of the run instead
            self.close()
        return self.saved == len(self.run.history)

    def _runs_are_whole(self) -> bool:
        return all(run.whole for run in _runs(self.run).values())

    def _write(self, done: int) -> None:
        self.folder.write(_checkpoints(self.run))
        self.saved = done


def first_files(problem: Problem, before: Mapping[str, Image], run: Run) -> dict[str, Content]:
    """Return the initial files of a run by name. The run can be resumed from these files.

    The files contain the targets, the weights, the images at the initial values, their checksums, and the checkpoints.
    ``before`` contains the images at the initial values by view name.
    """
    pictures = {_picture("target", view.name): view.target for view in problem.views}
    pictures |= {_picture("weight", view.name): view.weight for view in problem.views if view.weight is not None}
    pictures |= {_picture("start", name): image for name, image in before.items()}
    files = with_sums({name: made(exr_bytes, image) for name, image in pictures.items()})
    if problem.capture is not None:
        files[CAPTURE] = problem.capture.encode() + b"\n"
    return files | _checkpoints(run)


def saved_targets(folder: Path) -> Targets:
    """Read the targets and weights of a run folder. Raises PathreplayError if a file differs from its checksum."""
    sums = Sums(folder)
    images, weights = (
        {path.stem.removeprefix(f"{kind}-"): _read(path, sums) for path in sorted(folder.glob(_picture(kind, "*")))}
        for kind in ("target", "weight")
    )
    return Targets(images, weights)


def go_on(folder: Path, problem: Problem, run: Run, held: Collection[str] = ()) -> dict[str, Image]:
    """Restore a run from the checkpoint in its folder.

    Args:
        folder: the run folder.
        problem: the problem of the run.
        run: the run to restore, which is modified.
        held: keys of variables that a stage of the optimization may freeze.

    Returns:
        The images at the initial values by view name.

    Raises:
        PathreplayError: an image or a checkpoint is missing, damaged, or does not fit this run.
    """
    _require_capture(folder / CAPTURE, problem)
    keep, sums = problem.disk.keep, Sums(folder)
    before = {view.name: keep(_read(folder / _picture("start", view.name), sums)) for view in problem.views}
    for view in problem.views:
        home, there = problem.home(view)
        wanted = picture_shape(home.scene.sensors()[there.sensor])
        for kind, image in (("target", view.target), ("start", before[view.name])):
            path = folder / _picture(kind, view.name)
            if image.shape != wanted:
                raise PathreplayError(
                    f"{path} has shape {image.shape} (height, width, channels), but sensor '{view.name}' renders "
                    f"{wanted}; start a new run"
                )
            require_finite_array(str(path), image)
    for name, saved in _runs(run).items():
        checkpoint.restore(folder / name, saved, problem.variables, held)
    return before


def _require_capture(path: Path, problem: Problem) -> None:
    """Raise PathreplayError if the camera poses of the job's ``capture`` have changed since the start of the run."""
    if problem.capture is None:
        return
    try:
        saved = "" if file_problem(path, 1024) else path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        saved = ""
    if saved != problem.capture:
        changed = "has other cameras than when this run was started" if saved else f"has no hash in {path}"
        raise PathreplayError(f"The capture {changed}; restore it, or start a new run")


def _runs(run: Run) -> dict[str, Run]:
    return {CHECKPOINT: run} if run.baseline is None else {CHECKPOINT: run, BASELINE_CHECKPOINT: run.baseline}


def _checkpoints(run: Run) -> dict[str, Content]:
    return {name: checkpoint.save(part) for name, part in _runs(run).items()}


def _picture(kind: str, view: str) -> str:
    return f"images/{kind}-{view}.exr"


def _read(path: Path, sums: Sums) -> Image:
    sums.require(path)
    return read_image(path)
