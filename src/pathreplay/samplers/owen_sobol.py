"""Random numbers that fill the unit square evenly: for the paths of a pixel, and for those of pixels side by side.

Each pair that a path draws is a point of Sobol's (0,2)-sequence, whose order is shuffled and whose points are
scrambled (Owen) by keys of its own: pairs know nothing of each other, each number by itself is uniform, and every mean
is unbiased ("Practical Hash-based Owen Scrambling", Burley 2020). Paths are counted pixel by pixel in Morton's order,
so that not only those of a pixel are even, but those of a square of pixels, too ("Screen-space blue-noise diffusion of
Monte Carlo sampling error via hierarchical ordering of pixels", Ahmed and Wonka 2020): what sums over pixels, as
gradients do, has less noise for it.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

_GOLDEN = 0x9E3779B9


@dataclass
class OwenSobolSampler:
    """Takes a sampler's place, for paths side by side."""

    reversed: mi.UInt32  # the number of the path, its bits from last to first
    key: mi.UInt32
    drawn: mi.UInt32  # how often numbers were drawn

    @staticmethod
    def of(path: mi.UInt32, key: mi.UInt32) -> OwenSobolSampler:
        """Those of the path of that number among all with the same key."""
        return OwenSobolSampler(dr.brev(path), mi.UInt32(key), mi.UInt32(0))

    def clone(self) -> OwenSobolSampler:
        """One that gives the same numbers from here on."""
        return OwenSobolSampler(mi.UInt32(self.reversed), mi.UInt32(self.key), mi.UInt32(self.drawn))

    def next_1d(self, active: bool | mi.Bool = True) -> mi.Float:
        """Uniform in [0, 1)."""
        key, x = self._next()
        return _unit(_scrambled(x, key * 0x85EBCA6B))

    def next_2d(self, active: bool | mi.Bool = True) -> mi.Point2f:
        """Uniform in the unit square."""
        key, x = self._next()
        return mi.Point2f(_unit(_scrambled(x, key * 0x85EBCA6B)), _unit(_scrambled(_second(x), key * 0xC2B2AE35)))

    def _next(self) -> tuple[mi.UInt32, mi.UInt32]:
        """A key, and a radical inverse: of the path's number, shuffled by it."""
        key = mixed(self.key + self.drawn * _GOLDEN)
        self.drawn += 1
        return key, _permuted(self.reversed, key)


def key_of(seed: mi.UInt32, *more: mi.UInt32) -> mi.UInt32:
    """A key by a seed and further numbers, which goes with none of them."""
    key = mixed(mi.UInt32(seed) + _GOLDEN)
    for number in more:
        key = mixed(key + mixed(mi.UInt32(number) + _GOLDEN))
    return key


def in_order(x: mi.UInt32, y: mi.UInt32) -> mi.UInt32:
    """Where a pixel is in Morton's order, of up to 2^16 x 2^16."""
    return _spread(x) | (_spread(y) << 1)


def mixed(x: mi.UInt32) -> mi.UInt32:
    """A number for each number, which looks as if by chance: a permutation of all of 32 bits."""
    x = (x ^ (x >> 16)) * 0x21F0AAAD
    x = (x ^ (x >> 15)) * 0xD35A2D97
    return x ^ (x >> 15)


def _permuted(x: mi.UInt32, key: mi.UInt32) -> mi.UInt32:
    """Laine and Karras' permutation, in which a bit decides on higher ones only: constants are those of Burley."""
    x = ((x ^ (x * 0x3D20ADEA)) + key) * ((key >> 16) | 1)
    x = x ^ (x * 0x05526C56)
    return x ^ (x * 0x53A22864)


def _scrambled(x: mi.UInt32, key: mi.UInt32) -> mi.UInt32:
    """The same, in which a bit decides on lower ones only: intervals stay intervals."""
    return dr.brev(_permuted(dr.brev(x), key))


def _second(x: mi.UInt32) -> mi.UInt32:
    """Of the first coordinate of a point of Sobol's sequence the second: times Pascal's triangle modulo 2."""
    for shift, mask in ((1, 0xAAAAAAAA), (2, 0xCCCCCCCC), (4, 0xF0F0F0F0), (8, 0xFF00FF00), (16, 0xFFFF0000)):
        x = x ^ ((x << shift) & mask)
    return x


def _spread(x: mi.UInt32) -> mi.UInt32:
    """The lower 16 bits with a zero before each."""
    x = x & 0xFFFF
    for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        x = (x | (x << shift)) & mask
    return x


def _unit(x: mi.UInt32) -> mi.Float:
    return mi.Float(x >> 8) * 2**-24
