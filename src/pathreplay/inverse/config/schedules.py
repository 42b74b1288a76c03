"""Learning rates over a run, by name: how large a step is at each iteration, next to the rate that a job gives."""

from __future__ import annotations

import math
from typing import Literal

Schedule = Literal["exponential", "linear", "cosine", "constant"]


def rate(schedule: Schedule, position: int, iterations: int, decay: float, warmup_steps: int = 0) -> float:
    """The factor of iteration ``position`` of so many: 1 at the first, ``decay`` where one more would come.

    With x = position / iterations: decay^x, 1 - (1 - decay) x, decay + (1 - decay) (1 + cos πx) / 2, or 1. Through the
    first ``warmup_steps`` iterations it grows besides, in equal steps.
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
