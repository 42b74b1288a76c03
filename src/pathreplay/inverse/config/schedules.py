"""Learning-rate schedules."""

from __future__ import annotations

import math
from typing import Literal

Schedule = Literal["exponential", "linear", "cosine", "constant"]


def rate(schedule: Schedule, position: int, iterations: int, decay: float, warmup_steps: int = 0) -> float:
    """Return the factor on the learning rate at iteration ``position``.

    With x = position / iterations, the factor is decay^x (exponential), 1 - (1 - decay) x (linear),
    decay + (1 - decay) (1 + cos πx) / 2 (cosine) or 1 (constant). During warm-up, the factor is multiplied by
    (position + 1) / (warmup_steps + 1).

    Args:
        schedule: name of the schedule.
        position: iteration, from 0 to iterations - 1.
        iterations: number of iterations of the run.
        decay: ratio of the final to the initial rate, reached at ``position == iterations``.
        warmup_steps: number of iterations of linear warm-up.
    """
    x = position / iterations
    if schedule == "exponential":
        factor = decay**x
    elif schedule == "linear":
        factor = 1 - (1 - decay) * x
    elif schedule == "cosine":
        factor = decay + (1 - decay) * (1 + math.cos(math.pi * x)) / 2
    else:
        factor = 1.0
    return factor * min(1.0, (position + 1) / (warmup_steps + 1))
