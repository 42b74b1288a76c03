"""Connects second-order optimisers to the optimisation loop.

`draw_of` selects the random numbers of an iteration. `observe` passes the Gauss-Newton model to the optimiser.
"""

from __future__ import annotations

from functools import partial

from pathreplay.inverse.objective.evaluate import Evaluation
from pathreplay.inverse.optim.adaptive import Optimiser
from pathreplay.inverse.optim.levenberg_marquardt import LevenbergMarquardt
from pathreplay.inverse.parameters.gauss_newton import curvature
from pathreplay.inverse.parameters.reparameterization import Coordinates
from pathreplay.inverse.parameters.values import Array, Arrays
from pathreplay.inverse.parameters.variables import range_of
from pathreplay.inverse.problem.problem import Problem


def draw_of(optimiser: Optimiser, iteration: int, searches: bool) -> tuple[int, bool]:
    """Return which random numbers an iteration uses, and whether its Gauss-Newton model is evaluated.

    Args:
        optimiser: the optimiser.
        iteration: index of the iteration.
        searches: whether all iterations use the same random numbers, see `Optimizer.searches`.

    Returns:
        An index of random numbers, and the value of `Shard.second_order`. Iterations with equal indices use equal
        random numbers.
    """
    if isinstance(optimiser, LevenbergMarquardt):
        return optimiser.draw, True
    return 0 if searches else iteration, False


def observe(problem: Problem, optimiser: Optimiser, values: Arrays, evaluation: Evaluation) -> None:
    """Pass the Gauss-Newton model of an evaluation to a second-order optimiser.

    The model includes the regularizers. Its variables are the latent variables, in which the optimiser takes its steps.
    """
    model = evaluation.model
    if not isinstance(optimiser, LevenbergMarquardt) or model is None:
        return
    maps = {}
    for v in problem.variables:
        if v.key not in model.sizes:
            continue
        if v.penalty is not None:
            model = model.curved(v.key, curvature(v.penalty.of, values[v.key], range_of(v)))
        if v.coordinates is not None:
            maps[v.key] = partial(_by_latent, v.coordinates, values[v.key])
    optimiser.observe(model.mapped(maps))


def _by_latent(coordinates: Coordinates, value: Array, gradient: Array) -> Array:
    return coordinates.gradient(value, gradient.reshape(value.shape))
