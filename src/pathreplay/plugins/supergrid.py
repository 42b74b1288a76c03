"""Bounds of a volume's values in coarse cells, and the cell size for which delta tracking is cheapest.

`voxel_bounds` computes the lowest, mean and highest value that an interpolated lookup in a cell of BASE³ voxels can
return. `coarser` merges 2 x 2 x 2 cells. `cheapest` selects a cell size between BASE³ voxels and the whole volume.

`gridvolume` does not expose its filter and its wrap mode. The bounds are therefore valid for both filters and all wrap
modes. The bounds of a cell include the voxels adjacent to the cell. Beyond the faces of the grid, the bounds include
the values of all wrap modes. The bounds also hold up to half a voxel beyond the faces of the cell, so that rounding in
a traversal is harmless.

Nothing here is differentiated.
"""

from __future__ import annotations

import operator
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from typing import TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

#: Number of voxels along the side of the smallest cell. If the side were half as long, there would be eight times as
#: many cells, and rays would take twice as many steps.
BASE = 4
#: Lowest, mean and highest value (TensorXf, z y x), one entry per voxel or cell.
Values: TypeAlias = "tuple[mi.TensorXf, mi.TensorXf, mi.TensorXf]"
#: Cost of a step between cells, where the cost of a tentative collision is 1 (`pathreplay bench supergrid`).
STEP_COST = 0.15


@dataclass(frozen=True)
class Lattice:
    """Position of a volume's voxels in world space.

    Voxel i of an axis covers [i, i + 1] in voxel space, and its value is the value at the centre. ``to_voxel`` (3 x 4)
    maps world space to voxel space. ``size`` is the number of voxels along x, y, z. The voxels from ``low`` to ``high``
    cover the volume's bounding box, which is larger than the grid if the grid is rotated in world space.
    """

    to_voxel: NDArray[np.float64]
    size: tuple[int, ...]
    low: tuple[int, ...]
    high: tuple[int, ...]


@dataclass(frozen=True)
class Bounds:
    """Lowest, mean and highest value of a volume in cubic cells, over all channels.

    Each of the three is a Float with one entry per cell. The x index varies fastest. ``to_cell`` (3 x 4) maps world
    space to cell space, where cell i of an axis covers [i, i + 1]. ``shape`` is the number of cells along x, y, z.
    """

    to_cell: NDArray[np.float64]
    shape: tuple[int, ...]
    lowest: mi.Float
    mean: mi.Float
    highest: mi.Float

    @property
    def faces_per_length(self) -> float:
        """Mean number of cell faces that a ray of random direction d crosses per unit length.

        The mean of |d_k| is 1/2 for each axis k.
        """
        return float(np.linalg.norm(self.to_cell[:, :3], axis=1).sum() / 2)

    @property
    def is_single(self) -> bool:
        return self.shape == (1, 1, 1)


# ------------------------------------------------ voxel positions ------------------------------------------------


def find_lattice(volume: mi.Volume, shape: tuple[int, ...]) -> Lattice | None:
    """Determine the lattice of a `gridvolume` with data of shape (z, y, x, channels); return None on failure.

    Mitsuba does not expose the volume's `to_world`. The linear part of `to_world` is parsed from the volume's string
    representation. The translation is computed from the bounding box, which has full precision.
    """
    row = r"\[" + ", ".join([r"([-+.\de]+)"] * 4) + r"\]"
    printed = re.search(r"to_local = Transform\[\s*matrix=\[" + r",\s*".join([row] * 3), repr(volume))
    if printed is None:
        return None
    to_local = np.array(printed.groups(), dtype=np.float64).reshape(3, 4)[:, :3]
    to_local[np.abs(to_local) < 1e-6 * np.abs(to_local).max(axis=1, keepdims=True)] = 0  # rounding error of a rotation
    if np.linalg.matrix_rank(to_local) < 3:
        return None
    linear = np.linalg.inv(to_local)  # the columns are the edges of the grid in world space
    low, high = _corners(volume)
    corner = low - np.minimum(linear, 0).sum(axis=1)
    extent = high - low
    if not np.allclose(corner + np.maximum(linear, 0).sum(axis=1), high, atol=1e-4 * np.abs(extent).max()):
        return None

    size = tuple(int(n) for n in shape[2::-1])
    to_voxel = np.concatenate([to_local, -(to_local @ corner)[:, None]], axis=1) * np.array(size)[:, None]
    corners = np.array(np.meshgrid(*zip(low, high, strict=True), indexing="ij")).reshape(3, -1)
    reached = to_voxel[:, :3] @ corners + to_voxel[:, 3:]
    # The box may extend beyond the range of voxels by up to a hundredth of a voxel, because of rounding errors. This is
    # harmless, because the bounds are valid up to half a voxel beyond the range.
    first = np.floor(reached.min(axis=1) + 0.01).astype(int)
    last = np.ceil(reached.max(axis=1) - 0.01).astype(int)
    return Lattice(to_voxel, size, tuple(first.tolist()), tuple(np.maximum(last, first + 1).tolist()))


# -------------------------------------------------- bounds by cell --------------------------------------------------


def _corners(volume: mi.Volume) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    box = volume.bbox()
    return np.array(box.min, dtype=np.float64).ravel(), np.array(box.max, dtype=np.float64).ravel()


def constant_bounds(volume: mi.Volume, lowest: float, mean: float, highest: float) -> Bounds:
    """Return bounds with a single cell that covers the whole volume, for known extreme values."""
    low, high = _corners(volume)
    scale = 1 / np.maximum(high - low, 1e-30)
    to_cell = np.concatenate([np.diag(scale), (-low * scale)[:, None]], axis=1)
    return Bounds(to_cell, (1, 1, 1), mi.Float(lowest), mi.Float(mean), mi.Float(highest))


def voxel_bounds(lattice: Lattice, data: mi.TensorXf) -> Bounds:
    """Compute the bounds of ``data`` (z, y, x, channels) in cells of BASE³ voxels."""
    values = _channels(dr.detach(data))
    for axis, span in enumerate(zip(lattice.low, lattice.high, lattice.size, strict=True)):
        values = _merged(values, axis, _support(*span), _support(*span, neighbours=False))
        dr.eval(values)
    to_cell = lattice.to_voxel.copy()
    to_cell[:, 3] -= lattice.low
    return _bounds(to_cell / BASE, values)


def _bounds(to_cell: NDArray[np.float64], values: Values) -> Bounds:
    return Bounds(to_cell, tuple(values[0].shape[::-1]), *(value.array for value in values))


def coarser(bounds: Bounds) -> Bounds:
    """Merge the bounds into cells that are twice as large along every axis."""
    shape = bounds.shape[::-1]
    values = mi.TensorXf(bounds.lowest, shape), mi.TensorXf(bounds.mean, shape), mi.TensorXf(bounds.highest, shape)
    for axis, n in enumerate(bounds.shape):
        pairs = np.minimum(np.arange(0, n, 2)[:, None] + [0, 1], n - 1)
        values = _merged(values, axis, pairs, pairs)
    return _bounds(bounds.to_cell / 2, values)


def all_bounds(bounds: Bounds) -> list[Bounds]:
    """Return these bounds and successively coarser ones, down to a single cell."""
    levels = [bounds]
    while not levels[-1].is_single:
        levels.append(coarser(levels[-1]))
    dr.eval([(b.lowest, b.mean, b.highest) for b in levels])
    return levels


def _channels(data: mi.TensorXf) -> Values:
    """Compute lowest, mean and highest value over the channels of every voxel."""
    if data.shape[3] == 1:
        return 3 * (mi.TensorXf(data.array, data.shape[:3]),)
    channels = [data[..., k] for k in range(data.shape[3])]
    if len(channels) == 4:
        # The first three channels are coefficients of a spectrum, whose values are only known to be between 0 and 1.
        # The fourth channel is a factor of the spectrum.
        return dr.fmin(channels[3], 0), channels[3] * 0, channels[3]
    return reduce(dr.fmin, channels), reduce(operator.add, channels) / len(channels), reduce(dr.fmax, channels)


def _support(low: int, high: int, n: int, neighbours: bool = True) -> NDArray[np.int64]:
    """Return the voxel indices that lookups in each cell may use along one axis.

    The result has one row per cell. The cells cover the voxels from ``low`` to ``high`` of the axis. With trilinear
    interpolation, a lookup uses the cell's own voxels and one more voxel on either side. A voxel outside of 0 to n - 1
    is replaced by one voxel for each wrap mode: the last voxel (clamp), the voxel at the other end (repeat), and the
    mirror image (mirror). Rows with fewer indices than the longest row are filled by repeating their indices. If
    ``neighbours`` is False, only the cell's own voxels are returned.
    """
    rows = []
    for start in range(low, high, BASE):
        used: list[int] = []
        for i in range(start - neighbours, min(start + BASE, high) + neighbours):
            clamped, repeated, mirrored = min(max(i, 0), n - 1), i % n, i % (2 * n)
            used.append(clamped)
            if neighbours and clamped != i:
                used += [repeated, min(mirrored, 2 * n - 1 - mirrored)]
        rows.append(list(dict.fromkeys(used)) if neighbours else used)
    longest = max(map(len, rows))
    return np.array([(row * longest)[:longest] for row in rows])


def _merged(values: Values, axis: int, near: NDArray[np.int64], inside: NDArray[np.int64]) -> Values:
    """Merge values along axis 0, 1 or 2 (x, y, z).

    ``near`` and ``inside`` have one row of indices per merged cell. The extremes are taken over the indices in
    ``near``, and the means over the indices in ``inside``.
    """

    def pool(value: mi.TensorXf, table: NDArray[np.int64], merge: Callable) -> mi.TensorXf:
        before = [slice(None)] * (2 - axis)
        return reduce(merge, [value[tuple([*before, mi.UInt32(k)])] for k in table.T.astype(np.uint32)])

    lowest, mean, highest = values
    mean = pool(mean, inside, operator.add) / inside.shape[1]
    return pool(lowest, near, dr.fmin), mean, pool(highest, near, dr.fmax)


# ------------------------------------------------ the choice of cells ------------------------------------------------


def cheapest(levels: list[Bounds], rates: list[float], chord: float) -> int:
    """Return the index of the level at which a ray through the volume has the lowest mean cost.

    The cost is the number of tentative collisions plus STEP_COST times the number of steps between cells. Level i has
    ``rates[i]`` tentative collisions per unit length on average. ``chord`` is the mean length of a ray in the volume. A
    single cell needs no steps.
    """
    costs = [
        rate * chord + (0 if level.is_single else STEP_COST * (1 + level.faces_per_length * chord))
        for level, rate in zip(levels, rates, strict=True)
    ]
    return int(np.argmin(costs))


def mean_chord(box: mi.ScalarBoundingBox3f) -> float:
    """Return the mean length of a random line in a box: four times the volume over the surface area (Cauchy)."""
    x, y, z = (float(e) for e in box.extents())
    return 0.0 if x * y * z == 0 else 2 * x * y * z / (x * y + y * z + z * x)
