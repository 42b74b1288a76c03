"""Edges seen by an irradiance meter, of which each pixel sees the whole scene."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from pathreplay.testing.objective import Objective
from variant import VARIANT

HEIGHT = 0.5


@pytest.mark.parametrize("radius", [0.3, 0.05])
def test_the_shadow_of_a_ball_on_a_meter(radius: float) -> None:
    """At a point of the meter, the ball blocks the irradiance π r² cos / d², for distance d and angle to the normal.

    The mean of cos / d² over a square is its solid angle, seen from the ball, divided by its area.
    """
    mi.set_variant(VARIANT)
    meter = {"type": "irradiancemeter", "film": {"type": "hdrfilm", "width": 1, "height": 1}}
    meter["film"]["rfilter"] = {"type": "box"}
    black = {"type": "diffuse", "reflectance": 0.0}
    ball = {"type": "sphere", "to_world": mi.ScalarTransform4f().translate([0, 0, HEIGHT]).scale(radius), "bsdf": black}
    scene = {"type": "scene", "sky": {"type": "constant"}, "floor": {"type": "rectangle", "meter": meter}, "ball": ball}
    loaded = mi.load_dict(scene, optimize=False)
    grow = lambda value, t: mi.Transform4f(value) @ mi.Transform4f().scale(1 + t)  # noqa: E731
    objective = Objective(loaded, mi.traverse(loaded), "ball.to_world", grow)
    objective.weigh(np.full((1, 1, 3), 1 / 3))
    integrator = mi.load_dict({"type": "pathreplay", "max_depth": 2, "boundary": "primary"})
    found = np.array([objective.backward(integrator, seed, 1 << 14) for seed in range(16)])
    objective.put(dr.opaque(mi.Float, 0))
    expected = -2 * np.pi * radius**2 * np.arcsin(1 / (1 + HEIGHT**2))
    error = found.std() / len(found) ** 0.5
    assert error < 0.1 * abs(expected) and abs(found.mean() - expected) < 3 * error, (found.mean(), error, expected)
