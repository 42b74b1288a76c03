"""How much memory a job may take, as the user writes it: a number and a unit."""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import AfterValidator, Field

from pathreplay.errors import shown

UNITS = {"MB": 10**6, "GB": 10**9, "TB": 10**12, "MiB": 2**20, "GiB": 2**30, "TiB": 2**40}
PATTERN = r"^\s*(\d{1,9}(?:\.\d{1,9})?)\s*(MB|GB|TB|MiB|GiB|TiB)\s*$"
LEAST = 2**29
"""Bytes: Python, Mitsuba, Dr.Jit and compiled kernels take most of that."""


def bytes_of(text: str) -> int:
    """The bytes that a text such as '8 GiB' stands for. Raises ValueError for another."""
    found = re.match(PATTERN, text)
    if found is None:
        raise ValueError(
            f"memory_limit is {shown(text)}; write a number and a unit, as in '8 GiB' ({', '.join(UNITS)})"
        )
    size = int(float(found[1]) * UNITS[found[2]])
    if size < LEAST:
        raise ValueError(f"memory_limit is '{text}'; give '512 MiB' or more, of which the program itself takes most")
    return size


def _checked(text: str) -> str:
    bytes_of(text)
    return text


Memory = Annotated[str, Field(examples=["8 GiB"]), AfterValidator(_checked)]
