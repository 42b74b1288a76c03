"""Memory limit of a job, written as a number and a unit."""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import AfterValidator, Field

from pathreplay.errors import shown

UNITS = {"MB": 10**6, "GB": 10**9, "TB": 10**12, "MiB": 2**20, "GiB": 2**30, "TiB": 2**40}
PATTERN = r"^\s*(\d{1,9}(?:\.\d{1,9})?)\s*(MB|GB|TB|MiB|GiB|TiB)\s*$"
LEAST = 2**29
"""Smallest memory limit in bytes. Python, Mitsuba, Dr.Jit and compiled kernels use most of this amount."""


def bytes_of(text: str) -> int:
    """Return the number of bytes that a string such as '8 GiB' denotes. Raises ValueError if it is malformed."""
    match = re.match(PATTERN, text)
    if match is None:
        raise ValueError(
            f"memory_limit is {shown(text)}; write a number and a unit, as in '8 GiB' ({', '.join(UNITS)})"
        )
    size = int(float(match[1]) * UNITS[match[2]])
    if size < LEAST:
        raise ValueError(f"memory_limit is '{text}'; give '512 MiB' or more, since the program itself uses most of it")
    return size


def _checked(text: str) -> str:
    bytes_of(text)
    return text


Memory = Annotated[str, Field(examples=["8 GiB"]), AfterValidator(_checked)]
