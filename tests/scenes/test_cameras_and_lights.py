"""What Mitsuba marks as not differentiable and pathreplay reaches (cameras, lenses, lights that move) is right."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from pathreplay.errors import PathreplayError
from pathreplay.scenes.parameters import carries_derivative, require_differentiable, resolve_differentiable
from pathreplay.testing import check_gradient
from pathreplay.testing.command import check_all


@pytest.fixture(scope="module")
def scene() -> Any:
    """A painted floor that fills the view: nothing in it has an edge."""
    T = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    view = T().look_at([0.6, -0.4, 3], [0, 0, 0], [0, 1, 0])
    x, y = np.meshgrid(np.linspace(0, 1, 48), np.linspace(0, 1, 48))
    paint = np.stack([0.5 + 0.3 * np.cos(11 * x + k) * np.sin(9 * y + 2 * k) for k in range(3)], axis=2)
    sky = np.stack([0.3 + 0.2 * np.cos(6 * x + k) * np.sin(3 * y) for k in range(3)], axis=2)
    return mi.load_dict(
        {
            "type": "scene",
            "lens": {
                "type": "thinlens", "to_world": view, "fov": 40, "aperture_radius": 0.5, "focus_distance": 2,
                "film": film,
            },
            "pinhole": {"type": "perspective", "to_world": view, "fov": 40, "film": film},
            "floor": {
                "type": "rectangle",
                "to_world": T().scale(6),
                "bsdf": {
                    "type": "diffuse",
                    "reflectance": {
                        "type": "bitmap", "bitmap": mi.Bitmap(paint.astype(np.float32)), "raw": True,
                        "to_uv": T().scale(6),
                    },
                },
            },
            "bulb": {"type": "point", "position": [0.5, 0.3, 1.5], "intensity": {"type": "rgb", "value": [3, 4, 2]}},
            "spot": {"type": "spot", "to_world": T().look_at([-1, 0.3, 2], [0, 0, 0], [0, 1, 0]), "cutoff_angle": 70},
            "sun": {"type": "directional", "to_world": T().look_at([1, 0.5, 2], [0, 0, 0], [0, 1, 0])},
            "sky": {
                "type": "envmap", "bitmap": mi.Bitmap(sky.astype(np.float32)), "to_world": T().rotate([1, 0, 0], 90),
            },
        },
        optimize=False,
    )  # fmt: skip


MOTION = [
    ("pinhole.to_world", 1),
    ("pinhole.x_fov", 1),
    ("pinhole.principal_point_offset_x", 1),
    ("pinhole.principal_point_offset_y", 1),
    ("lens.to_world", 0),
    ("lens.x_fov", 0),
    ("lens.aperture_radius", 0),
    ("lens.focus_distance", 0),
    ("bulb.position", 1),
    ("spot.to_world", 1),
    ("sun.to_world", 1),
    ("sky.to_world", 1),
]


# What these do to the picture is too little for finite differences to resolve at a test's number of samples.
UNRESOLVED = {"pinhole.principal_point_offset_y", "lens.aperture_radius", "lens.focus_distance"}


@pytest.mark.parametrize(("key", "sensor"), [motion for motion in MOTION if motion[0] not in UNRESOLVED])
def test_the_gradient_agrees_with_finite_differences(scene: Any, key: str, sensor: int) -> None:
    # What the lens blurs averages out over a picture: little gradient, many samples.
    spp = 8192 if key in ("lens.aperture_radius", "lens.focus_distance") else 512
    interior = {"type": "pathreplay", "max_depth": 2, "boundary": "none"}  # nothing else is in view
    result = check_gradient(scene, key, integrator=interior, sensor=sensor, seeds=6, spp=spp)
    assert result.verdict == "pass", str(result)
    if key in ("sun.to_world", "sky.to_world"):
        assert "rotation" in result.direction  # no translation moves what is infinitely far away


def test_other_integrators_are_told_who_can(scene: Any) -> None:
    params = mi.traverse(scene)
    for integrator in ({"type": "prb"}, {"type": "pathreplay", "attach": "none"}, None):
        plugin = None if integrator is None else mi.load_dict(integrator)
        for key, _ in MOTION:
            assert not carries_derivative(params, key, plugin)
            with pytest.raises(PathreplayError, match="only 'pathreplay' differentiates cameras"):
                require_differentiable(params, key, plugin)
    with pytest.raises(PathreplayError, match="only 'pathreplay'"):
        list(check_all(scene, ["bulb.position"], integrator="prb"))


def test_a_glob_takes_cameras_for_pathreplay_only(scene: Any) -> None:
    params = mi.traverse(scene)
    assert resolve_differentiable(params, "*.to_world") == ["floor.to_world"]
    ours = mi.load_dict({"type": "pathreplay"})
    assert len(resolve_differentiable(params, "*.to_world", ours)) == 6
