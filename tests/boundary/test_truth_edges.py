"""Interior and edges together, against finite differences, in what the camera sees, also by mirrors and glass."""

from __future__ import annotations

import pytest

from edge_scenes import ALL_MOVE, BENT, SEEN, TOUCHING
from edge_truth import hold_forward, hold_gradients, hold_need, loaded, ours, some
from truth import TRANSPOSE_MAX

CELLS = [*SEEN, *TOUCHING, *BENT]
NAMES = pytest.mark.parametrize("name", some(CELLS))


@NAMES
def test_gradients_with_edges_agree(name: str) -> None:
    hold_gradients(name)


@NAMES
def test_forward_is_reverse(name: str) -> None:
    hold_forward(name)


# In "facet_seen", sampled directions follow the plane of the facet, so that the interior is the whole derivative.
@pytest.mark.parametrize("name", some([case for case in CELLS if case.name != "facet_seen"]))
def test_without_edges_they_do_not(name: str) -> None:
    hold_need(name)


@pytest.mark.slow
def test_forward_is_reverse_where_all_moves() -> None:
    """Lamps, a mirror, glass, a wall and what stands in it, each with its edges, three vertices deep."""
    with loaded(ALL_MOVE) as bench:
        assert bench.transpose_error(ours(bench), ours(bench), 1, 16) < TRANSPOSE_MAX
