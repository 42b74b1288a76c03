"""Checks that the stages of a problem can be run, among them: their variables affect a view of the stage.

The checks precede the first iteration.
"""

from __future__ import annotations

from collections.abc import Iterable

import drjit as dr
import mitsuba as mi

from pathreplay.errors import PathreplayError
from pathreplay.integrators.film.image import picture_shape
from pathreplay.integrators.stateful import stateful
from pathreplay.inverse.config.schema import CORNERED, PIXELWISE
from pathreplay.inverse.losses.pixelwise import LOSSES, QUADRATIC
from pathreplay.inverse.objective.stages import Part, parts_of, require_single_pixels, require_stages
from pathreplay.inverse.parameters.exposures import EXPOSURE
from pathreplay.inverse.parameters.response import RESPONSE
from pathreplay.inverse.problem.problem import Problem, scene_values, variables_of


def require_possible(problem: Problem) -> None:
    """Raise PathreplayError unless all stages of a problem can be run.

    See `require_loss`, `require_stages`, `require_single_pixels` and `require_reached`.
    """
    for each in problem.scenes():
        require_loss(each)
        require_stages(each)
        require_single_pixels(each)
        with problem.computing():
            require_reached(each)


def require_loss(problem: Problem) -> None:
    """Raise PathreplayError if the loss of one of several scenes does not suit the settings of all scenes.

    The settings themselves were checked with the loss of the first scene.
    """
    config, name = problem.config, next((name for name, each in LOSSES.items() if each is problem.loss), None)
    named = f"loss = '{name}'" if name else "the function in 'loss'"
    if config.optimizer.is_second_order and problem.loss not in QUADRATIC:
        raise PathreplayError(
            f"optimizer: type = '{config.optimizer.type}' needs a sum of squares in all scenes, which "
            f"{named} is not; use {' or '.join(PIXELWISE)}, or type = 'adam'"
        )
    if config.debias and name in CORNERED:
        raise PathreplayError(
            f"debias: loss = '{name}' is not smooth where image and target are equal; remove 'debias', or use a smooth "
            "loss such as 'log' in all scenes"
        )


def require_reached(problem: Problem) -> None:
    """Raise PathreplayError if the variables of a stage affect no view of the stage.

    A job without stages counts as one stage. Also raises PathreplayError if the integrator does not differentiate the
    variables.
    """
    for part in parts_of(problem):
        where = f"stages: stage {part.number + 1}: " if part.stage else ""
        views = part.problem.trained()
        reached = sorted(views.keys() & part.problem.reached(part.moving))
        if not reached and part.moving.isdisjoint({EXPOSURE, RESPONSE}):  # both affect the loss of all views
            names = _listed(view.name for view in views.values())
            raise PathreplayError(
                f"{where}{_listed(sorted(part.problem.moves(part.moving)))} affects none of the training views "
                f"({names}), because it belongs to other cameras; add the views of these cameras, or name other "
                "parameters"
            )
        if reached:
            _require_differentiated(part, views[reached[0]].sensor, where)


def _require_differentiated(part: Part, sensor: int, where: str) -> None:
    """Raise PathreplayError if the integrator of the run or of the baseline run cannot differentiate the variables."""
    problem = part.problem
    variables = variables_of(problem, {v.key: v.start for v in problem.variables})
    dr.enable_grad({key: value for key, value in variables.items() if key in part.moving})
    problem.params.update(scene_values(problem, variables))
    try:
        for integrator in filter(None, (problem.integrator, problem.baseline)):
            if not stateful(integrator).is_reached(problem.scene, sensor):
                nothing = dr.zeros(mi.TensorXf, picture_shape(problem.scene.sensors()[sensor]))
                integrator.render_backward(problem.scene, problem.params, nothing, sensor, spp=1)
    except PathreplayError as error:
        raise PathreplayError(f"{where}{error}") from None
    finally:
        dr.disable_grad(variables)
        problem.params.update(scene_values(problem, variables))


def _listed(names: Iterable[str]) -> str:
    return ", ".join(f"'{name}'" for name in names)
