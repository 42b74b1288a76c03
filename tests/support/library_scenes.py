"""A small room in memory, images of it, and an optimiser of a user's own: for tests of the library."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
import scipy.optimize

from pathreplay import Parameter, View
from variant import VARIANT

WALL, TEXTURE, BODY = "wall.bsdf.reflectance.value", "floor.bsdf.reflectance.data", "body.vertex_positions"
SIDE = 16


def room() -> dict[str, Any]:
    """A lit floor with a texture, a wall, and a body, seen by two cameras."""
    T = mi.ScalarTransform4f
    texels = np.random.default_rng(2).uniform(0.2, 0.8, (4, 4, 3)).astype(np.float32)

    def sensor(x: float) -> dict[str, Any]:
        film = {"type": "hdrfilm", "width": SIDE, "height": SIDE, "rfilter": {"type": "box"}}
        place = T().look_at([x, 2, 4], [0, 0, 0], [0, 1, 0])
        return {"type": "perspective", "fov": 45, "to_world": place, "film": film}

    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 3},
        "left": sensor(-1.0),
        "right": sensor(1.0),
        "sky": {"type": "constant"},
        "floor": {
            "type": "rectangle",
            "to_world": T().rotate([1, 0, 0], -90).scale(2),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "bitmap", "raw": True, "data": mi.TensorXf(texels)}},
        },
        "wall": {
            "type": "rectangle",
            "to_world": T().translate([0, 1, -1]).scale(1.5),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.3, 0.2]}},
        },
        "body": {"type": "cube", "to_world": T().translate([0, 0.3, 0.3]).scale(0.3)},
    }


def photos_of_room() -> list[np.ndarray]:
    """What both cameras see."""
    mi.set_variant(VARIANT)
    scene = mi.load_dict(room())
    return [np.array(mi.render(scene, sensor=n, spp=256), np.float32) for n in (0, 1)]


def views(photos: list[np.ndarray]) -> list[View]:
    return [View("left", photos[0]), View("right", photos[1])]


GREY = Parameter(initial=0.5, bounds=(0, 1))


class Descent:
    """An optimiser of the user's own."""

    def step(self, values: Any, gradients: Any, learning_rates: Any, loss: float) -> dict[str, np.ndarray]:
        return {key: value - 20 * learning_rates[key] * gradients[key] for key, value in values.items()}


class Heavy(Descent):
    """An optimiser of the user's own that remembers something, and tells it."""

    def __init__(self) -> None:
        self.velocity: dict[str, np.ndarray] = {}

    def step(self, values: Any, gradients: Any, learning_rates: Any, loss: float) -> dict[str, np.ndarray]:
        for key, gradient in gradients.items():
            before = self.velocity.get(key)
            same = before is not None and before.shape == gradient.shape
            self.velocity[key] = gradient + 0.5 * before if same else gradient
        return super().step(values, self.velocity, learning_rates, loss)

    def state_dict(self) -> dict[str, np.ndarray]:
        return dict(self.velocity)

    def load_state_dict(self, state: dict[str, np.ndarray]) -> None:
        self.velocity = dict(state)


class InPlace(Heavy):
    """An optimiser of the user's own that changes its values and what it remembers in place."""

    def step(self, values: Any, gradients: Any, learning_rates: Any, loss: float) -> dict[str, np.ndarray]:
        for key, gradient in gradients.items():
            velocity = self.velocity.get(key)
            if velocity is None or velocity.shape != gradient.shape:
                velocity = self.velocity[key] = np.zeros_like(gradient)
            velocity *= 0.5
            velocity += gradient
            values[key] -= 20 * learning_rates[key] * velocity
        return values


OPTIMIZERS: dict[str, Callable[[], Any]] = {
    "adam": lambda: "adam",
    "mitsuba": lambda: mi.ad.Adam(lr=0.03),
    "sgd of mitsuba": lambda: mi.ad.SGD(lr=0.5, momentum=0.8),
    "own": Heavy,
    "own, in place": InPlace,
}
SEARCHES: dict[str, Callable[[], Any]] = {
    "l-bfgs-b": lambda: "l-bfgs-b",
    "slsqp of scipy": lambda: partial(scipy.optimize.minimize, method="SLSQP"),
    "tnc of scipy": lambda: partial(scipy.optimize.minimize, method="TNC"),
}
#: Those that go through the library as another of these does.
SLOWLY: dict[str, Any] = {
    name: [pytest.mark.slow] if name in ("sgd of mitsuba", "own", "tnc of scipy") else []
    for name in (*OPTIMIZERS, *SEARCHES)
}
