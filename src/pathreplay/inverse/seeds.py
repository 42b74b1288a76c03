"""Seeds of a job: one for each stream of random numbers, iteration and view, none used twice."""

from __future__ import annotations

import numpy as np

# Pictures never share a seed with iterations, nor targets with renderings.
ITERATION, TARGET, PICTURE, JUDGEMENT = 0, 1, 2, 3


def seeds(seed: int, stream: int, index: int, view: int) -> tuple[int, int]:
    """Two independent 32-bit seeds for this job's seed, stream, iteration and view."""
    first, second = np.random.SeedSequence([seed, stream, index, view]).generate_state(2)
    return int(first), int(second)
