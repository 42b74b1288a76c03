"""Gradients of light paths against finite differences, with equal random numbers and in expectation.

Nothing that moves in these scenes has an outline or a crease in the light, so that the derivative at fixed visibility
is the whole derivative. With equal random numbers, the gradient of every image equals a central difference, where no
random choice depends on the parameter. Run with -s to see the figures as tables.
"""

from __future__ import annotations

import gc
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from particle_scenes import ROUGH, dome, mirror, plane, slab
from pathreplay.testing.objective import Move, Objective, smooth_weights
from pathreplay.testing.statistics import gap
from pathreplay.testing.stencil import CENTRAL
from pathreplay.testing.verdict import Z_LIMIT
from truth import TRANSPOSE_MAX, add, random, rotate, translate

PLUGIN = "pathreplay_particles"
SAME_SEED_MAX = 1e-3
"""Largest error of a gradient relative to the central difference with equal random numbers."""


def waves(amplitude: float = 0.5) -> Move:
    """Heights of the slab: a wave along the vertices, which changes its normals."""

    def move(value: Any, t: Any) -> Any:
        n = len(value) // 3
        direction = np.zeros((n, 3), np.float32)
        direction[:, 2] = amplitude * np.cos(2 * np.arange(n) / 17)
        return value + t * mi.Float(direction.ravel())

    return move


def both_ways(first: Move, second: Move) -> Move:
    """One move after the other."""
    return lambda value, t: second(first(value, t), t)


POSE = both_ways(translate(0.3, 0.5, 0.7), rotate(0.2, 0.4, 0.1))


@dataclass(frozen=True)
class Cell:
    """A parameter of a scene, and how it moves."""

    name: str
    scene: Callable[[], dict]
    key: str
    move: Move
    step: float = 2e-3  # of the central difference
    depth: int = 3
    spp: int = 512
    options: dict[str, Any] = field(default_factory=dict)


def cell(name: str, scene: Callable[[], dict], key: str, move: Move, **more: Any) -> Cell:
    return Cell(name, scene, key, move, **more)


STEADY = {"step": 1e-3}  # at depth 3
ONCE = {"depth": 2, "step": 3e-4}
"""Of what moves a vertex from which a smooth lobe continues: random directions there are fixed differently."""
THROWN = {"step": 3e-4}
SLAB = {"depth": 4, "step": 1e-3}
CELLS = (
    cell("heights of a mirror", mirror, "mirror.vertex_positions", waves(), **THROWN),
    cell("spot and mirror", mirror, "light.to_world", translate(0.3, 0.5, 0.7), **THROWN),
    cell("receiver and mirror", mirror, "ceiling.to_world", POSE, **THROWN),
    cell("receiver and slab", slab, "floor.to_world", POSE, **SLAB),
    cell("camera and slab", slab, "sensor.to_world", POSE, **SLAB),
    cell("receiver", dome, "dome.to_world", POSE, **ONCE),
    cell("receiver, rough", partial(dome, bsdf=ROUGH), "dome.to_world", translate(0.3, 0.5, 0.7), **ONCE),
    cell("perspective", dome, "sensor.to_world", POSE, **STEADY),
    cell("thin lens", partial(dome, eye="thinlens"), "sensor.to_world", POSE, **STEADY),
    cell("orthographic", partial(dome, eye="orthographic"), "sensor.to_world", POSE, **STEADY),
    cell("meter", partial(dome, eye="meter"), "dome.to_world", POSE, spp=2**17, **ONCE),
    cell("x_fov", dome, "sensor.x_fov", add(), step=0.1),
    cell("x_fov, cropped", partial(dome, eye="cropped"), "sensor.x_fov", add(), step=0.1),
    cell("x_fov, thin lens", partial(dome, eye="thinlens"), "sensor.x_fov", add(), step=0.1),
    cell("principal point", partial(dome, eye="cropped"), "sensor.principal_point_offset_x", add(), **STEADY),
    cell("focus_distance", partial(dome, eye="thinlens"), "sensor.focus_distance", add(), step=1e-2),
    cell("aperture_radius", partial(dome, eye="thinlens"), "sensor.aperture_radius", add(), **STEADY),
    cell("point", dome, "light.position", add([0.3, 0.5, 0.7]), **ONCE),
    cell("point, rough", partial(dome, bsdf=ROUGH), "light.position", add([0.3, 0.5, 0.7]), **ONCE),
    cell("spot", partial(dome, "spot"), "light.to_world", POSE, **ONCE),
    cell("area", partial(dome, "area"), "light.to_world", POSE, **ONCE),
    cell("projector", partial(dome, "projector"), "light.to_world", translate(0.3, 0.5, 0.7), **ONCE),
    cell("directional", partial(plane, "directional"), "light.to_world", rotate(0.3, 0.5, 0.7), **ONCE),
    cell("beam", partial(plane, "directionalarea"), "light.to_world", POSE, **ONCE),
    cell("sky", partial(plane, "envmap"), "light.to_world", rotate(0.3, 0.5, 0.7), **ONCE),
    cell("intensity", dome, "light.intensity.value", add([0.5, 1.0, 0.2]), step=0.1),
    cell("radiance", partial(dome, "area"), "light.emitter.radiance.value", add([0.5, 1.0, 0.2]), step=0.1, depth=2),
    cell("painted radiance", partial(dome, "painted area"), "light.emitter.radiance.data", random(), step=0.1, depth=2),
    cell("reflectance", dome, "dome.bsdf.brdf_0.reflectance.data", random(0.5), step=1e-2),
)
BY_NAME = {c.name: c for c in CELLS}
QUICK = ("heights of a mirror", "thin lens", "receiver")


@contextmanager
def opened(cell: Cell) -> Iterator[Objective]:
    """The objective of a cell, a weighted mean of the image. It is detached at the end."""
    gc.collect()
    scene = mi.load_dict(cell.scene(), optimize=False)
    params = mi.traverse(scene)
    objective = Objective(scene, params, cell.key, cell.move)
    width, height = scene.sensors()[0].film().crop_size()
    objective.weigh(smooth_weights((int(height), int(width), 3), alpha=False))
    try:
        yield objective
    finally:
        params[cell.key] = objective.value
        params.update()


def integrator(cell: Cell, plugin: str = PLUGIN, **options: Any) -> mi.Integrator:
    own = {"boundary": "none"} if plugin.startswith("pathreplay") else {}
    return mi.load_dict({"type": plugin, "max_depth": cell.depth, **own, **cell.options, **options})


# ------------------------------ Equal random numbers ------------------------------


def same_seed(cell: Cell, spp: int) -> tuple[float, float]:
    """Return the relative error of a gradient against the central difference, and forward against reverse mode."""
    with opened(cell) as objective:
        steady = integrator(cell, rr_depth=1000)  # probabilities of survival would move
        difference = objective.dot(objective.difference(steady, CENTRAL, cell.step, 1, spp))
        gradient = objective.backward(steady, 1, spp)
        transpose = objective.transpose_error(steady, steady, 1, spp)
    error = abs(gradient / difference - 1)
    print(f"{cell.name:20s} {cell.depth:2d} {difference:+12.5e} {gradient:+12.5e} {error:9.1e} {transpose:9.1e}")
    return error, transpose


@pytest.mark.parametrize("name", QUICK)
def test_gradients_are_differences_with_equal_numbers(name: str) -> None:
    error, transpose = same_seed(BY_NAME[name], 64)
    assert error < SAME_SEED_MAX and transpose < TRANSPOSE_MAX


@pytest.mark.slow
@pytest.mark.parametrize("cell", CELLS, ids=lambda c: c.name)
def test_all_gradients_are_differences_with_equal_numbers(cell: Cell) -> None:
    error, transpose = same_seed(cell, cell.spp)
    assert error < SAME_SEED_MAX and transpose < TRANSPOSE_MAX


@pytest.mark.slow
@pytest.mark.parametrize("rr_depth", [1, 2])
def test_reverse_is_the_transpose_of_forward_under_roulette(rr_depth: int) -> None:
    for name in ("receiver, rough", "reflectance", "spot"):
        cell = BY_NAME[name]
        with opened(cell) as objective:
            same = integrator(cell, rr_depth=rr_depth)
            assert objective.transpose_error(same, same, 1, 64) < TRANSPOSE_MAX
