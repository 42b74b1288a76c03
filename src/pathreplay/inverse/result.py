"""The end of a run: its outcome, the files of it, and what Python gets."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy

from pathreplay.inverse.checkpoint import Entry
from pathreplay.inverse.config import Config
from pathreplay.inverse.file_names import file_names
from pathreplay.inverse.images import Image, exposure_for, exr_bytes, png_bytes
from pathreplay.inverse.loop import Run
from pathreplay.inverse.outcome import Outcome, Recovered, RecoveredPose, ViewPictures, resume_command
from pathreplay.inverse.pose import Pose, PoseError
from pathreplay.inverse.problem import Problem, scene_values, variables_of
from pathreplay.inverse.report import report_files
from pathreplay.inverse.rival import Rival
from pathreplay.inverse.values import Array
from pathreplay.media.volume_files import vol_bytes
from pathreplay.scenes.parameters import get_array, to_value


@dataclass(frozen=True, repr=False)
class RunResult:
    """What a run came to; everything in it is also in ``folder``."""

    folder: Path
    report: Path
    iterations: int
    """Completed iterations; fewer than the job's when it was stopped."""
    stopped: bool
    """True when a signal ended the run early; it can be resumed."""
    stopped_by: str | None
    """'Ctrl-C', 'SIGTERM' or 'SIGHUP'."""
    history: tuple[Entry, ...]
    parameters: dict[str, Array]
    errors: dict[str, float]
    """Root mean square error of each parameter whose truth is known; poses are told apart."""
    poses: dict[str, PoseError]
    """How far each pose whose truth is known is from it."""

    def __repr__(self) -> str:
        """Short: a notebook prints it, and the history may have thousands of entries."""
        loss = f", loss {self.history[-1].loss:.4g}" if self.history else ""
        stopped = ", stopped early" if self.stopped else ""
        count = f"{len(self.parameters)} parameters"
        return f"<RunResult: {self.iterations} iterations{loss}{stopped}, {count}, {self.report}>"

    def describe(self) -> str:
        """A few lines for the terminal: loss, errors, where the report is, how to go on."""
        lines = []
        if self.history:
            first, last = self.history[0].loss, self.history[-1].loss
            lines.append(f"loss {first:.4g} -> {last:.4g} in {self.iterations} iterations")
        for key, error in self.errors.items():
            value = self.parameters[key]
            found = f"{value.item():.5g}, " if value.size == 1 else ""
            lines.append(f"{key}: {found}root mean square error {error:.4g}")
        lines += [f"{key}: {error}" for key, error in self.poses.items()]
        lines.append(f"report: {self.report}")
        if self.stopped:
            lines.append(f"stopped early by {self.stopped_by}; go on with: {resume_command(self.folder)}")
        return "\n".join(lines)


def outcome_of(
    config: Config,
    source: Path | None,
    folder: Path,
    problem: Problem,
    run: Run,
    before: dict[str, Image],
    after: dict[str, Image],
    rival: Rival | None,
    variant: str,
) -> Outcome:
    """All that is told of a run; ``before`` and ``after`` are the pictures by view."""
    theirs = rival.values if rival else {}
    stored = scene_values(problem, variables_of(problem, run.values))
    values = {key: get_array(value) for key, value in stored.items()} | run.values
    views = tuple(
        ViewPictures(
            v.name, v.target, before[v.name], after[v.name], exposure_for(v.target),
            rival.pictures[v.name] if rival else None,
        )
        for v in problem.views
    )  # fmt: skip
    poses = tuple(_recovered_pose(problem, pose, values) for pose in problem.poses)
    parts = {name for pose in problem.poses for name in pose.parts().values()}
    files_of = file_names(v.key for v in problem.variables)
    recovered = tuple(
        Recovered(v.key, files_of[v.key], v.start, values[v.key], v.truth, theirs.get(v.key))
        for v in problem.variables
        if v.key not in parts
    )
    history = tuple(run.history)
    return Outcome(config, source, folder, views, recovered, poses, history, values, variant, problem.notes, rival)


def result_files(outcome: Outcome) -> dict[str, bytes]:
    """All files of the end of a run, the report among them, by name in the run folder."""
    values = {key: np.ascontiguousarray(value) for key, value in outcome.values.items()}
    files = {
        "parameters.safetensors": safetensors.numpy.save(values),
        "parameters.json": _parameters_json(outcome.recovered, outcome.poses).encode(),
        "history.jsonl": "".join(json.dumps(asdict(entry)) + "\n" for entry in outcome.history).encode(),
        **(outcome.rival.files() if outcome.rival else {}),
    }
    for view in outcome.views:
        files[f"images/result-{view.name}.exr"] = exr_bytes(view.result)
        for kind, image in view.pictures().items():
            files[f"images/{kind}-{view.name}.png"] = png_bytes(image, view.exposure)
    for item in outcome.recovered:
        for kind, image in item.textures().items():
            files[f"images/texture-{kind}-{item.file_name}.png"] = png_bytes(image)
        for kind, image in item.volumes().items():
            files[f"images/volume-{kind}-{item.file_name}.png"] = png_bytes(image)
        if item.result.ndim == 4:
            files[f"volumes/{item.file_name}.vol"] = vol_bytes(item.result)
    return {**files, **report_files(outcome)}


def result_of(outcome: Outcome, stopped_by: str | None) -> RunResult:
    """What Python gets; ``stopped_by`` is the name of a signal, which may have come too late to stop anything."""
    stopped = len(outcome.history) < outcome.config.iterations
    return RunResult(
        folder=outcome.folder,
        report=outcome.folder / "report.html",
        iterations=len(outcome.history),
        stopped=stopped,
        stopped_by=stopped_by if stopped else None,
        history=outcome.history,
        parameters=outcome.values,
        errors={item.key: error for item in outcome.recovered if (error := item.error()) is not None},
        poses={item.pose.key: item.error for item in outcome.poses if item.error is not None},
    )


def _recovered_pose(problem: Problem, pose: Pose, values: dict[str, Array]) -> RecoveredPose:
    variables = {variable.key: variable for variable in problem.variables}
    names = pose.parts()
    at_start = {name: to_value(variables[name].like, variables[name].start) for name in names.values()}
    return RecoveredPose(
        pose=pose,
        start={part: variables[name].start for part, name in names.items()},
        result={part: values[name] for part, name in names.items()},
        value=values[pose.key],
        error=pose.error(values[pose.key]),
        error_at_start=pose.error(get_array(pose.value(at_start))),
    )


def _parameters_json(recovered: tuple[Recovered, ...], poses: tuple[RecoveredPose, ...]) -> str:
    """Small values in full, large ones by shape, mean and range (their numbers are in parameters.safetensors)."""
    table: dict[str, Any] = {}
    for item in recovered:
        value = item.result
        entry: dict[str, Any] = {"shape": list(value.shape)}
        if value.size <= 16:
            entry |= {"value": value.tolist(), "start": item.start.tolist()}
            if item.truth is not None:
                entry["truth"] = item.truth.tolist()
        else:
            entry |= {"mean": float(value.mean()), "min": float(value.min()), "max": float(value.max())}
        if item.truth is not None:
            entry |= {"rmse": item.error(), "rmse_at_start": item.error_at_start()}
        table[item.key] = entry
    for pose in poses:
        table[pose.pose.key] = pose.as_dict()
    return json.dumps(table, indent=2) + "\n"
