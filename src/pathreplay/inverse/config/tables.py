"""Building blocks of the tables of a job: strictly typed numbers, tables without unknown keys, and plugins."""

from __future__ import annotations

import math
from collections.abc import Mapping
from numbers import Integral, Real
from typing import Annotated

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from pathreplay.errors import shown


def _whole(value: object) -> object:
    return int(value) if isinstance(value, Integral) and not isinstance(value, bool) else value


def _single(value: object) -> object:
    """Convert a number to a float; reject values beyond single precision, in which Mitsuba computes."""
    if isinstance(value, bool) or not isinstance(value, Real):
        return value
    try:
        number = float(value)
    except OverflowError:  # the integer exceeds the range of double precision
        number = 2 * LARGEST
    if math.isfinite(number) and abs(number) > LARGEST:
        raise ValueError(f"{shown(value)} exceeds the range of single precision; give a number up to {LARGEST:.3g}")
    return number


LARGEST = float(np.finfo(np.float32).max)
# Types are strict: neither true nor "1" is accepted for 1. NumPy scalars are accepted.
Whole = Annotated[int, Field(strict=True), BeforeValidator(_whole)]
Finite = Annotated[float, Field(strict=True, allow_inf_nan=False), BeforeValidator(_single)]
Positive = Annotated[Finite, Field(gt=0)]
Share = Annotated[Finite, Field(ge=0, lt=1)]
Switch = Annotated[bool, Field(strict=True)]
Count = Annotated[Whole, Field(ge=1, le=2**31 - 1)]


class Table(BaseModel):
    """Base class of the tables of a job: immutable, without unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    @model_validator(mode="before")
    @classmethod
    def _is_a_table(cls, value: object) -> object:
        """Reject mappings that are not dictionaries, such as Dr.Jit optimizers. Their keys are not keys of a job."""
        if isinstance(value, Mapping) and not isinstance(value, dict):
            raise PydanticCustomError("table_type", "input should be a dictionary")
        return value


Argument = Switch | Whole | Finite | str
"""Replacement of a ``$name`` placeholder in a scene file, or argument of a built-in scene."""


class Plugin(BaseModel):
    """A Mitsuba plugin: its type and its options. The options are checked by Mitsuba."""

    model_config = ConfigDict(extra="allow", frozen=True, use_attribute_docstrings=True)

    type: str
    """Name of the plugin; its options are further keys of the same table."""

    @model_validator(mode="after")
    def _has_options(self) -> Plugin:
        if self.type not in ("pathreplay", "pathreplay_particles") and (
            asked := {"boundary", "boundary_spp"} & set(self.model_extra or {})
        ):
            raise ValueError(
                f"'{min(asked)}' is an option of the integrator 'pathreplay', which '{self.type}' does not have; "
                "remove it"
            )
        for name, value in (self.model_extra or {}).items():
            if isinstance(value, int) and abs(value) >= 2**31:
                raise ValueError(f"'{name}' of '{self.type}' is {shown(value)}; give an integer below {2**31}")
        return self
