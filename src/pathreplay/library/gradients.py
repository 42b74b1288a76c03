"""Loss and gradient of a problem as a pure function of the values."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from pathreplay.errors import require_count
from pathreplay.inverse.config.schema import ITERATION
from pathreplay.inverse.objective.evaluate import Shard, total
from pathreplay.inverse.objective.stages import evaluator_of
from pathreplay.inverse.parameters.values import Array
from pathreplay.inverse.problem.problem import detach
from pathreplay.library.problem import Problem

ValueAndGrad = Callable[..., tuple[float, dict[str, Array]]]
"""Function of (values=None, seed=0, spp=None) that returns the loss and the gradients by name."""


def value_and_grad(problem: Problem) -> ValueAndGrad:
    """Return a function that computes the loss and its gradients, like `jax.value_and_grad`.

    Args:
        problem: the problem to evaluate. The second call of the function records kernels, which later calls replay.

    Returns:
        ``f(values=None, seed=0, spp=None)``, which returns the loss and the gradients by name. ``values`` are arrays by
        name, or numbers for all entries; missing values are initial values. ``seed`` selects the sampled paths, and
        ``spp`` is the number of samples per pixel.

        The loss is the mean over the training views plus regularizers. Noise in the images increases the loss; for
        ``l2``, the increase is the variance of the images. The gradients have the shapes of the values and are unbiased
        for ``l2``, ``relative-l2`` and ``display-l2``. Gradient entries that are NaN or infinite count as zero. If the
        loss is NaN or infinite, all gradients are NaN.

    Raises:
        PathreplayError: another variant is active than when the problem was created. The function also raises it if a
            value is not finite, or has the wrong name or shape.
    """
    problem.require_variant()
    built = replace(problem.built, config=problem.built.config.model_copy(update={"stages": None}))
    config = built.config
    evaluator = evaluator_of(built, built.integrator, config.integrator)

    def evaluated(
        values: Mapping[str, ArrayLike] | None = None, seed: int = 0, spp: int | None = None
    ) -> tuple[float, dict[str, Array]]:
        at = problem.complete(values)
        require_count("seed", seed, 0)
        if spp is not None:
            require_count("spp", spp, 1)
        samples = config.most_spp if spp is None else spp
        shards = [
            Shard((n,), samples, config.seeds(ITERATION, view.sensor, seed, 1)) for n, view in built.trained().items()
        ]
        with built.computing():
            try:
                found = total((evaluator(at, shard, {}) for shard in shards), owned=True)
            finally:
                detach(built)
        loss, gradients = found.loss, found.gradients
        for variable in built.variables:
            if variable.penalty is not None:
                value, slope = variable.penalty.of(at[variable.key])
                loss, gradients[variable.key] = loss + value, gradients[variable.key] + slope
        if not np.isfinite(loss):  # finite gradients would hide the error
            gradients = {key: np.full_like(gradient, np.nan) for key, gradient in gradients.items()}
        return loss, gradients

    return evaluated
