"""The stages of a job, as it gives them: what is otherwise for some of its iterations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from pydantic import Field

from pathreplay.inverse.config.tables import Count, Positive, Table, Whole


class Stage(Table):
    """So many iterations, in which some things are otherwise; None: as in the rest of the job."""

    iterations: Count
    """Iterations of the stage."""
    downscale: Annotated[Whole, Field(ge=1, le=2**16)] = 1
    """Factor by which films are smaller."""
    spp: Count | None = None
    """Samples per pixel; default: those of the job."""
    max_depth: Count | None = None
    """Depth of paths; default: that of the job."""
    sensors: Annotated[list[Whole | str], Field(min_length=1)] | None = None
    """Sensors that the stage learns from; default: those of the job."""
    view_batch_size: Count | None = None
    """Views in an iteration."""
    pixel_batch_size: Count | None = None
    """Pixels of each view in an iteration."""
    parameters: Annotated[list[str], Field(min_length=1)] | None = None
    """Keys or globs of the parameters that move; the others are frozen. Default: all."""
    learning_rate_factor: Positive = 1.0
    """Factor on all learning rates."""


def begins(stages: Sequence[Stage]) -> list[int]:
    """The iteration with which each begins, and that after the last one."""
    found = [0]
    for stage in stages:
        found.append(found[-1] + stage.iterations)
    return found


def place(stages: Sequence[Stage], iteration: int) -> int:
    """Which stage an iteration belongs to; beyond the end, the last one."""
    return min(sum(begin <= iteration for begin in begins(stages)[1:]), len(stages) - 1)
