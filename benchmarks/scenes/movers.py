"""Realistic scenes in which one number moves something: a head, its shadow, a camera, or objects behind glass.

The head is a closed, smooth-shaded mesh that occludes itself: a bumpy ball with ears, eyes and a snout.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .edges import ball_with_bumps, mesh_of
from .parts import SceneDict, sensor

HEAD, FIELD = 2000, 24
"""Number of vertices of the head's ball, and along each side of the height field."""
Move = Callable[..., Any]
"""(value, number) -> the value, moved by the number."""


@dataclass(frozen=True)
class Mover:
    """A function from the resolution to a scene, and the motion of the scene's parameter in task `edges`."""

    scene: Callable[[int], SceneDict]
    move: Move
    step: float = 0.02  # of finite differences


def T() -> Any:
    """Return the identity transform of the active variant."""
    return mi.ScalarTransform4f()


# ------------------------------ Moves ------------------------------


def _slide(x: float, y: float, z: float) -> Move:
    return lambda value, t: mi.Transform4f().translate([x * t, y * t, z * t]) @ mi.Transform4f(value)


def _turn(value: Any, t: mi.Float) -> Any:
    return mi.Transform4f(value) @ mi.Transform4f().rotate([0.3, 1, 0], dr.rad2deg(t))


def _go_around(value: Any, t: mi.Float) -> Any:
    return mi.Transform4f().rotate([0.3, 1, 0], dr.rad2deg(t)) @ mi.Transform4f(value)


def _turn_vertices(value: Any, t: mi.Float) -> Any:
    return dr.ravel(mi.Transform4f().rotate([0.3, 1, 0], dr.rad2deg(t)) @ dr.unravel(mi.Point3f, value))


def _slide_vertices(value: Any, t: mi.Float) -> Any:
    return dr.ravel(mi.Transform4f().translate([t, 0.3 * t, 0]) @ dr.unravel(mi.Point3f, value))


def _rise(value: Any, t: mi.Float) -> Any:
    """Scale all heights by 1 + t."""
    p = dr.unravel(mi.Point3f, value)
    return dr.ravel(mi.Point3f(p.x, p.y, p.z * (1 + t)))


def _widen(value: Any, t: mi.Float) -> Any:
    """Increase a field of view by 50 t degrees."""
    return value + 50 * t


# ------------------------------ Parts ------------------------------


def _paint(*value: float) -> SceneDict:
    return {"type": "twosided", "inner": {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(value)}}}


CLAY = _paint(0.6, 0.4, 0.3)
SKY = {"type": "constant", "radiance": {"type": "rgb", "value": [0.8, 0.8, 0.8]}}


def _texture(low: float, high: float) -> SceneDict:
    texels = np.random.default_rng(3).uniform(low, high, (8, 8, 3)).astype(np.float32)
    return {"type": "bitmap", "raw": True, "data": mi.TensorXf(texels), "wrap_mode": "clamp"}


def _environment() -> SceneDict:
    """An environment map of random radiance, with a sun."""
    texels = np.random.default_rng(5).uniform(0.1, 1, (16, 32, 3)).astype(np.float32)
    texels[4:6, 20:22] = 20
    return {"type": "envmap", "bitmap": mi.Bitmap(texels)}


def _wall(z: float = -1.0) -> SceneDict:
    bsdf = {"type": "diffuse", "reflectance": _texture(0.2, 0.9)}
    return {"type": "rectangle", "to_world": T().translate([0, 0, z]).scale([3, 3, 1]), "bsdf": bsdf}


def _lamp(size: float = 0.4) -> SceneDict:
    glow = {"type": "area", "radiance": {"type": "rgb", "value": [12.0, 10.0, 8.0]}}
    place = T().look_at([1.6, 2.2, 2.0], [0, 0, -0.5], [0, 1, 0]).scale(size)
    return {"type": "rectangle", "to_world": place, "bsdf": _paint(0, 0, 0), "emitter": glow}


def _floor(size: float = 3.0) -> SceneDict:
    place = T().translate([0, -0.5, 0]).rotate([1, 0, 0], -90).scale(size)
    return {"type": "rectangle", "to_world": place, "bsdf": _paint(0.5, 0.5, 0.6)}


def _ball(at: list[float], radius: float, bsdf: SceneDict = CLAY) -> SceneDict:
    return {"type": "sphere", "to_world": T().translate(at).scale(radius), "bsdf": bsdf}


def _box() -> SceneDict:
    return {"type": "cube", "to_world": T().translate([0.1, 0, 0.1]).rotate([1, 0.4, 0], 30).scale(0.45), "bsdf": CLAY}


def _head(at: list[float], size: float) -> mi.Mesh:
    """A bumpy ball with cup-shaped ears and spherical eyes in sockets."""
    parts = [
        ball_with_bumps(
            HEAD, ((0, -0.4, 1), 0.4, 0.15), ((-0.35, 0.25, 0.9), -0.2, 0.05), ((0.35, 0.25, 0.9), -0.2, 0.05)
        )
    ]
    for side in (-1.0, 1.0):
        eye, faces = ball_with_bumps(HEAD // 10)
        parts.append((0.2 * eye + np.array([0.3 * side, 0.22, 0.72]), faces))
        parts.append(_ear(side))
    counts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    vertices = np.concatenate([vertices for vertices, _ in parts])
    faces = np.concatenate([faces + begin for (_, faces), begin in zip(parts, counts, strict=False)])
    return mesh_of(vertices, faces, at, size, CLAY["inner"], flat=False)


def _ear(side: float) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of a flattened, bent ball: a thin cup that opens to the front."""
    ball, faces = ball_with_bumps(HEAD // 4)
    x, y, z = ball.T
    flat = np.stack([0.5 * x + 1.2 * side, 0.5 * y + 0.35, 0.08 * z + 0.9 * (0.25 * (x * x + y * y)) - 0.1], 1)
    return flat, faces


def _heights() -> mi.Mesh:
    """Hills over the square [-1, 1]²."""
    at = np.linspace(-1, 1, FIELD)
    x, y = (axis.ravel() for axis in np.meshgrid(at, at))
    z = 0.25 * np.sin(5 * x) * np.cos(4 * y) + 0.1 * np.sin(9 * y + 2 * x)
    i = np.arange(FIELD * (FIELD - 1)).reshape(FIELD - 1, FIELD)[:, :-1].ravel()
    right, above = i + 1, i + FIELD
    faces = np.concatenate([np.stack([i, right, above + 1], 1), np.stack([i, above + 1, above], 1)])
    return mesh_of(np.stack([x, y, z], 1), faces, [0, 0, 0], 1.2, CLAY["inner"], flat=False)


def _scene(
    camera: Callable[[int], SceneDict] | None = None, /, **parts: Callable[[], Any]
) -> Callable[[int], SceneDict]:
    """Return a function from the resolution to a scene, which creates new parts for each scene."""
    camera = camera or (lambda n: sensor(n, [0, 0, 4], [0, 0, 0], 40, up=(0, 1, 0)))
    return lambda n: {"type": "scene", "camera": camera(n), **{name: make() for name, make in parts.items()}}


def _parallel(n: int) -> SceneDict:
    seen = sensor(n, [0, 0, 4], [0, 0, 0], 40, up=(0, 1, 0))
    del seen["fov"]
    return seen | {"type": "orthographic", "to_world": seen["to_world"] @ T().scale([1.3, 1.3, 1])}


def _close(n: int) -> SceneDict:
    return sensor(n, [0, 0, 4], [0, 0, 0], 30, up=(0, 1, 0))


def _aslant(n: int) -> SceneDict:
    return sensor(n, [0, -2.5, 3], [0, 0, 0], 40, up=(0, 1, 0))


def _above(n: int) -> SceneDict:
    return sensor(n, [0, 1.2, 3.5], [0, -0.2, 0], 40, up=(0, 1, 0))


_mesh_and_ball: dict[str, Callable[[], Any]] = {
    "wall": _wall,
    "object": lambda: _head([-0.5, 0, 0], 0.45),
    "ball": lambda: _ball([0.7, -0.2, 0.2], 0.4),
    "lamp": _lamp,
}


def _rough_glass() -> SceneDict:
    glass = {"type": "roughdielectric", "alpha": 0.15, "int_ior": 1.5}
    return {"type": "cube", "to_world": T().translate([0, 0, 1.2]).scale([1.2, 1.2, 0.1]), "bsdf": glass}


def _pane() -> SceneDict:
    place = T().look_at([0.9, 1.2, 1.0], [0, 0, -0.5], [0, 1, 0]).scale(0.9)
    return {"type": "rectangle", "to_world": place, "bsdf": {"type": "thindielectric"}}


def _fog(extinction: float) -> SceneDict:
    medium = {"type": "homogeneous", "sigma_t": extinction, "albedo": 0.8}
    return {"type": "cube", "to_world": T().scale(0.9), "bsdf": {"type": "null"}, "interior": medium}


def _bulb() -> SceneDict:
    return _ball([0.3, 0.3, 0.8], 0.12) | {"emitter": {"type": "area", "radiance": 8.0}}


def _textured_ball() -> SceneDict:
    return _ball([0, 0, 0], 0.8, {"type": "diffuse", "reflectance": _texture(0.1, 0.9)})


def _under_the_sky(bsdf: SceneDict) -> Mover:
    """A ball that slides over a floor."""
    scene = _scene(_above, floor=_floor, object=lambda: _ball([0, 0.1, 0], 0.5, bsdf), sky=lambda: SKY)
    return Mover(scene, _slide(1, 0.3, 0))


MOVERS: dict[str, Mover] = {
    "head turns": Mover(_scene(object=lambda: _head([0, 0, 0], 0.7), sky=lambda: SKY), _turn_vertices),
    "shadow of the head": Mover(
        _scene(_close, wall=_wall, lamp=_lamp, object=lambda: _head([1.0, 1.2, 1.0], 0.35)), _turn_vertices
    ),
    "textured ball": Mover(_scene(object=_textured_ball, sky=_environment), _slide(1, 0.3, 0)),
    "heights": Mover(_scene(_aslant, object=_heights, lamp=_lamp, sky=lambda: SKY), _rise),
    "camera turns": Mover(_scene(**_mesh_and_ball), _turn),
    "camera around a head": Mover(_scene(object=lambda: _head([0, 0, 0], 0.7), sky=lambda: SKY), _go_around),
    "orthographic camera": Mover(_scene(_parallel, **_mesh_and_ball), _slide(1, 0.3, 0)),
    "field of view": Mover(_scene(**_mesh_and_ball), _widen),
    "behind rough glass": Mover(_scene(wall=_wall, object=_box, lamp=_lamp, glass=_rough_glass), _slide_vertices),
    "between walls": Mover(_scene(wall=_wall, floor=_floor, object=_box, lamp=_lamp), _slide_vertices),
    "ball lifts off": Mover(
        _scene(_above, floor=_floor, object=lambda: _ball([0, 0, 0], 0.5), lamp=_lamp, sky=lambda: SKY), _slide(0, 1, 0)
    ),
    "ball in fog": Mover(
        _scene(wall=_wall, object=lambda: _ball([0, 0, 0], 0.4), lamp=_lamp, fog=lambda: _fog(1.5)), _slide(1, 0.3, 0)
    ),
    "ball in thick fog": Mover(
        _scene(object=lambda: _ball([0, 0, 0], 0.4), sky=lambda: SKY, fog=lambda: _fog(4.0)), _slide(1, 0.3, 0)
    ),
    "wall behind a lamp": Mover(_scene(object=_wall, bulb=_bulb), _slide(1, 0.3, 0)),
    "ball behind a lamp": Mover(
        _scene(wall=_wall, object=lambda: _ball([0, 0, 0], 0.5), bulb=_bulb), _slide(1, 0.3, 0)
    ),
    "behind a pane": Mover(
        _scene(_close, wall=_wall, lamp=_lamp, pane=_pane, object=lambda: _ball([1.15, 1.55, 1.35], 0.25)),
        _slide(1, 0.3, 0),
    ),
    "ball of metal": Mover(
        _scene(_above, floor=_floor, object=lambda: _ball([0, 0.1, 0], 0.5, {"type": "conductor"}), lamp=_lamp),
        _slide(1, 0.3, 0),
    ),
    "ball of glass": _under_the_sky({"type": "dielectric"}),
    "ball of rough metal": _under_the_sky({"type": "roughconductor", "alpha": 0.15}),
    "ball of rough plastic": _under_the_sky({"type": "roughplastic", "alpha": 0.15}),
    "ball of frosted glass": _under_the_sky({"type": "principled", "roughness": 0.3, "spec_trans": 0.6, "eta": 1.4}),
    "small in a room": Mover(
        _scene(_above, floor=_floor, wall=_wall, object=lambda: _ball([0.3, -0.3, 0.5], 0.06), lamp=_lamp),
        _slide(1, 0.3, 0),
    ),
}
"""Scenes by name. Either ``object`` or the camera moves."""
MOVING_SCENES = {name: mover.scene for name, mover in MOVERS.items()}
