"""Counter-based random numbers for paths and boundary segments. Each number is a function of a key and an index."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from pathreplay.samplers.streams import Stream

STEPS = tuple(round(2**32 * (root % 1)) for root in ((1 + 5**0.5) / 2, 2**0.5))
"""Steps of the Kronecker lattice: the fractional parts of the golden ratio and of √2, in units of 2^-32. These numbers
and 1 are linearly independent over the rationals, so that pairs of coordinates also fill the square evenly."""
ROUNDS = 8
"""Rounds of the TEA cipher. With Mitsuba's default of 4 rounds, samples of neighbouring keys are correlated, and
shadows in two-bounce light were 4 % too weak."""


@dataclass
class CounterSampler:
    """Counter-based sampler with the interface of Mitsuba's samplers: equal keys give equal samples."""

    key: mi.UInt32
    index: mi.UInt32

    @staticmethod
    def of(key: mi.UInt32) -> CounterSampler:
        """Create a sampler at index 0 of a key."""
        return CounterSampler(mi.UInt32(key), mi.UInt32(0))

    @staticmethod
    def stream(key: mi.UInt32, stream: Stream) -> CounterSampler:
        """Create a sampler for a key, positioned at the first index of a stream."""
        return CounterSampler(mi.UInt32(key), mi.UInt32(int(stream)))

    @staticmethod
    def at_vertex(key: mi.UInt32, k: mi.UInt32) -> CounterSampler:
        """Create a sampler at vertex k of the path with this key. A vertex uses six indices (`VertexSamples.draw`)."""
        return CounterSampler(mi.UInt32(key), mi.UInt32(6 * k))

    def clone(self) -> CounterSampler:
        return CounterSampler(mi.UInt32(self.key), mi.UInt32(self.index))

    def next_1d(self, active: bool | mi.Bool = True) -> mi.Float:
        x = mi.sample_tea_float32(self.key, self.index, ROUNDS)
        self.index += 1
        return x

    def next_2d(self, active: bool | mi.Bool = True) -> mi.Point2f:
        x, y = mi.sample_tea_32(self.key, self.index, ROUNDS)  # the two halves of a cipher block
        self.index += 2  # a 2D sample uses two indices, and a vertex uses six (see `at_vertex`)
        return mi.Point2f(in_unit(x), in_unit(y))


def key_of(i: mi.UInt32, seed: mi.UInt32) -> mi.UInt32:
    """Return the key of the i-th segment of a pass.

    The key must not be a function of i ^ seed. Otherwise all passes would use the same set of keys in another order,
    and the mean over many passes would be as noisy as a single pass.
    """
    return mi.sample_tea_32(i, seed, ROUNDS)[0]


def quasi_random(i: mi.UInt32, n: int, seed: mi.UInt32, dimensions: int = 2) -> list[mi.Float | mi.Float64]:
    """Return the i-th of n points of a randomly shifted Kronecker lattice, ordered by the first coordinate.

    The first coordinate is a Float64 with 32 bits. The other coordinates have 24 bits.
    """
    steps = [dr.opaque(mi.UInt32, 2**32 // n % 2**32), *map(mi.UInt32, STEPS)][:dimensions]
    shifts = [mi.sample_tea_32(seed, mi.UInt32(k + 1), ROUNDS)[0] for k in range(dimensions)]
    first, *rest = [i * step + shift for step, shift in zip(steps, shifts, strict=True)]
    return [mi.Float64(first) * 2**-32, *map(in_unit, rest)]


def in_unit(x: mi.UInt32) -> mi.Float:
    """Map a 32-bit integer to a float in [0, 1)."""
    return mi.Float(x >> 8) * 2**-24
