"""Interior and edges together, against finite differences; and that neither could be missing or counted twice."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from edge_scenes import ALL_MOVE, BY_NAME, weights
from pathreplay.check.statistics import gap
from pathreplay.check.verdict import RESOLUTION, Z_LIMIT
from pathreplay.gradient import inner_edges, seer
from pathreplay.render import boundary
from pathreplay.transport import velocity
from truth import ROWS, TRANSPOSE_MAX, Bench, Row

QUICK = ("shadow_all",)
"""The cell that says most in a few seconds."""
COUNTED_TWICE = ("shadow_lamp", "shadow_all", "lamp_lights", "cube8_lit", "sphere_lamp")
"""Cells in which something moves that the interior follows, and that edges could add again."""
MANY = 32
"""Passes of an estimator that looks for small lamps by chance."""

SOME = 12
TAIL = 0.75
"""Largest share of one pass in the variance of so many; of normal deviates it is hardly ever more."""


@dataclass(frozen=True)
class Loaded:
    """A case, and what finite differences say of it."""

    bench: Bench
    reference: np.ndarray


@cache
def load(name: str) -> Loaded:
    bench = Bench(BY_NAME[name])
    bench.weigh(weights())
    reference = bench.reference(bench.case.seeds)
    bench.put(dr.opaque(mi.Float, 0))
    return Loaded(bench, reference)


@contextmanager
def loaded(name: str) -> Iterator[Loaded]:
    """The case, detached at the end, since Dr.Jit trips over what is attached in other scenes."""
    case = load(name)
    try:
        yield case
    finally:
        case.bench.release()


def backwards(bench: Bench, seeds: int = 0, **options: Any) -> np.ndarray:
    """The gradient at places all along the interval of a central difference: their mean is what that measures.

    So steps may be large, which makes differences of images less noisy, and curves as bent as they like. A straight
    line through the gradients is taken out, since its mean is zero.
    """
    case, move = bench.case, bench.move
    integrator = bench.integrator(rr_depth=case.rr_depth, **{**case.options, **options})
    seeds = seeds or case.seeds
    places = case.step * (2 * (np.arange(seeds) + np.random.default_rng(0).random(seeds)) / seeds - 1)
    found = []
    try:
        for k, place in enumerate(places):
            bench.move = lambda value, t, place=place: move(value, t + mi.Float(place))
            found.append(bench.backward(integrator, k + 1, case.spp))
    finally:
        bench.move = move
    return np.array(found) - np.polyfit(places, found, 1)[0] * places


def some(names: tuple[str, ...]) -> list[Any]:
    return [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in names]


@pytest.mark.parametrize("name", some(tuple(BY_NAME)))
def test_gradients_with_edges_agree(name: str) -> None:
    with loaded(name) as case:
        g = backwards(case.bench)
    found = gap(g, case.reference)
    row = Row(f"edges: {name}", "sweep", g.mean(), case.reference.mean(), found.error, found.z, np.nan, np.nan)
    ROWS.append(row)
    assert abs(row.z) < Z_LIMIT, row
    assert row.error < RESOLUTION * max(abs(row.gradient), abs(row.reference)), row


@pytest.mark.parametrize("name", some(tuple(BY_NAME)))
def test_forward_is_reverse(name: str) -> None:
    """With the same seed."""
    with loaded(name) as case:
        bench = case.bench
        integrator = bench.integrator(rr_depth=bench.case.rr_depth, **bench.case.options)
        assert bench.transpose_error(integrator, integrator, 1, bench.case.spp) < TRANSPOSE_MAX


@pytest.mark.parametrize("name", some(tuple(BY_NAME)))
def test_without_edges_they_do_not(name: str) -> None:
    with loaded(name) as case:
        found = gap(backwards(case.bench, edges="none"), case.reference)
    assert abs(found.z) > Z_LIMIT, found


@pytest.mark.slow
@pytest.mark.parametrize("name", COUNTED_TWICE)
def test_nor_do_they_where_edges_ignore_what_the_interior_follows(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """∫ (f_near - f_far) n·V_edge over all edges that a surface sees is right for directions that are kept only.

    So emitters are looked for by arcs alone, with all of their light, and directions at both sides stand still.
    """
    arrival, kept = seer.Arrival, (mi.Bool(True), mi.Bool(False))
    monkeypatch.setattr(inner_edges, "moved_direction", lambda lengths, origin, d, hit, active: (d, mi.Float(1)))
    monkeypatch.setattr(seer, "Arrival", lambda ray, hit, pdf, *_: arrival(ray, hit, pdf, *kept))
    monkeypatch.setattr(inner_edges, "shadow_weight", lambda x, shaded: mi.Spectrum(0))
    with loaded(name) as case:
        found = gap(backwards(case.bench, MANY), case.reference)
    assert abs(found.z) > Z_LIMIT, found


# ------------------------------ What the sum does not depend on ------------------------------


@pytest.mark.slow
def test_forward_is_reverse_where_all_moves() -> None:
    """Lamps, a mirror, glass, a wall and what stands in it, each with its edges, three vertices deep."""
    bench = Bench(ALL_MOVE)
    bench.weigh(weights())
    integrator = bench.integrator(rr_depth=1000, **ALL_MOVE.options)
    try:
        assert bench.transpose_error(integrator, integrator, 1, 16) < TRANSPOSE_MAX
    finally:
        bench.release()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cube8_lit", "indirect_contact"])
def test_lines_may_be_shorter_and_no_pass_says_it_all(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with loaded(name) as case:
        long = backwards(case.bench, SOME)
        monkeypatch.setattr(boundary, "FILM_LENGTH", boundary.FILM_LENGTH / 4)
        monkeypatch.setattr(boundary, "INNER_LENGTHS", tuple(l / 4 for l in boundary.INNER_LENGTHS))
        short = backwards(case.bench, SOME)
    found = gap(long - short)  # the interior is the same
    assert abs(found.z) < Z_LIMIT, found
    assert found.error < RESOLUTION * abs(case.reference.mean()), found
    assert abs(gap(long[::2], long[1::2]).z) < Z_LIMIT
    share = np.square(long - long.mean())
    assert share.max() < TAIL * share.sum(), long


@pytest.mark.slow
def test_points_may_be_held_closer_to_a_surface(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the interior gives up, edges take over."""
    with loaded("cube_in_wall") as case:
        near, near_inside = (backwards(case.bench, SOME, edges=edges) for edges in ("all", "none"))
        monkeypatch.setattr(velocity, "BLEND", velocity.BLEND * 4)
        far, far_inside = (backwards(case.bench, SOME, edges=edges) for edges in ("all", "none"))
    found = gap(far - near)
    assert abs(found.z) < Z_LIMIT, found
    assert abs(gap(far_inside - near_inside).z) > Z_LIMIT
