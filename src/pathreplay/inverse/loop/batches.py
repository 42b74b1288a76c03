"""Batches of views: all training views, or minibatches of a random permutation in each epoch."""

from __future__ import annotations

import numpy as np

from pathreplay.inverse.config.schema import BATCH, Config
from pathreplay.inverse.problem.problem import Problem


def batch(problem: Problem, config: Config, iteration: int) -> list[int]:
    """Return the indices of the views of an iteration, in the order of evaluation.

    An epoch contains every training view once; its last batch may be smaller. The batch depends only on the seed and
    the iteration, so a resumed run continues with the same views.
    """
    views = list(problem.trained())
    n, size = len(views), config.view_batch_size
    if size is None or size >= n:
        return views[::-1]  # the order of earlier versions, which affects the baselines of media
    number, k = divmod(iteration, -(-n // size))
    return [views[i] for i in _shuffled(config, number, n)[k * size : (k + 1) * size]]


def _shuffled(config: Config, number: int, n: int) -> list[int]:
    """Return the permutation of n views in epoch ``number``."""
    return np.random.default_rng([config.seed, BATCH, number]).permutation(n).tolist()
