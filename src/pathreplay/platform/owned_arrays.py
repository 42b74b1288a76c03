"""Copies arrays into memory that Dr.Jit has allocated, for the arguments of frozen functions."""

from __future__ import annotations

from typing import TypeVar

import drjit as dr
import mitsuba as mi

A = TypeVar("A", bound=dr.ArrayBase)


def owned(value: A) -> A:
    """Return a copy of an array or tensor. Its evaluation allocates memory of Dr.Jit.

    Arrays that were created from NumPy share NumPy's memory in LLVM variants. The alignment of this memory varies, and
    Dr.Jit records a frozen function again if the alignment of an argument has changed.
    """
    return dr.select(dr.opaque(mi.Bool, True), value, type(value)(0))
