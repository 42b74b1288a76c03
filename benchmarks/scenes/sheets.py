"""Bent sheets that face each other, and bent panes of glass, under a smooth sky. Paths have many smooth bounces."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import mitsuba as mi
import numpy as np

from .caustics import grid
from .parts import SceneDict, sensor

UP = (0, 0.1, 1)

DIFFUSE: SceneDict = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.7, 0.9]}}
ROUGH_METAL: SceneDict = {"type": "roughconductor", "alpha": 0.2}


def sheet(z: float, bend: float, half_width: float, up: bool, bsdf: SceneDict, n: int = 9) -> mi.Mesh:
    """A bent sheet of n x n vertices with shading normals, about the plane at height z."""
    y, x = np.mgrid[-1 : 1 : n * 1j, -1 : 1 : n * 1j] * half_width
    return grid(x, y, z + bend * np.sin(1.3 * x + 0.3) * np.cos(1.1 * y), bsdf, up)


def smooth_environment(height: int = 32) -> SceneDict:
    y, x = np.mgrid[0:height, 0 : 2 * height] * (np.pi / height)
    waves = [np.sin(x) * np.sin(y) / 2, np.cos(x + 1) * np.sin(y) / 2, np.sin(2 * x) * np.sin(y) / 3]
    return {"type": "envmap", "bitmap": mi.Bitmap((1 + np.stack(waves, axis=-1)).astype(np.float32))}


def corridor(bsdf: SceneDict, resolution: int) -> SceneDict:
    """Two sheets seen from the side. Nearly every path bounces back and forth between the sheets."""
    return {
        "type": "scene",
        "environment": smooth_environment(),
        "camera": sensor(resolution, [0, -5, 0.3], [0, 0, -0.6], 30, up=UP),
        "low": sheet(-1, 0.1, 2, True, bsdf),
        "high": sheet(1, 0.1, 2, False, bsdf),
    }


def panes(interfaces: int, wall: SceneDict | None, resolution: int) -> SceneDict:
    """Bent panes of glass one behind the other, optionally in front of a wall. Paths are chains of delta lobes."""
    glass = {"type": "dielectric_ad", "int_ior": 1.5}
    scene = {
        "type": "scene",
        "environment": smooth_environment(),
        "camera": sensor(resolution, [0.3, -0.2, -5], [0.3, 0, 0], 30, up=UP),
    }
    names = ["low"] + [f"pane-{k}" for k in range(1, interfaces)]
    scene |= {name: sheet(0.25 * k, 0.05, 4, k % 2 == 1, glass) for k, name in enumerate(names)}
    if wall is not None:
        scene["wall"] = sheet(0.25 * interfaces + 0.5, 0.1, 4, False, wall)
    return scene


SHEET_SCENES: dict[str, Callable[[int], SceneDict]] = {
    "diffuse sheets": partial(corridor, DIFFUSE),
    "rough metal sheets": partial(corridor, ROUGH_METAL),
    "glass before a diffuse wall": partial(panes, 4, DIFFUSE),
    "glass panes": partial(panes, 16, None),
}
