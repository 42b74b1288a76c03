"""The learned baseline of volume gradients: an estimate of the radiance that arrives at a point of a medium.

Two averages of radiance are stored for each cell of position and direction. X is the mean over rays with a real
collision in the cell, and Y is the mean over rays that pass through the cell. With p the probability of a real
collision, the baseline is b = (1 - p) X + p Y. Only earlier passes contribute to b, which is therefore independent of
the current pass. The control variate of `fly_again` then has mean zero for any b, provided that b is zero where neither
real collisions nor the null collisions of `null_branching` occur. A poor estimate increases noise and causes no bias.
Nothing in this module is differentiated.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.platform.owned_arrays import owned, with_space
from pathreplay.transport.vertex import VertexRecord, channel_mean
from pathreplay.transport.volume.media import interaction, majorant, span

# CELLS is the number of cells along each axis of space. SIDES is the number of cells along each side of the octahedral
# map of directions. Each of the 8³ x 4² cells has two averages, and each average has four values: 256 KiB in total.
# Three arrays have this size: the averages, the sums from which the averages are computed, and the sums of the current
# pass. If there were more cells, each cell would have fewer samples, and gradients would be noisier: see the cloud of
# `pathreplay bench media`.
CELLS, SIDES = 8, 4
AVERAGES = 2 * CELLS**3 * SIDES**2  # the averages X and Y of each cell (see the module), side by side
# Factor by which the previous sums are multiplied when a pass is added. About the last ten passes contribute.
MEMORY = 0.9
# Initial relative weight c of null collisions (see `branch_weight`). Later weights are computed by
# `BaselineState.after`. They are about as large as this weight if a path has fifty null collisions on average.
FIRST_BRANCHING = 0.02
# Null collisions are counted in this many partial sums, so that no sum is too large for float32.
SLOTS = 256
# The average of a cell includes the mean over all cells, which counts as much as this many samples of the cell.
PRIOR = 2.0


def _channels() -> int:
    """Return the number of channels: 3 in rgb variants, and otherwise 1, the mean over the wavelengths of a path."""
    return 3 if mi.is_rgb else 1


@dataclass(frozen=True)
class BaselineCells:
    """The cells, by position and direction, in which radiance is averaged.

    In space, the cells divide a box that contains all media. The fields are Python values, because a frozen function
    treats Python values as constants.
    """

    low: tuple[float, ...]  # lower corner of the box
    scale: tuple[float, ...]  # number of cells per unit of length, along each axis

    @staticmethod
    def of(box: mi.ScalarBoundingBox3f) -> BaselineCells:
        scale = (CELLS / max(float(e), 1e-20) for e in box.extents())
        return BaselineCells(tuple(map(float, box.min)), tuple(scale))

    def index(self, p: mi.Point3f, d: mi.Vector3f) -> mi.UInt32:
        """Return the index of the average X of a cell (see the module). The cell's average Y has the next index."""
        at = mi.Vector3u(
            dr.clip(mi.Vector3f(p - mi.ScalarPoint3f(self.low)) * mi.ScalarVector3f(self.scale), 0, CELLS - 1)
        )
        d = d * dr.rcp(dr.abs(d.x) + dr.abs(d.y) + dr.abs(d.z))
        sx, sy = dr.select(d.x >= 0, 1.0, -1.0), dr.select(d.y >= 0, 1.0, -1.0)
        x = dr.select(d.z >= 0, d.x, (1 - dr.abs(d.y)) * sx)
        y = dr.select(d.z >= 0, d.y, (1 - dr.abs(d.x)) * sy)
        to = mi.Vector2u(dr.clip((mi.Vector2f(x, y) + 1) * (0.5 * SIDES), 0, SIDES - 1))
        return 2 * (((at.z * CELLS + at.y) * CELLS + at.x) * SIDES**2 + to.y * SIDES + to.x)


@dataclass
class BaselineStats:
    """Sums of the radiance that gradient passes computed in media. Sums of several passes or shards can be added."""

    cells: BaselineCells
    sums: mi.Float  # for each average X or Y of a cell: Σ weight·L in three channels, and Σ weight
    nulls: mi.Float  # partial sums of the numbers of null collisions, each small enough for float32
    paths: int  # number of paths that contribute to ``nulls``
    passes: frozenset[Hashable]  # keys of the passes

    @staticmethod
    def none(cells: BaselineCells, *keys: Hashable) -> BaselineStats:
        """Create empty statistics. The passes that will be added to them have the given ``keys``.

        A pass that is recorded in a frozen function has no key.
        """
        sums, nulls = dr.zeros(mi.Float, 4 * AVERAGES), dr.zeros(mi.Float, SLOTS)
        dr.make_opaque(sums, nulls)
        return BaselineStats(cells, sums, nulls, 0, frozenset(keys))

    def __add__(self, other: BaselineStats) -> BaselineStats:
        sums, nulls, paths = self.sums + other.sums, self.nulls + other.nulls, self.paths + other.paths
        return BaselineStats(self.cells, sums, nulls, paths, self.passes | other.passes)

    def learn(self, replayed: VertexRecord, L: mi.Spectrum) -> None:
        """Add the radiance ``L`` along the ray that arrives at a replayed vertex; called in the loop of a pass."""
        at, flight = replayed.at, replayed.kept.media.flight
        in_medium = at.medium != None  # noqa: E711 (an array of pointers)
        event = in_medium & flight.event
        reach = dr.select(at.hit.is_valid(), at.hit.t, dr.inf)
        a, b = span(at.medium, at.ray, reach, in_medium)
        end = dr.select(event, flight.t, b)
        length = dr.select(in_medium & dr.isfinite(end), end - a, 0)
        x = interaction(at.medium, at.ray, flight.t)
        y = interaction(at.medium, at.ray, a + flight.along * length)
        self._add(self.cells.index(x.p, at.ray.d), L, mi.Float(1), event)
        # The point y is uniform on the flight. Its density, 1 / length, is compensated by the weight length · majorant.
        weight = length * majorant(at.medium, at.ray, length > 0)
        self._add(self.cells.index(y.p, at.ray.d) + 1, L, weight, length > 0)

    def _add(self, cell: mi.UInt32, L: mi.Spectrum, weight: mi.Float, active: mi.Bool) -> None:
        active = active & dr.all(dr.isfinite(L))
        x, y, z = L if _channels() == 3 else 3 * [channel_mean(L)]
        dr.scatter_add(self.sums, mi.Vector4f(x, y, z, 1) * weight, cell, active)

    def tally(self, nulls: mi.Float) -> None:
        """Add each path's number of null collisions to the statistics."""
        paths = dr.width(nulls)
        dr.scatter_add(self.nulls, nulls, dr.arange(mi.UInt32, paths) % SLOTS)
        self.paths += paths


@dataclass(frozen=True)
class Baseline:
    """The part of a `BaselineState` that a pass reads. A frozen function accepts this class as an input.

    ``branching`` is the relative weight c of null collisions (see `branch_weight`).
    """

    cells: BaselineCells
    known: mi.Float  # the averages X and Y of all cells
    branching: mi.Float

    def lookup(self, mei: mi.MediumInteraction3f, σ_t: mi.Spectrum, σ_bar: mi.Float, active: mi.Bool) -> mi.Spectrum:
        """Estimate the radiance that arrives at an interaction from the direction -mei.wi. σ̄ is the majorant."""
        mei, σ_t = dr.detach(mei), dr.detach(σ_t)
        cell = self.cells.index(mei.p, -mei.wi)
        X, Y = dr.gather(mi.Vector4f, self.known, cell, active), dr.gather(mi.Vector4f, self.known, cell + 1, active)
        p = dr.select(σ_bar > 0, dr.clip(channel_mean(σ_t) / σ_bar, 0, 1), 0)
        b = X + p * (Y - X)
        return mi.Spectrum(b.x, b.y, b.z) if _channels() == 3 else mi.Spectrum(b.x)


@dataclass(frozen=True)
class BaselineState:
    """State of the learned baseline for the media of a scene. `after` returns the state after further passes."""

    cells: BaselineCells
    sums: mi.Float  # like `BaselineStats.sums`, with smaller weights for older passes
    branching: mi.Float
    passes: frozenset[Hashable] = frozenset()  # keys of the passes that contributed, which must not use this state
    guess: Baseline = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "guess", Baseline(self.cells, _averages(self.sums), self.branching))
        dr.make_opaque(self.guess.known, self.sums, self.branching)

    @staticmethod
    def fresh(box: mi.ScalarBoundingBox3f) -> BaselineState:
        """Create the initial state for media in a box."""
        return BaselineState(BaselineCells.of(box), dr.zeros(mi.Float, 4 * AVERAGES), mi.Float(FIRST_BRANCHING))

    def after(self, seen: BaselineStats) -> BaselineState:
        """Return the state updated with the statistics of passes, whose kernels must already have been launched."""
        branching = seen.paths / (seen.paths + dr.sum(seen.nulls)) if seen.paths else self.branching
        sums, passes = MEMORY * self.sums + seen.sums, self.passes | seen.passes
        return BaselineState(self.cells, sums, branching, passes)

    def state_dict(self) -> dict[str, np.ndarray]:
        """Return the state as float32 arrays by name; `restored` is the inverse."""
        return {"sums": self.sums.numpy(), "branching": self.branching.numpy()}

    @staticmethod
    def restored(box: mi.ScalarBoundingBox3f, learned: Mapping[str, np.ndarray]) -> BaselineState:
        """Create a state from the result of `state_dict`. Raises PathreplayError if shapes or values do not fit."""
        shapes = {name: np.shape(value) for name, value in learned.items()}
        wanted = {"sums": (4 * AVERAGES,), "branching": (1,)}
        if shapes != wanted or not 0 < learned["branching"][0] <= 1:
            raise PathreplayError(
                f"the learned baseline of the media has the shapes {shapes} instead of {wanted}, "
                "or a branching weight outside (0, 1]: start a new run"
            )
        sums, branching = (
            owned(mi.Float(with_space(np.array(learned[name], np.float32)))) for name in ("sums", "branching")
        )
        return BaselineState(BaselineCells.of(box), sums, branching)


def _averages(sums: mi.Float) -> mi.Float:
    """Compute the averages X and Y of all cells. In a cell with few samples, the mean over all cells dominates."""
    i = dr.arange(mi.UInt32, AVERAGES)
    is_y = i % 2 == 1
    weight = dr.gather(mi.Float, sums, 4 * i + 3)
    total = [dr.sum(dr.select(is_y == y, weight, 0)) for y in (False, True)]
    known = dr.zeros(mi.Float, 4 * AVERAGES)
    for k in range(_channels()):
        part = dr.gather(mi.Float, sums, 4 * i + k)
        mean = [dr.sum(dr.select(is_y == y, part, 0)) / dr.maximum(total[y], 1) for y in (False, True)]
        dr.scatter(known, (part + PRIOR * dr.select(is_y, mean[1], mean[0])) / (weight + PRIOR), 4 * i + k)
    return known
