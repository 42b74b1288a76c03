"""Interior and edges together, against finite differences, in what points of surfaces see: shadows and indirect light.

And that neither could be missing or counted twice.
"""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from edge_scenes import BY_NAME, INDIRECT, REFLECTED, SHADOWS, VEILED
from edge_truth import backwards, hold_forward, hold_gradients, hold_need, loaded, reference, some
from pathreplay.boundary import observer
from pathreplay.boundary.emitters import ShadowCrossing
from pathreplay.integrators import boundary_term as boundary
from pathreplay.integrators import integrator as integrators
from pathreplay.testing.statistics import gap
from pathreplay.testing.verdict import RESOLUTION, Z_LIMIT
from pathreplay.transport import velocity

NAMES = pytest.mark.parametrize("name", some([*SHADOWS, *INDIRECT, *REFLECTED, *VEILED]))
MANY = 32
"""Passes where a small difference is to be seen, or where small lamps are looked for by chance."""
COUNTED_TWICE = {
    "shadow_lamp": 4 * MANY,
    "shadow_all": 6 * MANY,
    "lamp_lights": MANY,
    "sphere_lamp": 6 * MANY,
    "cube8_lit": 16 * MANY,
}
"""Cells in which something moves that the interior follows, and that edges could add again, and passes that show it."""

SOME = 12
TAIL = 0.75
"""Largest share of one pass in the variance of so many; of normal deviates it is hardly ever more."""


@NAMES
def test_gradients_with_edges_agree(name: str) -> None:
    hold_gradients(name)


@NAMES
def test_forward_is_reverse(name: str) -> None:
    hold_forward(name)


@NAMES
def test_without_edges_they_do_not(name: str) -> None:
    hold_need(name)


def test_what_shades_a_pane_of_glass_is_an_edge() -> None:
    """With few samples: enough to tell that the edges behind the pane are there."""
    with loaded(replace(BY_NAME["pane_shades"], spp=256, reference_spp=1024)) as bench:
        differences, g, interior = bench.reference(8), backwards(bench, 8), backwards(bench, 8, boundary="none")
    assert abs(gap(g, differences).z) < Z_LIMIT < abs(gap(interior, differences).z)


@pytest.mark.slow
@pytest.mark.parametrize("name", COUNTED_TWICE)
def test_nor_do_they_where_edges_ignore_what_the_interior_follows(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """∫ (f_near - f_far) n·V_edge over all edges that a surface sees is right for directions that are kept only.

    So emitters are looked for by arcs alone, with all of their light, and directions at both sides stand still. Nor
    does the film follow what is seen: where that moves with it, there is nothing to be counted twice.
    """
    monkeypatch.setattr(integrators, "can_follow", lambda trace, sensor: False)
    arrival, kept = observer.Arrival, (mi.Bool(True), mi.Bool(False))
    monkeypatch.setattr(observer, "moved_direction", lambda lengths, origin, d, hit, active: (d, mi.Float(1)))
    monkeypatch.setattr(observer, "Arrival", lambda ray, hit, pdf, *_: arrival(ray, hit, pdf, *kept))
    monkeypatch.setattr(ShadowCrossing, "weighted", lambda self, *_: replace(self, weight=mi.Spectrum(0)))
    differences = reference(name)
    with loaded(BY_NAME[name]) as bench:
        found = gap(backwards(bench, COUNTED_TWICE[name]), differences)
    assert abs(found.z) > Z_LIMIT, found


# ------------------------------ What the sum does not depend on ------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cube8_lit", "indirect_contact"])
def test_lines_may_be_shorter_and_no_pass_says_it_all(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with loaded(BY_NAME[name]) as bench:
        long = backwards(bench, SOME)
        monkeypatch.setattr(boundary, "FILM_LENGTH", boundary.FILM_LENGTH / 4)
        monkeypatch.setattr(boundary, "INNER_LENGTHS", tuple(l / 4 for l in boundary.INNER_LENGTHS))
        short = backwards(bench, SOME)
    found = gap(long - short)  # the interior is the same
    assert abs(found.z) < Z_LIMIT, found
    assert found.error < RESOLUTION * abs(long.mean()), found
    assert abs(gap(long[::2], long[1::2]).z) < Z_LIMIT
    share = np.square(long - long.mean())
    assert share.max() < TAIL * share.sum(), long


@pytest.mark.slow
def test_points_may_be_held_closer_to_a_surface(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the interior gives up, edges take over: also at the sides of the triangles that it gives up."""
    with loaded(BY_NAME["indirect_can"]) as bench:
        near, near_inside = (backwards(bench, MANY, boundary=edges) for edges in ("all", "none"))
        monkeypatch.setattr(velocity, "BLEND", velocity.BLEND * 20)
        far, far_inside = (backwards(bench, MANY, boundary=edges) for edges in ("all", "none"))
    found = gap(far - near)
    assert abs(found.z) < Z_LIMIT, found
    assert found.error < RESOLUTION * abs(near.mean()), found
    assert abs(gap(far_inside - near_inside).z) > Z_LIMIT
