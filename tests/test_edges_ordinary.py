"""Edges in ordinary use: interior and edges together, in scenes as people have them, against finite differences."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from edge_ordinary import SCENES, Measured, measured
from pathreplay.check.statistics import gap
from pathreplay.check.verdict import RESOLUTION, Z_LIMIT
from truth import ROWS, Row

AGREE = ("smooth_torus", "flat_torus", "constant")
"""Those of `SCENES` that have been seen to agree."""
SEEDS = 8
TAIL = 0.9
"""Largest share of one pass in the variance of eight; of normal deviates it is more once in some thousand tests."""


def hold(name: str, found: Measured) -> None:
    g, d = found.gradients, found.differences
    difference = gap(g, d)
    row = Row(f"edges: {name}", "sweep", g.mean(), d.mean(), difference.error, difference.z, np.nan, found.transpose)
    ROWS.append(row)
    assert abs(row.z) < Z_LIMIT, row
    assert row.error < RESOLUTION * max(abs(row.gradient), abs(row.reference)), row
    share = np.square(g - g.mean())
    assert share.max() < TAIL * share.sum(), g


@pytest.mark.slow
@pytest.mark.parametrize("name", AGREE)
def test_gradients_agree(name: str, tmp_path: Path) -> None:
    hold(name, measured(SCENES[name](tmp_path), tmp_path, SEEDS))
