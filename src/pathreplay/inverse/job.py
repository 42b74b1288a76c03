"""One optimisation job from config to report: the function behind ``pathreplay optimize``."""

from __future__ import annotations

import gc
import json
import shlex
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy

from pathreplay import backend
from pathreplay.errors import PathreplayError
from pathreplay.interrupts import undisturbed
from pathreplay.inverse import checkpoint
from pathreplay.inverse.config import Config, load_config
from pathreplay.inverse.file_names import file_names
from pathreplay.inverse.images import Image, exposure_for, exr_bytes, png_bytes
from pathreplay.inverse.limits import require_finite_loss
from pathreplay.inverse.loop import Run, iterate, new_run, put_values, render_views, scene_values
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
    require_output,
)
from pathreplay.inverse.saved_pictures import require_pictures, saved_picture
from pathreplay.inverse.stopping import Stop, stopping
from pathreplay.inverse.values import Array
from pathreplay.media.volume_files import vol_bytes
from pathreplay.scenes.loading import told
from pathreplay.scenes.parameters import get_array, to_value
from pathreplay.threads import one_thread, require_one_thread_possible


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
            lines.append(f"stopped early by {self.stopped_by}; go on with: {_resume_command(self.folder)}")
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

    The first Ctrl-C, SIGTERM or SIGHUP ends the run after the current iteration with everything written; a Ctrl-C after
    that aborts (KeyboardInterrupt). Until the run folder is there, signals do what they did before. With
    ``deterministic`` all that is computed is computed by one thread, whatever was set; that comes back afterwards.

    Raises:
        PathreplayError: anything in the job that cannot work, told before the first iteration; a full disk; a run
            folder that is in use, damaged, or vanishes.
    """
    try:
        return _run(config, resume, output, progress)
    finally:
        # Python finds the scene only by its collector, and Dr.Jit traces calls through every scene that is alive.
        gc.collect()


def _run(
    config: str | Path | Config | None, resume: str | Path | None, output: str | Path | None, progress: bool
) -> RunResult:
    with ExitStack() as stack:
        start = _resumed(resume, config, output) if resume is not None else _fresh(config, output)
        if start.folder is not None:
            stack.callback(start.folder.close)
        with undisturbed():
            variant = backend.set_variant(start.config.variant)
        if start.config.deterministic:
            require_one_thread_possible()
        bar = stack.enter_context(Progress(progress))
        bar.say("preparing")
        problem = build_problem(start.config, start.base, start.targets())
        for note in problem.notes:
            bar.note(note)
        record = not start.config.deterministic
        run = new_run(problem, problem.integrator, record)
        rival = None if problem.rival is None else new_run(problem, problem.rival, record)
        if start.folder is None:
            before, folder = _begun(start, problem, run, rival)
            stack.callback(folder.close)
        else:
            folder = start.folder
            before = _went_on(folder, start.config, problem, run, rival)
        way_out = f"aborted; go on from the last checkpoint with: {_resume_command(folder.path)}"
        stop = stack.enter_context(stopping(bar.say, way_out))
        _iterate(start, folder, problem, run, rival, stop, bar)
        bar.say("writing")
        with one_thread(start.config.deterministic), told(_failing(start.config)):
            result = render_views(problem, start.config)
            theirs = None if rival is None else finished(problem, start.config, rival)
        return _finish(start, folder, problem, run, before, result, theirs, variant, stop.by())


def _begun(start: _Start, problem: Problem, run: Run, rival: Run | None) -> tuple[dict[str, Image], RunFolder]:
    """A new folder for a run at its start; and the pictures there."""
    with one_thread(start.config.deterministic), told(_failing(start.config)):
        put_values(problem, run.adam)
        before = render_views(problem, start.config)
    for view in problem.views:
        require_finite_loss(problem.loss, view.name, view.target, before[view.name])
    files = {**_first_files(problem, before), **_checkpoints(run, rival)}
    return before, create_run_folder(start.output, start.config, start.source, start.base, files)


def _went_on(folder: RunFolder, config: Config, problem: Problem, run: Run, rival: Run | None) -> dict[str, Image]:
    """Bring a run to where the folder's checkpoint was; returns the pictures of its start."""
    require_pictures(folder.path, "target", problem.scene, problem.views, {v.name: v.target for v in problem.views})
    before = {view.name: saved_picture(folder.path / f"images/start-{view.name}.exr") for view in problem.views}
    require_pictures(folder.path, "start", problem.scene, problem.views, before)
    levels = {v.key: v.levels for v in problem.variables if v.levels is not None}
    for each, name in ((run, CHECKPOINT), (rival, RIVAL_CHECKPOINT)):
        if each is not None:
            history, learned = checkpoint.restore(folder.path / name, each.adam, levels)
            each.history.extend(history)
            each.passes.restore_learned(learned)
    # All iterations but no report: the disk was full at the end. Then only the end is done again.
    if len(run.history) >= config.iterations and (folder.path / "report.html").exists():
        raise PathreplayError(
            f"Run {folder.path} has all its {len(run.history)} iterations; raise 'iterations' in its config"
        )
    return before


def _iterate(
    start: _Start, folder: RunFolder, problem: Problem, run: Run, rival: Run | None, stop: Stop, bar: Progress
) -> None:
    """Do the iterations that are left, with a checkpoint now and then and one at the end.

    A new folder goes again where not even the first iteration can be done; one that is resumed never does.
    """
    config = start.config
    bar.start(len(run.history), config.iterations)
    saved = len(run.history)

    def after(entry: checkpoint.Entry) -> None:
        nonlocal saved
        bar.advance(entry.loss)
        done = entry.iteration + 1
        folder.require_in_place(f"iterations {saved + 1} to {done} are")
        if done % config.checkpoint_every == 0:
            folder.write(_checkpoints(run, rival))
            saved = done

    try:
        with one_thread(config.deterministic), told(_failing(config)):
            iterate(problem, config, run, rival, stop, after)
    except PathreplayError:
        if start.folder is None and not run.history and not stop.aborted:
            folder.remove()
        raise
    if saved < len(run.history):
        folder.write(_checkpoints(run, rival))


def _failing(config: Config) -> str:
    names = config.integrator.type if config.rival is None else f"{config.integrator.type}' or '{config.rival.type}"
    return f"Integrator '{names}' cannot do this job"


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
        return {path.stem.removeprefix("target-"): saved_picture(path) for path in pictures}


def _fresh(config: str | Path | Config | None, output: str | Path | None) -> _Start:
    if config is None:
        raise PathreplayError("Nothing to do: give a config file, or --resume RUN_FOLDER")
    if not isinstance(config, (str, Path, Config)):
        raise PathreplayError(
            f"config is a {type(config).__name__}; give the path of a TOML file, or make_config of a dictionary"
        )
    source = None if isinstance(config, Config) else Path(config)
    job = config if isinstance(config, Config) else load_config(Path(config))
    base = Path.cwd() if source is None else source.parent
    wanted = job.output if output is None else output
    return _Start(job, source, base, default_output(source) if wanted is None else require_output(wanted), None)


def _resumed(resume: str | Path, config: object, output: object) -> _Start:
    if config is not None or output is not None:
        raise PathreplayError("--resume takes config and output from the run folder; leave CONFIG and --output out")
    folder, job, source = open_run_folder(Path(resume))
    return _Start(job, None if source is None else Path(source), folder.origin, folder.path, folder)


def _first_files(problem: Problem, before: dict[str, Image]) -> dict[str, bytes]:
    files = {f"images/target-{view.name}.exr": exr_bytes(view.target) for view in problem.views}
    return files | {f"images/start-{name}.exr": exr_bytes(image) for name, image in before.items()}


def _checkpoints(run: Run, rival: Run | None) -> dict[str, bytes]:
    runs = {CHECKPOINT: run} if rival is None else {CHECKPOINT: run, RIVAL_CHECKPOINT: rival}
    return {name: checkpoint.save(each.adam, each.history, each.passes.learned()) for name, each in runs.items()}


def _resume_command(folder: Path) -> str:
    return f"pathreplay optimize --resume {shlex.quote(str(folder))}"


def _finish(
    start: _Start,
    folder: RunFolder,
    problem: Problem,
    run: Run,
    before: dict[str, Image],
    result: dict[str, Image],
    rival: Rival | None,
    variant: str,
    stopped_by: str | None,
) -> RunResult:
    config = start.config
    adam, history, theirs = run.adam, run.history, rival.values if rival else {}
    # The variables (translations, rotation vectors), as people see them, and what poses make of the scene (transforms).
    values = {key: get_array(value) for key, value in {**scene_values(problem, adam), **adam}.items()}
    views = tuple(
        ViewPictures(
            v.name, v.target, before[v.name], result[v.name], exposure_for(v.target),
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
            files[f"images/texture-{kind}-{item.file_name}.png"] = png_bytes(image)
        for kind, image in item.volumes().items():
            files[f"images/volume-{kind}-{item.file_name}.png"] = png_bytes(image)
        if item.result.ndim == 4:
            files[f"volumes/{item.file_name}.vol"] = vol_bytes(item.result)
    folder.write({**files, **report_files(outcome)})
    return RunResult(
        folder=folder.path,
        report=folder.path / "report.html",
        iterations=len(history),
        stopped=len(history) < config.iterations,
        stopped_by=stopped_by if len(history) < config.iterations else None,
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
