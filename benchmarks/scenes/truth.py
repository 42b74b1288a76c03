"""Small scenes for the task `truth`: an object in a room or under a sky, and boxes of fog."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np

SceneDict = dict[str, Any]

RESOLUTION = 16
VOXELS = 6  # along an edge of a grid: few enough for each to matter to the picture
NULL = {"type": "null"}


def _rgb(*value: float) -> SceneDict:
    return {"type": "rgb", "value": list(value)}


def _camera(origin: list[float], fov: float, target: tuple[float, ...] = (0, 0, 0), **more: Any) -> SceneDict:
    film = {"type": "hdrfilm", "width": RESOLUTION, "height": RESOLUTION, "rfilter": {"type": "box"}}
    to_world = mi.ScalarTransform4f().look_at(origin=origin, target=list(target), up=[0, 1, 0])
    return {"type": "perspective", "fov": fov, "to_world": to_world, "film": film} | more


def _texture(texels: np.ndarray) -> SceneDict:
    return {"type": "bitmap", "raw": True, "data": mi.TensorXf(texels.astype(np.float32))}


def _sky(height: int = 64) -> SceneDict:
    """A smooth sky without edges, under which only the silhouettes of moving objects are discontinuities."""
    v, u = np.mgrid[0:height, 0 : 2 * height] * (np.pi / height)
    waves = [np.cos(u) * np.sin(v) / 2, np.sin(u + 1) * np.sin(v) / 2, np.cos(2 * u) * np.sin(v) / 3]
    return {"type": "envmap", "bitmap": mi.Bitmap((1 + np.stack(waves, axis=-1)).astype(np.float32))}


# ------------------------------ Surfaces ------------------------------


def _room(texels: np.ndarray) -> SceneDict:
    """A textured panel on a floor under an area light."""
    T = mi.ScalarTransform4f
    return {
        "type": "scene",
        "camera": _camera([0, 1, 5], 30),
        "floor": {
            "type": "rectangle",
            "to_world": T().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(4),
            "bsdf": {"type": "diffuse", "reflectance": _rgb(0.5, 0.6, 0.7)},
        },
        "light": {
            "type": "rectangle",
            "to_world": T().translate([0.4, 2.5, 1.5]).rotate([1, 0, 0], 100),
            "emitter": {"type": "area", "radiance": _rgb(4, 3, 2)},
        },
        "object": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": _texture(texels)}},
    }


def _ball(bsdf: SceneDict) -> SceneDict:
    """A ball under the sky that fills the image."""
    ball = {"type": "sphere", "bsdf": bsdf}
    return {"type": "scene", "camera": _camera([0, 0, 5], 10), "sky": _sky(), "object": ball}


def _waves() -> SceneDict:
    """A diffuse plane with a smooth texture that extends beyond the image."""
    y, x = np.mgrid[0:64, 0:64] / 64 * 2 * np.pi
    texels = 0.5 + 0.3 * np.stack([np.sin(x), np.cos(y), np.sin(x + y)], axis=-1)
    bsdf = {"type": "diffuse", "reflectance": _texture(texels)}
    plane = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(4), "bsdf": bsdf}
    return {"type": "scene", "camera": _camera([0.5, 1, 5], 20), "sky": _sky(), "object": plane}


# ------------------------------ Media ------------------------------


def _waving(low: float, high: float, channels: int = 1) -> np.ndarray:
    """Values of a grid between ``low`` and ``high``, out of phase between channels."""
    z, y, x = np.mgrid[0:VOXELS, 0:VOXELS, 0:VOXELS] * (np.pi / (VOXELS - 1))
    waves = [np.cos(x - k) * np.sin(0.8 * y + k) * np.cos(0.6 * z + 2 * k) for k in range(channels)]
    return low + (high - low) * (0.5 + 0.5 * np.stack(waves, axis=-1))


def _checkers() -> np.ndarray:
    """Full and empty blocks of 3³ voxels. Points in their centres are full or empty in spite of interpolation."""
    z, y, x = np.mgrid[0:VOXELS, 0:VOXELS, 0:VOXELS] // 3
    return 2.0 * ((x + y + z) % 2)[..., None]


def _even(value: float) -> np.ndarray:
    return np.full((VOXELS, VOXELS, VOXELS, 1), value)


def _volume(values: np.ndarray) -> SceneDict:
    box = mi.ScalarTransform4f().translate(-1).scale(2)
    grid = mi.VolumeGrid(np.ascontiguousarray(values, np.float32))
    return {"type": "gridvolume", "grid": grid, "to_world": box, "raw": True}


def _grid(density: np.ndarray, albedo: np.ndarray | None = None, g: float | None = None) -> SceneDict:
    return {
        "type": "heterogeneous",
        "sigma_t": _volume(density),
        "albedo": _volume(_even(0.7) if albedo is None else albedo),
        "phase": {"type": "isotropic"} if g is None else {"type": "hg", "g": g},
    }


def _fog() -> SceneDict:
    return {"type": "homogeneous", "sigma_t": 1.0, "albedo": 0.7}


def _cloud(medium: SceneDict, **more: Any) -> SceneDict:
    """A box of a medium under the sky."""
    box = {"type": "cube", "bsdf": NULL, "interior": medium}
    return {"type": "scene", "camera": _camera([0.6, 0.8, 5], 30), "sky": _sky(), "object": box} | more


def _sunlit_cloud() -> SceneDict:
    """A cloud lit from behind, so that the camera sees light that is scattered forwards."""
    sun = {"type": "directional", "direction": [0.3, -0.6, 1], "irradiance": _rgb(4, 3, 2)}
    return _cloud(_grid(_waving(0.4, 2), _waving(0.3, 0.9), g=0.5), sky=sun)


def _cloud_on_a_floor() -> SceneDict:
    T = mi.ScalarTransform4f
    floor = {
        "type": "rectangle",
        "to_world": T().translate([0, -1.01, 0]).rotate([1, 0, 0], -90).scale(3),
        "bsdf": {"type": "diffuse", "reflectance": _rgb(0.5, 0.4, 0.3)},
    }
    light = {
        "type": "rectangle",
        "to_world": T().translate([0.5, 3, 1]).rotate([1, 0, 0], 90),
        "emitter": {"type": "area", "radiance": _rgb(9, 6, 3)},
    }
    # Dark: in a bright cloud what it scatters and what its shadow takes away nearly cancel.
    scene = _cloud(_grid(_waving(0.4, 2), _even(0.2)), floor=floor, light=light)
    del scene["sky"]
    return scene


def _camera_in_a_cloud() -> SceneDict:
    fog = {"type": "ref", "id": "fog"}
    box = {"type": "cube", "bsdf": NULL, "interior": dict(fog)}
    camera = _camera([0, 0, 0.5], 50, medium=dict(fog))
    return {"type": "scene", "fog": _grid(_waving(0.4, 2)), "camera": camera, "sky": _sky(), "object": box}


def _fog_in_glass() -> SceneDict:
    return _cloud(_fog(), object={"type": "sphere", "bsdf": {"type": "dielectric_ad"}, "interior": _fog()})


TRUTH_SCENES: dict[str, Callable[[], SceneDict]] = {
    "textured room": lambda: _room(np.random.default_rng(0).uniform(0.2, 0.8, (8, 8, 3))),
    "black room": lambda: _room(np.zeros((8, 8, 3))),
    "plastic ball": lambda: _ball({"type": "plastic", "diffuse_reflectance": _rgb(0.3, 0.5, 0.7)}),
    "rough plastic ball": lambda: _ball(
        {"type": "roughplastic", "alpha": 0.2, "diffuse_reflectance": _rgb(0.3, 0.5, 0.7)}
    ),
    "rough metal ball": lambda: _ball({"type": "roughconductor", "material": "Au", "alpha": 0.2}),
    "principled ball": lambda: _ball({"type": "principled", "roughness": 0.4, "metallic": 0.3, "specular": 0.6}),
    "glass ball": lambda: _ball({"type": "dielectric_ad"}),
    "rough glass ball": lambda: _ball(
        {"type": "roughdielectric", "alpha": 0.3, "specular_transmittance": _rgb(0.8, 0.7, 0.9)}
    ),
    "waves": _waves,
    "smooth cloud": lambda: _cloud(_grid(_waving(0.4, 2), _waving(0.3, 0.9))),
    "even cloud": lambda: _cloud(_grid(_even(1.2))),
    "checkered cloud": lambda: _cloud(_grid(_checkers())),
    "coloured cloud": lambda: _cloud(_grid(_waving(0.4, 2, 3), _waving(0.3, 0.9, 3))),
    "black cloud": lambda: _cloud(_grid(_waving(0.4, 2), _even(0))),
    "forward cloud": _sunlit_cloud,
    "fog": lambda: _cloud(_fog()),
    "cloud on a floor": _cloud_on_a_floor,
    "camera in a cloud": _camera_in_a_cloud,
    "fog in glass": _fog_in_glass,
}
"""Scenes by name, as dictionaries for mi.load_dict (with optimize=False, which keeps the keys)."""
