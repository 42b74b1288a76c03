"""`debias`: the bias that noise causes in a smooth loss falls to second order, in loss and gradient."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import pathreplay
from pathreplay.errors import PathreplayError
from pathreplay.inverse.losses.pixelwise import LOSSES
from pathreplay.inverse.objective.frozen import ViewTarget, _extrapolated
from pathreplay.jobs import make_config

RED, LIGHT = "red.reflectance.value", "light.emitter.radiance.value"
SMOOTH = ("log", "ssim", "scale-invariant")


@pytest.mark.parametrize("shares", [(0.5, 0.5), (0.6, 0.4)])
def test_the_extrapolated_loss_of_noisy_images_has_a_small_bias(shares: tuple[float, float]) -> None:
    rng, N, loss = np.random.default_rng(0), 40, LOSSES["log"]
    # Gamma variates with the mean 1 and the variance of N s_i samples.
    images = [mi.TensorXf(rng.gamma(N * s, 1 / (N * s), (1000, 1000, 1)).astype(np.float32)) for s in shares]
    target = ViewTarget(mi.TensorXf(np.full((1000, 1000, 1), 0.8, np.float32)))
    gap = np.log(2) - np.log(1.8)
    value, terms = _extrapolated(loss, target, images, list(shares))
    plain = target.compared(loss, terms[0][1])
    assert plain[0] > 1.4 * gap**2
    assert abs(value[0] - gap**2) < 0.05 * (plain[0] - gap**2)
    dr.enable_grad(images)
    value, _ = _extrapolated(loss, target, images, list(shares))
    dr.backward(value)
    gradient = sum(float(dr.sum(dr.grad(image), axis=None).array[0]) for image in images)
    assert gradient == pytest.approx(gap, rel=0.01)  # 2 (log(1 + I) - log(1 + T)) / (1 + I) at I = 1


def problem(loss: str, spp: int, target: np.ndarray, **settings: object) -> pathreplay.Problem:
    box = mi.cornell_box()
    box["sensor"]["film"].update(width=24, height=24)
    parameters = {
        RED: pathreplay.Parameter(initial=[0.45, 0.1, 0.1], bounds=(0, 1)),
        LIGHT: pathreplay.Parameter(initial=[15.0, 12.0, 6.0]),
    }
    return pathreplay.Problem(box, parameters, pathreplay.View(target=target), spp=spp, loss=loss, **settings)


@pytest.fixture(scope="module")
def target() -> np.ndarray:
    box = mi.cornell_box()
    box["sensor"]["film"].update(width=24, height=24)
    return np.array(mi.render(mi.load_dict(box), spp=1024))


def gradients(problem: pathreplay.Problem, passes: int, first: int = 1) -> np.ndarray:
    f = pathreplay.value_and_grad(problem)
    found = [f({}, seed=first + n)[1] for n in range(passes)]
    return np.array([np.concatenate([np.ravel(g[key]) for key in (RED, LIGHT)]) for g in found])


def bias(loss: str, spp: int, target: np.ndarray, passes: int, exact: np.ndarray, **settings: object) -> list[float]:
    """The distance of the mean gradient from the exact one, and its standard error; relative to its norm."""
    found = gradients(problem(loss, spp, target, **settings), passes)
    error = np.linalg.norm(found.std(axis=0, ddof=1)) / passes**0.5
    return [float(x / np.linalg.norm(exact)) for x in (np.linalg.norm(found.mean(axis=0) - exact), error)]


def test_the_gradient_of_a_rendered_loss_loses_most_of_its_bias(target: np.ndarray) -> None:
    exact = gradients(problem("ssim", 256, target), 4, first=9000).mean(axis=0)
    plain, noise = bias("ssim", 8, target, 15, exact)
    ours, ours_noise = bias("ssim", 8, target, 15, exact, debias=True)
    assert noise < 0.02 and ours_noise < 0.02
    assert plain > 0.08
    assert ours < plain / 2


def test_the_gradient_of_an_exposure_loses_most_of_its_bias(target: np.ndarray) -> None:
    def by_exposure(spp: int, passes: int, **settings: object) -> tuple[float, float]:
        f = pathreplay.value_and_grad(problem("log", spp, 13 * target, exposure={"fix_scale": False}, **settings))
        found = [f({LIGHT: np.float32([150, 120, 60])}, seed=1 + n)[1]["exposure"].item() for n in range(passes)]
        return float(np.mean(found)), float(np.std(found, ddof=1) / passes**0.5)

    exact, noise = by_exposure(512, 4)
    plain, ours = by_exposure(8, 64), by_exposure(8, 64, debias=True)
    assert abs(plain[0] - exact) > 4 * max(noise, plain[1], ours[1])
    assert abs(ours[0] - exact) < abs(plain[0] - exact) / 3


def test_an_odd_number_of_samples_is_split(target: np.ndarray) -> None:
    f = pathreplay.value_and_grad(problem("log", 3, target, debias=True))
    first, again = f({}, seed=3), f({}, seed=3)  # traced, then recorded
    assert again[0] == pytest.approx(first[0], rel=1e-4)
    assert again[1][RED] == pytest.approx(first[1][RED], rel=1e-3, abs=1e-7)


@pytest.mark.parametrize(
    "loss, spp, message",
    [
        ("l2", 4, "the gradient of loss = 'l2' has no bias"),
        ("l1", 4, "loss = 'l1' is not smooth"),
        ("log", 1, "two halves of the samples; set spp to 2 or more"),
    ],
)
def test_where_it_cannot_help_it_is_refused(loss: str, spp: int, message: str) -> None:
    with pytest.raises(PathreplayError, match=message):
        problem(loss, spp, np.zeros((24, 24, 3), np.float32), debias=True)


def test_shards_of_a_fixed_number_of_samples_are_not_those_of_an_adaptive_one() -> None:
    job = {"scene": "cornell-box", "parameters": [{"key": "red.reflectance.value"}], "loss": "log", "debias": True}
    make_config({**job, "target": {"values": {"red.reflectance.value": 0.5}}, "spp": 64, "spp_shards": 8})
    with pytest.raises(PathreplayError, match="set spp to 16 or more"):
        make_config({**job, "target": {"values": {"red.reflectance.value": 0.5}}, "spp": 8, "spp_shards": 8})


def test_a_stage_with_its_own_samples_is_not_split_into_the_halves_of_adaptive_ones() -> None:
    job = {"scene": "cornell-box", "parameters": [{"key": "red.reflectance.value"}], "spp": "auto"}
    job |= {"target": {"values": {"red.reflectance.value": 0.5}}, "stages": [{"iterations": 1, "spp": 2}]}
    make_config({**job, "spp_shards": 2})
    make_config({**job, "loss": "log", "debias": True})
    with pytest.raises(PathreplayError, match="multiple of 4"):
        make_config({**job, "spp_shards": 2, "measure_snr": True})


@pytest.mark.slow
def test_table(target: np.ndarray) -> None:
    for loss in SMOOTH:
        exact = gradients(problem(loss, 1024, target), 8, first=9000).mean(axis=0)
        cells = []
        for spp in (4, 16):
            plain, noise = bias(loss, spp, target, 400, exact)
            ours, ours_noise = bias(loss, spp, target, 400, exact, debias=True)
            cells += [f"{plain:.3f} ± {noise:.3f}", f"{ours:.3f} ± {ours_noise:.3f}"]
            assert plain > 4 * noise or spp == 16
            assert ours < max(plain / 2, 4 * ours_noise)
        print(f"| `{loss}` | {' | '.join(cells)} |")
