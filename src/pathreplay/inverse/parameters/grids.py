"""Grids of values, textures and volumes alike: the same function at another resolution, coarse to fine, and slices.

A grid has one or more spatial axes and, last, its channels: (y, x, channels) or (z, y, x, channels).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from pathreplay.inverse.images.io import Image

Array = NDArray[np.float32]

LARGEST_SHOWN = 2048
"""Pixels along a side of a texture that is looked at: more than a screen has, and no burden to a page."""
_PIECE = 2**22


@dataclass(frozen=True)
class Levels:
    """The resolutions that a grid goes through: shape ``shapes[j]`` from iteration ``begins[j]`` on."""

    shapes: tuple[tuple[int, ...], ...]
    begins: tuple[int, ...]

    def shape_at(self, iteration: int) -> tuple[int, ...]:
        """The shape that the grid should have in an iteration."""
        return max((b, s) for b, s in zip(self.begins, self.shapes, strict=True) if b <= iteration)[1]


def make_levels(shape: Sequence[int], longest: Sequence[int], refine_at: Sequence[int]) -> Levels:
    """Levels of a grid of that shape: its longest axis gets ``longest[j]`` entries, the others in proportion."""
    *axes, channels = shape
    # Mitsuba's bitmaps refuse fewer than two texels on an axis.
    shapes = [(*(max(min(n, 2), round(n * size / max(axes))) for n in axes), channels) for size in longest]
    return Levels(tuple(shapes), (0, *refine_at))


def resampled(grid: Array, shape: Sequence[int]) -> Array:
    """The grid in another ``shape`` (same channels): linear between the centres of its cells, constant beyond them.

    That is how Mitsuba looks grids and textures up, so a doubled resolution changes the function by no more than the
    bends between the old centres. It keeps bounds. Where entries get fewer than half, some are passed over.
    """
    factors = [new / old for new, old in zip((*shape[:-1], grid.shape[-1]), grid.shape, strict=True)]
    return scipy.ndimage.zoom(grid, factors, np.float32, order=1, mode="nearest", grid_mode=True)


def comparable(shape: Sequence[int], other: Sequence[int]) -> bool:
    """Whether two arrays are the same quantity: of one shape, or grids of as many axes and channels."""
    same_kind = len(shape) == len(other) and len(shape) >= 3 and shape[-1] == other[-1]
    return same_kind or tuple(shape) == tuple(other)


def matched(grid: Array, other: Array) -> Array:
    """``grid`` in the shape of ``other``, to which it is `comparable`."""
    return grid if grid.shape == other.shape else resampled(grid, other.shape)


def rmse(value: Array, truth: Array) -> float:
    """Root mean square error; grids of different resolutions are compared at that of the truth."""
    a, b = matched(value, truth).reshape(-1), truth.reshape(-1)
    # In pieces: differences in double precision would take four times what the values do.
    squares = [
        float(np.square(a[i : i + _PIECE].astype(np.float64) - b[i : i + _PIECE]).sum())
        for i in range(0, b.size, _PIECE)
    ]
    return float(np.sqrt(sum(squares) / b.size))


def shown(image: Image, side: int = LARGEST_SHOWN) -> Image:
    """A picture of at most ``side`` pixels along each side: means of squares of pixels, where it has more."""
    n = -(-max(image.shape[:2]) // side)
    if n == 1:
        return image
    height, width = (length // n for length in image.shape[:2])
    if not height or not width:
        return np.ascontiguousarray(image[::n, ::n])
    squares = image[: height * n, : width * n].reshape(height, n, width, n, -1)
    return squares.mean(axis=(1, 3), dtype=np.float32)


def slices(volume: Array) -> Image:
    """The middle slices of a volume (z, y, x, channels), side by side: seen along z, along y and along x.

    Up is y in the first and the last and z in the second one.
    """
    z, y, x = (n // 2 for n in volume.shape[:3])
    cuts = [volume[z, ::-1], volume[::-1, y], volume[:, ::-1, x].swapaxes(0, 1)]
    height = max(cut.shape[0] for cut in cuts)
    gap = np.zeros((height, 1, volume.shape[3]), np.float32)
    padded = [np.pad(cut, ((0, height - cut.shape[0]), (0, 0), (0, 0))) for cut in cuts]
    return np.concatenate([padded[0], gap, padded[1], gap, padded[2]], axis=1)[..., :3].astype(np.float32)
