"""What a run came to, in numbers and pictures: everything that the report, the files and the result tell."""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pathreplay.inverse.config.schema import Config
from pathreplay.inverse.images.io import Image, difference
from pathreplay.inverse.images.metrics import Likeness
from pathreplay.inverse.loop.checkpoint import Run
from pathreplay.inverse.loop.verdict import Verdict
from pathreplay.inverse.parameters.grids import matched, rmse, shown, slices
from pathreplay.inverse.parameters.pose import Pose, PoseError, error_names
from pathreplay.inverse.parameters.values import Array

# Differences are shown brighter than the pictures: a converged one would be black otherwise.
DIFFERENCE_GAIN = 4.0
_KINDS = "target", "start", "result", "difference"


def resume_command(folder: Path) -> str:
    """The command line that goes on with a run."""
    return f"pathreplay optimize --resume {shlex.quote(str(folder))}"


@dataclass(frozen=True)
class ViewPictures:
    """One view: target, start, result and baseline's result (linear), and the exposure under which all are shown."""

    name: str
    target: Image
    start: Image
    result: Image
    exposure: float
    baseline: Image | None = None
    weight: Image | None = None
    """How much pixels count, if not all the same."""
    is_test: bool = False
    factors: tuple[float, ...] = ()
    """What the result is multiplied with, where exposures were recovered: one number, or one for each colour."""

    def error(self, image: Image) -> float:
        """Root mean square difference from the target, of what counts."""
        squares = np.square(image.astype(np.float64) - self.target)
        return float(np.sqrt(np.mean(squares if self.weight is None else squares * self.weight)))

    @cached_property
    def likenesses(self) -> dict[str, Likeness]:
        """Of 'start', 'result' and 'baseline', where there is one: of what counts, at the exposure of the view."""
        images = {"result": self.result, "start": self.start, "baseline": self.baseline}
        return {
            kind: Likeness.of(image, self.target, self.exposure, self.weight, flip=self.is_test)
            for kind, image in images.items()
            if image is not None
        }

    def as_dict(self) -> dict[str, Any]:
        """For views.json."""
        table: dict[str, Any] = {"is_test": self.is_test, "exposure": self.exposure}
        if self.factors:
            table["recovered_exposure"] = list(self.factors)
        for kind, likeness in self.likenesses.items():
            known = {name: value for name, value in asdict(likeness).items() if value is not None}
            table[kind] = {"rmse": self.error(getattr(self, kind)), **known}
        return table

    def kinds(self) -> tuple[str, ...]:
        """Kinds of pictures to show; a difference is result - target, red above, blue below, DIFFERENCE_GAIN times."""
        return (*_KINDS, *(() if self.baseline is None else ("baseline", "baseline-difference")))

    def picture(self, kind: str) -> Image:
        """The picture of a kind."""
        if kind in ("difference", "baseline-difference"):
            image = self.result if kind == "difference" else self.baseline
            assert image is not None
            return self._difference(image)
        return getattr(self, kind)

    def pictures(self) -> dict[str, Image]:
        """All pictures to show, by kind."""
        return {kind: self.picture(kind) for kind in self.kinds()}

    def _difference(self, image: Image) -> Image:
        gap = difference(image, self.target) * DIFFERENCE_GAIN
        return gap if self.weight is None else gap * (self.weight > 0)


@dataclass(frozen=True)
class Recovered:
    """One parameter: start, result, truth where it is known, and the baseline's result where there was one."""

    key: str
    file_name: str
    """What of the key is in the names of its files."""
    start: Array
    result: Array
    truth: Array | None
    baseline: Array | None = None
    faces: NDArray[np.integer] | None = None
    """Of a mesh whose vertices these are (3 m numbers)."""
    derived: bool = False
    """From others, which are recovered."""

    def known(self, *kinds: str) -> dict[str, Array]:
        """What there is of these kinds: 'start', 'result', 'baseline', 'truth'."""
        return {kind: value for kind in kinds if (value := getattr(self, kind)) is not None}

    def textures(self) -> dict[str, Image]:
        """Start, result and truth as images (see `shown`); empty unless it is a texture of one to four channels."""
        if self.result.ndim != 3 or self.result.shape[2] > 4:
            return {}
        return {kind: shown(image) for kind, image in self.known("start", "result", "truth").items()}

    def volumes(self) -> dict[str, Image]:
        """Middle slices of start, result, baseline's result and truth, white at the largest value of the last of them.

        Empty for what is no volume (z, y, x, one to four channels). All are shown in the finest resolution.
        """
        if self.result.ndim != 4 or self.result.shape[3] > 4:
            return {}
        given = self.known("start", "result", "baseline", "truth")
        finest = max(given.values(), key=lambda volume: volume.size)
        white = float((self.result if self.truth is None else self.truth).max()) or 1.0
        return {kind: slices(matched(volume, finest)) / white for kind, volume in given.items()}

    def numbers(self) -> dict[str, list[float]]:
        """Start, result and truth as numbers; empty for what has more of them than one reads (over 16)."""
        if self.result.ndim > 1 or self.result.size > 16:
            return {}
        return {kind: value.tolist() for kind, value in self.known("start", "result", "truth").items()}

    def error(self, kind: str = "result") -> float | None:
        """Root mean square error of 'start', 'result' or 'baseline' against the truth; None where there is none."""
        value = getattr(self, kind)
        return None if self.truth is None or value is None else rmse(value, self.truth)

    def relative_error(self) -> float | None:
        """|result - truth| / |truth| (L2 norms); None where the truth is unknown or zero."""
        if self.truth is None or not self.truth.any():
            return None
        return float(np.linalg.norm(matched(self.result, self.truth) - self.truth) / np.linalg.norm(self.truth))

    def as_dict(self) -> dict[str, Any]:
        """For parameters.json: small values in full, large ones by shape, mean and range."""
        value = self.result
        table: dict[str, Any] = {"shape": list(value.shape)}
        if value.size <= 16:
            table["value"] = value.tolist()
            table |= {kind: array.tolist() for kind, array in self.known("start", "truth").items()}
        else:
            table |= {"mean": float(value.mean()), "min": float(value.min()), "max": float(value.max())}
        if self.truth is not None:
            table |= {"rmse": self.error(), "rmse_at_start": self.error("start")}
        return table


def number_of(items: Iterable[Recovered]) -> int:
    """How many were recovered: what is derived from others does not count."""
    return sum(not item.derived for item in items)


@dataclass(frozen=True)
class RecoveredPose:
    """One pose: translation and rotation vector (degrees) at the start and in the result, by part, and their errors."""

    pose: Pose
    start: dict[str, Array]
    result: dict[str, Array]
    value: Array
    """The transform (4 x 4) or the vertices in the result."""
    value_at_start: Array

    def errors(self) -> dict[str, PoseError]:
        """How far it is from the truth, and was at the start; empty where that is not known."""
        values = {"error": self.value, "error_at_start": self.value_at_start}
        return {kind: error for kind, value in values.items() if (error := self.pose.error(value)) is not None}

    def rows(self) -> dict[str, str]:
        """Readable rows: what was moved by how much, and how far it is from the truth."""
        table: dict[str, str] = {}
        for kind, parts in (("start", self.start), ("recovered", self.result)):
            for part, array in parts.items():
                unit = "°" if part == "rotation" else ""
                table[f"{kind}, {part}"] = ", ".join(f"{v:.4g}{unit}" for v in array)
        return table | {kind.replace("_at_", " at the "): str(e) for kind, e in reversed(self.errors().items())}

    def as_dict(self) -> dict[str, Any]:
        """Everything for parameters.json."""
        table: dict[str, Any] = {"pose": self.pose.kind, "pivot": list(self.pose.pivot)}
        for kind, parts in (("start", self.start), ("result", self.result)):
            table[kind] = {part: array.tolist() for part, array in parts.items()}
        if self.value.shape == (4, 4):
            table["value"] = self.value.tolist()
            if self.pose.truth is not None:
                table["truth"] = self.pose.truth.tolist()
        table |= {kind: asdict(error) for kind, error in self.errors().items()}
        if self.pose.distance is not None:
            table["distance"] = self.pose.distance
        return table


@dataclass(frozen=True)
class Contestant:
    """One of two integrators that had the same time, and the errors of the parameters and poses that it ended with."""

    name: str
    run: Run
    errors: dict[str, float]


@dataclass(frozen=True)
class Outcome:
    """Everything that the report tells."""

    config: Config
    source: Path | None
    changes: tuple[str, ...]
    folder: Path
    views: tuple[ViewPictures, ...]
    recovered: tuple[Recovered, ...]
    poses: tuple[RecoveredPose, ...]
    run: Run
    values: dict[str, Array]
    """Variables as people see them, and what poses make of the scene, by key."""
    notes: tuple[str, ...]
    verdict: Verdict

    @property
    def complete(self) -> bool:
        """Whether all iterations are done, or the optimiser takes no more."""
        return len(self.run.history) >= self.config.iterations or bool(self.run.optimiser.finished)

    def test_views(self) -> list[ViewPictures]:
        """The views that were not learned from."""
        return [view for view in self.views if view.is_test]

    def has_flip(self) -> bool:
        """Whether there is FLIP to be told of."""
        return any(view.likenesses["result"].flip is not None for view in self.views)

    def command(self) -> str:
        """The command line that makes this run again, or goes on with it where it was stopped."""
        if not self.complete:
            return resume_command(self.folder)
        job = self.folder / "config.json" if self.source is None else self.source
        changes = "".join(f" --set {shlex.quote(change)}" for change in self.changes)
        return f"pathreplay optimize {shlex.quote(str(job))}{changes if self.source else ''}"

    def names(self) -> tuple[str, str]:
        """What the job and its baseline are called: their integrators; a run against itself has one name twice."""
        ours = self.config.integrator.type
        theirs = ours if self.config.baseline is None else self.config.baseline.type
        return ours, theirs if theirs != ours else f"{theirs} (baseline)"

    def caption(self, kind: str) -> str:
        """What stands below a picture, texture or volume of that kind."""
        ours, theirs = self.names()
        captions = {
            "result": "recovered" if self.run.baseline is None else f"recovered by {ours}",
            "baseline": f"recovered by {theirs}",
            "difference": f"difference ×{DIFFERENCE_GAIN:g}",
            "baseline-difference": f"its difference ×{DIFFERENCE_GAIN:g}",
        }
        return captions.get(kind, kind)

    def comparison(self) -> list[Contestant]:
        """The job and its baseline in numbers; empty where there was none."""
        if self.run.baseline is None:
            return []
        runs = zip(self.names(), (self.run, self.run.baseline), ("result", "baseline"), strict=True)
        known = [item for item in self.recovered if item.truth is not None]
        found = []
        for name, run, kind in runs:
            last = run.history[-1].errors if run.history else {}
            errors = {item.key: item.error(kind) or 0.0 for item in known}
            places = {name: last[name] for pose in self.poses for name in error_names(pose.pose.key) if name in last}
            found.append(Contestant(name, run, errors | places))
        return found
