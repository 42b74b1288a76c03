"""Collects the outcome of a run, and makes the result files and the `RunResult` of the Python API from it."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np

from pathreplay.inverse.images.io import Image, exposure_for, exr_bytes, levels, png_bytes
from pathreplay.inverse.images.metrics import Likeness
from pathreplay.inverse.loop.checkpoint import Entry, Run
from pathreplay.inverse.loop.verdict import Verdict
from pathreplay.inverse.parameters.exposures import EXPOSURE
from pathreplay.inverse.parameters.pose import PoseError
from pathreplay.inverse.parameters.values import Array
from pathreplay.inverse.problem.problem import Problem
from pathreplay.platform.atomic_files import Content, made
from pathreplay.platform.tensor_files import safetensors_chunks
from pathreplay.report.outcome import Outcome, ViewPictures
from pathreplay.report.recovered import poses_of, recovered_of, with_faces, with_scene
from pathreplay.report.report import Film, report_files
from pathreplay.runs.run_folder import Job, resume_command
from pathreplay.scenes.volume_files import vol_bytes

HISTORY = "history.jsonl"


@dataclass(frozen=True, repr=False)
class RunResult:
    """Result of a run. The files in ``folder`` contain the same data."""

    folder: Path
    report: Path
    iterations: int
    """Number of completed iterations, which is smaller than in the job if the run was stopped."""
    stopped: bool
    """Whether the run was stopped early. A stopped run can be resumed."""
    stopped_by: str | None
    """What stopped the run: 'Ctrl-C', 'SIGTERM', 'SIGHUP', 'the stop button' or 'stop()'; None if not stopped."""
    history: tuple[Entry, ...]
    parameters: dict[str, Array]
    errors: dict[str, float]
    """Root mean square error of each parameter whose true value is known, except poses."""
    poses: dict[str, PoseError]
    """Error of each pose whose true value is known."""
    views: dict[str, Likeness]
    """Image metrics of the result of each view, compared with its target."""
    test_views: tuple[str, ...]
    """Names of the views that were excluded from the optimization."""
    verdict: Verdict
    """Assessment of the values: which still move, which have converged, and which the images do not determine."""

    def __repr__(self) -> str:
        """Return a short description for notebooks, because the history may have thousands of entries."""
        loss = f", loss {self.history[-1].loss:.4g}" if self.history else ""
        stopped = ", stopped early" if self.stopped else ""
        count = f"{len(self.parameters)} parameters"
        return f"<RunResult: {self.iterations} iterations{loss}{stopped}, {count}, {self.report}>"

    def describe(self) -> str:
        """Return lines for the terminal: loss, errors, path of the report, command to resume, and verdict."""
        lines = []
        if self.history:
            first, last = self.history[0].loss, self.history[-1].loss
            lines.append(f"loss {first:.4g} -> {last:.4g} in {self.iterations} iterations")
        for key, error in self.errors.items():
            value = self.parameters[key]
            number = f"{value.item():.5g}, " if value.size == 1 else ""
            lines.append(f"{key}: {number}RMS error {error:.4g}")
        lines += [f"{key}: {error}" for key, error in self.poses.items()]
        if self.test_views:
            psnr, ssim = (np.mean([getattr(self.views[v], kind) for v in self.test_views]) for kind in ("psnr", "ssim"))
            flips = [flip for v in self.test_views if (flip := self.views[v].flip) is not None]
            mean_flip = f", FLIP {np.mean(flips):.4f}" if flips else ""
            lines.append(f"test views ({len(self.test_views)}): PSNR {psnr:.2f} dB, SSIM {ssim:.4f}{mean_flip}")
        lines.append(f"report: {self.report}")
        if self.stopped:
            lines.append(f"stopped early by {self.stopped_by}; resume with: {resume_command(self.folder)}")
        lines.append(str(self.verdict))
        return "\n".join(lines)


def outcome_of(
    job: Job,
    folder: Path,
    problem: Problem,
    run: Run,
    before: dict[str, Image],
    after: dict[str, Image],
    baselines: dict[str, Image],
    verdict: Verdict,
) -> Outcome:
    """Collect the outcome of a run.

    ``before`` contains the images at the initial values, ``after`` the images of the result, and ``baselines`` the
    images of the baseline's result, each by view name.
    """
    views = tuple(
        ViewPictures(
            v.name,
            v.target,
            before[v.name],
            after[v.name],
            exposure_for(levels(v.target, v.weight)),
            baselines.get(v.name),
            v.weight,
            v.is_test,
            tuple(run.values[EXPOSURE][n].tolist()) if EXPOSURE in run.values else (),
        )
        for n, v in enumerate(problem.views)
    )
    recovered, poses = with_faces(problem, recovered_of(problem, run)), poses_of(problem, run)
    values = with_scene(problem, run.values)
    return Outcome(
        job.config, job.source, job.changes, folder, views, recovered, poses, run, values, problem.notes, verdict,
        job.base.resolve(), job.in_python,
    )  # fmt: skip


def result_files(outcome: Outcome, films: Mapping[str, Film]) -> dict[str, Content]:
    """Return the content of all result files by name. The report includes the time-lapse frames ``films``."""
    table = {item.key: item.as_dict() for item in outcome.recovered}
    table |= {item.pose.key: item.as_dict() for item in outcome.poses}
    files: dict[str, Content] = {"parameters.json": (json.dumps(table, indent=2) + "\n").encode()}
    views = {view.name: view.as_dict() for view in outcome.views}
    files["views.json"] = (json.dumps(views, indent=2) + "\n").encode()
    if baseline := outcome.run.baseline:
        files |= _run_files("baseline/", baseline.history, baseline.values)
    for view in outcome.views:
        files[f"images/result-{view.name}.exr"] = made(exr_bytes, view.result)
        for kind in view.kinds():
            files[f"images/{kind}-{view.name}.png"] = made(_png, view, kind)
    for item in outcome.recovered:
        for kind, image in item.textures().items():
            files[f"images/texture-{kind}-{item.file_name}.png"] = png_bytes(image)
        for kind, image in item.volumes().items():
            files[f"images/volume-{kind}-{item.file_name}.png"] = png_bytes(image)
        if item.result.ndim == 4:
            files[f"volumes/{item.file_name}.vol"] = made(vol_bytes, item.result)
    # The history is the last file to be renamed, because `has_results` reads it.
    return {**files, **report_files(outcome, films), **_run_files("", outcome.run.history, outcome.values)}


def has_results(folder: Path, iterations: int) -> bool:
    """Return whether a run folder contains results, and they were written after this number of iterations."""
    history = folder / HISTORY
    if not history.is_file() or not (folder / "report.html").is_file():
        return False
    with contextlib.suppress(OSError), open(history, "rb") as file:
        return sum(1 for _ in file) == iterations
    return False


def result_of(outcome: Outcome, stopped_by: str | None) -> RunResult:
    """Return the `RunResult` of a run.

    ``stopped_by`` names the source of a stop request, and is ignored if the run is complete.
    """
    stopped = not outcome.complete
    return RunResult(
        folder=outcome.folder,
        report=outcome.folder / "report.html",
        iterations=len(outcome.run.history),
        stopped=stopped,
        stopped_by=stopped_by if stopped else None,
        history=tuple(outcome.run.history),
        parameters=outcome.values,
        errors={item.key: error for item in outcome.recovered if (error := item.error()) is not None},
        poses={item.pose.key: errors["error"] for item in outcome.poses if (errors := item.errors())},
        views={view.name: view.likenesses["result"] for view in outcome.views},
        test_views=tuple(view.name for view in outcome.test_views()),
        verdict=outcome.verdict,
    )


def _png(view: ViewPictures, kind: str) -> bytes:
    return png_bytes(view.picture(kind), view.exposure)


def _run_files(folder: str, history: Sequence[Entry], values: Mapping[str, Array]) -> dict[str, Content]:
    return {
        f"{folder}parameters.safetensors": partial(safetensors_chunks, values, {}),
        f"{folder}{HISTORY}": "".join(json.dumps(asdict(entry)) + "\n" for entry in history).encode(),
    }
