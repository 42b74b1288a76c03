"""Owen-scrambled Sobol samples, stratified within each pixel and across pixels in Morton order.

Each 2D sample of a path is a point of the Sobol (0,2)-sequence. The order of the points and the points themselves are
scrambled with a separate key per dimension pair ("Practical Hash-based Owen Scrambling", Burley 2020). The dimension
pairs are therefore independent of each other, each coordinate is uniform, and every mean is unbiased. Paths are
numbered pixel by pixel in Morton order, so that samples are also stratified over square blocks of pixels ("Screen-space
blue-noise diffusion of Monte Carlo sampling error via hierarchical ordering of pixels", Ahmed and Wonka 2020). This
stratification lowers the noise of sums over pixels, such as gradients.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from pathreplay.samplers.counter_sampler import in_unit

_GOLDEN = 0x9E3779B9


@dataclass
class OwenSobolSampler:
    """Owen-scrambled Sobol sampler for an array of paths, with the interface of Mitsuba's samplers."""

    reversed: mi.UInt32  # index of the path, bit-reversed
    key: mi.UInt32
    drawn: mi.UInt32  # number of samples drawn so far (the dimension)

    @staticmethod
    def of(path: mi.UInt32, key: mi.UInt32) -> OwenSobolSampler:
        """Create the sampler of a path. ``path`` is the index of the path among all paths with the same ``key``."""
        return OwenSobolSampler(dr.brev(path), mi.UInt32(key), mi.UInt32(0))

    def clone(self) -> OwenSobolSampler:
        return OwenSobolSampler(mi.UInt32(self.reversed), mi.UInt32(self.key), mi.UInt32(self.drawn))

    def next_1d(self, active: bool | mi.Bool = True) -> mi.Float:
        key, x = self._next()
        return in_unit(_scrambled(x, key * 0x85EBCA6B))

    def next_2d(self, active: bool | mi.Bool = True) -> mi.Point2f:
        key, x = self._next()
        return mi.Point2f(in_unit(_scrambled(x, key * 0x85EBCA6B)), in_unit(_scrambled(_second(x), key * 0xC2B2AE35)))

    def _next(self) -> tuple[mi.UInt32, mi.UInt32]:
        """Return the key of the next dimension, and the bit-reversed path index after it was shuffled with this key."""
        key = mixed(self.key + self.drawn * _GOLDEN)
        self.drawn += 1
        return key, _permuted(self.reversed, key)


def key_of(seed: mi.UInt32, *more: mi.UInt32) -> mi.UInt32:
    """Return a hash of the seed and further integers, decorrelated from each of them."""
    key = mixed(mi.UInt32(seed) + _GOLDEN)
    for number in more:
        key = mixed(key + mixed(mi.UInt32(number) + _GOLDEN))
    return key


def morton_index(x: mi.UInt32, y: mi.UInt32) -> mi.UInt32:
    """Return the Morton index of a pixel, for images of up to 2^16 x 2^16 pixels."""
    return _spread(x) | (_spread(y) << 1)


def mixed(x: mi.UInt32) -> mi.UInt32:
    """Hash a 32-bit integer with a bijection."""
    x = (x ^ (x >> 16)) * 0x21F0AAAD
    x = (x ^ (x >> 15)) * 0xD35A2D97
    return x ^ (x >> 15)


def _permuted(x: mi.UInt32, key: mi.UInt32) -> mi.UInt32:
    """Apply the Laine-Karras permutation, in which each bit affects only higher bits. The constants are Burley's."""
    x = ((x ^ (x * 0x3D20ADEA)) + key) * ((key >> 16) | 1)
    x = x ^ (x * 0x05526C56)
    return x ^ (x * 0x53A22864)


def _scrambled(x: mi.UInt32, key: mi.UInt32) -> mi.UInt32:
    """Apply Owen scrambling: each bit affects lower bits only, so that dyadic intervals map to dyadic intervals."""
    return dr.brev(_permuted(dr.brev(x), key))


def _second(x: mi.UInt32) -> mi.UInt32:
    """Compute the second coordinate of a Sobol point from the first coordinate.

    The bits of the first coordinate are multiplied by Pascal's triangle modulo 2.
    """
    for shift, mask in ((1, 0xAAAAAAAA), (2, 0xCCCCCCCC), (4, 0xF0F0F0F0), (8, 0xFF00FF00), (16, 0xFFFF0000)):
        x = x ^ ((x << shift) & mask)
    return x


def _spread(x: mi.UInt32) -> mi.UInt32:
    """Interleave the lower 16 bits with zeros."""
    x = x & 0xFFFF
    for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        x = (x | (x << shift)) & mask
    return x
