"""Random numbers of all paths of a pixel, in sets that know nothing of each other, so that one may judge another."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import mitsuba as mi

SETS = 4
"""Of even numbers, where a pixel has so many paths: fewer are judged by fewer others, more are less even."""


class PixelSamples(Protocol):
    """Random numbers of all paths of each lane's pixel."""

    def together(self, paths: int) -> int:
        """How many of so many paths make a set."""

    def first(self) -> Any:
        """What the first path draws from: a sampler, or what takes its place."""

    def of(self, before: Any, place: mi.UInt32, size: int, number: mi.UInt32) -> Any:
        """What a path draws from, by its place in the set of that number, and what the path ``before`` drew from."""


@dataclass(frozen=True)
class Alone:
    """Those of a sampler whose numbers know nothing of each other: each path is a set of its own."""

    sampler: mi.Sampler

    def together(self, paths: int) -> int:
        """See `PixelSamples`."""
        return 1

    def first(self) -> Any:
        """See `PixelSamples`."""
        return self.sampler

    def of(self, before: Any, place: mi.UInt32, size: int, number: mi.UInt32) -> Any:
        """See `PixelSamples`: its numbers go on."""
        return before


@dataclass(frozen=True)
class EvenSets:
    """Even ones, in up to `SETS` sets."""

    numbers: Callable[[mi.UInt32, int, mi.UInt32], Any]

    def together(self, paths: int) -> int:
        """See `PixelSamples`."""
        return -(-paths // min(SETS, paths))

    def first(self) -> Any:
        """See `PixelSamples`."""
        return self.numbers(mi.UInt32(0), 1, mi.UInt32(0))

    def of(self, before: Any, place: mi.UInt32, size: int, number: mi.UInt32) -> Any:
        """See `PixelSamples`."""
        return self.numbers(place, size, number)
