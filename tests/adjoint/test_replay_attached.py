"""Attached path replay: the noise leaves the expected Jacobian product and the gradient alone; chains are exact."""

from __future__ import annotations

import gc
import sys
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from pathreplay.adjoint import replay as replay_module
from pathreplay.adjoint.ray_jacobian import Recovery, independence, random_sign
from pathreplay.testing.statistics import gap
from pathreplay.transport.vertex import VertexSamples
from places import ROOT

sys.path.insert(0, str(ROOT))  # the benchmarks run from the checkout and are not installed

from benchmarks.measures.recoveries import OtherRecovery

RESOLUTION = 8
SPP = 16
DIFFUSE = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.7, 0.9]}}
MIRROR = {"type": "conductor"}
GLASS = {"type": "dielectric_ad", "int_ior": 1.5}
ROUGH = {"type": "roughconductor", "alpha": 0.2}


# ------------------------------------------------------ scenes -------------------------------------------------------


def environment() -> dict[str, Any]:
    y, x = np.mgrid[0:16, 0:32] * (np.pi / 16)
    waves = [np.sin(x) * np.sin(y) / 2, np.cos(x + 1) * np.sin(y) / 2, np.sin(2 * x) * np.sin(y) / 3]
    return {"type": "envmap", "bitmap": mi.Bitmap((1 + np.stack(waves, axis=-1)).astype(np.float32))}


def scene_with(origin: list[float], target: list[float], **objects: Any) -> mi.Scene:
    gc.collect()  # Dr.Jit traces calls through every scene alive
    camera = {
        "type": "perspective",
        "fov": 20,
        "to_world": mi.ScalarTransform4f().look_at(origin=origin, target=target, up=[0, 0.1, 1]),
        "film": {"type": "hdrfilm", "width": RESOLUTION, "height": RESOLUTION, "rfilter": {"type": "box"}},
    }
    return mi.load_dict({"type": "scene", "camera": camera, **objects}, optimize=False)


def panes(interfaces: int) -> mi.Scene:
    """Tilted panes of glass behind one another: the path has as many delta vertices as ``max_depth`` lets it have."""
    turn, T = mi.ScalarTransform4f().rotate, mi.ScalarTransform4f
    place = [T().translate([0, 0, k / 4]) @ turn([1, k % 3, 0], 180 * (k % 2) + 3 + k) for k in range(interfaces)]
    glass = {
        f"pane{k}": {"type": "rectangle", "to_world": to @ T().scale(6), "bsdf": {"type": "ref", "id": "glass"}}
        for k, to in enumerate(place)
    }
    return scene_with([0.3, -0.2, -5], [0.3, 0, 0], env=environment(), glass=GLASS, **glass, obj=_mirror_behind())


def _mirror_behind() -> dict[str, Any]:
    """A mirror ball behind the panes, so that the chain is long and passes a curved surface in its middle."""
    return {"type": "sphere", "center": [0, 0, 9], "radius": 4, "bsdf": MIRROR}


def valley(bsdf: dict[str, Any]) -> mi.Scene:
    """Two balls and a floor that see one another."""
    bsdf, material = {"type": "ref", "id": "material"}, bsdf
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(4), "bsdf": bsdf}
    return scene_with(
        [0, -6, 2],
        [0, 0, 0.7],
        env=environment(),
        material=material,
        floor=floor,
        obj={"type": "sphere", "center": [-0.9, 0, 1], "radius": 0.9, "bsdf": bsdf},
        other={"type": "sphere", "center": [1, 0.2, 1.1], "radius": 0.9, "bsdf": bsdf},
    )


def lit_room(bsdf: dict[str, Any]) -> mi.Scene:
    """A ball and a floor under a near light: MIS weights depend on the density and on the distance of a ray."""
    light = mi.ScalarTransform4f().translate([0.5, 0, 2.5]) @ mi.ScalarTransform4f().rotate([1, 0.2, 0], 170)
    return scene_with(
        [0, -5, 1.5],
        [0, 0, 0.5],
        floor={"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3), "bsdf": bsdf},
        obj={"type": "sphere", "center": [-0.3, 0, 0.8], "radius": 0.7, "bsdf": bsdf},
        light={"type": "rectangle", "to_world": light, "emitter": {"type": "area", "radiance": 3.0}},
    )


# ----------------------------------------------------- gradients -----------------------------------------------------


def gradient(
    scene: mi.Scene,
    driver: str,
    depth: int,
    *keys: str,
    recovery: Recovery | None = None,
    seed: int = 1,
    attach: str = "delta",
) -> np.ndarray:
    """Derivative of a weighted image by three shifts and a turn of each of ``keys`` (number of keys x 4)."""
    keys = keys or ("obj.to_world",)
    integrator = mi.load_dict(
        {
            "type": "pathreplay",
            "max_depth": depth,
            "rr_depth": 1000,
            "adjoint": driver,
            "attach": attach,
            "boundary": "none",
        }
    )
    if recovery is not None:
        integrator.interior = replace(integrator.interior, recovery=recovery)
    params = mi.traverse(scene)
    still = {key: mi.Transform4f(params[key]) for key in keys}
    by = [[dr.opaque(mi.Float, 0) for _ in range(4)] for _ in keys]
    dr.enable_grad(by)
    for key, t in zip(keys, by, strict=True):
        moved = mi.Transform4f().translate(mi.Vector3f(*t[:3])) @ mi.Transform4f().rotate([0.3, 1, 0.2], t[3])
        params[key] = moved @ still[key]
    params.update()
    weights = np.random.default_rng(0).uniform(0.5, 1.5, (RESOLUTION, RESOLUTION, 3)).astype(np.float32)
    integrator.render_backward(scene, params, mi.TensorXf(weights), seed=seed, spp=SPP)
    dr.enqueue(dr.ADMode.Backward, [params[key] for key in keys])
    dr.traverse(dr.ADMode.Backward)
    result = np.array([[dr.grad(x)[0] for x in t] for t in by], dtype=np.float64)
    params.update(still)
    return result


def error(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


# --------------------------------------------- claim 1: the product survives -----------------------------------------

CHAIN = [np.random.default_rng(k).normal(size=(4, 4)) for k in range(4)]
CHAIN[1][:, 2:] = CHAIN[1][:, :2] @ [[0.5, 0.2], [-0.1, 0.7]]  # of rank two, as at a diffuse vertex
CHAIN[3][2:] = 0.3 * CHAIN[3][:2]


@pytest.mark.parametrize("place", ["everywhere", "smooth", "directions"])
def test_noise_leaves_the_expected_product_of_jacobians_alone(place: str) -> None:
    draws = 200_000
    rng = mi.PCG32(size=draws)
    real = dr.float64_array_t(mi.Matrix4f)
    product = real(1)
    expected = np.eye(4)
    for k, A in enumerate(CHAIN):
        numbers = [rng.next_float32() for _ in range(6)]
        u = VertexSamples(mi.Point2f(*numbers[:2]), numbers[2], mi.Point2f(*numbers[3:5]), numbers[5])
        recovery = OtherRecovery(noise=0.7, place=place)
        product = recovery.regularised(real(A), random_sign(u), mi.Bool(k % 2 == 1)) @ product
        expected = A @ expected
    found = np.array([[np.array(product[i, j]) for j in range(4)] for i in range(4)])
    spread = found.std(axis=-1)
    assert spread.max() > 0.1  # there is noise
    z = (found.mean(axis=-1) - expected) / (spread / np.sqrt(draws) + 1e-9)
    assert np.abs(z).max() < 4.5, z  # 16 entries, three places: 4.5 standard errors happen once in 3000 runs


def test_the_sign_repeats_and_has_mean_zero() -> None:
    rng = mi.PCG32(size=100_000)
    numbers = [rng.next_float32() for _ in range(6)]
    u = VertexSamples(mi.Point2f(*numbers[:2]), numbers[2], mi.Point2f(*numbers[3:5]), numbers[5])
    signs = np.array(random_sign(u))
    assert np.array_equal(signs, np.array(random_sign(u)))
    assert set(signs) == {-1.0, 1.0}
    assert abs(signs.mean()) < 4 / np.sqrt(len(signs))


def test_noise_only_where_the_matrix_is_ill_conditioned() -> None:
    real = dr.float64_array_t(mi.Matrix4f)
    well, singular = real(CHAIN[0]), real(CHAIN[1])
    assert independence(well)[0] > 0.01
    assert independence(singular)[0] < 1e-12
    recovery = Recovery(noise=0.5)
    assert dr.allclose(recovery.regularised(well, mi.Float(1), mi.Bool(True)), well)
    assert independence(recovery.regularised(singular, mi.Float(1), mi.Bool(False)))[0] > 1e-3


# --------------------------------------------- claim 2: the gradient survives ----------------------------------------


def test_a_chain_of_sixteen_delta_lobes_agrees_with_the_sweep() -> None:
    scene, keys = panes(12), ("obj.to_world", "pane0.to_world", "camera.to_world")
    expected = gradient(scene, "recorded", 16, *keys)
    found = gradient(scene, "replay", 16, *keys, recovery=Recovery(noise=0))
    single = gradient(scene, "replay", 16, *keys, recovery=OtherRecovery(noise=0, double=False))
    shorter = gradient(scene, "recorded", 15, *keys)
    for k in range(len(keys)):
        assert error(found[k], expected[k]) < 1e-5
        assert error(single[k], expected[k]) < 1e-5
        # The chain is that long: without its last vertex the gradient is another.
        assert error(shorter[k], expected[k]) > 1e-3


@pytest.mark.parametrize(
    ("scene", "depth", "recovery"),
    [
        pytest.param(lambda: panes(2), 6, OtherRecovery(noise=0.2, place="everywhere"), marks=pytest.mark.slow),
        pytest.param(lambda: valley(DIFFUSE), 3, OtherRecovery(noise=0.5, place="smooth"), marks=pytest.mark.slow),
        (lambda: valley(DIFFUSE), 4, Recovery(noise=0.5)),
        pytest.param(lambda: valley(ROUGH), 4, Recovery(noise=0.5), marks=pytest.mark.slow),
    ],
    ids=["glass", "diffuse-identity", "diffuse", "rough-metal"],
)
def test_noise_leaves_the_gradient_unbiased(scene: Any, depth: int, recovery: Recovery) -> None:
    scene = scene()
    seeds = range(1, 17)
    differences = np.array(
        [
            gradient(scene, "replay", depth, recovery=recovery, seed=k) - gradient(scene, "recorded", depth, seed=k)
            for k in seeds
        ]
    )
    assert np.abs(differences).max() > 1e-5  # the noise is there
    # 4.5 standard errors of 16 seeds are as improbable as 3.5 of very many.
    assert np.abs(gap(differences, np.zeros((1, 4))).z).max() < 3.5, gap(differences, np.zeros((1, 4)))


@pytest.mark.parametrize(
    ("bsdf", "attach", "key"),
    [
        (DIFFUSE, "delta", "obj.to_world"),
        pytest.param(DIFFUSE, "delta", "camera.to_world", marks=pytest.mark.slow),
        pytest.param(ROUGH, "delta", "light.to_world", marks=pytest.mark.slow),
        (ROUGH, "all", "obj.to_world"),
    ],
    ids=["diffuse", "diffuse-camera", "rough-metal-light", "rough-metal-all"],
)
def test_density_and_distance_reach_the_mis_weight_of_the_next_emission(attach: str, bsdf: Any, key: str) -> None:
    scene = lit_room(bsdf)
    found = gradient(scene, "replay", 4, key, recovery=Recovery(noise=1e-3), attach=attach)
    assert error(found, gradient(scene, "recorded", 4, key, attach=attach)) < 1e-3


@pytest.mark.slow
def test_float64_books_reach_further_than_float32() -> None:
    """What is left: rounding that the inverses magnify. With float32 it beats the gradient after a few bounces."""
    scene = valley(DIFFUSE)
    expected = gradient(scene, "recorded", 8)
    books = {double: OtherRecovery(double=double) for double in (True, False)}
    by_double = {d: error(gradient(scene, "replay", 8, recovery=books[d]), expected) for d in books}
    assert by_double[True] < 0.01
    assert by_double[False] > 10 * by_double[True]


@pytest.mark.slow
def test_rough_metal_sampled_attached_needs_noise_at_few_vertices() -> None:
    scene = valley(ROUGH)
    expected = gradient(scene, "recorded", 6, attach="all")
    places = {place: OtherRecovery(noise=0.1, place=place) for place in ("directions", "smooth")}
    noisy = {p: error(gradient(scene, "replay", 6, recovery=places[p], attach="all"), expected) for p in places}
    assert noisy["directions"] < 0.01 * noisy["smooth"]


# ------------------------------------------------------ honesty ------------------------------------------------------


def test_without_noise_the_gradient_stays_finite() -> None:
    found = gradient(valley(DIFFUSE), "replay", 6, recovery=Recovery(noise=0))
    assert np.isfinite(found).all()


def test_smooth_lobes_on_moving_paths_are_warned_of_once(capfd: pytest.CaptureFixture[str]) -> None:
    replay_module._warn_of_smooth_lobes.cache_clear()
    scene = valley(DIFFUSE)
    gradient(scene, "replay", 2)
    gradient(scene, "replay", 2)
    told = capfd.readouterr()
    assert (told.out + told.err).count("adjoint = 'recorded' has no such limit") == 1


def test_negative_noise_is_refused() -> None:
    # Mitsuba's loader wraps what a plugin raises into an error of its own.
    with pytest.raises(Exception, match=r"noise = -0\.1: use a finite standard deviation >= 0"):
        mi.load_dict({"type": "pathreplay", "jacobian_noise": -0.1})
