"""The outcome of a run in numbers and images: the data behind the report, the result files and `RunResult`."""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path

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
from pathreplay.runs.run_folder import resume_command
from pathreplay.types import Json

# Gain of difference images, which would be black after convergence otherwise.
DIFFERENCE_GAIN = 4.0
_KINDS = "target", "start", "result", "difference"


@dataclass(frozen=True)
class ViewPictures:
    """Images of one view (linear): target, initial, result and the baseline's result, and their display exposure."""

    name: str
    target: Image
    start: Image
    result: Image
    exposure: float
    baseline: Image | None = None
    weight: Image | None = None
    """Weight per pixel, if not uniform."""
    is_test: bool = False
    factors: tuple[float, ...] = ()
    """Recovered exposure by which the result is multiplied: one factor, or one per colour channel."""

    def error(self, image: Image) -> float:
        """Weighted root mean square difference from the target."""
        squares = np.square(image.astype(np.float64) - self.target)
        return float(np.sqrt(np.mean(squares if self.weight is None else squares * self.weight)))

    @cached_property
    def likenesses(self) -> dict[str, Likeness]:
        """Image metrics of 'start', 'result' and 'baseline' if any, weighted, at the view's exposure."""
        images = {"result": self.result, "start": self.start, "baseline": self.baseline}
        return {
            kind: Likeness.of(image, self.target, self.exposure, self.weight, flip=self.is_test)
            for kind, image in images.items()
            if image is not None
        }

    def as_dict(self) -> Json:
        """The view's entry of views.json."""
        table: Json = {"is_test": self.is_test, "exposure": self.exposure}
        if self.factors:
            table["recovered_exposure"] = list(self.factors)
        for kind, likeness in self.likenesses.items():
            known = {name: value for name, value in asdict(likeness).items() if value is not None}
            table[kind] = {"rmse": self.error(getattr(self, kind)), **known}
        return table

    def kinds(self) -> tuple[str, ...]:
        """Kinds of images to show; a difference is DIFFERENCE_GAIN * (result - target), positive red, negative blue."""
        return (*_KINDS, *(() if self.baseline is None else ("baseline", "baseline-difference")))

    def picture(self, kind: str) -> Image:
        """The image of a kind."""
        if kind in ("difference", "baseline-difference"):
            image = self.result if kind == "difference" else self.baseline
            assert image is not None
            return self._difference(image)
        return getattr(self, kind)

    def pictures(self) -> dict[str, Image]:
        """All images to show, by kind."""
        return {kind: self.picture(kind) for kind in self.kinds()}

    def _difference(self, image: Image) -> Image:
        gap = difference(image, self.target) * DIFFERENCE_GAIN
        return gap if self.weight is None else gap * (self.weight > 0)


@dataclass(frozen=True)
class Recovered:
    """One parameter: initial value, result, truth if known, and the baseline's result if any."""

    key: str
    file_name: str
    """File-system-safe form of the key."""
    start: Array
    result: Array
    truth: Array | None
    baseline: Array | None = None
    faces: NDArray[np.integer] | None = None
    """Vertex indices of the m faces (3 m numbers), if the parameter is the vertices of a mesh."""
    derived: bool = False
    """Whether it is computed from other parameters, which are recovered."""

    def known(self, *kinds: str) -> dict[str, Array]:
        """The values of these kinds that exist: 'start', 'result', 'baseline', 'truth'."""
        return {kind: value for kind in kinds if (value := getattr(self, kind)) is not None}

    def textures(self) -> dict[str, Image]:
        """Initial value, result and truth as images (see `shown`); empty unless a texture of one to four channels."""
        if self.result.ndim != 3 or self.result.shape[2] > 4:
            return {}
        return {kind: shown(image) for kind, image in self.known("start", "result", "truth").items()}

    def volumes(self) -> dict[str, Image]:
        """Middle slices of initial value, result, baseline's result and truth.

        White is the maximum of the truth, or of the result if the truth is unknown. All are shown at the finest
        resolution among them. Empty unless a volume (z, y, x, one to four channels).
        """
        if self.result.ndim != 4 or self.result.shape[3] > 4:
            return {}
        given = self.known("start", "result", "baseline", "truth")
        finest = max(given.values(), key=lambda volume: volume.size)
        white = float((self.result if self.truth is None else self.truth).max()) or 1.0
        return {kind: slices(matched(volume, finest)) / white for kind, volume in given.items()}

    def numbers(self) -> dict[str, list[float]]:
        """Initial value, result and truth as numbers; empty for more than 16 numbers or more than one dimension."""
        if self.result.ndim > 1 or self.result.size > 16:
            return {}
        return {kind: value.tolist() for kind, value in self.known("start", "result", "truth").items()}

    def error(self, kind: str = "result") -> float | None:
        """Root mean square error of 'start', 'result' or 'baseline'; None if it or the truth does not exist."""
        value = getattr(self, kind)
        return None if self.truth is None or value is None else rmse(value, self.truth)

    def relative_error(self) -> float | None:
        """|result - truth| / |truth| (L2 norms); None if the truth is unknown or zero."""
        if self.truth is None or not self.truth.any():
            return None
        return float(np.linalg.norm(matched(self.result, self.truth) - self.truth) / np.linalg.norm(self.truth))

    def as_dict(self) -> Json:
        """Entry of parameters.json: small values in full, large ones by shape, mean and range."""
        value = self.result
        table: Json = {"shape": list(value.shape)}
        if value.size <= 16:
            table["value"] = value.tolist()
            table |= {kind: array.tolist() for kind, array in self.known("start", "truth").items()}
        else:
            table |= {"mean": float(value.mean()), "min": float(value.min()), "max": float(value.max())}
        if self.truth is not None:
            table |= {"rmse": self.error(), "rmse_at_start": self.error("start")}
        return table


def number_of(items: Iterable[Recovered]) -> int:
    """Number of recovered parameters, without derived ones."""
    return sum(not item.derived for item in items)


@dataclass(frozen=True)
class RecoveredPose:
    """One pose: initial and resulting translation and rotation vector (degrees) by part, and their errors."""

    pose: Pose
    start: dict[str, Array]
    result: dict[str, Array]
    value: Array
    """Resulting transform (4 x 4) or vertices."""
    value_at_start: Array

    def errors(self) -> dict[str, PoseError]:
        """Errors of the result and of the initial value; empty if the truth is unknown."""
        values = {"error": self.value, "error_at_start": self.value_at_start}
        return {kind: error for kind, value in values.items() if (error := self.pose.error(value)) is not None}

    def rows(self) -> dict[str, str]:
        """Table rows: the parts of the pose, and its errors."""
        table: dict[str, str] = {}
        for kind, parts in (("start", self.start), ("recovered", self.result)):
            for part, array in parts.items():
                unit = "°" if part == "rotation" else ""
                table[f"{kind}, {part}"] = ", ".join(f"{v:.4g}{unit}" for v in array)
        return table | {kind.replace("_at_", " at the "): str(e) for kind, e in reversed(self.errors().items())}

    def as_dict(self) -> Json:
        """Entry of parameters.json."""
        table: Json = {"pose": self.pose.kind, "pivot": list(self.pose.pivot)}
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
    """One of two integrators that ran for equal time, and the final errors of its parameters and poses."""

    name: str
    run: Run
    errors: dict[str, float]


@dataclass(frozen=True)
class Outcome:
    """All content of the report."""

    config: Config
    source: Path | None
    changes: tuple[str, ...]
    folder: Path
    views: tuple[ViewPictures, ...]
    recovered: tuple[Recovered, ...]
    poses: tuple[RecoveredPose, ...]
    run: Run
    values: dict[str, Array]
    """Decoded values of the variables, and the transforms or vertices of poses, by key."""
    notes: tuple[str, ...]
    verdict: Verdict
    in_python: bool = False
    """See `Job`."""

    @property
    def complete(self) -> bool:
        """Whether all iterations are done, or the optimizer has terminated."""
        return len(self.run.history) >= self.config.iterations or bool(self.run.optimiser.finished)

    def test_views(self) -> list[ViewPictures]:
        """The views that were excluded from the optimization."""
        return [view for view in self.views if view.is_test]

    def has_flip(self) -> bool:
        """Whether FLIP was computed for any view."""
        return any(view.likenesses["result"].flip is not None for view in self.views)

    def command(self) -> str:
        """Return the command line, or the call in Python, that repeats this run, or resumes it if it was stopped."""
        if not self.complete:
            return resume_command(self.folder, self.in_python)
        if self.in_python:
            return f"pathreplay.minimize(problem, output={str(self.folder)!r})"
        job = self.folder / "config.json" if self.source is None else self.source
        changes = "".join(f" --set {shlex.quote(change)}" for change in self.changes)
        return f"pathreplay optimize {shlex.quote(str(job))}{changes if self.source else ''}"

    def names(self) -> tuple[str, str]:
        """Names of the job and its baseline: their integrators, with a suffix if both are the same."""
        job = self.config.integrator.type
        baseline = job if self.config.baseline is None else self.config.baseline.type
        return job, baseline if baseline != job else f"{baseline} (baseline)"

    def caption(self, kind: str) -> str:
        """Caption of an image, texture or volume of that kind."""
        job, baseline = self.names()
        captions = {
            "result": "recovered" if self.run.baseline is None else f"recovered by {job}",
            "baseline": f"recovered by {baseline}",
            "difference": f"difference ×{DIFFERENCE_GAIN:g}",
            "baseline-difference": f"its difference ×{DIFFERENCE_GAIN:g}",
        }
        return captions.get(kind, kind)

    def comparison(self) -> list[Contestant]:
        """The job and its baseline in numbers; empty without a baseline."""
        if self.run.baseline is None:
            return []
        runs = zip(self.names(), (self.run, self.run.baseline), ("result", "baseline"), strict=True)
        known = [item for item in self.recovered if item.truth is not None]
        contestants = []
        for name, run, kind in runs:
            last = run.history[-1].errors if run.history else {}
            errors = {item.key: item.error(kind) or 0.0 for item in known}
            poses = {name: last[name] for pose in self.poses for name in error_names(pose.pose.key) if name in last}
            contestants.append(Contestant(name, run, errors | poses))
        return contestants
