"""Evaluated loops, calls and conditionals, as people switch to them to look into a kernel, change no gradient."""

from __future__ import annotations

from contextlib import ExitStack

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from pathreplay.scenes.parameters import get_array

SYMBOLIC = {
    "loops": dr.JitFlag.SymbolicLoops,
    "calls": dr.JitFlag.SymbolicCalls,
    "conditionals": dr.JitFlag.SymbolicConditionals,
}
WALL, LIGHT = "green.reflectance.value", "light.to_world"
DENSITY = "cloud.interior_medium.sigma_t.data"


def _scene(key: str) -> mi.Scene:
    if key != DENSITY:
        box = mi.cornell_box()
        box["sensor"]["film"].update(width=4, height=4, rfilter={"type": "box"})
        return mi.load_dict(box, optimize=False)
    grid = mi.VolumeGrid(np.linspace(0.5, 2, 8, dtype=np.float32).reshape(2, 2, 2, 1))
    camera = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}}
    volume = {"type": "gridvolume", "grid": grid, "to_world": mi.ScalarTransform4f().translate(-1).scale(2)}
    medium = {"type": "gridmedium", "albedo": 0.6, "sigma_t": volume}
    return mi.load_dict(
        {
            "type": "scene",
            "sky": {"type": "constant"},
            "camera": {"type": "perspective", "fov": 30, "to_world": camera, "film": film},
            "cloud": {"type": "cube", "bsdf": {"type": "null"}, "interior": medium},
        },
        optimize=False,
    )


def _results(way: str, key: str, **options: object) -> np.ndarray:
    """Mean of the image, and what the gradient or the tangent adds up to."""
    scene = _scene(key)
    params = mi.traverse(scene)
    integrator = mi.load_dict({"type": "pathreplay", "max_depth": 4, **options})
    dr.enable_grad(params[key])
    params.update()
    if way == "forward":
        dr.set_grad(params[key], 1)
        params.update()
    if way == "pixels":
        slope = dr.full(mi.TensorXf, 0.01, (4, 4, 3))
        image = integrator.render_value_and_grad(scene, slope, slope, 0, 1, 4)
    else:
        image = mi.render(scene, params, integrator=integrator, spp=4, seed=1)
        if way == "forward":
            return np.array([np.mean(np.array(image)), np.sum(np.array(dr.forward_to(image)))])
        dr.backward(dr.mean(image, axis=None))
    return np.array([np.mean(np.array(image)), np.sum(get_array(dr.grad(params[key])))])


WAYS = {
    "sweep": ("backward", WALL, {}),
    "replay": ("backward", WALL, {"adjoint": "replay"}),
    "forward": ("forward", WALL, {}),
    "pixels": ("pixels", WALL, {}),
    "what moves": ("backward", LIGHT, {}),
    "medium": ("backward", DENSITY, {}),
    "medium, forward": ("forward", DENSITY, {}),
    "medium, replay": ("backward", DENSITY, {"adjoint": "replay"}),
}
ALL = ("loops", "calls", "conditionals")
QUICK = ("sweep",)


@pytest.mark.parametrize(
    ("off", "name"),
    [
        *((ALL, name) if name in QUICK else pytest.param(ALL, name, marks=pytest.mark.slow) for name in WAYS),
        *(pytest.param((one,), name, marks=pytest.mark.slow) for one in ALL for name in WAYS),
    ],
)
def test_what_is_evaluated_changes_no_gradient(off: tuple[str, ...], name: str) -> None:
    way, key, options = WAYS[name]
    expected = _results(way, key, **options)
    with ExitStack() as flags:
        for each in off:
            flags.enter_context(dr.scoped_set_flag(SYMBOLIC[each], False))
        found = _results(way, key, **options)
    assert abs(expected[1]) > 1e-4
    np.testing.assert_allclose(found, expected, rtol=1e-4)
