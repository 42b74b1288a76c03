"""Lights that the camera sees: which are found, and which are not."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from pathreplay.integrators.film.lights import SeenLights
from variant import VARIANT


def lamp(x: float, y: float, z: float, size: float = 0.02, turned: bool = False) -> dict[str, Any]:
    place = mi.ScalarTransform4f().translate([x, y, z])
    place = place.rotate([0, 1, 0], 180) if turned else place
    return {"type": "rectangle", "to_world": place.scale(size), "emitter": {"type": "area"}}


def with_a_sun() -> dict[str, Any]:
    texels = np.full((32, 64, 3), 0.3, np.float32)
    texels[16, 0] = 1e4  # in front of the camera
    return {"type": "envmap", "bitmap": mi.Bitmap(texels)}


FOG = {
    "type": "sphere",
    "radius": 1.5,
    "bsdf": {"type": "null"},
    "interior": {"type": "homogeneous", "sigma_t": 0.5},
}
SCENES: dict[str, Any] = {
    "lamp": (lambda: {"lamp": lamp(0, 0, 0)}, "shape"),
    "one of many lamps": (
        lambda: {**{f"lamp{i}": lamp(i, 0, 50) for i in range(1500)}, "seen": lamp(0, 0, 0)},
        "shape",
    ),
    "back of a lamp": (lambda: {"lamp": lamp(0, 0, 0, 0.5, turned=True)}, ""),
    "lamp in a fog": (lambda: {"lamp": lamp(0, 0, 0), "fog": FOG}, "shape"),
    "hidden lamp": (lambda: {"lamp": lamp(0, 0, 0), "wall": {"type": "sphere", "radius": 0.5}}, ""),
    "sun": (lambda: {"sky": with_a_sun()}, "sky"),
    "sun over a large floor": (
        lambda: {
            "sky": with_a_sun(),
            "floor": {
                "type": "disk",
                "to_world": mi.ScalarTransform4f().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(8e3),
            },
        },
        "sky",
    ),
    "even sky": (lambda: {"sky": {"type": "constant"}}, ""),
    "even sky beside weak lamps": (
        lambda: {
            "sky": {"type": "constant"},
            **{f"lamp{i}": lamp(i, 0, 50) | {"emitter": {"type": "area", "sampling_weight": 1e-3}} for i in range(30)},
        },
        "",
    ),
    "directions": (lambda: {f"sun{i}": {"type": "directional", "direction": [0, 0.01 * i, 1]} for i in range(4)}, ""),
    "nothing": (lambda: {}, ""),
}


def camera(kind: str) -> dict[str, Any]:
    made = {"type": kind, "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])}
    return made | ({} if kind == "orthographic" else {"fov": 40})


@pytest.mark.parametrize("kind", ["perspective", "thinlens", "orthographic"])
@pytest.mark.parametrize("name", SCENES)
def test_lights_are_found(name: str, kind: str) -> None:
    mi.set_variant(VARIANT)
    make, expected = SCENES[name]
    lens = {"aperture_radius": 0.01, "focus_distance": 4.0} if kind == "thinlens" else {}
    scene = mi.load_dict({"type": "scene", "camera": camera(kind) | lens, **make()})
    trace = mi.load_dict({"type": "pathreplay"})._trace_config(scene, scene.sensors()[0])
    seen = SeenLights.of(trace, scene.sensors()[0])
    found = {"sky": bool(dr.any(seen.sky)), "shape": bool(dr.any(seen.shape))}
    if kind == "orthographic":  # it sees a single point of the sky
        found["sky"] = expected == "sky" and not found["sky"]
    assert found == {which: which == expected for which in found}
