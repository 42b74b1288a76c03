"""Tails: no pass of few samples says it all, in any cell of truth with edges.

A gradient may be right in the mean and have an infinite variance all the same: once in some thousand passes one is a
thousand standard deviations off. Tests of few passes do not meet it, an optimisation does.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import edge_media_scenes as media
import edge_ordinary
import edge_scenes as scenes
from edge_truth import ours
from pathreplay.boundary.arcs import Arc
from pathreplay.boundary.searches import secondary
from pathreplay.testing.objective import Objective
from pathreplay.testing.statistics import gap
from pathreplay.testing.verdict import Z_LIMIT
from pathreplay.transport.signature import turned_away
from truth import Bench, add, translate

PASSES, SPP = 256, 16
FIRST_SEED = int(os.environ.get("PATHREPLAY_TEST_TAIL_SEED", "1"))
"""Seed of the first pass. `LEFT` has figures of 1, 1001, 2001 and 3001."""
SHARE = 0.1
"""Largest share of one pass in the variance of all; of normal deviates it is more once in 10^6 tests."""
HALVES = 1.5
"""Largest ratio of the standard errors of two halves."""


def ball(bsdf: dict) -> dict:
    return scenes.shape(scenes.T().translate([0.1, 0.1, -0.3]).scale(0.5), bsdf, "sphere")


def with_a_ball(bsdf: dict) -> dict:
    return {
        "wall": scenes.shape(scenes.BACK, scenes.patterned()),
        "lamp": scenes.lamp(scenes.OVERHEAD),
        "object": ball(bsdf),
    }


def of_glass() -> dict:
    return scenes.scene(30, **with_a_ball(scenes.GLASS))


ASIDE = translate(*scenes.ASIDE)
BALLS = [
    scenes.cell(
        "ball_in_fog", lambda: media.in_fog(media.thin(), **with_a_ball(scenes.paint(0.5))), scenes.OBJECT, ASIDE, 3
    ),
    scenes.cell("glass_ball_moves", of_glass, scenes.OBJECT, ASIDE, 5),
    scenes.cell("glass_ball_index", of_glass, "object.bsdf.eta", add(1.0), 5),
]
"""Balls whose limbs are seen from fog, and from a wall that is seen through them."""
CASES = {each.name: each for each in (*BALLS, *scenes.BY_NAME.values(), *media.CELLS)}

LEFT = {
    "cube_in_wall": "with other seeds, one pass in 256 held 31 % of the variance: a shadow beside a side of the cube",
    "glass_ball_index": "one pass in 256 held 21 % of the variance: the lamp, seen by a reflection inside of the ball",
    "glass_ball_moves": "with other seeds, one pass in 256 held 11 % of the variance: a reflection turns as 1 / cos",
    "principled": "one pass in 256 held 11 % of the variance: light that the wall reflects, and a narrow lobe",
    "indirect_contact": "with other seeds, one pass in 256 held 26 % of the variance",
}
"""What has a tail still, and whence."""


def some(names: Iterable[str]) -> list[Any]:
    """Names as parameters of a test, which is known to fail where something is `LEFT`."""
    return [pytest.param(n, marks=pytest.mark.xfail(reason=LEFT[n])) if n in LEFT else n for n in names]


def passes(objective: Objective, integrator: mi.Integrator) -> np.ndarray:
    return np.array([objective.backward(integrator, seed, SPP) for seed in range(FIRST_SEED, FIRST_SEED + PASSES)])


def hold_tail(g: np.ndarray) -> None:
    off = np.square(g - g.mean())
    assert off.max() < SHARE * off.sum(), np.sort(g)[[0, 1, 2, PASSES // 2, -3, -2, -1]]
    halves = sorted(half.std() for half in (g[::2], g[1::2]))
    assert halves[1] < HALVES * halves[0], halves


@pytest.mark.hours
@pytest.mark.parametrize("name", some(CASES))
def test_no_pass_says_it_all(name: str) -> None:
    bench = Bench(CASES[name])
    bench.weigh(scenes.weights())
    try:
        hold_tail(passes(bench, ours(bench)))
    finally:
        bench.release()


@pytest.mark.hours
@pytest.mark.parametrize("name", some(edge_ordinary.SCENES))
def test_nor_does_one_in_ordinary_scenes(name: str, tmp_path: Path) -> None:
    moving = edge_ordinary.SCENES[name](tmp_path)
    objective = edge_ordinary.loaded(moving, tmp_path)
    options = {"max_depth": moving.depth, "rr_depth": edge_ordinary.NEVER, **moving.options}
    try:
        hold_tail(passes(objective, mi.load_dict({"type": "pathreplay", "boundary": "all", **options})))
    finally:
        objective.put(dr.opaque(mi.Float, 0))


# ------------------------------ What had no bounds ------------------------------

AXIS = mi.ScalarVector3f(0.6, 0, 0.8)


class Lobe:
    """A vertex that scatters around an axis: von Mises and Fisher's distribution of directions."""

    def __init__(self, κ: float) -> None:
        self.κ = κ

    def pdf(self, d: mi.Vector3f) -> mi.Float:
        return self.κ / dr.two_pi * dr.exp(-0.5 * self.κ * dr.squared_norm(d - mi.Vector3f(AXIS)))

    def sample(self, lobe: mi.Float, u: mi.Point2f) -> tuple[mi.Vector3f, mi.Bool]:
        return mi.Frame3f(mi.Vector3f(AXIS)).to_world(mi.warp.square_to_von_mises_fisher(u, self.κ)), mi.Bool(True)

    def towards(self, d: mi.Vector3f, active: mi.Bool) -> tuple[mi.Color3f, mi.Float]:
        return mi.Color3f(self.pdf(d)), self.pdf(d)


def crossings(κ: float, narrow: bool, n: int = 1 << 18) -> np.ndarray:
    """What each of n arcs says of ∫ f dl along a great circle through the middle of the lobe f."""
    observer: Any = Lobe(κ)
    line = Arc.draw(observer, 0.1, narrow, dr.arange(mi.UInt32, n) ^ mi.UInt32(0x51ED270B), mi.Bool(True))
    ends = -0.5 * line.length, 0.5 * line.length
    a, b = (dr.dot(mi.Vector3f(0, 1, 0), line.at(t)) for t in ends)
    t = dr.lerp(*ends, a / (a - b))  # the arc is all but straight
    f = observer.pdf(line.at(t))
    weight = 0.5 * dr.pi * f * line.weight(f, mi.Bool(True))
    return np.array(dr.select(a * b < 0, weight, 0), np.float64)


@pytest.mark.parametrize("κ", [1.0, 300.0, 30000.0, 300000.0], ids=["broad", "rough", "narrow", "almost a mirror"])
def test_arcs_of_all_lengths_add_up(κ: float) -> None:
    found = crossings(κ, narrow=True)
    φ = np.linspace(-np.pi, np.pi, 2_000_001)
    f = κ / (2 * np.pi) * np.exp(κ * (np.cos(φ) - 1))
    expected = f.mean() * 2 * np.pi / (1 - np.exp(-2 * κ))
    error = found.std() / len(found) ** 0.5
    assert abs(found.mean() - expected) < 4 * error
    assert error < 0.05 * expected
    assert np.square(found).max() < 0.01 * np.square(found).sum()


def test_arcs_longer_than_a_lobe_is_wide_have_a_tail() -> None:
    one, several = (crossings(30000.0, narrow) for narrow in (False, True))
    assert several.std() < 0.5 * one.std()
    assert several.max() < 0.1 * one.max()
    broad = crossings(1.0, narrow=False)
    assert crossings(1.0, narrow=True).std() < 1.1 * broad.std()


@pytest.mark.slow
def test_several_searches_around_a_vertex_are_less_noisy_than_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """A moving shape that a rough conductor reflects: the same sum, and less variance."""
    bench = Bench(scenes.BY_NAME["indirect_rough"])
    bench.weigh(scenes.weights())
    found = []
    try:
        for arcs in (1, secondary.ARCS):
            monkeypatch.setattr(secondary, "ARCS", arcs)
            integrator = ours(bench)
            found.append(np.array([bench.backward(integrator, 1000 * arcs + seed, SPP) for seed in range(64)]))
    finally:
        bench.release()
    one, several = found
    difference = gap(one, several)
    assert abs(difference.z) < Z_LIMIT and difference.error < 0.2 * abs(several.mean())
    spread_of_one, spread = (np.subtract(*np.quantile(each, [0.84, 0.16])) for each in found)
    assert spread < 0.85 * spread_of_one


def test_only_a_mesh_turns_away() -> None:
    """The limb of a ball is met from behind by rounding, where the derivative of that has no bounds."""
    for shape, turns in (({"type": "sphere"}, False), ({"type": "cylinder"}, False), ({"type": "cube"}, True)):
        scene = mi.load_dict({"type": "scene", "shape": shape})
        si = scene.ray_intersect(mi.Ray3f(mi.Point3f(0, 0, 0.5), mi.Vector3f(1, 0, 0)))
        assert bool(si.is_valid()[0]) and bool((dr.dot(si.n, mi.Vector3f(1, 0, 0)) > 0)[0])
        assert bool(turned_away(si, mi.Vector3f(1, 0, 0))[0]) == turns
