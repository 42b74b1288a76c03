"""Scene parameters: names found or suggested, missing derivatives explained, values carried to NumPy and back."""

from __future__ import annotations

import sys
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from end_of_page import run_at_the_end
from pathreplay.errors import PathreplayError
from pathreplay.scenes.parameters import (
    displaced,
    get_array,
    require_differentiable,
    require_finite,
    resolve_differentiable,
    resolve_keys,
    to_value,
)

# Arrays of NumPy that end where memory ends: the next page cannot be read.
AT_THE_END = """
import drjit as dr
from pathreplay.scenes.parameters import to_value

for n in (15, 16, 1000):
    values = at_the_end(np.ones(n, np.float32))
    for like in (dr.zeros(mi.Float, n), dr.zeros(mi.TensorXf, (n, 1))):
        taken = to_value(like, values.reshape(np.shape(like))) * 2
        print(n, dr.sum(taken, axis=None))
"""


def grey(*shape: int, dtype: Any = np.float32) -> Any:
    return mi.Bitmap(np.full((*shape, 3), 64 if dtype == np.uint8 else 0.5, dtype))


@pytest.fixture
def scene() -> Any:
    return mi.load_dict(
        {
            "type": "scene",
            "glass": {"type": "sphere", "bsdf": {"type": "dielectric"}},
            "lacquer": {"type": "sphere", "bsdf": {"type": "plastic"}},
            "frosted": {"type": "sphere", "bsdf": {"type": "roughdielectric"}},
            "photo": {
                "type": "cube",
                "bsdf": {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": grey(4, 6), "raw": True}},
            },
            "png": {
                "type": "rectangle",
                "bsdf": {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": grey(2, 2, dtype=np.uint8)}},
            },
            "smoke": {
                "type": "cube",
                "bsdf": {"type": "null"},
                "interior": {"type": "heterogeneous", "albedo": 0.5, "scale": 2.0, "sigma_t": {"type": "constvolume"}},
            },
            "lamp": {"type": "point", "intensity": {"type": "rgb", "value": [1, 2, 3]}},
            "sensor": {"type": "perspective"},
        },
        optimize=False,
    )


@pytest.fixture
def params(scene: Any) -> Any:
    return mi.traverse(scene)


def test_resolve_takes_keys_and_globs_once_and_in_order(params: Any) -> None:
    found = resolve_keys(params, ["lamp.intensity.value", "photo.bsdf.*", "lamp.*.value"])
    assert found == ["lamp.intensity.value", "photo.bsdf.reflectance.data", "photo.bsdf.reflectance.to_uv"]


@pytest.mark.parametrize(
    ("wrong", "suggested"),
    [
        ("photo.bsdf.reflectanse.data", "photo.bsdf.reflectance.data"),
        ("Lamp.Intensity.Value", "lamp.intensity.value"),
        ("lamp.intensity", "lamp.intensity.value"),
    ],
)
def test_resolve_suggests_the_nearest_key(params: Any, wrong: str, suggested: str) -> None:
    with pytest.raises(PathreplayError) as error:
        resolve_keys(params, wrong)
    assert str(error.value).startswith(f"No parameter '{wrong}' in the scene; nearest: {suggested}")


def test_resolve_says_when_nothing_is_near(params: Any) -> None:
    with pytest.raises(PathreplayError, match=r"No parameter 'q\*' .* no similar one"):
        resolve_keys(params, "q*")


def test_a_glob_keeps_what_has_a_derivative_and_an_exact_key_must(params: Any) -> None:
    assert resolve_differentiable(params, "photo.bsdf.*") == ["photo.bsdf.reflectance.data"]
    with pytest.raises(PathreplayError, match=r"glass\.bsdf\.eta"):
        resolve_differentiable(params, ["photo.bsdf.*", "glass.bsdf.eta"])
    with pytest.raises(PathreplayError, match=r"photo\.faces"):
        resolve_differentiable(params, "*.faces")


@pytest.mark.parametrize(
    ("key", "remedy"),
    [
        ("glass.bsdf.eta", "dielectric_ad"),
        ("lacquer.bsdf.eta", "no replacement yet"),
        ("smoke.interior_medium.scale", "multiply the values of 'sigma_t'"),
        ("png.bsdf.reflectance.data", "format='variant'"),
        ("photo.faces", "UInt"),
        ("photo.bsdf.reflectance.to_uv", "ScalarAffineTransform3f"),
        ("sensor.far_clip", "plain number (10000.0)"),
        ("sensor.to_world", "only 'pathreplay' differentiates cameras"),
        ("lamp.intensity.valve", "nearest: lamp.intensity.value"),
    ],
)
def test_a_missing_derivative_is_explained(params: Any, key: str, remedy: str) -> None:
    with pytest.raises(PathreplayError) as error:
        require_differentiable(params, key)
    assert key in str(error.value) and remedy in str(error.value) and "\n" not in str(error.value)


DIFFERENTIABLE = {
    "frosted.bsdf.eta": (1,),
    "lamp.intensity.value": (3,),
    "photo.bsdf.reflectance.data": (4, 6, 3),
    "photo.vertex_positions": (72,),
    "frosted.to_world": (4, 4),
}


@pytest.mark.parametrize("key", DIFFERENTIABLE)
def test_values_survive_the_way_through_numpy(params: Any, key: str) -> None:
    require_differentiable(params, key)
    value = params[key]
    array = get_array(value)
    assert array.shape == DIFFERENTIABLE[key] and array.dtype == np.float32
    again = to_value(value, array)
    assert type(again) is type(value)
    assert np.array_equal(get_array(again), array)
    with pytest.raises(PathreplayError, match="shape"):
        to_value(value, np.zeros((7, 5)))


@pytest.mark.parametrize("key", DIFFERENTIABLE)
def test_displaced_moves_the_value_and_carries_the_derivative(params: Any, key: str) -> None:
    value = params[key]
    direction = np.random.default_rng(1).uniform(-1, 1, DIFFERENTIABLE[key])
    t = mi.Float(0.25)
    dr.enable_grad(t)
    moved = displaced(value, direction, t)
    assert type(moved) is type(value)
    assert np.allclose(get_array(moved), get_array(value) + 0.25 * direction, atol=1e-6)
    entries = moved.matrix if key.endswith("to_world") else moved
    dr.forward(t, dr.ADFlag.ClearEdges)  # else the matrix, of which the inverse is a function, loses its own
    derivative = get_array(dr.grad(entries))
    assert np.allclose(derivative, direction, atol=1e-6)


def set_array(params: Any, key: str, array: Any) -> None:
    params[key] = to_value(params[key], array)
    params.update()


def test_arrays_reach_the_scene(scene: Any, params: Any) -> None:
    key = "photo.bsdf.reflectance.data"
    texels = np.linspace(0, 1, 72).reshape(4, 6, 3)
    set_array(params, key, texels)
    set_array(params, "lamp.intensity.value", [4, 5, 6])
    again = mi.traverse(scene)
    assert np.allclose(get_array(again[key]), texels) and np.allclose(
        get_array(again["lamp.intensity.value"]), [4, 5, 6]
    )


def test_a_finite_scene_is_accepted_and_a_bad_texel_is_named(params: Any) -> None:
    require_finite(params)
    key = "photo.bsdf.reflectance.data"
    texels = np.full((4, 6, 3), 0.5)
    texels[1, 2, 0], texels[3, 3, 1] = np.nan, np.inf
    set_array(params, key, texels)
    with pytest.raises(PathreplayError) as error:
        require_finite(params)
    for part in (key, "2 NaN or infinite of 72", "(1, 2, 0)", "nan_to_num"):
        assert part in str(error.value)


def test_an_infinite_vertex_and_colour_are_found_too(params: Any) -> None:
    for key, entry in (("photo.vertex_positions", 5), ("lamp.intensity.value", 1)):
        array = get_array(params[key])
        good = array.copy()
        array[entry] = -np.inf
        set_array(params, key, array)
        with pytest.raises(PathreplayError, match=f"{key}.*index \\({entry},\\)"):
            require_finite(params)
        set_array(params, key, good)
    require_finite(params)


@pytest.mark.skipif(sys.platform != "linux", reason="protects a page of memory")
def test_values_are_taken_from_the_end_of_memory() -> None:
    lines = run_at_the_end(AT_THE_END)
    assert [float(line.split()[1].strip("[]")) for line in lines] == [30, 30, 32, 32, 2000, 2000]
