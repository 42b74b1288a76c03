"""Scenes with media: boxes and balls of fog under lights, small enough that thousands of paths take a second.

The box is the cube [-1, 1]³; grids fill it. Every function gives a dictionary with arrays of its own.
"""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from truth import camera, environment, rgb

N = 6  # voxels along an edge: a few steps across the box, and every one of them matters to the picture
NULL = {"type": "null"}
ISOTROPIC = {"type": "isotropic"}
FORWARD = {"type": "hg", "g": 0.5}
SEE_ALL = {"fov": 30}  # the box fills most of the picture


# ------------------------------ Media ------------------------------


def box_to_world() -> Any:
    return mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2)


def grid(values: np.ndarray) -> dict:
    """A volume over the box, of shape (z, y, x, channels), taken as it is (no spectral upsampling)."""
    volume = mi.VolumeGrid(np.ascontiguousarray(values, np.float32))
    return {"type": "gridvolume", "grid": volume, "to_world": box_to_world(), "raw": True}


def smooth(low: float, high: float, channels: int = 1) -> np.ndarray:
    """Waves between ``low`` and ``high``, out of phase between axes and channels."""
    z, y, x = np.mgrid[0:N, 0:N, 0:N] / (N - 1) * np.pi
    waves = [np.sin(x + k) * np.cos(0.7 * y - k) * np.sin(0.8 * z + 2 * k) for k in range(channels)]
    return low + (high - low) * (0.5 + 0.5 * np.stack(waves, -1))


def checkers() -> np.ndarray:
    """Full (1) and empty (0) blocks of three voxels a side: interpolation leaves pure ones of both kinds."""
    z, y, x = np.mgrid[0:N, 0:N, 0:N] // 3
    return ((x + y + z) % 2)[..., None].astype(np.float32)


def sparse() -> np.ndarray:
    """24³ voxels, nearly all of them empty: two blobs."""
    z, y, x = np.mgrid[0:24, 0:24, 0:24]
    blobs = [
        np.maximum(0, 1 - ((x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2) / 12) for a, b, c in ((7, 8, 9), (16, 15, 14))
    ]
    return sum(blobs)[..., None].astype(np.float32)


def constant(value: float | tuple[float, ...]) -> np.ndarray:
    return np.ones((N, N, N, 1), np.float32) * np.asarray(value, np.float32)


def heterogeneous(
    σ_t: np.ndarray, albedo: Any = 0.6, phase: dict = ISOTROPIC, scale: float = 1.0, **props: Any
) -> dict:
    return {
        "type": props.pop("plugin", "heterogeneous"),
        "sigma_t": grid(σ_t),
        "albedo": grid(albedo) if isinstance(albedo, np.ndarray) else {"type": "constvolume", "value": albedo},
        "phase": dict(phase),
        "scale": scale,
        **props,
    }


def homogeneous(σ_t: Any = 1.0, albedo: Any = 0.6, phase: dict = ISOTROPIC, **props: Any) -> dict:
    value = {"sigma_t": σ_t, "albedo": albedo}
    value = {k: dict(v) if isinstance(v, dict) else v for k, v in value.items()}
    return {"type": "homogeneous", **value, "phase": dict(phase), **props}


# ------------------------------ Scenes ------------------------------


def cloud(medium: dict, shape: str = "cube", bsdf: dict | None = None, **parts: Any) -> dict:
    """A medium in a box (or ball) under a smooth sky."""
    return {
        "type": "scene",
        "camera": camera(origin=(0.6, 0.8, 5), **SEE_ALL),
        "sky": environment(64),
        "object": {"type": shape, "bsdf": dict(bsdf or NULL), "interior": medium},
        **parts,
    }


def sunlit(medium: dict) -> dict:
    """The box lit from behind: what is scattered forwards is seen."""
    sun = {"type": "directional", "direction": [0.3, -0.6, 1], "irradiance": rgb(4, 3, 2)}
    return cloud(medium, sky=sun)


def lit_floor(medium: dict, albedo: float = 0.5) -> dict:
    """A medium on a diffuse floor under an area light, in the dark."""
    T = mi.ScalarTransform4f
    return {
        "type": "scene",
        "camera": camera(origin=(0, 2, 5), fov=30, target=(0, -0.3, 0)),
        "floor": {
            "type": "rectangle",
            "to_world": T().translate([0, -1.01, 0]).rotate([1, 0, 0], -90).scale([3, 3, 1]),
            "bsdf": {"type": "diffuse", "reflectance": rgb(albedo, 0.8 * albedo, 0.6 * albedo)},
        },
        "light": {
            "type": "rectangle",
            "to_world": T().translate([0.5, 3, 1]).rotate([1, 0, 0], 90),
            "emitter": {"type": "area", "radiance": rgb(9, 6, 3)},
        },
        "object": {"type": "cube", "bsdf": NULL, "interior": medium},
    }


def inside(medium: dict) -> dict:
    """The camera stands in the middle of the box."""
    return {
        "type": "scene",
        "fog": medium,
        "camera": {**camera(origin=(0, 0, 0.5), fov=50), "medium": {"type": "ref", "id": "fog"}},
        "sky": environment(64),
        "object": {"type": "cube", "bsdf": NULL, "interior": {"type": "ref", "id": "fog"}},
    }


def behind_glass(bsdf: dict, medium: dict) -> dict:
    """A cloud that is seen through a tilted pane whose far side is never left: one refraction or reflection."""
    scene = cloud(medium)
    pane = mi.ScalarTransform4f().translate([0, 0, 2.5]).rotate([0, 1, 0], 20).scale([2, 2, 1])
    scene["pane"] = {"type": "rectangle", "to_world": pane, "bsdf": bsdf}
    return scene


def in_the_mirror(bsdf: dict, medium: dict) -> dict:
    """A cloud behind the camera, seen in a tilted plane in front of it."""
    scene = cloud(medium)
    T = mi.ScalarTransform4f
    scene["camera"] = camera(origin=(0, 0, 3), fov=24, target=(0, 0, 8))
    scene["pane"] = {
        "type": "rectangle",
        "to_world": T().translate([0, 0, 6]).rotate([0, 1, 0], 180).scale([4, 4, 1]),
        "bsdf": bsdf,
    }
    return scene


def ball(radius: float, center: tuple[float, float, float], interior: Any, exterior: Any = None) -> dict:
    scene = {"type": "sphere", "radius": radius, "center": list(center), "bsdf": NULL, "interior": interior}
    return scene if exterior is None else {**scene, "exterior": exterior}


def nested(outer: dict, inner: dict) -> dict:
    """A ball of one medium within a box of another."""
    scene = cloud({"type": "ref", "id": "outer"})
    scene["kernel"] = ball(0.6, (0.1, 0, 0.2), {"type": "ref", "id": "inner"}, {"type": "ref", "id": "outer"})
    return {"type": "scene", "outer": outer, "inner": inner, **scene}


def overlapping(left: dict, right: dict) -> dict:
    """Two balls that overlap without knowing of each other: the boundary that was crossed last decides."""
    scene = cloud(left, "sphere")
    scene["object"] = ball(0.9, (-0.5, 0, 0), left)
    scene["other"] = ball(0.9, (0.5, 0.1, 0), right)
    return scene
