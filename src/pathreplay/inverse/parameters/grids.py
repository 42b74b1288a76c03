"""Resampling, refinement schedules, errors and display of grids, which are textures or volumes.

A texture has the shape (y, x, channels), a volume (z, y, x, channels).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from pathreplay.inverse.images.io import Image

Array = NDArray[np.float32]

LARGEST_SHOWN = 2048
"""Maximum side length of a displayed texture in pixels: larger than a screen, but small enough for report pages."""
_PIECE = 2**22


@dataclass(frozen=True)
class Levels:
    """Refinement schedule of a grid, which has the shape ``shapes[j]`` from iteration ``begins[j]`` on."""

    shapes: tuple[tuple[int, ...], ...]
    begins: tuple[int, ...]

    def shape_at(self, iteration: int) -> tuple[int, ...]:
        return max((b, s) for b, s in zip(self.begins, self.shapes, strict=True) if b <= iteration)[1]


def make_levels(shape: Sequence[int], longest: Sequence[int], refine_at: Sequence[int]) -> Levels:
    """Make the levels of a grid.

    Args:
        shape: shape of the grid in the scene.
        longest: number of entries along the longest axis for each level. The other axes are scaled in proportion.
        refine_at: first iteration of the second and each later level.
    """
    *axes, channels = shape
    # Mitsuba's bitmap textures need at least two texels per axis.
    shapes = [(*(max(min(n, 2), round(n * size / max(axes))) for n in axes), channels) for size in longest]
    return Levels(tuple(shapes), (0, *refine_at))


def resampled(grid: Array, shape: Sequence[int], wraps: bool = False) -> Array:
    """Resample a grid to ``shape`` by linear interpolation between cell centres, clamped at the border.

    If ``wraps``, the x axis (the one before the channels) is periodic, as in environment maps. The number of channels
    stays the same. Textures and volumes of Mitsuba interpolate in the same way, so doubling the resolution hardly
    changes the texture. Downsampling by more than a factor of two skips entries. The result is clipped to the range of
    the values, which rounding errors could leave.
    """
    low, high = np.float32(grid.min()), np.float32(grid.max())
    values = interpolated(grid, shape, wraps)
    return np.clip(values, low, high, out=values)


def interpolated(grid: Array, shape: Sequence[int], wraps: bool, transposed: bool = False) -> Array:
    """Interpolate a grid as in `resampled`, without clipping.

    With ``transposed``, the transpose of the interpolation from ``shape`` to the shape of the grid is applied.
    """
    for axis, n in enumerate(shape[:-1]):
        m, periodic = grid.shape[axis], wraps and axis == len(shape) - 2
        matrix = _interpolation(n, m, periodic).T if transposed else _interpolation(m, n, periodic)
        columns = np.moveaxis(grid, axis, 0)
        rows = matrix @ columns.reshape(m, -1)
        grid = np.moveaxis(rows.reshape(n, *columns.shape[1:]), 0, axis)
    return np.ascontiguousarray(grid, np.float32)


@cache
def _interpolation(m: int, n: int, wraps: bool) -> scipy.sparse.csr_array:
    """Return the n x m matrix of linear interpolation from the centres of m cells to the centres of n cells."""
    x = (np.arange(n) + 0.5) * (m / n) - 0.5
    left = np.floor(x).astype(int)
    weight = (x - left).astype(np.float32)
    columns = np.stack([left, left + 1])
    columns = columns % m if wraps else np.clip(columns, 0, m - 1)
    weights = np.stack([1 - weight, weight])
    return scipy.sparse.csr_array((weights.ravel(), (np.tile(np.arange(n), 2), columns.ravel())), shape=(n, m))


def comparable(shape: Sequence[int], other: Sequence[int]) -> bool:
    """Return whether two arrays can be compared: equal shapes, or grids with equal numbers of axes and channels."""
    same_kind = len(shape) == len(other) and len(shape) >= 3 and shape[-1] == other[-1]
    return same_kind or tuple(shape) == tuple(other)


def matched(grid: Array, other: Array, wraps: bool = False) -> Array:
    """Resample ``grid`` to the shape of ``other`` (see `resampled`). The two shapes must be `comparable`."""
    return grid if grid.shape == other.shape else resampled(grid, other.shape, wraps)


def rmse(value: Array, truth: Array, wraps: bool = False) -> float:
    """Compute the root mean square error of values.

    A grid is resampled to the resolution of the true values (see `resampled`).
    """
    a, b = matched(value, truth, wraps).reshape(-1), truth.reshape(-1)
    # Work in pieces, because temporary arrays in double precision need four times the memory of the values.
    squares = [
        float(np.square(a[i : i + _PIECE].astype(np.float64) - b[i : i + _PIECE]).sum())
        for i in range(0, b.size, _PIECE)
    ]
    return float(np.sqrt(sum(squares) / b.size))


def shown(image: Image, side: int = LARGEST_SHOWN) -> Image:
    """Reduce an image to at most ``side`` pixels per side by averaging blocks of pixels."""
    n = -(-max(image.shape[:2]) // side)
    if n == 1:
        return image
    height, width = (length // n for length in image.shape[:2])
    if not height or not width:
        return np.ascontiguousarray(image[::n, ::n])
    squares = image[: height * n, : width * n].reshape(height, n, width, n, -1)
    return squares.mean(axis=(1, 3), dtype=np.float32)


def slices(volume: Array) -> Image:
    """Show the middle slices of a volume (z, y, x, channels) side by side, as seen along z, y and x.

    The up axis is y in the first and third image and z in the second.
    """
    z, y, x = (n // 2 for n in volume.shape[:3])
    cuts = [volume[z, ::-1], volume[::-1, y], volume[:, ::-1, x].swapaxes(0, 1)]
    height = max(cut.shape[0] for cut in cuts)
    gap = np.zeros((height, 1, volume.shape[3]), np.float32)
    padded = [np.pad(cut, ((0, height - cut.shape[0]), (0, 0), (0, 0))) for cut in cuts]
    return np.concatenate([padded[0], gap, padded[1], gap, padded[2]], axis=1)[..., :3].astype(np.float32)
