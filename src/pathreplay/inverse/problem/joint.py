"""Problems of several scenes that share variables, as one problem: the mean of their losses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.schema import Config
from pathreplay.inverse.dataset.views import View
from pathreplay.inverse.parameters.exposures import EXPOSURE
from pathreplay.inverse.parameters.variables import Variable
from pathreplay.inverse.problem.problem import Problem


@dataclass(frozen=True)
class JointProblem(Problem):
    """Its views are those of all parts, numbered throughout, so that each has random numbers of its own."""

    parts: tuple[Problem, ...] = ()

    def scenes(self) -> tuple[Problem, ...]:
        """See `Problem`."""
        return self.parts

    def home(self, view: View) -> tuple[Problem, View]:
        """See `Problem`."""
        part, place = self.place(view.sensor)
        return self.parts[part], self.parts[part].views[place]

    def place(self, view: int) -> tuple[int, int]:
        """The part that a view belongs to, and its place there."""
        for n, part in enumerate(self.parts):
            if view < len(part.views):
                return n, view
            view -= len(part.views)
        raise IndexError(view)


def joined(parts: Sequence[Problem], config: Config) -> JointProblem:
    """The problems as one, with the settings of the ``config``; of a shared variable, the first problem's counts.

    Raises PathreplayError for what several scenes cannot have, and for variables of one name and several shapes.
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
    if EXPOSURE in variables or any(part.baseline is not None for part in parts):
        raise PathreplayError("Several scenes have neither 'exposure' nor 'baseline'; leave them out")
    if len({id(part.scene) for part in parts}) < len(parts):
        raise PathreplayError("Two of the problems are of one scene; give one problem several views")
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
        parts=tuple(parts),
    )
