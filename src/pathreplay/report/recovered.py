"""Where the parameters of a run are, each with its start and its truth: as people see them, and as scenes do."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np

from pathreplay.inverse.loop.checkpoint import Run
from pathreplay.inverse.parameters.exposures import EXPOSURE
from pathreplay.inverse.parameters.pose import Pose
from pathreplay.inverse.parameters.values import Array, Arrays
from pathreplay.inverse.problem.problem import Problem, variables_of
from pathreplay.platform.files import file_names
from pathreplay.report.outcome import Recovered, RecoveredPose
from pathreplay.scenes.parameters import get_array

VERTICES = ".vertex_positions"


def recovered_of(problem: Problem, run: Run) -> tuple[Recovered, ...]:
    """The parameters that are no poses, those that are derived behind those that they are derived from."""
    parts = {name for pose in problem.poses for name in pose.of}
    known = [(v.key, v.truth) for v in problem.variables if v.key not in parts and v.key != EXPOSURE]
    made = {each.key: each.truth for each in problem.derived}
    known += made.items()
    starts = with_scene(problem, {v.key: v.start for v in problem.variables})
    values = with_scene(problem, run.values)
    theirs = with_scene(problem, run.baseline.values) if run.baseline else {}
    files_of = file_names([*(v.key for v in problem.variables), *made])
    return tuple(
        Recovered(key, files_of[key], starts[key], values[key], truth, theirs.get(key), derived=key in made)
        for key, truth in known
    )


def with_faces(problem: Problem, items: tuple[Recovered, ...]) -> tuple[Recovered, ...]:
    """The vertices of a mesh among these are given its faces."""
    params = mi.traverse(problem.scene) if any(item.key.endswith(VERTICES) for item in items) else {}
    faces = {item.key: item.key.removesuffix(VERTICES) + ".faces" for item in items if item.key.endswith(VERTICES)}
    found = {key: np.array(params[name]) for key, name in faces.items() if name in params}
    return tuple(replace(item, faces=found.get(item.key)) for item in items)


def poses_of(problem: Problem, run: Run) -> tuple[RecoveredPose, ...]:
    """The parameters that are poses."""
    if not problem.poses:
        return ()
    starts = with_scene(problem, {v.key: v.start for v in problem.variables})
    values = with_scene(problem, run.values)
    return tuple(
        RecoveredPose(pose, _parts(pose, starts), _parts(pose, values), values[pose.key], starts[pose.key])
        for pose in problem.poses
    )


def with_scene(problem: Problem, values: Arrays) -> dict[str, Array]:
    """The values of the variables, and what they make of poses and of derived parameters, as people see it."""
    used = {name for each in problem.made() for name in each.of}
    if not used:
        return dict(values)
    few = replace(problem, variables=tuple(v for v in problem.variables if v.key in used))
    variables = variables_of(few, values)
    return {each.key: get_array(each.value(variables)) for each in problem.made()} | dict(values)


def _parts(pose: Pose, values: Arrays) -> dict[str, Array]:
    """Translation and rotation vector (degrees) of a pose."""
    parts = {part: values[name] for part, name in pose.parts().items()}
    return {part: np.degrees(value) if part == "rotation" else value for part, value in parts.items()}
