"""Values at which Mitsuba leaves out a lobe of a BSDF: gradients lack the lobe there, and steps would end there."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import pathreplay
from pathreplay import Parameter, Problem, View
from pathreplay.integrators.scene_facts import facts_of
from variant import VARIANT

KEY = "ball.bsdf.{}.value"
#: BSDF, parameter, and the end at which it starts.
CASES: dict[str, tuple[dict[str, Any], str, float]] = {
    "metallic": ({"type": "principled", "roughness": 0.4}, "metallic", 1),
    "spec_trans": ({"type": "principled", "roughness": 0.4}, "spec_trans", 1),
    "clearcoat": ({"type": "principled", "clearcoat_gloss": 0.2}, "clearcoat", 0),
    "sheen": ({"type": "principled"}, "sheen", 0),
    "opacity": ({"type": "mask", "nested": {"type": "diffuse"}}, "opacity", 1),
    "weight": ({"type": "blendbsdf", "one": {"type": "diffuse"}, "two": {"type": "roughconductor"}}, "weight", 0),
}


def ball(bsdf: dict[str, Any], name: str, value: float) -> mi.Scene:
    place = mi.ScalarTransform4f().look_at([0, 1, -4], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 8, "height": 8, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    ground = mi.ScalarTransform4f().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(4)
    return mi.load_dict({
        "type": "scene",
        "sensor": {"type": "perspective", "to_world": place, "film": film},
        "ground": {"type": "rectangle", "to_world": ground},
        "ball": {"type": "sphere", "bsdf": {**bsdf, name: float(value)}},
        "sky": {"type": "constant"},
    })  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_values_leave_the_end_at_which_they_start(case: str) -> None:
    """The truth is .5. A gradient at the end itself is zero, or points away."""
    mi.set_variant(VARIANT)
    bsdf, name, end = CASES[case]
    photo = mi.render(ball(bsdf, name, 0.5), integrator=mi.load_dict({"type": "path"}), spp=64)
    parameter = Parameter(initial=end, bounds=(0, 1), learning_rate=0.05)
    problem = Problem(ball(bsdf, name, end), {KEY.format(name): parameter}, View(target=photo), spp=8)
    result = pathreplay.minimize(problem, steps=15, progress=False).values[KEY.format(name)]
    assert abs(result[0] - end) > 0.1


def test_other_ends_and_bounds_stay() -> None:
    mi.set_variant(VARIANT)

    def start(name: str, initial: float, bounds: tuple[float, float]) -> float:
        scene = ball({"type": "principled"}, name, 0.5)
        wanted = {KEY.format(name): Parameter(initial=initial, bounds=bounds)}
        problem = Problem(scene, wanted, View(target=np.zeros((8, 8, 3), np.float32)))
        return float(problem.initial[KEY.format(name)][0])

    assert start("metallic", 0, (0, 1)) == 0 and start("flatness", 1, (0, 1)) == 1
    assert start("metallic", 1, (0, 1)) == np.float32(0.999)
    assert start("metallic", 1, (0.9995, 1)) == 1  # nothing else is allowed


def test_a_texture_with_several_uses_keeps_to_all_of_its_ranges() -> None:
    mi.set_variant(VARIANT)
    grey = mi.load_dict({"type": "uniform", "value": 0.5})
    scene = ball({"type": "principled", "metallic": grey, "clearcoat": grey, "roughness": grey}, "sheen", 0.5)
    ranges = facts_of(scene).ranges()
    assert ranges[grey] == (0.001, 0.999) and len(ranges) == 3
    assert facts_of(ball({"type": "plastic", "diffuse_reflectance": grey}, "specular_reflectance", 0)).ranges() == {}
