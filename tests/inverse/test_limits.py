"""Sizes are refused by the numbers that are told: the largest one that is named does, the next one does not."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from pathreplay.errors import PathreplayError
from pathreplay.integrators.film.image import MOST_SAMPLES, require_film
from pathreplay.inverse.parameters.limits import require_grid, require_learning_rate
from pathreplay.platform import memory


def test_a_container_s_limit_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limit, used, statistics = (tmp_path / name for name in ("max", "current", "stat"))
    statistics.write_text("anon 900000\n")
    monkeypatch.setattr(memory, "_CONTAINERS", ((tmp_path / "none", used, statistics), (limit, used, statistics)))
    used.write_text("1000000\n")
    limit.write_text("max\n")
    free = memory.available()
    assert free > 1e8
    limit.write_text("3000000\n")
    assert memory.available() == 2_000_000
    # Files that were read count as used, but are given up. The first version has totals of nested groups, too.
    statistics.write_text("active_file 1\ninactive_file 2\ntotal_active_file 100000\ntotal_inactive_file 200000\n")
    assert memory.available() == 2_300_000
    statistics.write_text("")
    limit.write_text("1\n")
    assert memory.available() == 0
    with pytest.raises(PathreplayError, match=r"A film needs about 5 GB of memory, 0 GB is available; take less"):
        memory.require(5 * 10**9, "A film", "take less")


@pytest.mark.parametrize("shape", [(8, 4, 3), (4, 8, 8, 1), (1, 1, 2)])
def test_the_named_resolution_is_the_largest_that_fits(shape: tuple[int, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available", lambda: 10**9)
    with pytest.raises(PathreplayError) as error:
        require_grid("k", shape, [4, 10**20])
    largest = int(str(error.value).rsplit(" ", 1)[1])
    require_grid("k", shape, [largest])
    with pytest.raises(PathreplayError, match=f"use a resolution up to {largest}$"):
        require_grid("k", shape, [largest + 1])


def test_the_named_count_of_samples_is_the_largest_that_dr_jit_takes() -> None:
    film = {"type": "hdrfilm", "width": 6, "height": 4, "rfilter": {"type": "box"}}
    sensor, most = mi.load_dict({"type": "perspective", "film": film}), MOST_SAMPLES // 24
    require_film(sensor, "sensor 'eye'", {"spp": most})
    with pytest.raises(PathreplayError, match=f"'spp' up to {most}$"):
        require_film(sensor, "sensor 'eye'", {"spp": most + 1})


def test_learning_rates_are_held_against_values_and_bounds() -> None:
    for start, bounds in ((0.0, ()), (1e8, ()), (0.0, (None, 1e8))):
        scale = max(1.0, start, *(bound or 0 for bound in bounds))
        require_learning_rate("k", 0.5e6 * scale, np.array([start]), bounds)
        with pytest.raises(PathreplayError, match="learning rate"):
            require_learning_rate("k", 2e6 * scale, np.array([start]), bounds)
