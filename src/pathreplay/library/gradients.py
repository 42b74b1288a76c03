"""Loss and gradient of a problem as a pure function of the values."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

from numpy.typing import ArrayLike

from pathreplay.inverse.config.schema import ITERATION
from pathreplay.inverse.objective.evaluate import Shard, total
from pathreplay.inverse.objective.stages import evaluator_of
from pathreplay.inverse.parameters.values import Array
from pathreplay.library.problem import Problem

ValueAndGrad = Callable[..., tuple[float, dict[str, Array]]]
"""(values=None, seed=0, spp=None) -> loss, gradients by name."""


def value_and_grad(problem: Problem) -> ValueAndGrad:
    """The loss and its gradient as a function, as `jax.value_and_grad` gives one.

    Args:
        problem: what is evaluated; its kernels are recorded by the second call.

    Returns:
        ``f(values=None, seed=0, spp=None)``. ``values`` are arrays by name (left out: initial ones), ``seed`` decides
        the paths, ``spp`` are samples per pixel. It gives the loss (mean over the views that are learned from, and
        regularizers) and the gradients, arrays in the shapes of the values. Unbiased for ``l2`` and ``relative-l2``;
        the loss itself carries the variance of the images on top. Entries that are NaN or infinite count as zero.
    """
    built = replace(problem.built, config=problem.built.config.model_copy(update={"stages": None}))
    config = built.config
    evaluator = evaluator_of(built, built.integrator, config.integrator)

    def evaluated(
        values: Mapping[str, ArrayLike] | None = None, seed: int = 0, spp: int | None = None
    ) -> tuple[float, dict[str, Array]]:
        at = problem.complete(values)
        samples = config.most_spp if spp is None else spp
        shards = [
            Shard((n,), samples, config.seeds(ITERATION, view.sensor, seed, 1)) for n, view in built.trained().items()
        ]
        with built.computing():
            found = total((evaluator(at, shard, {}) for shard in shards), owned=True)
        loss, gradients = found.loss, found.gradients
        for variable in built.variables:
            if variable.penalty is not None:
                value, slope = variable.penalty.of(at[variable.key])
                loss, gradients[variable.key] = loss + value, gradients[variable.key] + slope
        return loss, gradients

    return evaluated
