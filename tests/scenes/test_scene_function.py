"""What the bridges share: a scene as a function of values, in Dr.Jit's own tensors; and bridges that lead nowhere."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from bridges import PLAIN, SMALL, TEXTURE, WALL, hold, mitsubas
from pathreplay.errors import PathreplayError
from pathreplay.scenes.loading import load_scene
from pathreplay.scenes.scene_function import SceneFunction, View

FEW, MANY = View(1, 4, 16), View(1, 4, 2048)


@pytest.fixture
def function() -> SceneFunction:
    return SceneFunction("cornell-box-photo", [TEXTURE, WALL], integrator=PLAIN, arguments=SMALL)


def values_of(function: SceneFunction, wall: float = 0.5) -> list[Any]:
    found = {key: np.full_like(value, wall) if key == WALL else value for key, value in function._start.items()}
    return [mi.TensorXf(found[key]) for key in function.keys]


def test_pictures_and_gradients_are_those_of_mitsuba(function: SceneFunction) -> None:
    values = values_of(function)
    scene = load_scene("cornell-box-photo", **SMALL)
    params = mi.traverse(scene)
    params[WALL] = mi.Color3f(0.5)
    params.update()
    expected = np.array(mi.render(scene, sensor=1, integrator=mi.load_dict(PLAIN), spp=FEW.spp, seed=FEW.seed))
    np.testing.assert_allclose(np.array(function.picture(values, FEW)), expected, rtol=1e-5, atol=1e-6)

    weights = np.random.default_rng(0).uniform(0.5, 1, (6, 6, 3)).astype(np.float32)
    function.picture(values_of(function, 0.1), FEW)  # which the next one is to know nothing of
    found = dict(zip(function.keys, function.gradient(values, MANY, mi.TensorXf(weights)), strict=True))
    gradients = mitsubas({key: np.array(v) for key, v in zip(function.keys, values, strict=True)}, 1, weights)
    for key, gradient in gradients.items():
        hold(np.array(found[key]), gradient)


def test_the_scene_keeps_no_graph_and_values_are_not_shared(function: SceneFunction) -> None:
    values = values_of(function)
    function.gradient(values, FEW, mi.TensorXf(np.ones((6, 6, 3), np.float32)))
    assert not any(dr.grad_enabled(function.params[key]) for key in function.keys)
    assert not any(dr.grad_enabled(value) for value in values)


def test_the_scene_keeps_no_graph_after_an_error(function: SceneFunction) -> None:
    with pytest.raises(PathreplayError, match="The gradient cannot be computed"):
        function.gradient(values_of(function), FEW, mi.TensorXf(np.ones((5, 6, 3), np.float32)))
    assert not any(dr.grad_enabled(function.params[key]) for key in function.keys)


def test_what_does_not_fit_is_told(function: SceneFunction) -> None:
    shapes = {key: value.shape for key, value in function._start.items()}
    function.require(shapes)
    function.require({**shapes, TEXTURE: (5, 7, 3)})
    for wrong in ((5, 7, 1), (0, 7, 3), (7, 3)):
        with pytest.raises(PathreplayError, match="given for the parameter 'back"):
            function.require({**shapes, TEXTURE: wrong})
    with pytest.raises(PathreplayError, match=r"missing or unexpected: 'red\.reflectance\.value'"):
        function.require({TEXTURE: shapes[TEXTURE]})
    with pytest.raises(PathreplayError, match="missing or unexpected: 'blue'"):
        function.require({**shapes, "blue": (3,)})
    with pytest.raises(PathreplayError, match="Integrator 'path' computes no gradients"):
        SceneFunction("cornell-box", WALL, integrator={"type": "path"})
    with pytest.raises(PathreplayError, match="No parameter 'blue'"):
        SceneFunction("cornell-box", "blue")


@pytest.mark.parametrize(("name", "module"), [("PyTorch", "torch"), ("JAX", "jax")])
def test_one_line_says_what_is_not_installed(run_python: Any, name: str, module: str) -> None:
    code = f"""
import sys
sys.modules["{module}"] = None
import mitsuba as mi, pathreplay
mi.set_variant("llvm_ad_rgb")
try:
    import pathreplay.{module}
except pathreplay.PathreplayError as error:
    print(error)
"""
    assert run_python(code).stdout == f"{name} is not installed: pip install {module}, or 'pathreplay[{module}]'\n"


def test_arguments_of_a_loaded_scene_are_refused() -> None:
    scene = load_scene("cornell-box", resolution=4)
    with pytest.raises(PathreplayError, match=r"arguments \(resolution\) cannot be given for a loaded scene"):
        SceneFunction(scene, WALL, integrator=PLAIN, arguments={"resolution": 8})
