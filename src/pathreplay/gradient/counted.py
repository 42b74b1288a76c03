"""Random numbers that are counted: those of a key are the same each time, for paths and lines side by side."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi


@dataclass
class Counted:
    """Random numbers that are counted: those of a key are the same each time. Takes a sampler's place."""

    key: mi.UInt32
    index: mi.UInt32

    @staticmethod
    def of(key: mi.UInt32) -> Counted:
        return Counted(mi.UInt32(key), mi.UInt32(0))

    @staticmethod
    def at_vertex(key: mi.UInt32, k: mi.UInt32) -> Counted:
        """Those of the k-th vertex (see `Numbers.draw`) of a path whose first has the first."""
        return Counted(mi.UInt32(key), mi.UInt32(6 * k))

    def next_1d(self, active: bool | mi.Bool = True) -> mi.Float:
        x = mi.sample_tea_float32(self.key, self.index)
        self.index += 1
        return x

    def next_2d(self, active: bool | mi.Bool = True) -> mi.Point2f:
        x = self.next_1d()
        return mi.Point2f(x, self.next_1d())


def quasi_random(i: mi.UInt32, seed: mi.UInt32) -> mi.Point2f:
    """The i-th point of the R2 sequence in the unit square (Roberts, 2018), shifted by the seed."""
    x = i * mi.UInt32(3242174889) + mi.sample_tea_32(seed, mi.UInt32(1))[0]
    y = i * mi.UInt32(2447445413) + mi.sample_tea_32(seed, mi.UInt32(2))[0]
    return mi.Point2f(mi.Float(x >> 8), mi.Float(y >> 8)) * 2**-24
