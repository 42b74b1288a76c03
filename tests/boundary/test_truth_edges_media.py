"""Interior and edges together in scenes with media, against finite differences of `volpath`, and forward by reverse."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from edge_media_scenes import BY_NAME
from edge_scenes import weights
from edge_truth import ours
from pathreplay.testing.statistics import gap
from pathreplay.testing.verdict import RESOLUTION, Z_LIMIT
from truth import ROWS, TRANSPOSE_MAX, Bench, Row

FEW = ("fog_shadow", "by_ball_chance", "spot_border", "indirect", "indirect_box")
"""Cells that say most in a minute: shadows, lamps that are found by chance behind a boundary, the border of a spot
light, and hard shadows in indirect light."""


@contextmanager
def loaded(name: str) -> Iterator[Bench]:
    """The case, detached at the end, since Dr.Jit trips over what is attached in other scenes."""
    bench = Bench(BY_NAME[name])
    bench.weigh(weights())
    try:
        yield bench
    finally:
        bench.release()


@pytest.mark.slow
@pytest.mark.parametrize("name", FEW)
def test_gradients_with_edges_agree(name: str) -> None:
    with loaded(name) as bench:
        case = bench.case
        reference = bench.reference(case.seeds)
        bench.put(dr.opaque(mi.Float, 0))
        integrator = ours(bench)
        g = bench.backwards(integrator)
        transpose = bench.transpose_error(integrator, integrator, 1, case.spp)
    found = gap(g, reference)
    row = Row(f"edges: {name}", "recorded", g.mean(), reference.mean(), found.error, found.z, np.nan, transpose)
    ROWS.append(row)
    assert abs(row.z) < Z_LIMIT, row
    assert row.error < RESOLUTION * max(abs(row.gradient), abs(row.reference)), row
    assert row.transpose < TRANSPOSE_MAX, row


@pytest.mark.slow
def test_edges_in_thick_fog_are_less_noisy_than_differences() -> None:
    """Both use the same number of samples.

    If both sides of an edge sample their flights up to it, the ratio is 4. If all collisions of a flight move in
    proportion to its length, the ratio is 0.6.
    """
    with loaded("thick_fog") as bench:
        differences = bench.reference(32, spp=bench.case.spp // 2)
        bench.put(dr.opaque(mi.Float, 0))
        gradients = bench.backwards(ours(bench), 32)
    ratio = gradients.var() / differences.var()
    print(f"variance of gradients over that of differences: {ratio:.2f}")
    assert ratio < 0.3 and abs(gap(gradients, differences).z) < Z_LIMIT
