"""Problems indoors: lamps and materials of a Cornell box, a pane of glass, a mesh seen by its outline and shadow."""

from __future__ import annotations

import mitsuba as mi

from pathreplay.scenes import builtin
from pathreplay.scenes.bodies import ball

from ..scenes.parts import SceneDict, sensor
from .problem import Problem, Unknown


def _view(pixels: int, origin: list[float], target: list[float], fov: float) -> SceneDict:
    view = sensor(pixels, origin, target, fov, up=(0, 1, 0))
    view["film"]["pixel_format"] = "rgb"
    return view


def room(pixels: int, cells: int) -> Problem:
    """The Cornell box with two lamps of different colours and four materials: eighteen numbers."""
    scene: SceneDict = mi.cornell_box()
    del scene["sensor"]
    T = mi.ScalarTransform4f
    lamp = scene.pop("light")
    for name, x, radiance in (("left-lamp", -0.5, [18.0, 12.0, 6.0]), ("right-lamp", 0.5, [5.0, 9.0, 16.0])):
        place = T().translate([x, 0.99, 0.01]).rotate([1, 0, 0], 90).scale([0.2, 0.2, 0.2])
        glow = {"type": "area", "radiance": {"type": "rgb", "value": radiance}}
        scene[name] = {**lamp, "to_world": place, "emitter": glow}
    colours = {"white": [0.85, 0.8, 0.7], "red": [0.6, 0.07, 0.05], "green": [0.1, 0.4, 0.08], "blue": [0.1, 0.2, 0.6]}
    for name, colour in colours.items():
        scene[name] = {"type": "diffuse", "reflectance": {"type": "rgb", "value": colour}}
    scene["large-box"]["bsdf"] = {"type": "ref", "id": "blue"}
    # References are resolved in order, so materials come first.
    scene = {
        "type": "scene",
        **{name: scene.pop(name) for name in colours},
        **{k: v for k, v in scene.items() if k != "type"},
    }
    for name, origin, target, fov in (
        ("front", [0.0, 0.0, 3.9], [0.0, 0.0, 0.0], 39.0),
        ("left-side", [-0.7, 0.3, 1.6], [0.3, -0.3, -0.3], 70.0),
        ("high", [0.5, 0.8, 1.5], [0.0, -0.6, -0.2], 60.0),
        ("right-side", [0.8, -0.3, 1.3], [-0.4, 0.2, -0.4], 70.0),
    ):
        scene[name] = _view(pixels, origin, target, fov)
    return Problem(
        scene,
        {f"{name}.reflectance.value": Unknown(0.5, 0.0, 1.0) for name in colours}
        | {f"{name}.emitter.radiance.value": Unknown(5.0, 0.0, 30.0) for name in ("left-lamp", "right-lamp")},
        ("front", "left-side"),
        ("high", "right-side"),
        {"max_depth": 6, "rr_depth": 16},
    )


def glass(pixels: int, cells: int) -> Problem:
    """The built-in `glass-pane`: index and normal map of an uneven pane. Its `dielectric_ad` serves all loops."""
    scene = builtin.glass_pane(pixels, texture=12)
    scene["low"] = _view(pixels, [0.6, -1.3, 2.5], [0, 0, 0], 44)
    scene["high"] = _view(pixels, [-1.6, 1.0, 2.2], [0, 0, 0], 42)
    return Problem(
        scene,
        {"glass.eta": Unknown(1.4, 1.05, 2.05), "front_face.bsdf.normalmap.data": Unknown((0.5, 0.5, 1.0), 0.0, 1.0)},
        ("front", "left", "right"),
        ("low", "high"),
        {"max_depth": 5, "rr_depth": 16},
        target_paths=2**22,
    )


def mesh(pixels: int, cells: int) -> Problem:
    """The built-in `shadows`: a black body, from a sphere with as many vertices."""
    names = [f"view{n + 1}" for n in range(6)]
    return Problem(
        builtin.shadows(pixels, views=6),
        {"body.vertex_positions": Unknown((0.3 * ball(4)[0]).ravel(), -0.5, 0.5, large_steps=20.0)},
        tuple(names[:2] + names[3:5]),
        (names[2], names[5]),
        {"max_depth": 2, "rr_depth": 16},
    )
