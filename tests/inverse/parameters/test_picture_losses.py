"""Losses in which pixels meet: as their formulas say, by finite differences, masks included; and in a job."""

from __future__ import annotations

import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scipy.ndimage

from formulas import FORMULAS
from pathreplay.errors import PathreplayError
from pathreplay.inverse.images.io import encoded
from pathreplay.inverse.images.metrics import C1, C2, CUT, SIGMA, _similarity
from pathreplay.inverse.losses import image_losses as losses
from pathreplay.inverse.losses.pixelwise import LOSSES, find_loss, mean_loss
from pathreplay.jobs import make_config, optimize
from wall_job import JOB

Pair = tuple[np.ndarray, np.ndarray]


def pictures(shape: tuple[int, ...]) -> Pair:
    rng = np.random.default_rng(1)
    target = rng.uniform(0.02, 0.9, shape)
    return target * rng.uniform(0.6, 1.1, shape), target


def weights(shape: tuple[int, ...]) -> np.ndarray:
    weight = np.random.default_rng(2).uniform(0, 1, (*shape[:2], 1))
    weight[:2] = 0
    return weight / weight.mean()


def scaled(image: np.ndarray, target: np.ndarray, weight: np.ndarray | float) -> float:
    s = (weight * image * target).sum() / (weight * image**2).sum()
    return float((weight * (s * image - target) ** 2).mean())


def structural(image: np.ndarray, target: np.ndarray, weight: np.ndarray | float) -> float:
    """By the SSIM that reports have, which is another code (SciPy's windows)."""
    a, b = (encoded(x).astype(float) for x in (np.where(np.asarray(weight) > 0, image, target), target))
    return float((weight * (1 - _similarity(a, b, np.ones((*a.shape[:2], 1))))).mean())


EXPECTED: dict[str, Callable[..., float]] = {"scale-invariant": scaled, "ssim": structural}


def value_and_gradient(name: str, image: np.ndarray, target: np.ndarray, weight: Any) -> tuple[float, np.ndarray]:
    x = mi.TensorXf(image.astype(np.float32))
    dr.enable_grad(x)
    given = None if weight is None else mi.TensorXf(weight.astype(np.float32))
    loss = mean_loss(find_loss(name), x, mi.TensorXf(target.astype(np.float32)), given)
    dr.backward(loss)
    return float(np.array(loss).item()), np.array(dr.grad(x), dtype=np.float64)


def test_every_loss_has_a_formula() -> None:
    assert {*FORMULAS, *EXPECTED, "lpips"} == set(LOSSES)


QUICK = ("scale-invariant", (9, 7, 3), True), ("ssim", (3, 2, 1), False)
CASES = [(name, shape, masked) for name in EXPECTED for shape in ((9, 7, 3), (3, 2, 1)) for masked in (False, True)]


@pytest.mark.parametrize(
    ("name", "shape", "masked"), [c if c in QUICK else pytest.param(*c, marks=pytest.mark.slow) for c in CASES]
)
def test_a_loss_and_its_gradient_follow_the_formula(name: str, shape: tuple[int, ...], masked: bool) -> None:
    image, target = pictures(shape)
    weight = weights(shape) if masked else None
    value, gradient = value_and_gradient(name, image, target, weight)
    w = 1.0 if weight is None else weight

    def formula(x: np.ndarray) -> float:
        return EXPECTED[name](x, target, w)

    assert value == pytest.approx(formula(image), rel=2e-4)
    δ = np.random.default_rng(3).uniform(-1, 1, shape)
    for direction in (δ, np.where(np.arange(δ.size).reshape(shape) == δ.size // 2, 1.0, 0.0)):
        h = 1e-3
        slope = (formula(image + h * direction) - formula(image - h * direction)) / (2 * h)
        assert np.vdot(gradient, direction) == pytest.approx(slope, rel=5e-3, abs=2e-6)


def test_hidden_pixels_do_not_reach_into_visible_ones() -> None:
    image, target = pictures((9, 7, 3))
    weight = np.where(np.arange(7) < 4, 7 / 4, 0.0)[None, :, None] * np.ones((9, 1, 1))
    value, gradient = value_and_gradient("ssim", image, target, weight)
    other = value_and_gradient("ssim", np.where(weight > 0, image, 5 * image), target, weight)
    assert value == other[0] > 0 and (gradient == other[1]).all()
    assert (gradient[:, 4:] == 0).all() and (gradient[:, :4] != 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", EXPECTED)
def test_at_the_target_and_in_the_dark_gradients_are_numbers(name: str) -> None:
    _, target = pictures((6, 6, 3))
    for image in (target, np.zeros_like(target), 50 * target, -target):
        value, gradient = value_and_gradient(name, image, target, None)
        assert np.isfinite(value) and np.isfinite(gradient).all()
    assert value_and_gradient(name, target, target, None)[0] == pytest.approx(0, abs=1e-6)
    assert np.isfinite(value_and_gradient(name, target, np.zeros_like(target), None)[1]).all()


@pytest.mark.parametrize("name", ["log", "ssim"])
def test_black_pixels_have_a_gradient(name: str) -> None:
    """Otherwise, a light whose intensity is zero would keep it."""
    _, target = pictures((6, 6, 3))
    black = np.zeros_like(target)
    value, gradient = value_and_gradient(name, black, target, None)
    brighter = value_and_gradient(name, black + 1e-4, target, None)[0]
    assert gradient.sum() == pytest.approx((brighter - value) / 1e-4, rel=0.05)
    assert gradient.sum() < 0


def test_even_regions_of_high_radiance_are_compared_in_double_precision() -> None:
    """A variance is a difference of squares, which single precision rounds to more than the constants of SSIM."""
    _, target = pictures((24, 24, 3))
    target[4:, 4:] = 1e4
    image = np.where(target == 1e4, 1.001e4, 1.05 * target)
    image, target = (x.astype(np.float32).astype(np.float64) for x in (image, target))
    value, gradient = value_and_gradient("ssim", image, target, None)

    def at(scale: float) -> float:
        return exact_ssim(np.where(target == 1e4, scale * image, image), target)

    assert value == pytest.approx(at(1), rel=1e-3)
    along = np.where(target == 1e4, image, 0)
    assert np.vdot(gradient, along) == pytest.approx((at(1 + 1e-4) - at(1 - 1e-4)) / 2e-4, rel=1e-2)


def exact_ssim(image: np.ndarray, target: np.ndarray) -> float:
    """In double precision, unlike the SSIM of reports, with colours that are not clipped."""

    def blurred(x: np.ndarray) -> np.ndarray:
        window = np.exp(-0.5 * (np.arange(-CUT, CUT + 1) / SIGMA) ** 2)
        for axis in (0, 1):
            x = scipy.ndimage.correlate1d(x, window / window.sum(), axis=axis, mode="reflect")
        return x

    a, b = (
        np.where(x > 0.0031308, 1.055 * np.maximum(x, 0.0031308) ** (1 / 2.4) - 0.055, 12.92 * x)
        for x in (image, target)
    )
    m, n = blurred(a), blurred(b)
    s, t, c = blurred(a * a) - m * m, blurred(b * b) - n * n, blurred(a * b) - m * n
    return float(np.mean(1 - (2 * m * n + C1) * (2 * c + C2) / ((m * m + n * n + C1) * (s + t + C2))))


def test_a_factor_does_not_count() -> None:
    image, target = pictures((6, 6, 3))
    values = [value_and_gradient("scale-invariant", k * image, target, None)[0] for k in (0.1, 1.0, 10.0)]
    assert values == pytest.approx([values[1]] * 3, rel=1e-5)
    assert value_and_gradient("scale-invariant", 3 * target, target, None)[0] == pytest.approx(0, abs=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ssim", "scale-invariant", "smape", "relative-l1"])
@pytest.mark.parametrize("integrator", ["pathreplay", "prb"])
def test_a_job_learns_by_it(name: str, integrator: str, wall_room: Path) -> None:
    """Recorded passes, too: more iterations than the two that are traced."""
    entry = {**JOB["parameters"][0], "initial": [0.2, 0.5, 0.3], "lower": 0.0, "upper": 1.0}
    plugin = {"type": integrator, "max_depth": 2}
    job = {**JOB, "integrator": plugin, "loss": name, "spp": 64, "parameters": [entry], "deterministic": False}
    result = optimize(make_config({**job, "iterations": 40, "target": {**JOB["target"], "spp": 1024}}), progress=False)
    key = entry["key"]
    found, truth = result.parameters[key], np.float32(JOB["target"]["values"][key])
    if name == "scale-invariant":
        found, truth = found / found[0], truth / truth[0]
    before = np.abs(np.float32(entry["initial"]) - np.float32(JOB["target"]["values"][key])).max()
    assert np.abs(found - truth).max() < 0.5 * before
    assert result.history[-1].loss < result.history[0].loss


# ------------------------------ A network ------------------------------


@pytest.fixture
def stub(monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    """A module `lpips` with a small network of random weights; the real one loads its own from elsewhere."""
    torch = pytest.importorskip("torch")

    class LPIPS(torch.nn.Module):  # type: ignore[misc, name-defined]
        def __init__(self, net: str, spatial: bool, verbose: bool) -> None:
            super().__init__()
            assert (net, spatial) == ("alex", True)
            torch.manual_seed(0)
            self.layer = torch.nn.Conv2d(3, 8, 3, padding=1)

        def forward(self, a: Any, b: Any) -> Any:
            return ((torch.tanh(self.layer(a)) - torch.tanh(self.layer(b))) ** 2).mean(1, keepdim=True)

    module = types.ModuleType("lpips")
    module.LPIPS = LPIPS  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "lpips", module)
    losses._network.cache_clear()
    yield module  # type: ignore[misc]
    losses._network.cache_clear()


@pytest.mark.parametrize("masked", [False, True])
def test_a_networks_gradient_follows_its_value(stub: types.ModuleType, masked: bool) -> None:
    shape = (8, 6, 3)
    image, target = pictures(shape)
    weight = weights(shape) if masked else None
    _, gradient = value_and_gradient("lpips", image, target, weight)
    δ, h = np.random.default_rng(3).uniform(-1, 1, shape) * image, 2e-2
    up, down = (value_and_gradient("lpips", image + k * h * δ, target, weight)[0] for k in (1, -1))
    assert np.vdot(gradient, δ) == pytest.approx((up - down) / (2 * h), rel=1e-2)
    assert value_and_gradient("lpips", target, target, weight)[0] == pytest.approx(0, abs=1e-9)


@pytest.mark.slow
def test_a_job_learns_by_a_network(stub: types.ModuleType, wall_room: Path) -> None:
    result = optimize(make_config({**JOB, "loss": "lpips", "spp": 64, "iterations": 20}), progress=False)
    assert result.history[-1].loss < 0.7 * result.history[0].loss


def test_without_the_module_one_line_says_so(wall_room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "lpips", None)
    losses._network.cache_clear()
    with pytest.raises(PathreplayError, match=r"Loss 'lpips' needs a package .*pip install 'pathreplay\[lpips\]'"):
        optimize(make_config({**JOB, "loss": "lpips"}), progress=False)
    assert [path.name for path in wall_room.iterdir()] == ["room.xml"]


def test_weights_that_cannot_be_loaded_are_told_in_one_line(wall_room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def offline(**options: Any) -> None:
        raise OSError("<urlopen error [Errno -2] Name or service not known>")

    module = types.ModuleType("lpips")
    module.LPIPS = offline  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "lpips", module)
    losses._network.cache_clear()
    with pytest.raises(PathreplayError, match="Loss 'lpips' cannot load the weights of its network"):
        optimize(make_config({**JOB, "loss": "lpips"}), progress=False)
