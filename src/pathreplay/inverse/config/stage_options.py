"""Stages of a job: settings that hold for a range of its iterations."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import Annotated

from pydantic import Field

from pathreplay.inverse.config.tables import Count, Positive, Table, Whole


class Stage(Table):
    """A range of iterations that overrides some settings of the job; None stands for the setting of the job."""

    iterations: Count
    """Number of iterations of the stage."""
    downscale: Annotated[Whole, Field(ge=1, le=2**16)] = 1
    """Factor by which the width and height of all films are reduced."""
    spp: Count | None = None
    """Samples per pixel; default: the spp of the job."""
    max_depth: Count | None = None
    """Maximum path depth; default: the max_depth of the job's integrator."""
    sensors: Annotated[list[Whole | str], Field(min_length=1)] | None = None
    """Sensors whose views are part of the loss; default: the sensors of the job."""
    view_batch_size: Count | None = None
    """Views per iteration; default: the view_batch_size of the job."""
    pixel_batch_size: Count | None = None
    """Pixels of each view per iteration; default: the pixel_batch_size of the job."""
    parameters: Annotated[list[str], Field(min_length=1)] | None = None
    """Keys or globs of the parameters to optimise; the others are frozen. Default: all."""
    learning_rate_factor: Positive = 1.0
    """Factor on all learning rates."""


def begins(stages: Sequence[Stage]) -> list[int]:
    """Return the first iteration of each stage, followed by the total number of iterations."""
    return list(accumulate((stage.iterations for stage in stages), initial=0))


def place(stages: Sequence[Stage], iteration: int) -> int:
    """Return the index of the stage that an iteration belongs to. The last stage includes all later iterations."""
    return min(sum(begin <= iteration for begin in begins(stages)[1:]), len(stages) - 1)
