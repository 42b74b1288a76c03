"""Problems under a sky: a texture, a camera, an object whose maps and sky are unknown, and a metal."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from ..scenes.parts import SceneDict, sensor
from ..scenes.surfaces import sky
from .problem import Made, Problem, Unknown

_LIMITS = {"max_depth": 4, "rr_depth": 16}
_AROUND = {"west": (-1.0, -4.2, 2.2), "east": (3.6, -2.2, 2.0), "north": (0.6, 4.0, 2.6), "top": (0.0, -1.0, 4.6),
           "far": (-3.4, 1.2, 2.6), "near": (2.0, -3.2, 2.8), "high": (-1.6, 1.6, 3.8)}  # fmt: skip
_TRAIN, _HELD_OUT = ("west", "east", "north", "top", "far"), ("near", "high")


def _views(pixels: int, target: list[float], fov: float) -> dict[str, SceneDict]:
    views = {name: sensor(pixels, list(origin), target, fov) for name, origin in _AROUND.items()}
    for view in views.values():
        view["film"]["pixel_format"] = "rgb"
    return views


def _pattern(rows: int, columns: int, channels: int, low: float, high: float, seed: int) -> np.ndarray:
    """Waves of half a wave to eight waves per edge, whose amplitude falls with their number."""
    random = np.random.default_rng(seed)
    v, u = ((np.mgrid[0:rows, 0:columns] + 0.5) / np.array([rows, columns])[:, None, None]).astype(float)
    total = np.zeros((rows, columns, channels))
    for wave in (0.5, 1, 2, 4, 8):
        angle, phase = random.uniform(0, 2 * np.pi, (2, channels))
        total += (
            np.cos(2 * np.pi * wave * (u[..., None] * np.cos(angle) + v[..., None] * np.sin(angle)) + phase) / wave**0.5
        )
    total = (total - total.min()) / (total.max() - total.min())
    return (low + (high - low) * total).astype(np.float32)


def _map(values: np.ndarray) -> SceneDict:
    return {"type": "bitmap", "data": mi.TensorXf(values), "raw": True}


def _sky() -> SceneDict:
    return {"type": "envmap", "bitmap": mi.Bitmap(sky()), "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 90)}


def _balls() -> dict[str, SceneDict]:
    return {
        name: {"type": "sphere", "center": [x, y, r], "radius": r, "bsdf": bsdf}
        for name, x, y, r, bsdf in (
            ("metal", -0.8, 0.5, 0.5, {"type": "roughconductor", "material": "Al", "alpha": 0.15}),
            ("matt", 0.9, -0.2, 0.35, {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.3, 0.2]}}),
        )
    }


def texture(pixels: int, cells: int) -> Problem:
    """The texture of a floor with two balls on it."""
    floor = {"type": "diffuse", "reflectance": _map(_pattern(cells, cells, 3, 0.1, 0.9, seed=1))}
    ground = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(1.6), "bsdf": floor}
    scene = {"type": "scene", "sky": _sky(), "floor": ground, **_balls(), **_views(pixels, [0, 0, 0], 42)}
    unknowns = {"floor.bsdf.reflectance.data": Unknown(0.5, 0.0, 1.0)}
    return Problem(scene, unknowns, _TRAIN, _HELD_OUT, _LIMITS)


def _placed(first: Any, shift: Any, turn: Any) -> Any:
    """A camera moved by ``shift`` and turned about its target, the origin, by angles about x, y and z in radians."""
    T, degrees = mi.Transform4f, 180 / np.pi
    turned = T()
    for axis in range(3):
        direction = [float(axis == k) for k in range(3)]
        turned = turned @ T().rotate(direction, turn[axis].array * degrees)
    return T().translate(mi.Vector3f(shift[0].array, shift[1].array, shift[2].array)) @ turned @ first


def _second(first: Any, shift: Any, turn: Any) -> Any:
    """The other camera of the rig: its place in the scene is that of the first, and it looks 15 degrees aside."""
    return _placed(first, shift, turn) @ mi.Transform4f().rotate([0, 1, 0], 15)


def _widened(first: Any, fov: Any) -> Any:
    return type(first)(first + fov[0].array)


def camera(pixels: int, cells: int) -> Problem:
    """Three shifts, three angles and the field of view of a camera; the second camera of a rig is held out.

    The true shifts and angles are zero, and the true field of view is that in the scene.
    """
    floor = {"type": "diffuse", "reflectance": _map(_pattern(64, 64, 3, 0.1, 0.9, seed=1))}
    ground = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(1.6), "bsdf": floor}
    view = _views(pixels, [0, 0, 0.2], 40)["west"]
    aside = {**view, "to_world": view["to_world"] @ mi.ScalarTransform4f().rotate([0, 1, 0], 15)}
    scene = {"type": "scene", "sky": _sky(), "floor": ground, **_balls(), "camera": view, "second": aside}
    unknowns = {
        "shift": Unknown((0.25, -0.2, 0.15), -1.0, 1.0, (3,)),
        "turn": Unknown((0.08, -0.06, 0.1), -0.5, 0.5, (3,)),
        "fov": Unknown((4.0,), -20.0, 20.0, (1,)),
    }
    pose, wide = ("shift", "turn"), ("fov",)
    return Problem(
        scene, unknowns, ("camera",), ("second",), _LIMITS,
        derived={"camera.to_world": Made(_placed, pose), "camera.x_fov": Made(_widened, wide)},
        derived_held_out={"second.to_world": Made(_placed, pose), "second.x_fov": Made(_widened, wide)},
    )  # fmt: skip


def object_under_sky(pixels: int, cells: int) -> Problem:
    """Albedo and roughness maps of a ball on a grey floor, and an environment map of 8 x 16 pixels."""
    half = cells // 2
    bsdf = {
        "type": "principled",
        "base_color": _map(_pattern(half, cells, 3, 0.1, 0.9, seed=2)),
        "roughness": _map(_pattern(half, cells, 1, 0.15, 0.7, seed=3)),
        "specular": 0.6,
    }
    sphere = {"type": "sphere", "center": [0, 0, 1], "bsdf": bsdf}
    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.4}}
    ground = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3), "bsdf": grey}
    light = sky().reshape(8, 8, 16, 8, 3).mean((1, 3))
    around = {"type": "envmap", "bitmap": mi.Bitmap(light), "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 90)}
    scene = {"type": "scene", "sky": around, "ball": sphere, "floor": ground, **_views(pixels, [0, 0, 0.9], 32)}
    unknowns = {
        "ball.bsdf.base_color.data": Unknown(0.5, 0.0, 1.0),
        "ball.bsdf.roughness.data": Unknown(0.4, 0.05, 1.05),
        "sky.data": Unknown(0.5, 0.0, 4.0),
    }
    return Problem(scene, unknowns, _TRAIN, _HELD_OUT, _LIMITS)


def metal(pixels: int, cells: int) -> Problem:
    """`principled` fitted to copper (Mitsuba's measured indices, microfacets of roughness 0.3): it is another model.

    So the error has a floor above zero. The unknowns are the base colour and the roughness.
    """
    around = {"sky": _sky(), **_views(pixels, [0, 0, 0], 30)}
    fit = {
        "type": "principled",
        "base_color": {"type": "rgb", "value": 0.5},
        "metallic": 1.0,
        "roughness": 0.7,
    }
    copper = {"type": "roughconductor", "material": "Cu", "distribution": "ggx", "alpha": 0.3}
    scene = {"type": "scene", "ball": {"type": "sphere", "bsdf": fit}, **around}
    truth = {"type": "scene", "ball": {"type": "sphere", "bsdf": copper}, **around}
    unknowns = {
        "ball.bsdf.base_color.value": Unknown(0.5, 0.0, 1.0),
        "ball.bsdf.roughness.value": Unknown(0.7, 0.05, 1.05),
    }
    return Problem(scene, unknowns, _TRAIN, _HELD_OUT, _LIMITS, seen=truth)
