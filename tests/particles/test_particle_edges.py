"""Moving edges that light paths meet: how much of the derivative the gradient leaves out."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest
from test_particle_gradients import OWN, Mean, in_expectation, mean

from particle_scenes import slab
from pathreplay.testing.verdict import Z_LIMIT
from truth import translate

SEEDS = 12


def with_ball(center: list[float], radius: float, bsdf: dict, **parts: dict) -> dict:
    """The slab that casts a caustic, and a ball."""
    ball = {"type": "sphere", "center": center, "radius": radius, "bsdf": bsdf}
    return {**slab(), **parts, "ball": ball}


def lens() -> dict:
    """A ball of glass in the light, in place of the slab."""
    scene = with_ball([0, 0, 0], 0.3, {"type": "dielectric"})
    del scene["top"], scene["bottom"]
    return scene


BLACK = {"type": "diffuse", "reflectance": 0.0}
SIDEWAYS = translate(0.3, 0.7, 0)
ball: Callable[..., Mean] = partial(mean, move=SIDEWAYS, depth=6, spp=1024, step=2e-2, **OWN)
MISSING = (
    ball("blocker in the caustic", lambda: with_ball([0.1, 0.1, -1.2], 0.12, BLACK), "ball.to_world"),
    ball("blocker before the slab", lambda: with_ball([0.1, 0.1, 1.2], 0.12, BLACK), "ball.to_world"),
    ball("blocker before the camera", lambda: with_ball([1.2, 0.05, -1.35], 0.12, BLACK), "ball.to_world"),
)
GRAZED = ball("outline of a glass ball", lens, "ball.to_world")


@pytest.mark.slow
@pytest.mark.parametrize("cell", MISSING, ids=lambda c: c.name)
def test_table_of_edges_that_light_paths_leave_out(cell: Mean) -> None:
    z, _ = in_expectation(cell, SEEDS)
    assert abs(z) > Z_LIMIT, "this edge is in the gradient now: move the cell, and the row of docs/particles.md"


@pytest.mark.slow
def test_the_outline_of_smooth_glass_is_no_edge() -> None:
    """Light that grazes glass is reflected forwards, so that it continues as if it had missed the glass."""
    z, _ = in_expectation(GRAZED, SEEDS)
    assert abs(z) < Z_LIMIT
