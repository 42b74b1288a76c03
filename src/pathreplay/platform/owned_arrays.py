"""Copies arrays into memory that Dr.Jit can use: for the arguments of frozen functions, and for arrays from NumPy."""

from __future__ import annotations

from typing import TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

A = TypeVar("A", bound=dr.ArrayBase)
T = TypeVar("T", bound=np.generic)
_PACKET = 64
"""A multiple of the number of entries that Dr.Jit reads at once."""


def owned(value: A) -> A:
    """Return a copy of an array or tensor. Its evaluation allocates memory of Dr.Jit.

    Arrays that were created from NumPy share NumPy's memory in LLVM variants. The alignment of this memory varies, and
    Dr.Jit records a frozen function again if the alignment of an argument has changed.
    """
    return dr.select(dr.opaque(mi.Bool, True), value, type(value)(0))


def with_space(values: NDArray[T]) -> NDArray[T]:
    """Return the values in memory that continues after them. They are copied, unless they fill whole packets.

    In LLVM variants, Dr.Jit uses the memory of a NumPy array in place, and reads whole packets, which may extend beyond
    the end of the array. If the array ends at the end of a memory page, such a read crashes the process.
    """
    if values.size % _PACKET == 0:
        return values
    room = np.zeros(values.size + _PACKET, values.dtype)
    room[: values.size] = values.ravel()
    return room[: values.size].reshape(values.shape)
