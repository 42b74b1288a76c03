"""The parts of an optimisation job: losses, images, values, configs."""

from __future__ import annotations

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from formulas import FORMULAS
from pathreplay.errors import PathreplayError
from pathreplay.inverse.images import io as images
from pathreplay.inverse.losses.pixelwise import find_loss, mean_loss
from pathreplay.inverse.parameters.grids import resampled
from pathreplay.inverse.parameters.values import make_value
from pathreplay.jobs import load_config, make_config
from pathreplay.platform.threads import spare_thread
from pathreplay.scenes.volume_files import save_vol
from places import ROOT


@pytest.mark.parametrize("name", FORMULAS)
def test_loss_and_its_gradient_follow_the_formula(name: str) -> None:
    rng = np.random.default_rng(1)
    target = rng.uniform(0.1, 2, (3, 2, 3))
    image = target + rng.choice([-1, 1], target.shape) * rng.uniform(0.02, 0.09, target.shape)  # away from l1's kink
    x = mi.TensorXf(image.astype(np.float32))
    dr.enable_grad(x)
    loss = mean_loss(find_loss(name), x, mi.TensorXf(target.astype(np.float32)))
    dr.backward(loss)
    assert loss.array[0] == pytest.approx(FORMULAS[name](image, target), rel=1e-4)
    step = np.zeros_like(image)
    step[1, 1, 2] = 1e-4
    slope = (FORMULAS[name](image + step, target) - FORMULAS[name](image - step, target)) / 2e-4
    assert dr.grad(x).numpy()[1, 1, 2] == pytest.approx(slope, rel=1e-3)


def test_eight_bit_images_are_decoded_and_exr_is_exact(tmp_path: Path) -> None:
    linear = np.random.default_rng(2).uniform(0, 1, (5, 4, 3)).astype(np.float32)
    (tmp_path / "a.exr").write_bytes(images.exr_bytes(linear))
    (tmp_path / "a.png").write_bytes(images.png_bytes(linear))
    assert np.array_equal(images.read_image(tmp_path / "a.exr"), linear)
    decoded = images.read_image(tmp_path / "a.png")
    # Mitsuba truncates or rounds: at most one step of 1/255, times the slope of the decoding, at most 2.28 (at white).
    assert decoded == pytest.approx(linear, abs=2.28 / 255)
    stored = images.read_image(tmp_path / "a.png", raw=True)
    assert stored == pytest.approx(1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055, abs=0.04)
    assert np.abs(stored - linear).max() > 0.1


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 12])
def test_written_exr_is_read_back_exactly(tmp_path: Path, channels: int) -> None:
    image = np.random.default_rng(3).normal(0, 1e3, (6, 7, channels)).astype(np.float32)
    image[0, 0] = 3e38  # beyond half precision
    (tmp_path / "a.exr").write_bytes(images.exr_bytes(image))
    assert np.array_equal(images.read_image(tmp_path / "a.exr"), image)
    with spare_thread():
        stored = mi.Bitmap(str(tmp_path / "a.exr"))
    assert stored.component_format() == mi.Struct.Type.Float32
    kinds = {1: "Y", 2: "YA", 3: "RGB", 4: "RGBA", 12: "MultiChannel"}
    assert stored.pixel_format() == getattr(mi.Bitmap.PixelFormat, kinds[channels])


def test_crop_keeps_the_middle_and_the_aspect() -> None:
    image = np.zeros((4, 8, 1), np.float32)
    image[:, 2:6] = 1
    assert (images.resized(image, 4, 4, crop=True) == 1).all()
    assert images.resized(image, 4, 4).mean() == pytest.approx(0.5, abs=0.05)
    assert images.resized(image, 2, 2, crop=True).shape == (2, 2, 1)


@pytest.mark.parametrize(("height", "width"), [(2, 512), (512, 2)])
def test_a_crop_to_a_strip_keeps_at_least_one_pixel(height: int, width: int) -> None:
    image = np.linspace(0, 1, 40 * 64, dtype=np.float32).reshape(40, 64, 1)
    strip = images.resized(image, height, width, crop=True)
    assert strip.shape == (height, width, 1) and 0.4 < strip.mean() < 0.6


def test_channels_are_adapted_or_refused() -> None:
    colour = np.full((1, 1, 3), 0.5, np.float32)
    assert images.with_channels(colour, 1) == pytest.approx(0.5)
    assert images.with_channels(np.ones((1, 1, 4), np.float32), 3).shape == (1, 1, 3)  # type: ignore[union-attr]
    assert images.with_channels(np.ones((1, 1, 1), np.float32), 3).shape == (1, 1, 3)  # type: ignore[union-attr]
    assert images.with_channels(colour, 5) is None


def test_values_take_the_parameter_s_shape(tmp_path: Path) -> None:
    texture, colour = mi.TensorXf(np.zeros((2, 3, 3), np.float32)), mi.Color3f(0, 0, 0)
    (tmp_path / "t.exr").write_bytes(images.exr_bytes(np.full((4, 6, 3), 0.25, np.float32)))
    assert make_value("k", texture, 0.5, tmp_path).shape == (2, 3, 3)
    assert make_value("k", texture, [0.1, 0.2, 0.3], tmp_path)[1, 2] == pytest.approx([0.1, 0.2, 0.3])
    assert make_value("k", texture, "t.exr", tmp_path) == pytest.approx(0.25)
    assert make_value("k", colour, [1.0, 2.0, 3.0], tmp_path) == pytest.approx([1, 2, 3])
    with pytest.raises(PathreplayError, match="2 numbers, but the parameter takes 3"):
        make_value("k", colour, [1.0, 2.0], tmp_path)
    with pytest.raises(PathreplayError, match="not a texture"):
        make_value("k", colour, "t.exr", tmp_path)


def test_volume_files_are_values_of_grids(tmp_path: Path) -> None:
    grid = mi.TensorXf(np.zeros((4, 4, 4, 1), np.float32))
    data = np.random.default_rng(4).random((2, 3, 4, 1), np.float32)
    save_vol(tmp_path / "v.vol", data)
    assert np.array_equal(make_value("k", grid, "v.vol", tmp_path), resampled(data, (4, 4, 4, 1)))
    save_vol(tmp_path / "rgb.vol", np.zeros((2, 2, 2, 3)))
    with pytest.raises(PathreplayError, match=r"rgb\.vol has 3 channels, but 'k' has 1"):
        make_value("k", grid, "rgb.vol", tmp_path)
    with pytest.raises(PathreplayError, match=r"No volume file .*none\.vol"):
        make_value("k", grid, "none.vol", tmp_path)


def test_config_of_the_example_is_valid() -> None:
    config = load_config(ROOT / "examples/cornell-photo/config.toml")
    assert config.scene == "cornell-box-photo"
    assert len(config.parameters) == 4


MINIMAL = {"scene": "cornell-box", "parameters": [{"key": "a"}], "target": {"images": ["t.exr"]}}
BAD_CONFIGS = {
    "unknown key": ({"iteration": 3}, "unknown key 'iteration'; did you mean 'iterations'?"),
    "an unknown key with the name of a type": ({"count": 3}, "unknown key 'count'; "),
    "an unknown key of a table with the name of a type": (
        {"parameters": [{"key": "a", "float": 3}]},
        "unknown key 'parameters.0.float'; ",
    ),
    "no import path": (
        {"parameters": [{"key": "a", "regularizer": "own"}]},
        "'parameters.0.regularizer': 'own' is not an import path; write module:function",
    ),
    "a key of the library": ({"steps": 3}, "unknown key 'steps'; did you mean 'iterations'?"),
    "bounds as in the library": (
        {"parameters": [{"key": "a", "bounds": [0, 1]}]},
        "unknown key 'parameters.0.bounds'; did you mean 'lower' and 'upper'?",
    ),
    "a key of the job in a table": (
        {"optimizer": {"type": "adam", "lr": 0.1}},
        "'optimizer.lr'; 'learning_rate' is a key of the job, not of 'optimizer'",
    ),
    "a key of a table in the job": ({"masks": ["m.png"]}, "unknown key 'masks'; it is a key of 'target'"),
    "resolutions without iterations": (
        {"parameters": [{"key": "a", "resolutions": [8, 16]}]},
        "'a': 2 resolutions and 0 entries in refine_at",
    ),
    "refined backwards": (
        {"parameters": [{"key": "a", "resolutions": [4, 8, 16], "refine_at": [20, 10]}]},
        "'a': refine_at [20, 10] is not increasing",
    ),
    "refined after the end": (
        {"parameters": [{"key": "a", "resolutions": [4, 8], "refine_at": [50]}], "iterations": 50},
        "'a': refine_at 50 is not less than iterations = 50",
    ),
    "a pose has no resolutions": (
        {"parameters": [{"key": "a", "pose": "rigid", "resolutions": [4]}]},
        "'resolutions' does not apply to a pose",
    ),
    "unknown key of a parameter": (
        {"parameters": [{"key": "a", "upr": 1}]},
        "'parameters.0.upr'; did you mean 'upper'?",
    ),
    "unknown key of the target": ({"target": {"image": ["a"]}}, "'target.image'; did you mean 'images'?"),
    "unknown key of a picture": (
        {"target": {"values": {"k": {"image": "a.png", "fitt": "crop"}}}},
        "did you mean 'fit'?",
    ),
    "missing key": ({"parameters": [{"lower": 0}]}, "key 'parameters.0.key' is missing"),
    "no parameters": ({"parameters": []}, "'parameters' is []; give at least 1 entry"),
    "too many axes": (
        {"parameters": [{"key": "a", "shape": [1] * 9}]},
        "'parameters.0.shape' is [1, 1, 1, 1, 1, 1, 1, 1, 1]; give at most 8 entries",
    ),
    "an option of the optimizer": ({"tolerance": 0.1}, "unknown key 'tolerance'; it is a key of 'optimizer'"),
    "upper below lower": (
        {"parameters": [{"key": "a", "lower": 1, "upper": 0.5}]},
        "'a': upper bound 0.5 is not above lower bound 1",
    ),
    "NaN bound": ({"parameters": [{"key": "a", "lower": float("nan")}]}, "'parameters.0.lower' is nan"),
    "zero spp": ({"spp": 0}, "'spp' is 0"),
    "no iterations": ({"iterations": 0}, "'iterations' is 0"),
    "negative seed": ({"seed": -1}, "'seed' is -1"),
    "zero learning rate": ({"learning_rate": 0}, "'learning_rate' is 0"),
    "nothing to match": ({"target": {}}, "no target images"),
    "images and values": ({"target": {"images": ["a"], "values": {"k": 1}}}, "'images' excludes 'values'"),
    "an optimiser of Dr.Jit's": ({"optimizer": dr.opt.Adam(lr=0.1)}, "'optimizer' is Adam"),
    "an optimiser in the place of a target": ({"target": dr.opt.SGD(lr=0.1)}, "'target' is SGD"),
    "graded by itself": (
        {"target": {"values": {"k": 1}, "integrator": {"type": "pathreplay"}}},
        "with itself",
    ),
}


@pytest.mark.parametrize("case", BAD_CONFIGS)
def test_bad_configs_get_one_line(case: str) -> None:
    change, message = BAD_CONFIGS[case]
    with pytest.raises(PathreplayError) as caught:
        make_config({**MINIMAL, **change})
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
