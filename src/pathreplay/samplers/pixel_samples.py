"""Samples for all paths of a pixel.

The paths are divided into sets. Different sets are independent of each other, as `pixel_sweep` requires.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import mitsuba as mi

from pathreplay.samplers.sampler import Sampler

SETS = 4
"""Largest number of low-discrepancy sets per pixel; each set has at least one path. With fewer sets, the adjoint of a
path is computed from fewer paths and is noisier. With more sets, the samples of a set are less evenly distributed."""


class PixelSamples(Protocol):
    """Samplers for all paths of a pixel; each lane samples one pixel."""

    def together(self, paths: int) -> int:
        """Return the number of paths per set, for ``paths`` paths in total."""

    def first(self) -> Sampler:
        """Return the sampler of the first path."""

    def of(self, before: Sampler, place: mi.UInt32, size: int, number: mi.UInt32) -> Sampler:
        """Return the sampler of the path at index ``place`` in set ``number``, which has ``size`` paths.

        ``before`` is the sampler of the previous path.
        """


@dataclass(frozen=True)
class IndependentSets:
    """`PixelSamples` from a Mitsuba sampler. All samples are independent: each set consists of a single path."""

    sampler: mi.Sampler

    def together(self, paths: int) -> int:
        return 1

    def first(self) -> Sampler:
        return self.sampler

    def of(self, before: Sampler, place: mi.UInt32, size: int, number: mi.UInt32) -> Sampler:
        """Return ``before``, whose sequence continues with the samples of the next path."""
        return before


@dataclass(frozen=True)
class SobolSets:
    """`PixelSamples` of low discrepancy, in up to `SETS` sets."""

    sampler: Callable[[mi.UInt32, int, mi.UInt32], Sampler]
    """Maps index in the set, size of the set and index of the set to a sampler."""

    def together(self, paths: int) -> int:
        return -(-paths // min(SETS, paths))

    def first(self) -> Sampler:
        return self.sampler(mi.UInt32(0), 1, mi.UInt32(0))

    def of(self, before: Sampler, place: mi.UInt32, size: int, number: mi.UInt32) -> Sampler:
        return self.sampler(place, size, number)
