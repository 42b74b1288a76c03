"""The interface that light paths require of a sampler."""

from __future__ import annotations

from typing import Protocol, TypeVar

import mitsuba as mi

S = TypeVar("S")


class Sampler(Protocol):
    """Generates random numbers in [0, 1). Samplers of Mitsuba and of this package have these methods."""

    def clone(self: S) -> S: ...

    def next_1d(self, active: bool | mi.Bool = True) -> mi.Float: ...

    def next_2d(self, active: bool | mi.Bool = True) -> mi.Point2f: ...
