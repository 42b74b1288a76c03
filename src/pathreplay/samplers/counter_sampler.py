"""Random numbers that are counted: those of a key are the same each time, for paths and lines side by side."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from pathreplay.samplers.streams import Stream

STEPS = tuple(round(2**32 * (root % 1)) for root in ((1 + 5**0.5) / 2, 2**0.5))
"""Of lattices. No rational multiples of both add up to a rational number, so that they fill a square evenly, too."""
ROUNDS = 8
"""Of the cipher that makes them. With Mitsuba's default of 4, neighbours of one key go together: light that came by two
bounces had 4 % too little shadow."""


@dataclass
class CounterSampler:
    """Random numbers that are counted: those of a key are the same each time. Takes a sampler's place."""

    key: mi.UInt32
    index: mi.UInt32

    @staticmethod
    def of(key: mi.UInt32) -> CounterSampler:
        return CounterSampler(mi.UInt32(key), mi.UInt32(0))

    @staticmethod
    def stream(key: mi.UInt32, stream: Stream) -> CounterSampler:
        """Those of a key that a stream has for itself."""
        return CounterSampler(mi.UInt32(key), mi.UInt32(int(stream)))

    @staticmethod
    def at_vertex(key: mi.UInt32, k: mi.UInt32) -> CounterSampler:
        """Those of the k-th vertex (see `VertexSamples.draw`) of a path whose first has the first."""
        return CounterSampler(mi.UInt32(key), mi.UInt32(6 * k))

    def next_1d(self, active: bool | mi.Bool = True) -> mi.Float:
        x = mi.sample_tea_float32(self.key, self.index, ROUNDS)
        self.index += 1
        return x

    def next_2d(self, active: bool | mi.Bool = True) -> mi.Point2f:
        x, y = mi.sample_tea_32(self.key, self.index, ROUNDS)  # both halves of one block of the cipher
        self.index += 2  # as for two single numbers: see `at_vertex`
        return mi.Point2f(_in_unit(x), _in_unit(y))


def key_of(i: mi.UInt32, seed: mi.UInt32) -> mi.UInt32:
    """The key of the i-th line of a pass.

    No function of i ^ seed: with that, passes would deal out the same keys to other lines, and their mean would keep
    the error of one.
    """
    return mi.sample_tea_32(i, seed, ROUNDS)[0]


def quasi_random(i: mi.UInt32, n: int, seed: mi.UInt32, dimensions: int = 2) -> list[mi.Float]:
    """The i-th of n points of a randomly shifted Kronecker lattice in the unit square or cube, from left to right."""
    steps = [dr.opaque(mi.UInt32, 2**32 // n % 2**32), *map(mi.UInt32, STEPS)][:dimensions]
    shifts = [mi.sample_tea_32(seed, mi.UInt32(k + 1), ROUNDS)[0] for k in range(dimensions)]
    return [_in_unit(i * step + shift) for step, shift in zip(steps, shifts, strict=True)]


def _in_unit(x: mi.UInt32) -> mi.Float:
    """An integer as a number in [0, 1)."""
    return mi.Float(x >> 8) * 2**-24
