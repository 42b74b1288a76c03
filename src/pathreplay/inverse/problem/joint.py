"""Joint problems: several scenes with shared variables, and the mean of their losses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.schema import Config
from pathreplay.inverse.dataset.targets import Targets
from pathreplay.inverse.dataset.views import View
from pathreplay.inverse.parameters.exposures import EXPOSURE
from pathreplay.inverse.parameters.response import RESPONSE
from pathreplay.inverse.parameters.variables import Variable
from pathreplay.inverse.problem.problem import Problem


@dataclass(frozen=True)
class JointProblem(Problem):
    """A problem of several scenes. Views are numbered across scenes, which makes their random numbers independent."""

    parts: tuple[Problem, ...] = ()

    def scenes(self) -> tuple[Problem, ...]:
        return self.parts

    def home(self, view: View) -> tuple[Problem, View]:
        part, place = self.place(view.sensor)
        return self.parts[part], self.parts[part].views[place]

    def with_targets(self, targets: Targets) -> JointProblem:
        joint = super().with_targets(targets)
        seen, parts = iter(joint.views), []
        for part in self.parts:
            known = [(view, next(seen)) for view in part.views]
            views = tuple(replace(view, target=other.target, weight=other.weight) for view, other in known)
            parts.append(replace(part, views=views))
        return replace(self, views=joint.views, parts=tuple(parts))

    def place(self, view: int) -> tuple[int, int]:
        """Return the index of the scene of a view, and the index of the view in this scene."""
        for n, part in enumerate(self.parts):
            if view < len(part.views):
                return n, view
            view -= len(part.views)
        raise IndexError(view)


def joined(parts: Sequence[Problem], config: Config) -> JointProblem:
    """Combine problems into a joint problem.

    Args:
        parts: problems of different scenes; the first definition of a shared variable is used.
        config: settings of the joint problem.

    Returns:
        The joint problem.

    Raises:
        PathreplayError: shared variables have different shapes, two problems have the same scene, or a problem has
            exposures, a response or a baseline.
    """
    variables: dict[str, Variable] = {}
    for part in parts:
        for variable in part.variables:
            shape = variables.setdefault(variable.key, variable).start.shape
            if shape != variable.start.shape:
                raise PathreplayError(
                    f"'{variable.key}' has the shape {variable.start.shape} in one problem and {shape} in another; "
                    "only parameters of one shape are shared"
                )
    if not variables.keys().isdisjoint({EXPOSURE, RESPONSE}) or any(part.baseline is not None for part in parts):
        raise PathreplayError("Joint problems support none of 'exposure', 'response' and 'baseline'; remove them")
    if len({id(part.scene) for part in parts}) < len(parts):
        raise PathreplayError("Two of the problems have the same scene; use one problem with several views")
    views = [replace(view, name=f"{n}-{view.name}") for n, part in enumerate(parts) for view in part.views]
    first = parts[0]
    return JointProblem(
        config,
        first.scene,
        first.params,
        first.integrator,
        None,
        first.judge,
        tuple(variables.values()),
        tuple({pose.key: pose for part in parts for pose in part.poses}.values()),
        tuple(replace(view, sensor=n) for n, view in enumerate(views)),
        first.loss,
        tuple(dict.fromkeys(note for part in parts for note in part.notes)),
        tuple({each.key: each for part in parts for each in part.derived}.values()),
        parts=tuple(replace(part, config=config) for part in parts),
    )
