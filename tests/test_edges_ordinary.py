"""Edges in ordinary use: interior and edges together, in scenes as people have them, against finite differences."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from edge_ordinary import SCENES, Measured, measured
from pathreplay.check.statistics import gap
from pathreplay.check.verdict import RESOLUTION, Z_LIMIT
from truth import ROWS, TRANSPOSE_MAX, Row

QUICK = ("blender", "two_lamps")
SEEDS = 8
TAIL = 0.9
"""Largest share of one pass in the variance of eight; of normal deviates it is more once in some thousand tests."""

IN_A_VARIANT = """
import json, sys
from pathlib import Path
folder, variant, *names = sys.argv[1:]
sys.path.insert(0, folder)
from pathreplay.backend import set_variant
set_variant(variant)
from edge_ordinary import SCENES, measured
for name in names:
    found = measured(SCENES[name](Path.cwd()), Path.cwd(), 8)
    print(json.dumps([name, found.gradients.tolist(), found.differences.tolist(), found.transpose]))
"""


def hold(name: str, found: Measured) -> None:
    g, d = found.gradients, found.differences
    difference = gap(g, d)
    row = Row(f"edges: {name}", "sweep", g.mean(), d.mean(), difference.error, difference.z, np.nan, found.transpose)
    ROWS.append(row)
    assert abs(row.z) < Z_LIMIT, row
    assert row.error < RESOLUTION * max(abs(row.gradient), abs(row.reference)), row
    assert row.transpose < TRANSPOSE_MAX, row
    share = np.square(g - g.mean())
    assert share.max() < TAIL * share.sum(), g


@pytest.mark.parametrize("name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in SCENES])
def test_gradients_agree(name: str, tmp_path: Path) -> None:
    hold(name, measured(SCENES[name](tmp_path), tmp_path, SEEDS))


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["llvm_ad_mono", "llvm_ad_spectral"])
def test_in_other_variants(variant: str, run_python, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    done = run_python(IN_A_VARIANT, args=[str(Path(__file__).parent), variant, "two_lamps", "sky"])
    assert done.returncode == 0, done.stderr
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("[")]
    assert len(lines) == 2
    for name, g, d, transpose in lines:
        hold(f"{name}, {variant}", Measured(np.array(g), np.array(d), transpose))
