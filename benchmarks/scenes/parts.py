"""Common parts of the scenes."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

SceneDict = dict[str, Any]


def sensor(
    resolution: int, origin: list[float], target: list[float], fov: float, up: tuple[float, ...] = (0, 0, 1)
) -> SceneDict:
    """A camera with a square film and a box filter."""
    return {
        "type": "perspective",
        "fov": fov,
        "to_world": mi.ScalarTransform4f().look_at(origin=origin, target=target, up=list(up)),
        "film": {"type": "hdrfilm", "width": resolution, "height": resolution, "rfilter": {"type": "box"}},
    }
