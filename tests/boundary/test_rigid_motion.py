"""A camera that moves one way sees what it sees of a world that moves the other way, and nothing changes if both move.

These gradients are compared with each other, and their noise, too: no finite difference is needed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from edge_scenes import BY_NAME, weights
from pathreplay.testing.statistics import gap
from pathreplay.testing.verdict import Z_LIMIT

SEEDS, SPP = 12, 64
SCENES = "cube24_lit", "hexagon_moves", "ball_in_floor", "mirror_z", "lamp_seen", "shadow_sphere"
MOVES: dict[str, Callable[[mi.Float], Any]] = {
    "slides": lambda t: mi.Transform4f().translate([t, 0.3 * t, 0.5 * t]),
    "turns": lambda t: mi.Transform4f().rotate([0.3, 1, 0.2], dr.rad2deg(t)),
}
"""Motions of everything, as functions of t."""


class World:
    """A scene whose shapes and camera move with one number."""

    def __init__(self, name: str) -> None:
        cell = BY_NAME[name]
        self.scene = mi.load_dict(cell.scene(), optimize=False)
        self.params = mi.traverse(self.scene)
        self.integrator = mi.load_dict({"type": "pathreplay", "max_depth": cell.depth, "rr_depth": 1000})
        places = [key for key in self.params.keys() if key.endswith((".to_world", ".vertex_positions"))]
        self.places = {key: dr.copy(self.params[key]) for key in places}
        self.camera = [key for key in places if isinstance(self.params.properties[key][2], mi.Sensor)]
        self.things = [key for key in places if key not in self.camera]
        self.normals = {k: dr.copy(self.params[k]) for k in self.params.keys() if k.endswith(".vertex_normals")}

    def gradients(self, keys: list[str], motion: Callable[[mi.Float], Any], first: int) -> np.ndarray:
        """The derivatives of the weighted image by the motion of these parameters, one for each seed."""
        W, found = mi.TensorXf(weights()), []
        for seed in range(first, first + SEEDS):
            t = mi.Float(0)
            dr.enable_grad(t)
            for key in keys:
                self.params[key] = _moved(self.places[key], motion(t))
            for key in self.normals if keys != self.camera else ():
                self.params[key] = dr.ravel(motion(t) @ dr.unravel(mi.Normal3f, self.normals[key]))
            self.params.update()
            image = mi.render(self.scene, self.params, integrator=self.integrator, spp=1, spp_grad=SPP, seed_grad=seed)
            dr.backward(dr.sum(image * W, axis=None))
            found.append(float(dr.grad(t)[0]))
        for key, value in {**self.places, **self.normals}.items():
            self.params[key] = value
        self.params.update()
        return np.array(found)


def _moved(value: Any, motion: Any) -> Any:
    if isinstance(value, mi.Float):
        return dr.ravel(motion @ dr.unravel(mi.Point3f, value))
    return motion @ mi.Transform4f(value)


@pytest.mark.slow
@pytest.mark.parametrize("move", MOVES)
@pytest.mark.parametrize("name", SCENES)
def test_a_camera_that_moves_is_a_world_that_moves_back(name: str, move: str) -> None:
    world, motion = World(name), MOVES[move]
    things = world.gradients(world.things, motion, 1)
    camera = world.gradients(world.camera, motion, 1001)
    both = world.gradients([*world.things, *world.camera], motion, 2001)
    assert abs(gap(things, -camera).z) < Z_LIMIT, (things.mean(), camera.mean())
    assert abs(gap(both).z) < Z_LIMIT, both.mean()
    assert camera.std() < 4 * things.std(), (camera.std(), things.std())
