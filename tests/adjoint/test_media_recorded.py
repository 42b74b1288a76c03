"""Steps over media that Dr.Jit has recorded: the same numbers as of those that are traced, what is learned included."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from media_scenes import checkers, cloud, constant, grid, heterogeneous, homogeneous, inside, lit_floor, smooth
from pathreplay.inverse.losses.pixelwise import l2
from pathreplay.inverse.objective.frozen import Recordings, RenderRequest, ViewLoss, ViewTarget, differentiate
from pathreplay.scenes.parameters import keep_only

# Denser than any step before, and emptier: bounds of the extinction have to follow.
SCALES = (1.0, 1.0, 4.0, 0.3, 2.0)
SPP = 16
DENSITY, ALBEDO = "sigma_t.data", "albedo.data"
GLOW = {"emission": grid(smooth(0.1, 0.5, 3))}
COLOURS = np.array([2.0, 1.0, 0.5])

MEDIA: dict[str, tuple[Callable[[], dict], str]] = {
    "grid": (lambda: heterogeneous(smooth(0.2, 1.0), constant(0.6), plugin="gridmedium"), DENSITY),
    "empty in places": (lambda: heterogeneous(checkers(), constant(0.6), plugin="gridmedium"), DENSITY),
    "coloured": (lambda: heterogeneous(smooth(0.2, 1.0) * COLOURS, constant(0.6), plugin="gridmedium"), DENSITY),
    "albedo": (lambda: heterogeneous(smooth(0.2, 1.0), smooth(0.1, 0.3, 3), plugin="gridmedium"), ALBEDO),
    "glowing": (lambda: heterogeneous(smooth(0.2, 1.0), constant(0.6), plugin="gridmedium", **GLOW), DENSITY),
    "heterogeneous": (lambda: heterogeneous(smooth(0.2, 1.0), constant(0.6)), DENSITY),
    "homogeneous": (lambda: homogeneous({"type": "rgb", "value": [1.0, 0.5, 0.3]}), "sigma_t.value.value"),
}


def steps(scene: mi.Scene, key: str, integrator: dict, recorded: bool) -> np.ndarray:
    """Loss, gradient and what was learned, of each step."""
    params = mi.traverse(scene)
    key = next(name for name in params.keys() if name.endswith(key))
    keep_only(params, [key])
    start, recordings = type(params[key])(params[key]), Recordings()
    made = mi.load_dict(integrator)
    target = mi.TensorXf(np.full((16, 16, 3), 0.3, np.float32))
    found = []
    for i, scale in enumerate(SCALES):
        value = start * dr.opaque(mi.Float, scale)
        dr.enable_grad(value)
        params[key] = value
        params.update()
        step = recordings.differentiate if recorded and i > 0 else differentiate
        seed = dr.opaque(mi.UInt32, i)
        result = step(params, scene, made, RenderRequest(0, seed, SPP), ViewTarget(target), ViewLoss(l2, 1.0, False))
        made.keep(scene, result.state)
        parts = [
            result.loss,
            dr.grad(value).array if dr.is_tensor_v(value) else dr.grad(value),
            *made.state_dict().values(),
        ]
        found.append(np.concatenate([np.ravel(part) for part in parts]))
    assert {each.n_recordings for each in recordings._frozen.values()} == ({1} if recorded else set())
    params[key] = start
    params.update()
    return np.array(found)


def hold(scene: dict, key: str, **options: Any) -> None:
    loaded = mi.load_dict(scene, optimize=False)
    integrator = {"type": "pathreplay", "max_depth": 4, **options}
    traced, recorded = (steps(loaded, key, integrator, recorded) for recorded in (False, True))
    assert np.abs(traced[:, 1:]).max() > 0
    difference = np.abs(recorded - traced).max(1) / np.abs(traced).max(1)
    assert difference.max() < 1e-4, difference


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name == "empty in places")) for name in MEDIA]
)
def test_recorded_steps_are_those_that_are_traced(name: str) -> None:
    medium, key = MEDIA[name]
    hold(cloud(medium()), key)


@pytest.mark.parametrize("options", [{"adjoint": "replay"}, {"null_branching": False}, {"boundary": "all"}], ids=str)
def test_however_they_are_differentiated(options: dict[str, Any]) -> None:
    medium, key = MEDIA["grid"]
    hold(lit_floor(medium()), key, **options)


def test_from_within() -> None:
    medium, key = MEDIA["grid"]
    hold(inside(medium()), key)


def test_cells_that_come_and_go_are_recorded_anew() -> None:
    """A grid that is walked through cell by cell where it is dense, and at once where it is thin."""
    medium, key = MEDIA["coloured"]
    scene = mi.load_dict(cloud(medium()), optimize=False)
    grid_medium = next(shape.interior_medium() for shape in scene.shapes() if shape.interior_medium())
    found = set()
    params = mi.traverse(scene)
    key = next(name for name in params.keys() if name.endswith(key))
    start = mi.TensorXf(params[key])
    for scale in SCALES:
        params[key] = start * scale
        params.update()
        found.add(grid_medium.constants)
    assert 1 < len(found) < len(set(SCALES))
