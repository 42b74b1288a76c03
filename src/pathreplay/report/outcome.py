"""The outcome of a run in numbers and images, from which the report, the result files and `RunResult` are made."""

from __future__ import annotations

import json
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
from pathreplay.inverse.parameters.pose import Pose, PoseError
from pathreplay.inverse.parameters.values import Array
from pathreplay.runs.run_folder import resume_command
from pathreplay.types import Json

# Factor of difference images, which would otherwise be black after convergence.
DIFFERENCE_GAIN = 4.0


@dataclass(frozen=True)
class ViewPictures:
    """Linear images of one view: target, image at the initial values, result, and result of the baseline.

    ``exposure`` is the factor with which the images are displayed.
    """

    name: str
    target: Image
    start: Image
    result: Image
    exposure: float
    baseline: Image | None = None
    weight: Image | None = None
    """Weight per pixel; None if all weights are equal."""
    is_test: bool = False
    factors: tuple[float, ...] = ()
    """Recovered exposure: factors by which the result is multiplied, one for all channels or one per channel."""

    def error(self, image: Image) -> float:
        """Return the weighted root mean square difference of an image from the target."""
        squares = np.square(image.astype(np.float64) - self.target)
        return float(np.sqrt(np.mean(squares if self.weight is None else squares * self.weight)))

    @cached_property
    def likenesses(self) -> dict[str, Likeness]:
        """Return image metrics by kind of image: 'result', 'start' and, if there is a baseline, 'baseline'.

        The metrics compare the image with the target, at the view's exposure and with the weights of the pixels.
        """
        images = {"result": self.result, "start": self.start, "baseline": self.baseline}
        return {
            kind: Likeness.of(image, self.target, self.exposure, self.weight, flip=self.is_test)
            for kind, image in images.items()
            if image is not None
        }

    def as_dict(self) -> Json:
        """Return the entry of this view in views.json."""
        table: Json = {"is_test": self.is_test, "exposure": self.exposure}
        if self.factors:
            table["recovered_exposure"] = list(self.factors)
        for kind, likeness in self.likenesses.items():
            known = {name: value for name, value in asdict(likeness).items() if value is not None}
            table[kind] = {"rmse": self.error(getattr(self, kind)), **known}
        return table

    def kinds(self) -> tuple[str, ...]:
        """Return the kinds of images to show.

        A difference is `DIFFERENCE_GAIN` times (result - target); positive values are red, and negative values blue.
        """
        kinds = "target", "start", "result", "difference"
        return kinds if self.baseline is None else (*kinds, "baseline", "baseline-difference")

    def picture(self, kind: str) -> Image:
        if kind in ("difference", "baseline-difference"):
            image = self.result if kind == "difference" else self.baseline
            assert image is not None
            gap = difference(image, self.target) * DIFFERENCE_GAIN
            return gap if self.weight is None else gap * (self.weight > 0)
        return getattr(self, kind)

    def pictures(self) -> dict[str, Image]:
        """Return all images to show, by kind."""
        return {kind: self.picture(kind) for kind in self.kinds()}


@dataclass(frozen=True)
class Recovered:
    """A parameter of a run: initial value, result, true value (if known), and the result of the baseline (if any)."""

    key: str
    file_name: str
    """File-system-safe form of the key."""
    start: Array
    result: Array
    truth: Array | None
    baseline: Array | None = None
    faces: NDArray[np.integer] | None = None
    """Vertex indices of the faces, (m, 3), if the parameter consists of the vertices of a mesh."""
    derived: bool = False
    """Whether the parameter is computed from other, recovered parameters."""
    wraps: bool = False
    """Whether the first and the last column of a texture are neighbours."""

    def known(self, *kinds: str) -> dict[str, Array]:
        """Return the values of the given kinds ('start', 'result', 'baseline', 'truth') that exist, by kind."""
        return {kind: value for kind in kinds if (value := getattr(self, kind)) is not None}

    def textures(self) -> dict[str, Image]:
        """Return initial value, result and true value as images by kind, downscaled by `shown`.

        The dictionary is empty unless the parameter is a texture (height, width, one to four channels).
        """
        if self.result.ndim != 3 or self.result.shape[2] > 4:
            return {}
        return {kind: shown(image) for kind, image in self.known("start", "result", "truth").items()}

    def volumes(self) -> dict[str, Image]:
        """Return the middle slices of initial value, result, baseline's result and truth as images by kind.

        The maximum of the truth, or of the result if the truth is unknown, is shown as white. All volumes are first
        resampled to the resolution of the finest volume. The dictionary is empty unless the parameter is a volume (z,
        y, x, one to four channels).
        """
        if self.result.ndim != 4 or self.result.shape[3] > 4:
            return {}
        given = self.known("start", "result", "baseline", "truth")
        finest = max(given.values(), key=lambda volume: volume.size)
        white = float((self.result if self.truth is None else self.truth).max()) or 1.0
        return {kind: slices(matched(volume, finest, self.wraps)) / white for kind, volume in given.items()}

    def numbers(self) -> dict[str, list[float]]:
        """Return initial value, result and truth as numbers by kind.

        The dictionary is empty if the parameter has more than 16 numbers or more than one dimension.
        """
        if self.result.ndim > 1 or self.result.size > 16:
            return {}
        return {kind: value.tolist() for kind, value in self.known("start", "result", "truth").items()}

    def error(self, kind: str = "result") -> float | None:
        """Return the root mean square error of one kind of value: 'start', 'result' or 'baseline'.

        The error is None if there is no value of this kind, or if the truth is unknown.
        """
        value = getattr(self, kind)
        return None if self.truth is None or value is None else rmse(value, self.truth, self.wraps)

    def relative_error(self) -> float | None:
        """Return |result - truth| / |truth| in L2 norms; None if the truth is unknown or zero."""
        if self.truth is None or not self.truth.any():
            return None
        result = matched(self.result, self.truth, self.wraps)
        return float(np.linalg.norm(result - self.truth) / np.linalg.norm(self.truth))

    def as_dict(self) -> Json:
        """Return the entry in parameters.json: all numbers if there are at most 16, otherwise shape, mean and range."""
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
    """Return the number of parameters, without parameters that are computed from other parameters."""
    return sum(not item.derived for item in items)


@dataclass(frozen=True)
class RecoveredPose:
    """A pose of a run. The parts of a pose are a translation and a rotation vector (degrees)."""

    pose: Pose
    start: dict[str, Array]
    result: dict[str, Array]
    value: Array
    """Resulting transform (4 x 4), or resulting vertices."""
    value_at_start: Array
    baseline: Array | None = None
    """Value that corresponds to ``value`` in the result of the baseline, if there is one."""

    def errors(self) -> dict[str, PoseError]:
        """Return the error of the result ('error') and of the initial value ('error_at_start'), by these names.

        The dictionary is empty if the truth is unknown.
        """
        values = {"error": self.value, "error_at_start": self.value_at_start}
        return {kind: error for kind, value in values.items() if (error := self.pose.error(value)) is not None}

    def as_dict(self) -> Json:
        """Return the entry of this pose in parameters.json."""
        table: Json = {"pose": self.pose.kind, "pivot": list(self.pose.pivot)}
        for kind, parts in (("start", self.start), ("result", self.result)):
            table[kind] = {part: array.tolist() for part, array in parts.items()}
        if self.value.shape == (4, 4):
            table["value"] = self.value.tolist()
            if self.pose.truth is not None:
                table["truth"] = self.pose.truth.tolist()
        table |= {kind: asdict(error) for kind, error in self.errors().items()}
        if self.pose.distance is not None:
            table["error_scale"] = self.pose.distance
        return table


@dataclass(frozen=True)
class Contestant:
    """One side of the comparison at equal time: the run of the job, or the run of its baseline.

    ``errors`` are the final errors of parameters and poses, by name.
    """

    name: str
    run: Run
    errors: dict[str, float]


@dataclass(frozen=True)
class Outcome:
    """All data of the report."""

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
    base: Path
    """Folder to which relative paths in the config refer."""
    in_python: bool = False
    """Whether the job has Python objects; see `Job`."""

    @property
    def complete(self) -> bool:
        """Return whether all iterations are done, or the optimizer has terminated."""
        return len(self.run.history) >= self.config.iterations or bool(self.run.optimiser.finished)

    def test_views(self) -> list[ViewPictures]:
        """Return the views that were excluded from the optimization."""
        return [view for view in self.views if view.is_test]

    def has_flip(self) -> bool:
        return any(view.likenesses["result"].flip is not None for view in self.views)

    def command(self) -> str:
        """Return the command line or Python call that repeats this run, or resumes this run if it is incomplete."""
        if not self.complete:
            return resume_command(self.folder, self.in_python)
        if self.in_python:
            return f"pathreplay.minimize(problem, output={str(self.folder)!r})"
        if self.source is None:
            # Read by `pathreplay optimize`, the copy of the config would refer to files in the run folder.
            path = json.dumps(str(self.folder.absolute() / "config.json"), ensure_ascii=False)
            call = f"from pathreplay.jobs import load_config, optimize; optimize(load_config({path}))"
            return f"cd {shlex.quote(str(self.base))} && python -c {shlex.quote(call)}"
        changes = "".join(f" --set {shlex.quote(change)}" for change in self.changes)
        return f"pathreplay optimize {shlex.quote(str(self.source))}{changes}"

    def names(self) -> tuple[str, str]:
        """Return names for the job and its baseline: the types of their integrators.

        If both types are the same, the baseline's name has a suffix.
        """
        job = self.config.integrator.type
        baseline = job if self.config.baseline is None else self.config.baseline.type
        return job, baseline if baseline != job else f"{baseline} (baseline)"

    def caption(self, kind: str) -> str:
        """Return the caption of an image, texture or volume. ``kind`` is a kind such as 'start' or 'result'."""
        job, baseline = self.names()
        captions = {
            "result": "recovered" if self.run.baseline is None else f"recovered by {job}",
            "baseline": f"recovered by {baseline}",
            "difference": f"difference ×{DIFFERENCE_GAIN:g}",
            "baseline-difference": f"its difference ×{DIFFERENCE_GAIN:g}",
        }
        return captions.get(kind, kind)

    def comparison(self) -> list[Contestant]:
        """Return the job and its baseline for a comparison; empty without a baseline."""
        if self.run.baseline is None:
            return []
        runs = zip(self.names(), (self.run, self.run.baseline), ("result", "baseline"), strict=True)
        known = [item for item in self.recovered if item.truth is not None]
        contestants = []
        for name, run, kind in runs:
            errors = {item.key: item.error(kind) or 0.0 for item in known}
            for item in self.poses:
                value = item.value if kind == "result" else item.baseline
                if value is not None and (error := item.pose.error(value)):
                    errors |= error.of(item.pose.key)
            contestants.append(Contestant(name, run, errors))
        return contestants
