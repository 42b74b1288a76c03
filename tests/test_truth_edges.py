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

from edge_scenes import BY_NAME, weights
from pathreplay.check.statistics import gap
from pathreplay.check.verdict import RESOLUTION, Z_LIMIT
from pathreplay.gradient import inner_edges, seer
from truth import ROWS, TRANSPOSE_MAX, Bench, Row

QUICK = ("rect_emit", "cube8_lit", "shadow_all")
"""Cells that say most in a few seconds."""
COUNTED_TWICE = ("shadow_lamp", "shadow_all", "lamp_lights", "lamp_seen", "cube8_lit", "sphere_lamp")
"""Cells in which something moves that the interior follows, and that edges could add again."""
MANY = 32
"""Passes of an estimator that looks for small lamps by chance."""


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
    return bench.backwards(bench.integrator(rr_depth=bench.case.rr_depth, **{**bench.case.options, **options}), seeds)


def some(names: tuple[str, ...], quick: tuple[str, ...]) -> list[Any]:
    return [name if name in quick else pytest.param(name, marks=pytest.mark.slow) for name in names]


@pytest.mark.parametrize("name", some(tuple(BY_NAME), QUICK))
def test_gradients_with_edges_agree(name: str) -> None:
    with loaded(name) as case:
        g = backwards(case.bench)
    found = gap(g, case.reference)
    row = Row(f"edges: {name}", "sweep", g.mean(), case.reference.mean(), found.error, found.z, np.nan, np.nan)
    ROWS.append(row)
    assert abs(row.z) < Z_LIMIT, row
    assert row.error < RESOLUTION * max(abs(row.gradient), abs(row.reference)), row


@pytest.mark.parametrize("name", some(tuple(BY_NAME), ("shadow_all",)))
def test_forward_is_reverse(name: str) -> None:
    """With the same seed."""
    with loaded(name) as case:
        bench = case.bench
        integrator = bench.integrator(rr_depth=bench.case.rr_depth, **bench.case.options)
        assert bench.transpose_error(integrator, integrator, 1, bench.case.spp) < TRANSPOSE_MAX


@pytest.mark.parametrize("name", some(tuple(BY_NAME), ("shadow_all",)))
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
