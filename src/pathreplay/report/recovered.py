"""Collects the parameters of a run, each with its initial value, result and truth.

All values are decoded values, which differ from the form that Mitsuba stores; see `scenes.stored`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import mitsuba as mi
import numpy as np

from pathreplay.inverse.loop.checkpoint import Run
from pathreplay.inverse.parameters.derived import Derived
from pathreplay.inverse.parameters.exposures import EXPOSURE
from pathreplay.inverse.parameters.pose import Pose
from pathreplay.inverse.parameters.response import RESPONSE
from pathreplay.inverse.parameters.values import Array, Arrays
from pathreplay.inverse.parameters.variables import Variable
from pathreplay.inverse.problem.problem import Problem, variables_of
from pathreplay.platform import compat
from pathreplay.platform.files import file_names
from pathreplay.report.outcome import Recovered, RecoveredPose
from pathreplay.scenes.parameters import get_array


def recovered_of(problem: Problem, run: Run) -> tuple[Recovered, ...]:
    """Return the parameters that are not poses. Parameters that are computed from other parameters come last."""
    parts = {name for pose in problem.poses for name in pose.of}
    entries: list[Variable | Derived] = [
        v for v in problem.variables if v.key not in parts and v.key not in (EXPOSURE, RESPONSE)
    ]
    entries += problem.derived
    starts = with_scene(problem, {v.key: v.start for v in problem.variables})
    values = with_scene(problem, run.values)
    baselines = with_scene(problem, run.baseline.values) if run.baseline else {}
    names = file_names([*(v.key for v in problem.variables), *(parameter.key for parameter in problem.derived)])
    return tuple(
        Recovered(
            each.key,
            names[each.key],
            starts[each.key],
            values[each.key],
            each.truth,
            baselines.get(each.key),
            derived=isinstance(each, Derived),
            wraps=each.form.wraps,
        )
        for each in entries
    )


def with_faces(problem: Problem, items: tuple[Recovered, ...]) -> tuple[Recovered, ...]:
    """Add the faces of the mesh to parameters that consist of mesh vertices."""
    params: Mapping[str, object] = (
        mi.traverse(problem.scene) if any(compat.is_positions(item.key) for item in items) else {}
    )
    return tuple(replace(item, faces=compat.faces_of_positions(params, item.key)) for item in items)


def poses_of(problem: Problem, run: Run) -> tuple[RecoveredPose, ...]:
    """Return the parameters that are poses."""
    if not problem.poses:
        return ()
    starts = with_scene(problem, {v.key: v.start for v in problem.variables})
    values = with_scene(problem, run.values)
    baselines = with_scene(problem, run.baseline.values) if run.baseline else {}
    return tuple(
        RecoveredPose(
            pose,
            _parts(pose, starts),
            _parts(pose, values),
            values[pose.key],
            starts[pose.key],
            baselines.get(pose.key),
        )
        for pose in problem.poses
    )


def with_scene(problem: Problem, values: Arrays) -> dict[str, Array]:
    """Return ``values`` together with the poses and derived parameters that are computed from ``values``.

    ``values`` contains the decoded values of the variables by key. The result contains all values by key.
    """
    inputs = {name for computed in problem.made() for name in computed.of}
    if not inputs:
        return dict(values)
    reduced = replace(problem, variables=tuple(v for v in problem.variables if v.key in inputs))
    variables = variables_of(reduced, values)
    return {computed.key: get_array(computed.value(variables)) for computed in problem.made()} | dict(values)


def _parts(pose: Pose, values: Arrays) -> dict[str, Array]:
    """Return the translation and the rotation vector (degrees) of a pose, by part."""
    parts = {part: values[name] for part, name in pose.parts().items()}
    return {part: np.degrees(value) if part == "rotation" else value for part, value in parts.items()}
