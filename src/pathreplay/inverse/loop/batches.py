"""Which views an iteration looks at: all of them, or batches in an order that is shuffled anew in every round."""

from __future__ import annotations

import numpy as np

from pathreplay.inverse.config.schema import BATCH, Config
from pathreplay.inverse.problem.problem import Problem


def batch(problem: Problem, config: Config, iteration: int) -> list[int]:
    """Places of the views of an iteration, in the order in which they are evaluated.

    A round has every view that is learned from once; its last batch has what is left. It depends on the seed and the
    iteration alone, so that a run that goes on takes the views that it would have taken.
    """
    views = list(problem.trained())
    n, size = len(views), config.view_batch_size
    if size is None or size >= n:
        return views[::-1]  # what is learned of media depends on the order, and earlier versions had this one
    number, k = divmod(iteration, -(-n // size))
    return [views[i] for i in _shuffled(config, number, n)[k * size : (k + 1) * size]]


def _shuffled(config: Config, number: int, n: int) -> list[int]:
    """The order of n views in a round of this number."""
    return np.random.default_rng([config.seed, BATCH, number]).permutation(n).tolist()
