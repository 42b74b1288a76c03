"""Second-order optimisers in the loop: their choice of random numbers, and the Gauss-Newton model of an iteration."""

from __future__ import annotations

from functools import partial

from pathreplay.inverse.objective.evaluate import Evaluation
from pathreplay.inverse.optim.adaptive import Optimiser
from pathreplay.inverse.optim.levenberg_marquardt import LevenbergMarquardt
from pathreplay.inverse.parameters.gauss_newton import curvature
from pathreplay.inverse.parameters.reparameterization import Coordinates
from pathreplay.inverse.parameters.values import Array, Arrays
from pathreplay.inverse.problem.problem import Problem


def draw_of(optimiser: Optimiser, iteration: int, searches: bool) -> tuple[int, bool]:
    """Return the index of the random numbers of an iteration, and whether its shards are of second order (see `Shard`).

    Args:
        optimiser: the optimiser.
        iteration: the iteration.
        searches: whether all iterations use the same random numbers, see `Optimizer.searches`.
    """
    if isinstance(optimiser, LevenbergMarquardt):
        return optimiser.draw, True
    return 0 if searches else iteration, False


def observe(problem: Problem, optimiser: Optimiser, values: Arrays, evaluation: Evaluation) -> None:
    """Pass the Gauss-Newton model of an evaluation to a second-order optimiser.

    The model includes the regularizers. It is a function of the latent variables that the optimiser steps.
    """
    model = evaluation.model
    if not isinstance(optimiser, LevenbergMarquardt) or model is None:
        return
    maps = {}
    for v in problem.variables:
        if v.key not in model.sizes:
            continue
        if v.penalty is not None:
            model = model.curved(v.key, curvature(v.penalty.of, values[v.key]))
        if v.coordinates is not None:
            maps[v.key] = partial(_by_latent, v.coordinates, values[v.key])
    optimiser.observe(model.mapped(maps))


def _by_latent(coordinates: Coordinates, value: Array, gradient: Array) -> Array:
    return coordinates.gradient(value, gradient.reshape(value.shape))
