"""The measured scenes without media: Cornell boxes, a sealed box, and metal balls in several kinds of light."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import mitsuba as mi
import numpy as np

from .parts import SceneDict, sensor


def _texture(size: int, low: float, high: float) -> SceneDict:
    """A texture of random texels between ``low`` and ``high``. All differ, so that errors cannot cancel by symmetry."""
    texels = np.random.default_rng(0).uniform(low, high, (size, size, 3)).astype(np.float32)
    return {"type": "bitmap", "data": mi.TensorXf(texels), "raw": True}


def cornell_box(resolution: int) -> SceneDict:
    """Mitsuba's Cornell box with a texture on its back wall. Key: ``back.bsdf.reflectance.data``."""
    scene: SceneDict = mi.cornell_box()
    scene["sensor"]["film"] |= {"width": resolution, "height": resolution}
    scene["back"]["bsdf"] = {"type": "diffuse", "reflectance": _texture(64, 0.1, 0.9)}
    return scene


def glass_and_diffuse(resolution: int) -> SceneDict:
    """Mitsuba's Cornell box with a textured back wall and a glass ball instead of the large box.

    Keys: ``back.bsdf.reflectance.data``, ``ball.to_world``.
    """
    scene = cornell_box(resolution)
    del scene["large-box"]
    place = mi.ScalarTransform4f().translate([-0.35, -0.55, -0.2]).scale(0.4)
    scene["ball"] = {"type": "sphere", "to_world": place, "bsdf": {"type": "dielectric"}}
    return scene


def glossy_environment(resolution: int) -> SceneDict:
    """Rough metal balls on a glossy textured floor under an environment. Key: ``floor.bsdf.base_color.data``."""
    T = mi.ScalarTransform4f
    floor = {"type": "principled", "base_color": _texture(64, 0.1, 0.9), "roughness": 0.3, "specular": 0.6}
    scene: SceneDict = {
        "type": "scene",
        "sensor": sensor(resolution, [0, -4.5, 2.2], [0, 0, 0.4], fov=40),
        "floor": {"type": "rectangle", "to_world": T().scale(3), "bsdf": floor},
        "environment": {"type": "envmap", "bitmap": mi.Bitmap(sky()), "to_world": T().rotate([1, 0, 0], 90)},
    }
    for name, x, alpha in (("left", -1.1, 0.05), ("middle", 0.0, 0.15), ("right", 1.1, 0.3)):
        scene[name] = {
            "type": "sphere",
            "center": [x, 0, 0.5],
            "radius": 0.5,
            "bsdf": {"type": "roughconductor", "material": "Al", "distribution": "ggx", "alpha": alpha},
        }
    return scene


def metal_ball(light: str, alpha: float, resolution: int) -> SceneDict:
    """A ball of rough metal on a floor, under a ``sky`` or a ``lamp``, or in a Cornell box (``room``).

    Key: ``ball.bsdf.alpha.value``.
    """
    T = mi.ScalarTransform4f
    metal = {"type": "roughconductor", "material": "Al", "distribution": "ggx", "alpha": alpha}
    if light == "room":
        scene = _boxed(glass_and_diffuse)(resolution)
        scene["ball"]["bsdf"] = metal
        return scene
    lights: dict[str, SceneDict] = {
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(sky()), "to_world": T().rotate([1, 0, 0], 90)},
        "lamp": {
            "type": "rectangle",
            "to_world": T().look_at(origin=[-2, -3, 4], target=[0, 0, 0.5], up=[0, 0, 1]).scale(0.7),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 10.0}},
        },
    }
    return {
        "type": "scene",
        "sensor": sensor(resolution, [0, -3, 1.5], [0, 0, 0.4], fov=30),
        "floor": {"type": "rectangle", "to_world": T().scale(3), "bsdf": {"type": "diffuse"}},
        "ball": {"type": "sphere", "center": [0, 0, 0.5], "radius": 0.5, "bsdf": metal},
        light: lights[light],
    }


def sky() -> np.ndarray:
    """A bluish sky over a dark ground with a warm sun of about 15 degrees, 32 times as bright as the sky."""
    v, u = np.mgrid[0:64, 0:128].astype(np.float32)
    v, u = (v + 0.5) / 64, (u + 0.5) / 128
    sky = np.where(v < 0.5, 0.4 + 0.6 * v, 0.15)[..., None] * np.array([0.7, 0.85, 1.0])
    sun = 32 * np.exp(-((v - 0.25) ** 2 + (2 * (u - 0.7)) ** 2) / 0.002)[..., None] * np.array([1.0, 0.8, 0.6])
    return (sky + sun).astype(np.float32)


def closed_box(resolution: int) -> SceneDict:
    """A sealed white box seen from inside, with a small light and a glass ball. No path leaves, and few are absorbed.

    The walls reflect 0.999. Without Russian roulette, a path is therefore as long as ``max_depth`` allows. Keys:
    ``box.bsdf.reflectance.data``, ``ball.to_world``.
    """
    T = mi.ScalarTransform4f
    white = {"type": "diffuse", "reflectance": _texture(16, 0.999, 0.9991)}
    return {
        "type": "scene",
        "sensor": sensor(resolution, [0, -0.9, 0], [0, 1, 0], fov=60),
        "box": {"type": "cube", "flip_normals": True, "bsdf": white},
        "ball": {
            "type": "sphere",
            "to_world": T().translate([0.4, 0.3, -0.5]).scale(0.3),
            "bsdf": {"type": "dielectric"},
        },
        "lamp": {
            "type": "rectangle",
            "to_world": T().translate([0, 0, 0.98]).rotate([1, 0, 0], 180).scale(0.2),
            # Two sides: the upper one of a diffuse lamp would absorb the paths that get above it.
            "bsdf": {
                "type": "twosided",
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.999}},
            },
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1.0}},
        },
    }


def _boxed(make: Callable[[int], SceneDict]) -> Callable[[int], SceneDict]:
    """Return a function that makes the scene with a box filter; Mitsuba's Cornell box has a Gaussian filter."""

    def boxed(resolution: int) -> SceneDict:
        scene = make(resolution)
        scene["sensor"]["film"] |= {"rfilter": {"type": "box"}}
        return scene

    return boxed


ROUGHNESSES, LIGHTS = (0.05, 0.1, 0.3), ("sky", "lamp", "room")

METAL_SCENES: dict[str, Callable[[int], SceneDict]] = {
    f"{light}, {alpha:g}": partial(metal_ball, light, alpha) for light in LIGHTS for alpha in ROUGHNESSES
}

SURFACE_SCENES: dict[str, Callable[[int], SceneDict]] = {
    "cornell-box": cornell_box,
    "cornell-box, box filter": _boxed(cornell_box),
    "glossy-environment": glossy_environment,
    "glass-and-diffuse": glass_and_diffuse,
    "glass-and-diffuse, box filter": _boxed(glass_and_diffuse),
    "closed-box": closed_box,
}
