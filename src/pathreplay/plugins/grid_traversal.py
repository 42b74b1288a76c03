"""Cell-by-cell ray traversal: free flight with local majorants, transmittance with local control densities.

The state of the traversal (Amanatides and Woo 1987) is the current cell and the distance along the ray o + t d. The
distance to the next cell face perpendicular to axis k is computed from the cell, as
t_k = (cell_k + [d_k > 0] - o_k) / d_k. The distance is not a sum of earlier steps, so that rounding errors do not grow.
The traversal never returns to a cell that it has left, which bounds the number of steps.

Callers detach all inputs, except those of `through`. All functions can be used inside symbolic loops.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pathreplay.plugins.supergrid import Bounds

T = TypeVar("T")

#: The rate m of residual collisions is DENSER times the largest |σ - c| in a cell. A larger value of DENSER lowers the
#: variance of the transmittance (see `control`), but adds collisions, which take time. At equal time, the noise is
#: higher with the value 4 than with the value 2 (`pathreplay bench gridmedium`).
DENSER = 2.0
#: Limit of ∫ (σ - c)²/m ds over one cell, for a ray on which σ is always the lowest density of the cell. The integral
#: approximates the relative variance that the cell adds to the transmittance (see `control`). A ray crosses 10 to 50
#: cells. Without the limit, the control density c would be the mean density of each cell, and the transmittance of
#: dense grids with sharp edges would have extreme outliers.
RISK = 0.1
#: Largest number of cells whose indices single precision represents exactly.
EXACT = 2**24
#: Russian roulette is applied to transmittance estimates below this value. Russian roulette adds a variance of at most
#: FAINT times the transmittance.
FAINT = 1e-2


@dataclass(frozen=True)
class Cells:
    """A lookup table of values per cell.

    One layer of empty cells surrounds the grid, because rounding may move a ray one cell too far. This layer is
    included in ``shape``, the number of cells along x, y, z. ``to_cell`` (3 x 4) maps world space to cell space, where
    the layer begins at 0. ``table`` (Float, flat) contains one or more values per cell. The x index varies fastest.
    """

    to_cell: NDArray[np.float64]
    shape: tuple[int, ...]
    table: mi.Float

    @property
    def is_single(self) -> bool:
        return self.shape == (3, 3, 3)

    def lookup(self, kind: type[T], cell: mi.Vector3f, active: mi.Bool) -> T:
        """Return the values of a cell (Vector3f of integers) as a Float or a vector."""
        place = cell if math.prod(self.shape) <= EXACT else mi.Vector3u(cell)
        index = mi.UInt32(dr.fma(dr.fma(place.z, self.shape[1], place.y), self.shape[0], place.x))
        return dr.gather(kind, self.table, index, active)


def make_cells(bounds: Bounds, values: Sequence[mi.Float]) -> Cells:
    """Create cells from ``values``. Each array in ``values`` has one entry per cell of ``bounds``."""
    shape = tuple(n + 2 for n in bounds.shape)
    count = int(np.prod(bounds.shape))
    i = dr.arange(mi.UInt32, count)
    x, rest = i % bounds.shape[0], i // bounds.shape[0]
    y, z = rest % bounds.shape[1], rest // bounds.shape[1]
    place = (x + 1) + shape[0] * ((y + 1) + shape[1] * (z + 1))
    table = dr.zeros(mi.Float, int(np.prod(shape)) * len(values))
    for k, value in enumerate(values):
        dr.scatter(table, value, place * len(values) + k)
    dr.make_opaque(table)
    to_cell = bounds.to_cell.copy()
    to_cell[:, 3] += 1
    return Cells(to_cell, shape, table)


# ---------------------------------------------------- traversal ----------------------------------------------------


def through(box: mi.ScalarBoundingBox3f, ray: mi.Ray3f) -> tuple[mi.Float, mi.Float]:
    """Return the distances at which the line of a ray enters and leaves a box.

    If the line misses the box, the first distance is larger than the second. The distances are differentiable in the
    ray. Mitsuba's `BoundingBox.ray_intersect` computes the same distances, but accepts only rays of the first variant
    that was set in the process.
    """
    near, far = mi.Float(-dr.inf), mi.Float(dr.inf)
    for k in range(3):
        o, d = ray.o[k], ray.d[k]
        low, high = float(box.min[k]), float(box.max[k])
        along = d == 0
        inverse = dr.rcp(dr.select(along, 1, d))
        t0, t1 = (low - o) * inverse, (high - o) * inverse
        beside = along & ((o < low) | (o > high))
        near = dr.select(along, near, dr.fmax(near, dr.fmin(t0, t1)))
        far = dr.select(along, dr.select(beside, -dr.inf, far), dr.fmin(far, dr.fmax(t0, t1)))
    return near, far


def clip(box: mi.ScalarBoundingBox3f, ray: mi.Ray3f) -> tuple[mi.Float, mi.Float]:
    """Return the part [a, b] of a ray inside a box, or a = 0, b = -1 on a miss. No result is NaN for a finite ray."""
    near, far = through(box, ray)
    a, b = dr.fmax(near, 0), dr.fmin(far, ray.maxt)
    met = a < b
    return dr.select(met, a, 0), dr.select(met, b, -1)


@dataclass(frozen=True)
class CellWalk:
    """A ray o + t d in cell space.

    In cell (i, j, k), it meets the next face perpendicular to the x axis at the distance i · inverse_x + offset_x.
    """

    inverse: mi.Vector3f  # 1/d; 0 for axes perpendicular to the ray
    offset: mi.Vector3f  # ([d > 0] - o)/d; infinite for axes perpendicular to the ray
    stride: mi.Vector3f  # the step from cell to cell, ±1
    start: mi.Vector3f  # the cell in which the traversal starts
    end: mi.Float  # the distance at which the traversal ends

    def crossing(self, cell: mi.Vector3f) -> mi.Vector3f:
        """Return the distances at which the ray crosses the next cell face perpendicular to each axis."""
        return dr.fma(cell, self.inverse, self.offset)

    def onward(self, cell: mi.Vector3f, crossings: mi.Vector3f, t: mi.Float) -> mi.Vector3f:
        """Return the cell of the ray after distance ``t``, which must not exceed the smallest of the ``crossings``."""
        return dr.select(crossings <= t, cell + self.stride, cell)


def begin(cells: Cells, ray: mi.Ray3f, a: mi.Float, b: mi.Float) -> CellWalk:
    """Start a traversal of the ray from distance ``a`` to distance ``b``. Both points lie inside the bounding box."""
    o, d = _transformed(cells.to_cell, ray)
    still, forward = d == 0, d > 0
    inverse = dr.select(still, 0, dr.rcp(d))
    offset = dr.select(still, dr.inf, (dr.select(forward, mi.Vector3f(1), mi.Vector3f(0)) - o) * inverse)
    inner = mi.Vector3f([n - 2 for n in cells.shape])
    start = dr.clip(dr.floor(dr.fma(d, a, o)), 1, inner)
    # The traversal ends at the far side of the last inner cell at the latest. The distance to this side is computed by
    # the formula of `CellWalk.crossing`, so that the two distances to the side have the same rounding error.
    last = dr.fma(dr.select(forward, inner, mi.Vector3f(1)), inverse, offset)
    stride = dr.select(forward, mi.Vector3f(1), mi.Vector3f(-1))
    return CellWalk(inverse, offset, stride, start, dr.minimum(b, dr.min(last)))


def _transformed(m: NDArray[np.float64], ray: mi.Ray3f) -> tuple[mi.Vector3f, mi.Vector3f]:
    """Transform origin and direction of a ray by an affine map, omitting zero entries of the matrix."""

    def linear(row: NDArray[np.float64], v: mi.Vector3f) -> mi.Float:
        terms = [float(row[k]) * v[k] for k in range(3) if row[k] != 0]
        return sum(terms[1:], terms[0])

    o = mi.Vector3f([linear(row, ray.o) + float(row[3]) for row in m])
    return o, mi.Vector3f([linear(row, ray.d) for row in m])


# ---------------------------------------------------- free flight ----------------------------------------------------


def free_flight(
    cells: Cells, box: mi.ScalarBoundingBox3f, ray: mi.Ray3f, u: mi.Float, active: mi.Bool | bool
) -> tuple[mi.Float, mi.Float]:
    """Sample the distance of the next tentative collision. Return the distance, and the majorant at this distance.

    The distance t solves ∫_0^t m ds = -log(1 - u), with ``u`` in [0, 1). The majorant m (1 / unit length) is the value
    of the cell, and 0 outside ``box``. If there is no solution, the distance is infinite and the majorant is 0.
    """
    a, b = clip(box, ray)
    τ = -dr.log(1 - u)
    active = mi.Mask(active) & (a < b)
    if cells.is_single:
        m = cells.lookup(mi.Float, mi.Vector3f(1), active)
        t = a + τ / m
        hit = active & (m > 0) & (t < b)
        return dr.select(hit, t, dr.inf), dr.select(hit, m, 0)

    trace = begin(cells, ray, a, b)

    def step(active: mi.Bool, cell: mi.Vector3f, t: mi.Float, τ: mi.Float, m: mi.Float) -> tuple[dr.ArrayBase, ...]:
        m = cells.lookup(mi.Float, cell, active)
        crossings = trace.crossing(cell)
        t_next = dr.minimum(dr.min(crossings), trace.end)
        depth = m * dr.maximum(t_next - t, 0)
        hit = depth > τ
        cell = trace.onward(cell, crossings, t_next)
        active = ~hit & (t_next < trace.end)
        return active, cell, dr.select(hit, t, t_next), dr.select(hit, τ, τ - depth), dr.select(hit, m, 0)

    state = (active & (a < trace.end), trace.start, a, τ, mi.Float(0))
    labels = ("active", "cell", "t", "τ", "m")
    going = dr.while_loop(state, lambda active, *_: active, step, labels=labels, label="gridmedium: free flight")
    _, _, t, τ, m = going
    hit = m > 0
    return dr.select(hit, t + τ / m, dr.inf), m


# --------------------------------------------------- transmittance ---------------------------------------------------


def control(bounds: Bounds, scale: mi.Float) -> tuple[mi.Float, mi.Float]:
    """Compute two values for each cell: the control density c, and the rate m of residual collisions.

    The density σ is ``scale`` times the value of the volume. The relative variance of the transmittance is
    exp(∫ (σ - c)²/m ds) - 1. On average over rays, the integral is smallest if c is the mean density of the cell.
    However, the integral over a cell can be large for a ray on which σ is always the lowest density of the cell.
    Therefore, c is limited, so that the integral does not exceed RISK on such a ray. The limit is computed for a ray
    whose length in the cell is twice the mean length.
    """
    lowest, highest = _scaled(bounds, scale)
    length = 2 / bounds.faces_per_length  # twice the mean length of a ray in a cell
    room = dr.sqrt(RISK / length * (highest - lowest))  # m is at least highest - lowest
    c = dr.fmin(bounds.mean * scale, lowest + room)
    return c, DENSER * dr.fmax(highest - c, c - lowest)


def majorants(bounds: Bounds, scale: mi.Float) -> mi.Float:
    """Return an upper bound of the density in each cell.

    Negative bounds are set to 0. They occur if an optimiser makes densities negative.
    """
    return dr.fmax(_scaled(bounds, scale)[1], 0)


def _scaled(bounds: Bounds, scale: mi.Float) -> tuple[mi.Float, mi.Float]:
    a, b = bounds.lowest * scale, bounds.highest * scale
    return dr.fmin(a, b), dr.fmax(a, b)


@dr.syntax
def transmittance(
    cells: Cells,
    box: mi.ScalarBoundingBox3f,
    ray: mi.Ray3f,
    density: Callable[[mi.Float, mi.Bool], mi.Spectrum],
    sampler: mi.Sampler,
    active: mi.Bool | bool,
) -> mi.Spectrum:
    """Estimate exp(-∫ σ ds) along the ray without bias, by residual ratio tracking (Novák et al. 2014).

    The result is an UnpolarizedSpectrum with one estimate exp(-∫ c ds) Π (1 - (σ - c)/m) per channel. The product is
    over the residual collisions, which are sampled with the rate m. ``cells`` contains the control density c and the
    rate m of each cell. ``density(t, active)`` evaluates σ at distance t.
    """
    a, b = clip(box, ray)
    trace = begin(cells, ray, a, b)
    active = mi.Mask(active) & (a < trace.end)
    cell, t = mi.Vector3f(trace.start), mi.Float(a)
    τ = -dr.log(1 - sampler.next_1d(active))
    depth = mi.Float(0)
    T = mi.UnpolarizedSpectrum(1)

    while dr.hint(active, exclude=[cells, box, ray, trace, density], label="gridmedium: transmittance"):
        c, m = cells.lookup(mi.Vector2f, cell, active)
        crossings = trace.crossing(cell)
        t_next = dr.minimum(dr.min(crossings), trace.end)
        expected = m * dr.maximum(t_next - t, 0)
        hit = active & (expected > τ)
        stop = dr.select(hit, t + τ / m, t_next)
        depth += c * dr.maximum(stop - t, 0)
        τ -= expected
        cell = dr.select(hit, cell, trace.onward(cell, crossings, t_next))
        t = stop
        active &= hit | (t_next < trace.end)
        if dr.hint(hit, exclude=[cells, box, ray, trace, density]):
            T *= 1 - (density(t, mi.Mask(True)) - c) / m
            # Russian roulette for small estimates
            kept = dr.minimum(dr.max(dr.abs(T)) * dr.exp(-depth) / FAINT, 1)
            survives = sampler.next_1d() < kept
            T = dr.select(survives, T / kept, 0)
            active &= survives
            τ = -dr.log(1 - sampler.next_1d())

    return T * dr.exp(-depth)
