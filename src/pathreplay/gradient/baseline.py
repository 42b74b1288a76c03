"""The learned baseline of volume gradients: a guess of the radiance that arrives at a point of a medium from beyond.

Two averages over cells of position and direction: X of what real collisions scatter, and Y of what comes through where
a ray goes on. With p the probability of a real collision there, b = (1 - p) X + p Y. Only earlier passes are asked, so
that b is independent of the pass that it serves and its score has mean zero, whatever b is, since real and (if the walk
branches) null collisions are asked everywhere: a bad guess is noise, not bias. Nothing here is differentiated.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import PathreplayError
from ..transport.media import interaction, majorant, span

# Cells along each axis of space, and along each side of the octahedron of directions. 8³ x 4² cells of two averages
# with four numbers each are 256 KiB, three times: what is known, its sums, and what the present pass sees. More cells
# know less each, so that gradients get noisier again: see the cloud of `pathreplay bench media`.
CELLS, SIDES = 8, 4
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


class Baseline:
    """Averages over the cells of a box that holds all media.

    ``look`` is the guess; ``learn``, called in the loop of a pass, collects what that pass sees, and ``absorb``, called
    after it, makes it known to later passes. ``branching`` (Float) is what a null collision is to count.
    """

    def __init__(self, box: Any) -> None:
        self.low = mi.ScalarPoint3f(box.min)
        self.scale = mi.ScalarVector3f(*(CELLS / max(float(e), 1e-20) for e in box.extents()))
        self.count = 2 * CELLS**3 * SIDES**2  # of averages: X and Y side by side
        self.known = dr.zeros(mi.Float, 4 * self.count)  # the averages
        self.sums = dr.zeros(mi.Float, 4 * self.count)  # Σ weight·L and Σ weight
        self.seen = dr.zeros(mi.Float, 4 * self.count)  # the same of the present pass
        self.branching = mi.Float(FIRST_BRANCHING)
        self.nulls = dr.zeros(mi.Float, SLOTS)  # null collisions of the present pass, in parts that float32 can hold
        self.paths = 0  # of the present pass
        dr.make_opaque(self.known, self.sums, self.seen, self.branching, self.nulls)

    def _cell(self, p: Any, d: Any) -> Any:
        """Index (UInt32) of the first average of the cell."""
        at = mi.Vector3u(dr.clip(mi.Vector3f(p - self.low) * self.scale, 0, CELLS - 1))
        d = d * dr.rcp(dr.abs(d.x) + dr.abs(d.y) + dr.abs(d.z))
        sx, sy = dr.select(d.x >= 0, 1.0, -1.0), dr.select(d.y >= 0, 1.0, -1.0)
        x = dr.select(d.z >= 0, d.x, (1 - dr.abs(d.y)) * sx)
        y = dr.select(d.z >= 0, d.y, (1 - dr.abs(d.x)) * sy)
        to = mi.Vector2u(dr.clip((mi.Vector2f(x, y) + 1) * (0.5 * SIDES), 0, SIDES - 1))
        return 2 * (((at.z * CELLS + at.y) * CELLS + at.x) * SIDES**2 + to.y * SIDES + to.x)

    def look(self, mei: Any, σ_t: Any, σ_bar: Any, active: Any) -> Any:
        """The guess (Spectrum) at a MediumInteraction3f, for radiance that travels along -mei.wi; σ̄ is the majorant."""
        mei, σ_t = dr.detach(mei), dr.detach(σ_t)
        cell = self._cell(mei.p, -mei.wi)
        X, Y = dr.gather(mi.Vector4f, self.known, cell, active), dr.gather(mi.Vector4f, self.known, cell + 1, active)
        p = dr.select(σ_bar > 0, dr.clip(dr.mean(σ_t) / σ_bar, 0, 1), 0)
        b = X + p * (Y - X)
        return mi.Spectrum(b.x, b.y, b.z) if _channels() == 3 else mi.Spectrum(b.x)

    def learn(self, replayed: Any, L: Any) -> None:
        """Collect the radiance ``L`` (Spectrum) that came back along the ray of a replayed vertex."""
        at, flight = replayed.at, replayed.kept.media.flight
        in_medium = at.medium != None  # noqa: E711 (an array of pointers)
        event = in_medium & flight.event
        reach = dr.select(at.hit.is_valid(), at.hit.t, dr.inf)
        a, b = span(at.medium, at.ray, reach, in_medium)
        end = dr.select(event, flight.t, b)
        length = dr.select(in_medium & dr.isfinite(end), end - a, 0)
        x = interaction(at.medium, at.ray, flight.t)
        y = interaction(at.medium, at.ray, a + flight.along * length)
        self._add(self._cell(x.p, at.ray.d), L, mi.Float(1), event)
        # Long flights are seldom cut at any given point of theirs; lengths make up for it, in mean free paths.
        self._add(self._cell(y.p, at.ray.d) + 1, L, length * majorant(at.medium, at.ray, length > 0), length > 0)

    def _add(self, cell: Any, L: Any, weight: Any, active: Any) -> None:
        active = active & dr.all(dr.isfinite(L))
        x, y, z = L if _channels() == 3 else 3 * [dr.mean(L)]
        dr.scatter_add(self.seen, mi.Vector4f(x, y, z, 1) * weight, cell, active)

    def tally(self, nulls: Any) -> None:
        """Collect the number of null collisions of each path (Float)."""
        paths = dr.width(nulls)
        dr.scatter_add(self.nulls, nulls, dr.arange(mi.UInt32, paths) % SLOTS)
        self.paths += paths

    def absorb(self) -> None:
        """Let later passes know what the last one saw."""
        self.sums = MEMORY * self.sums + self.seen
        self.seen = dr.zeros(mi.Float, 4 * self.count)
        if self.paths:
            self.branching = self.paths / (self.paths + dr.sum(self.nulls))
        self.nulls, self.paths = dr.zeros(mi.Float, SLOTS), 0
        self._conclude()

    def learned(self) -> dict[str, Any]:
        """All that it knows, as float32 arrays by name, from which `restore` makes the same again."""
        return {"sums": self.sums.numpy(), "branching": self.branching.numpy()}

    def restore(self, learned: Mapping[str, Any]) -> None:
        """Know what `learned` told of another one. Raises PathreplayError if that cannot be."""
        shapes = {name: np.shape(value) for name, value in learned.items()}
        wanted = {"sums": (4 * self.count,), "branching": (1,)}
        if shapes != wanted or not 0 < learned["branching"][0] <= 1:
            raise PathreplayError(
                f"What was learned of the media has the shapes {shapes}, not {wanted}, or branching beyond 0 to 1; "
                "start the job from its config"
            )
        self.sums, self.branching = (mi.Float(np.array(learned[n], np.float32)) for n in ("sums", "branching"))
        self._conclude()

    def _conclude(self) -> None:
        """The averages that follow from the sums."""
        i = dr.arange(mi.UInt32, self.count)
        is_y = i % 2 == 1
        weight = dr.gather(mi.Float, self.sums, 4 * i + 3)
        total = [dr.sum(dr.select(is_y == y, weight, 0)) for y in (False, True)]
        known = dr.zeros(mi.Float, 4 * self.count)
        for k in range(_channels()):
            sums = dr.gather(mi.Float, self.sums, 4 * i + k)
            mean = [dr.sum(dr.select(is_y == y, sums, 0)) / dr.maximum(total[y], 1) for y in (False, True)]
            value = (sums + PRIOR * dr.select(is_y, mean[1], mean[0])) / (weight + PRIOR)
            dr.scatter(known, value, 4 * i + k)
        self.known = known
        dr.make_opaque(self.known, self.sums, self.seen, self.branching, self.nulls)
