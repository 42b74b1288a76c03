"""Batches of views: all training views, or minibatches of a random permutation in each epoch."""

from __future__ import annotations

import numpy as np

from pathreplay.inverse.config.schema import BATCH


def batch(views: list[int], size: int | None, seed: int, iteration: int) -> list[int]:
    """Return the training ``views`` that an iteration evaluates, in the order of evaluation.

    An epoch contains every training view once. The last batch of an epoch may be smaller than ``size``. A batch depends
    only on the seed and the iteration, so a resumed run continues with the same views.
    """
    n = len(views)
    if size is None or size >= n:
        # The order affects the control variates of media, so it stays as in earlier versions.
        return views[::-1]
    number, k = divmod(iteration, -(-n // size))
    shuffled = np.random.default_rng([seed, BATCH, number]).permutation(n).tolist()
    return [views[i] for i in shuffled[k * size : (k + 1) * size]]
