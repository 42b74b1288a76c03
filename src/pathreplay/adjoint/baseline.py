"""The learned baseline of volume gradients: an estimate of the radiance that arrives at a point of a medium.

It consists of two averages over cells of position and direction: X of the radiance scattered at real collisions, and Y
of the radiance transmitted where rays continue. With p the probability of a real collision, b = (1 - p) X + p Y. Only
earlier passes contribute, so that b is independent of the current pass and its score has mean zero for any b. This
requires that real collisions and, if they are kept, null collisions evaluate b everywhere. A poor estimate increases
noise and causes no bias. Nothing here is differentiated.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.transport.vertex import VertexRecord
from pathreplay.transport.volume.media import interaction, majorant, span

# Cells along each axis of space, and along each side of the octahedron of directions. 8³ x 4² cells of two averages
# with four numbers each are 256 KiB, three times: what is known, its sums, and what the present pass sees. More cells
# know less each, so that gradients get noisier again: see the cloud of `pathreplay bench media`.
CELLS, SIDES = 8, 4
AVERAGES = 2 * CELLS**3 * SIDES**2  # X and Y side by side
# How much of what was known before stays when a pass has been learned: about the last ten passes count.
MEMORY = 0.9
# What a null collision counts at first (see `branch_weight`): as if there were fifty on a path.
FIRST_BRANCHING = 0.02
SLOTS = 256
# A cell believes the mean of all cells as much as this many samples of its own.
PRIOR = 2.0


def _channels() -> int:
    """Channels that are told apart. Wavelengths differ from path to path in spectral variants: there only the mean."""
    return 3 if mi.is_rgb else 1


@dataclass(frozen=True)
class BaselineCells:
    """The cells of position and direction, in a box that holds all media."""

    low: tuple[float, ...]  # numbers that a frozen function takes as they are
    scale: tuple[float, ...]  # cells per unit of length

    @staticmethod
    def of(box: mi.ScalarBoundingBox3f) -> BaselineCells:
        scale = (CELLS / max(float(e), 1e-20) for e in box.extents())
        return BaselineCells(tuple(map(float, box.min)), tuple(scale))

    def index(self, p: mi.Point3f, d: mi.Vector3f) -> mi.UInt32:
        """Index of the first average of the cell."""
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
    """What gradient passes saw of the media: sums, so that those of several passes or shards can be added."""

    cells: BaselineCells
    sums: mi.Float  # Σ weight·L in three channels and Σ weight, of each average
    nulls: mi.Float  # null collisions, in parts that float32 can hold
    paths: int  # that these collisions are of
    passes: frozenset[Hashable]  # keys of the passes

    @staticmethod
    def none(cells: BaselineCells, *keys: Hashable) -> BaselineStats:
        """For the pass with that key to begin with; recorded ones have none."""
        sums, nulls = dr.zeros(mi.Float, 4 * AVERAGES), dr.zeros(mi.Float, SLOTS)
        dr.make_opaque(sums, nulls)
        return BaselineStats(cells, sums, nulls, 0, frozenset(keys))

    def __add__(self, other: BaselineStats) -> BaselineStats:
        sums, nulls, paths = self.sums + other.sums, self.nulls + other.nulls, self.paths + other.paths
        return BaselineStats(self.cells, sums, nulls, paths, self.passes | other.passes)

    def learn(self, replayed: VertexRecord, L: mi.Spectrum) -> None:
        """Collect the radiance ``L`` that came back along the ray of a replayed vertex; in the loop of a pass."""
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
        # Long flights are seldom cut at any given point of theirs; lengths make up for it, in mean free paths.
        weight = length * majorant(at.medium, at.ray, length > 0)
        self._add(self.cells.index(y.p, at.ray.d) + 1, L, weight, length > 0)

    def _add(self, cell: mi.UInt32, L: mi.Spectrum, weight: mi.Float, active: mi.Bool) -> None:
        active = active & dr.all(dr.isfinite(L))
        x, y, z = L if _channels() == 3 else 3 * [dr.mean(L)]
        dr.scatter_add(self.sums, mi.Vector4f(x, y, z, 1) * weight, cell, active)

    def tally(self, nulls: mi.Float) -> None:
        """Collect the number of null collisions of each path."""
        paths = dr.width(nulls)
        dr.scatter_add(self.nulls, nulls, dr.arange(mi.UInt32, paths) % SLOTS)
        self.paths += paths


@dataclass(frozen=True)
class Baseline:
    """What a pass asks of a baseline, which a frozen function can be handed.

    ``branching`` is what a null collision is to count.
    """

    cells: BaselineCells
    known: mi.Float  # the averages
    branching: mi.Float

    def look(self, mei: mi.MediumInteraction3f, σ_t: mi.Spectrum, σ_bar: mi.Float, active: mi.Bool) -> mi.Spectrum:
        """The guess at an interaction, for radiance that travels along -mei.wi; σ̄ is the majorant."""
        mei, σ_t = dr.detach(mei), dr.detach(σ_t)
        cell = self.cells.index(mei.p, -mei.wi)
        X, Y = dr.gather(mi.Vector4f, self.known, cell, active), dr.gather(mi.Vector4f, self.known, cell + 1, active)
        p = dr.select(σ_bar > 0, dr.clip(dr.mean(σ_t) / σ_bar, 0, 1), 0)
        b = X + p * (Y - X)
        return mi.Spectrum(b.x, b.y, b.z) if _channels() == 3 else mi.Spectrum(b.x)


@dataclass(frozen=True)
class BaselineState:
    """What is known of the media of a scene. ``after`` is what is known when more has been seen."""

    cells: BaselineCells
    sums: mi.Float  # those of `BaselineStats`, of which older passes count less
    branching: mi.Float
    passes: frozenset[Hashable] = frozenset()  # keys of the passes that were learned from: none is its own judge
    guess: Baseline = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "guess", Baseline(self.cells, _averages(self.sums), self.branching))
        dr.make_opaque(self.guess.known, self.sums, self.branching)

    @staticmethod
    def fresh(box: mi.ScalarBoundingBox3f) -> BaselineState:
        """Nothing is known yet of what is in the box."""
        return BaselineState(BaselineCells.of(box), dr.zeros(mi.Float, 4 * AVERAGES), mi.Float(FIRST_BRANCHING))

    def after(self, seen: BaselineStats) -> BaselineState:
        """What is known when passes have seen that, too. Ask when their kernels have been launched."""
        branching = seen.paths / (seen.paths + dr.sum(seen.nulls)) if seen.paths else self.branching
        sums, passes = MEMORY * self.sums + seen.sums, self.passes | seen.passes
        return BaselineState(self.cells, sums, branching, passes)

    def state_dict(self) -> dict[str, np.ndarray]:
        """All that it knows, as float32 arrays by name, from which `restored` makes the same again."""
        return {"sums": self.sums.numpy(), "branching": self.branching.numpy()}

    @staticmethod
    def restored(box: mi.ScalarBoundingBox3f, learned: Mapping[str, np.ndarray]) -> BaselineState:
        """One that knows what `state_dict` told of another. Raises PathreplayError if that cannot be."""
        shapes = {name: np.shape(value) for name, value in learned.items()}
        wanted = {"sums": (4 * AVERAGES,), "branching": (1,)}
        if shapes != wanted or not 0 < learned["branching"][0] <= 1:
            raise PathreplayError(
                f"What was learned of the media has the shapes {shapes}, not {wanted}, or branching beyond 0 to 1; "
                "start the job from its config"
            )
        # In memory of Dr.Jit's own: recorded passes want it aligned as it was.
        one = dr.opaque(mi.Float, 1)
        sums, branching = (mi.Float(np.array(learned[name], np.float32)) * one for name in ("sums", "branching"))
        return BaselineState(BaselineCells.of(box), sums, branching)


def _averages(sums: mi.Float) -> mi.Float:
    """The averages that follow from the sums; cells that saw little lean on all of them."""
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
