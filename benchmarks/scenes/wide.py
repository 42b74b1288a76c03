"""Scenes of many shapes with a BSDF each, and a scene with only a sky, for the task `scale`."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import mitsuba as mi

from .parts import SceneDict, sensor

SHAPES = (1, 100, 1000, 10000)
COLOUR, SKY = "shape0.bsdf.reflectance.value", "sky.radiance.value"


def shapes_name(count: int) -> str:
    """Return the name of the scene with this number of shapes."""
    return f"{count} shape{'s' if count > 1 else ''}"


def _wall(count: int, resolution: int) -> SceneDict:
    """Squares side by side under a sky, each with a colour of its own."""
    side = math.ceil(math.sqrt(count))
    scene: SceneDict = {
        "type": "scene",
        "sensor": sensor(resolution, [0, 0.01, 3], [0, 0, 0], fov=40),
        "sky": {"type": "constant"},
    }
    for i in range(count):
        x, y = 2 * (i % side + 0.5) / side - 1, 2 * (i // side + 0.5) / side - 1
        colour = {"type": "rgb", "value": [0.2 + 0.6 * i / count, 0.5, 0.4]}
        scene[f"shape{i}"] = {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([x, y, 0]).scale(0.8 / side),
            "bsdf": {"type": "diffuse", "reflectance": colour},
        }
    return scene


def even_sky(resolution: int) -> SceneDict:
    """A sky of constant radiance, for which sums of samples are known. Key: ``sky.radiance.value``."""
    return {
        "type": "scene",
        "sensor": sensor(resolution, [0, 0.01, 3], [0, 0, 0], fov=40),
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.3}},
    }


WIDE_SCENES: dict[str, Callable[[int], SceneDict]] = {
    "even sky": even_sky,
    **{shapes_name(count): partial(_wall, count) for count in SHAPES},
}
