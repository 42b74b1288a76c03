"""What is measured of a cell with edges: interior and edges together, the interior alone, and finite differences.

Numbers are kept and scenes are not: Dr.Jit traces virtual calls through all scenes alive, which takes ever longer.
"""

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

from edge_scenes import BY_NAME, weights
from pathreplay.testing.statistics import gap
from pathreplay.testing.verdict import RESOLUTION, Z_LIMIT
from truth import ROWS, TRANSPOSE_MAX, Bench, Case, Row

QUICK = ("shadow_all",)
"""The cell that says most in a few seconds."""


@dataclass(frozen=True)
class Measured:
    """Of each seed."""

    gradients: np.ndarray
    interior: np.ndarray
    differences: np.ndarray
    transpose: float  # |<W, J v> - <Jᵀ W, v>| / Σ |W J v| of the first seed


@contextmanager
def loaded(case: Case) -> Iterator[Bench]:
    """The case, detached at the end, since Dr.Jit trips over what is attached in other scenes."""
    bench = Bench(case)
    bench.weigh(weights())
    try:
        yield bench
    finally:
        bench.release()


def ours(bench: Bench, **options: Any) -> mi.Integrator:
    return bench.integrator(rr_depth=bench.case.rr_depth, **{**bench.case.options, **options})


@cache
def reference(name: str) -> np.ndarray:
    """Finite differences, of each seed."""
    with loaded(BY_NAME[name]) as bench:
        return bench.reference(bench.case.seeds)


@cache
def measured(name: str) -> Measured:
    case, differences = BY_NAME[name], reference(name)
    with loaded(case) as bench:
        g = backwards(bench)
        transpose = bench.transpose_error(ours(bench), ours(bench), 1, case.spp)
        return Measured(g, backwards(bench, boundary="none"), differences, transpose)


def backwards(bench: Bench, seeds: int = 0, first: int = 0, **options: Any) -> np.ndarray:
    """The gradient at places all along the interval of a central difference, whose mean is what that measures.

    Of so many seeds from ``first`` on.
    So steps may be large, which makes differences of images less noisy, and curves as bent as they like. A straight
    line through the gradients is taken out, since its mean is zero.
    """
    case, move, integrator = bench.case, bench.move, ours(bench, **options)
    seeds = seeds or case.seeds
    places = case.step * (2 * (np.arange(seeds) + np.random.default_rng(first).random(seeds)) / seeds - 1)
    found = []
    try:
        for k, place in enumerate(places):
            bench.move = lambda value, t, place=place: move(value, t + mi.Float(place))
            found.append(bench.backward(integrator, first + k + 1, case.spp))
    finally:
        bench.move = move
        bench.put(dr.opaque(mi.Float, 0))
    return np.array(found) - np.polyfit(places, found, 1)[0] * places


def some(cells: list[Case]) -> list[Any]:
    """The names of cells, as parameters of tests, of which few are quick."""
    names = [case.name for case in cells]
    return [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in names]


def hold_gradients(name: str) -> None:
    """To finite differences."""
    found = measured(name)
    hold_agreement(name, found.gradients, found.differences, found.transpose)


def hold_agreement(name: str, g: np.ndarray, d: np.ndarray, transpose: float) -> None:
    """Gradients of seeds to differences of seeds; adds a row to the table of truth."""
    difference = gap(g, d)
    row = Row(f"edges: {name}", "recorded", g.mean(), d.mean(), difference.error, difference.z, np.nan, transpose)
    ROWS.append(row)
    assert abs(row.z) < Z_LIMIT, row
    assert row.error < RESOLUTION * max(abs(row.gradient), abs(row.reference)), row


def hold_forward(name: str) -> None:
    """To reverse mode, with the same seed."""
    assert measured(name).transpose < TRANSPOSE_MAX


def hold_need(name: str) -> None:
    """To being wrong without edges."""
    found = measured(name)
    wrong = gap(found.interior, found.differences)
    assert abs(wrong.z) > Z_LIMIT, wrong
