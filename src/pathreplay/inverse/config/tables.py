"""What the tables of a job are made of: numbers that are strictly what they should be, and no key that is unknown."""

from __future__ import annotations

import math
from collections.abc import Mapping
from numbers import Integral, Real
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from pathreplay.errors import shown


def _whole(value: Any) -> Any:
    return int(value) if isinstance(value, Integral) and not isinstance(value, bool) else value


def _single(value: Any) -> Any:
    """A number as a float; Mitsuba computes in single precision, so what that cannot hold is no number to it."""
    if isinstance(value, bool) or not isinstance(value, Real):
        return value
    try:
        number = float(value)
    except OverflowError:  # a whole number that not even double precision holds
        number = 2 * LARGEST
    if math.isfinite(number) and abs(number) > LARGEST:
        raise ValueError(f"{shown(value)} is beyond single precision; give a number up to {LARGEST:.3g}")
    return number


LARGEST = float(np.finfo(np.float32).max)
# Strict: true is not 1, and "16" is not 16. NumPy's numbers are numbers.
Whole = Annotated[int, Field(strict=True), BeforeValidator(_whole)]
Finite = Annotated[float, Field(strict=True, allow_inf_nan=False), BeforeValidator(_single)]
Positive = Annotated[Finite, Field(gt=0)]
Share = Annotated[Finite, Field(ge=0, lt=1)]
Switch = Annotated[bool, Field(strict=True)]
Count = Annotated[Whole, Field(ge=1, le=2**31 - 1)]


class Table(BaseModel):
    """A table of a job; it never changes."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    @model_validator(mode="before")
    @classmethod
    def _is_a_table(cls, value: Any) -> Any:
        """Of mappings only dictionaries: an optimiser of Dr.Jit's is one, and says nothing of what it is."""
        if isinstance(value, Mapping) and not isinstance(value, dict):
            raise PydanticCustomError("table_type", "input should be a dictionary")
        return value
