"""One optimisation job from config to report: the function behind ``pathreplay optimize``."""

from __future__ import annotations

import json
import shlex
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy

from pathreplay import backend
from pathreplay.errors import PathreplayError
from pathreplay.inverse import checkpoint
from pathreplay.inverse.config import Config, load_config
from pathreplay.inverse.images import Image, exposure_for, exr_bytes, png_bytes, read_image
from pathreplay.inverse.limits import require_finite_loss
from pathreplay.inverse.loop import Run, ctrl_c_stops, iterate, new_run, put_values, render_views, scene_values
from pathreplay.inverse.pose import Pose, PoseError
from pathreplay.inverse.problem import Problem, build_problem
from pathreplay.inverse.progress import Progress
from pathreplay.inverse.report import Outcome, Recovered, RecoveredPose, ViewPictures, report_files
from pathreplay.inverse.rival import Rival, finished
from pathreplay.inverse.run_folder import (
    CHECKPOINT,
    RIVAL_CHECKPOINT,
    RunFolder,
    create_run_folder,
    default_output,
    open_run_folder,
)
from pathreplay.inverse.values import Array
from pathreplay.media.volume_files import vol_bytes
from pathreplay.parameters import get_array, to_value


@dataclass(frozen=True, repr=False)
class RunResult:
    """What a run came to; everything in it is also in ``folder``."""

    folder: Path
    report: Path
    iterations: int
    """Completed iterations; fewer than the job's when it was stopped."""
    stopped: bool
    """True when Ctrl-C ended the run early; it can be resumed."""
    history: tuple[checkpoint.Entry, ...]
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
            lines.append(f"stopped early; go on with: pathreplay optimize --resume {shlex.quote(str(self.folder))}")
        return "\n".join(lines)


def optimize(
    config: str | Path | Config | None = None,
    *,
    resume: str | Path | None = None,
    output: str | Path | None = None,
    progress: bool = True,
) -> RunResult:
    """Recover the parameters that a job names, and write its run folder.

    Args:
        config: path of a TOML file, or a Config (relative paths in it start at the current folder).
        resume: run folder of an earlier, unfinished run, to go on with; excludes ``config`` and ``output``.
        output: run folder to make; the default is the config's ``output``, else ``runs/<name of the config>``. Where it
            exists, a number is appended: an earlier run is never touched.
        progress: draw a progress bar on stderr (lines, now and then, where that is no terminal).

    The first Ctrl-C ends the run after the current iteration with everything written; the second one aborts.

    Raises:
        PathreplayError: anything in the job that cannot work, told before the first iteration; a full disk.
    """
    start = _resumed(Path(resume), config, output) if resume is not None else _fresh(config, output)
    variant = backend.set_variant(start.config.variant)
    with Progress(progress) as bar:
        bar.say("preparing")
        problem = build_problem(start.config, start.base, start.targets())
        for note in problem.notes:
            bar.note(note)
        run = new_run(problem, problem.integrator)
        rival = None if problem.rival is None else new_run(problem, problem.rival)
        if start.folder is None:
            put_values(problem, run.adam)
            before = render_views(problem, start.config)
            for view in problem.views:
                require_finite_loss(problem.loss, view.name, view.target, before[view.name])
            folder = create_run_folder(start.output, start.config, start.source, start.base)
            folder.write({**_first_files(problem, before), **_checkpoints(run, rival)})
        else:
            folder = start.folder
            refined = [v.key for v in problem.variables if v.levels is not None]
            run.history.extend(checkpoint.restore(folder.path / CHECKPOINT, run.adam, refined))
            if rival is not None:
                rival.history.extend(checkpoint.restore(folder.path / RIVAL_CHECKPOINT, rival.adam, refined))
            # All iterations but no report: the disk was full at the end. Then only the end is done again.
            if len(run.history) >= start.config.iterations and (folder.path / "report.html").exists():
                raise PathreplayError(
                    f"Run {folder.path} has all its {len(run.history)} iterations; raise 'iterations' in its config"
                )
            before = {view.name: read_image(folder.path / f"images/start-{view.name}.exr") for view in problem.views}
        bar.start(len(run.history), start.config.iterations)

        def after(entry: checkpoint.Entry) -> None:
            bar.advance(entry.loss)
            if (entry.iteration + 1) % start.config.checkpoint_every == 0:
                folder.write(_checkpoints(run, rival))

        with ctrl_c_stops() as stop:
            iterate(problem, start.config, run, rival, stop, after)
            bar.say("writing")
            result = render_views(problem, start.config)
            theirs = None if rival is None else finished(problem, start.config, rival)
            folder.write(_checkpoints(run, rival))
            return _finish(start, folder, problem, run, before, result, theirs, variant)


@dataclass(frozen=True)
class _Start:
    config: Config
    source: Path | None
    base: Path
    output: Path
    folder: RunFolder | None

    def targets(self) -> dict[str, Image] | None:
        if self.folder is None:
            return None
        pictures = sorted((self.folder.path / "images").glob("target-*.exr"))
        return {path.stem.removeprefix("target-"): read_image(path) for path in pictures}


def _fresh(config: str | Path | Config | None, output: str | Path | None) -> _Start:
    if config is None:
        raise PathreplayError("Nothing to do: give a config file, or --resume RUN_FOLDER")
    source = None if isinstance(config, Config) else Path(config)
    job = config if isinstance(config, Config) else load_config(Path(config))
    base = Path.cwd() if source is None else source.parent
    wanted = output or job.output
    return _Start(job, source, base, Path(wanted) if wanted else default_output(source), None)


def _resumed(path: Path, config: object, output: object) -> _Start:
    if config is not None or output is not None:
        raise PathreplayError("--resume takes config and output from the run folder; leave CONFIG and --output out")
    folder, job, source = open_run_folder(path)
    return _Start(job, None if source is None else Path(source), folder.origin, path, folder)


def _first_files(problem: Problem, before: dict[str, Image]) -> dict[str, bytes]:
    files = {f"images/target-{view.name}.exr": exr_bytes(view.target) for view in problem.views}
    return files | {f"images/start-{name}.exr": exr_bytes(image) for name, image in before.items()}


def _checkpoints(run: Run, rival: Run | None) -> dict[str, bytes]:
    files = {CHECKPOINT: checkpoint.save(run.adam, run.history)}
    return files if rival is None else {**files, RIVAL_CHECKPOINT: checkpoint.save(rival.adam, rival.history)}


def _finish(
    start: _Start,
    folder: RunFolder,
    problem: Problem,
    run: Run,
    before: dict[str, Image],
    result: dict[str, Image],
    rival: Rival | None,
    variant: str,
) -> RunResult:
    config = start.config
    adam, history, theirs = run.adam, run.history, rival.values if rival else {}
    # The variables (translations, rotation vectors) and what they make of the scene (transforms).
    values = {key: get_array(value) for key, value in {**adam, **scene_values(problem, adam)}.items()}
    views = tuple(
        ViewPictures(
            v.name, v.target, before[v.name], result[v.name], exposure_for(v.target),
            rival.pictures[v.name] if rival else None,
        )
        for v in problem.views
    )  # fmt: skip
    poses = tuple(_recovered_pose(problem, pose, values) for pose in problem.poses)
    parts = {name for pose in problem.poses for name in pose.parts().values()}
    recovered = tuple(
        Recovered(v.key, v.start, values[v.key], v.truth, theirs.get(v.key))
        for v in problem.variables
        if v.key not in parts
    )
    outcome = Outcome(
        config, start.source, folder.path, views, recovered, poses, tuple(history), variant, problem.notes, rival
    )
    files = {
        "parameters.safetensors": safetensors.numpy.save({k: np.ascontiguousarray(v) for k, v in values.items()}),
        "parameters.json": _parameters_json(recovered, poses).encode(),
        "history.jsonl": "".join(json.dumps(asdict(entry)) + "\n" for entry in history).encode(),
        **(rival.files() if rival else {}),
    }
    for view in views:
        files[f"images/result-{view.name}.exr"] = exr_bytes(view.result)
        for kind, image in view.pictures().items():
            files[f"images/{kind}-{view.name}.png"] = png_bytes(image, view.exposure)
    for item in recovered:
        for kind, image in item.textures().items():
            files[f"images/texture-{kind}-{item.file_name()}.png"] = png_bytes(image)
        for kind, image in item.volumes().items():
            files[f"images/volume-{kind}-{item.file_name()}.png"] = png_bytes(image)
        if item.result.ndim == 4:
            files[f"volumes/{item.file_name()}.vol"] = vol_bytes(item.result)
    folder.write({**files, **report_files(outcome)})
    return RunResult(
        folder=folder.path,
        report=folder.path / "report.html",
        iterations=len(history),
        stopped=len(history) < config.iterations,
        history=tuple(history),
        parameters=values,
        errors={item.key: error for item in recovered if (error := item.error()) is not None},
        poses={item.pose.key: item.error for item in poses if item.error is not None},
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
