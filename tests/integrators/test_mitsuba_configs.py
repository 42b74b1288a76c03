"""Mitsuba's own tests of derivatives, static, moving and with edges, at its thresholds: see `mitsuba_errors`."""

from __future__ import annotations

import pytest

from mitsuba_configs import CONFIGS, EDGES
from mitsuba_errors import measure, row
from pathreplay.testing.verdict import Z_LIMIT

QUICK = ("part of a film",)
# Float32 rounding of sums in another order, relative to the sum of magnitudes.
TRANSPOSE_MAX = 1e-5


@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n in QUICK else pytest.mark.slow) for n in CONFIGS])
def test_errors_are_below_the_limits(name: str) -> None:
    hold(name, part=8 if name in QUICK else 1)


@pytest.mark.hours
@pytest.mark.parametrize("seed", [3001, 6001])
@pytest.mark.parametrize("name", CONFIGS)
def test_errors_are_below_the_limits_with_other_seeds(name: str, seed: int) -> None:
    hold(name, seed=seed)


def hold(name: str, **options: int) -> None:
    config = CONFIGS[name]
    found = measure(config, boundary="all", **options)
    told = row(name, found, config.limits)
    assert not found.misses(config.limits), told
    # The limits allow much where the image is mostly dark.
    assert abs(found.z) < Z_LIMIT, told
    assert found.transpose < TRANSPOSE_MAX, told


@pytest.mark.slow
@pytest.mark.parametrize("name", EDGES)
def test_without_edges_the_sum_is_wrong(name: str) -> None:
    found = measure(CONFIGS[name], boundary="none")
    assert abs(found.z) > Z_LIMIT, row(name, found, CONFIGS[name].limits)
