"""What a run came to, in numbers and pictures: everything that the report, the files and the result tell."""

from __future__ import annotations

import shlex
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pathreplay.inverse.checkpoint import Entry
from pathreplay.inverse.config import Config
from pathreplay.inverse.grids import matched, rmse, slices
from pathreplay.inverse.images import Image, difference
from pathreplay.inverse.pose import Pose, PoseError
from pathreplay.inverse.rival import Rival
from pathreplay.inverse.values import Array

# Differences are shown brighter than the pictures: a converged one would be black otherwise.
DIFFERENCE_GAIN = 4.0


def resume_command(folder: Path) -> str:
    """The command line that goes on with a run."""
    return f"pathreplay optimize --resume {shlex.quote(str(folder))}"


@dataclass(frozen=True)
class ViewPictures:
    """One view: target, start, result and rival's result (linear), and the exposure under which all are shown."""

    name: str
    target: Image
    start: Image
    result: Image
    exposure: float
    rival: Image | None = None

    def pictures(self) -> dict[str, Image]:
        """The pictures to show; a difference is result - target, red above and blue below, DIFFERENCE_GAIN times."""
        gap = difference(self.result, self.target) * DIFFERENCE_GAIN
        found = {"target": self.target, "start": self.start, "result": self.result, "difference": gap}
        if self.rival is None:
            return found
        return {**found, "rival": self.rival, "rival-difference": difference(self.rival, self.target) * DIFFERENCE_GAIN}

    def error(self) -> float:
        """Root mean square difference of result and target; includes the noise of both."""
        return rmse(self.result, self.target)

    def error_at_start(self) -> float:
        return rmse(self.start, self.target)


@dataclass(frozen=True)
class Recovered:
    """One parameter: start, result, truth where it is known, and the rival's result where there was one."""

    key: str
    file_name: str
    """What of the key is in the names of its files."""
    start: Array
    result: Array
    truth: Array | None
    rival: Array | None = None

    def textures(self) -> dict[str, Image]:
        """Start, result and truth as images; empty for what is no texture of one to four channels."""
        if self.result.ndim != 3 or self.result.shape[2] > 4:
            return {}
        images = {"start": self.start, "result": self.result}
        return images if self.truth is None else {**images, "truth": self.truth}

    def volumes(self) -> dict[str, Image]:
        """Middle slices of start, result, rival's result and truth, white at the largest value of the last of them.

        Empty for what is no volume (z, y, x, one to four channels). All are shown in the finest resolution.
        """
        if self.result.ndim != 4 or self.result.shape[3] > 4:
            return {}
        kinds = {"start": self.start, "result": self.result, "rival": self.rival, "truth": self.truth}
        given = {kind: volume for kind, volume in kinds.items() if volume is not None}
        finest = max(given.values(), key=lambda volume: volume.size)
        white = float((self.result if self.truth is None else self.truth).max()) or 1.0
        return {kind: slices(matched(volume, finest)) / white for kind, volume in given.items()}

    def numbers(self) -> dict[str, list[float]]:
        """Start, result and truth as numbers; empty for what has more of them than one reads (over 16)."""
        if self.result.ndim > 1 or self.result.size > 16:
            return {}
        rows = {"start": self.start.tolist(), "result": self.result.tolist()}
        return rows if self.truth is None else {**rows, "truth": self.truth.tolist()}

    def error(self) -> float | None:
        """Root mean square error against the truth."""
        return None if self.truth is None else rmse(self.result, self.truth)

    def error_at_start(self) -> float | None:
        return None if self.truth is None else rmse(self.start, self.truth)

    def relative_error(self) -> float | None:
        """|result - truth| / |truth| (L2 norms); None where the truth is unknown or zero."""
        if self.truth is None or not self.truth.any():
            return None
        return float(np.linalg.norm(matched(self.result, self.truth) - self.truth) / np.linalg.norm(self.truth))

    def rival_error(self) -> float | None:
        return None if self.truth is None or self.rival is None else rmse(self.rival, self.truth)


@dataclass(frozen=True)
class RecoveredPose:
    """One pose: translation and rotation vector (radians) at the start and in the result, by part, and their errors."""

    pose: Pose
    start: dict[str, Array]
    result: dict[str, Array]
    value: Array
    """The transform (4 x 4) or the vertices in the result."""
    error: PoseError | None
    error_at_start: PoseError | None

    def rows(self) -> dict[str, str]:
        """Readable rows: what was moved by how much, and how far it is from the truth."""
        table: dict[str, str] = {}
        for kind, parts in (("start", self.start), ("recovered", self.result)):
            for part, array in parts.items():
                unit = "°" if part == "rotation" else ""
                numbers = np.degrees(array) if part == "rotation" else array
                table[f"{kind}, {part}"] = ", ".join(f"{v:.4g}{unit}" for v in numbers)
        if self.error is not None and self.error_at_start is not None:
            table["error at the start"] = str(self.error_at_start)
            table["error"] = str(self.error)
        return table

    def as_dict(self) -> dict[str, Any]:
        """Everything for parameters.json; rotations in degrees."""
        table: dict[str, Any] = {"pose": self.pose.kind, "pivot": list(self.pose.pivot)}
        for kind, parts in (("start", self.start), ("result", self.result)):
            table[kind] = {p: (np.degrees(a) if p == "rotation" else a).tolist() for p, a in parts.items()}
        if self.value.shape == (4, 4):
            table["value"] = self.value.tolist()
            if self.pose.truth is not None:
                table["truth"] = self.pose.truth.tolist()
        for kind, error in (("error", self.error), ("error_at_start", self.error_at_start)):
            if error is not None:
                table[kind] = asdict(error)
        if self.pose.distance is not None:
            table["distance"] = self.pose.distance
        return table


@dataclass(frozen=True)
class Contestant:
    """One of two integrators that had the same time: iterations, seconds, and the errors that they ended with."""

    name: str
    history: tuple[Entry, ...]
    picture_error: float
    """Root mean square over all views, noise taken out, at the last judgement; NaN where none was made."""
    errors: dict[str, float]

    def seconds(self) -> float:
        return sum(entry.seconds for entry in self.history)


def _contestant(name: str, history: tuple[Entry, ...], errors: dict[str, float]) -> Contestant:
    judged = [entry.picture_error for entry in history if entry.picture_error is not None]
    return Contestant(name, history, judged[-1] if judged else float("nan"), errors)


@dataclass(frozen=True)
class Outcome:
    """Everything that the report tells."""

    config: Config
    source: Path | None
    folder: Path
    views: tuple[ViewPictures, ...]
    recovered: tuple[Recovered, ...]
    poses: tuple[RecoveredPose, ...]
    history: tuple[Entry, ...]
    values: dict[str, Array]
    """Variables as people see them, and what poses make of the scene, by key."""
    variant: str
    notes: tuple[str, ...]
    rival: Rival | None = None

    def command(self) -> str:
        """The command line that makes this run again, or goes on with it where it was stopped."""
        if len(self.history) < self.config.iterations:
            return resume_command(self.folder)
        job = self.folder / "config.json" if self.source is None else self.source
        return f"pathreplay optimize {shlex.quote(str(job))}"

    def seconds(self) -> float:
        return sum(entry.seconds for entry in self.history)

    def dropped(self) -> int:
        return sum(entry.dropped for entry in self.history)

    def judge(self) -> str:
        """Type of the integrator that renders the pictures by which two runs are compared."""
        target = self.config.target
        return self.config.integrator.type if target.images is not None else target.integrator.type

    def names(self) -> tuple[str, str]:
        """What the job and its rival are called: their integrators; a run against itself has one name twice."""
        ours = self.config.integrator.type
        theirs = ours if self.config.rival is None else self.config.rival.type
        return ours, theirs if theirs != ours else f"{theirs} (rival)"

    def caption(self, kind: str) -> str:
        """What stands below a picture, texture or volume of that kind."""
        ours, theirs = self.names()
        captions = {
            "result": "recovered" if self.rival is None else f"recovered by {ours}",
            "rival": f"recovered by {theirs}",
            "difference": f"difference ×{DIFFERENCE_GAIN:g}",
            "rival-difference": f"its difference ×{DIFFERENCE_GAIN:g}",
        }
        return captions.get(kind, kind)

    def comparison(self) -> list[Contestant]:
        """The job and its rival in numbers; empty where there was none."""
        if self.rival is None:
            return []
        known = [item for item in self.recovered if item.truth is not None]
        ours = {item.key: item.error() or 0.0 for item in known}
        theirs = {item.key: item.rival_error() or 0.0 for item in known}
        name, rival = self.names()
        return [_contestant(name, self.history, ours), _contestant(rival, self.rival.history, theirs)]
