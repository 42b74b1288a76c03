"""The camera response: its two directions, its derivatives, and what is recovered from a photographed chart."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scipy.ndimage

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.schema import make_config
from pathreplay.inverse.images.io import encoded, exr_bytes
from pathreplay.inverse.losses.pixelwise import LOSSES, mean_loss
from pathreplay.inverse.objective.evaluate import Evaluator, Shard
from pathreplay.inverse.parameters.response import (
    RESPONSE,
    coordinates,
    decoded,
    gradient,
    linearized,
    start,
    stored,
)
from pathreplay.inverse.problem.problem import build_problem
from pathreplay.jobs import optimize

BENT = np.array([0, 0.05, 0.2, 0.3, 0.55, 0.7, 0.8, 0.92, 1], np.float32)
PICTURE = np.random.default_rng(2).uniform(0.0, 1.1, (5, 7, 3)).astype(np.float32)


def test_the_initial_response_changes_nothing() -> None:
    for segments in (None, 8):
        values = {RESPONSE: start(segments)}
        np.testing.assert_allclose(linearized(values, PICTURE), PICTURE, rtol=2e-6, atol=1e-7)
        np.testing.assert_allclose(stored(values, PICTURE), PICTURE, rtol=2e-6, atol=1e-7)
    assert linearized({}, PICTURE) is PICTURE
    assert stored({}, PICTURE) is PICTURE


@pytest.mark.parametrize("curve", [BENT, np.array([1.7], np.float32)], ids=["curve", "gamma"])
def test_what_is_stored_is_the_inverse(curve: np.ndarray) -> None:
    values = {RESPONSE: curve}
    there = linearized(values, PICTURE)
    assert np.abs(there - PICTURE).max() > 0.05
    np.testing.assert_allclose(stored(values, there), PICTURE, rtol=1e-5, atol=1e-6)
    with_alpha = np.concatenate([PICTURE, PICTURE[:, :, :1]], axis=2)
    np.testing.assert_array_equal(linearized(values, with_alpha)[:, :, 3], PICTURE[:, :, 0])


def test_sRGB_is_decoded() -> None:
    ramp = np.linspace(0, 1, 101)
    np.testing.assert_allclose(encoded(decoded(ramp)), ramp, atol=1e-6)


@pytest.mark.parametrize("curve", [BENT, np.array([1.7], np.float32)], ids=["curve", "gamma"])
def test_gradient_by_the_curve_against_finite_differences(curve: np.ndarray) -> None:
    by_target = np.random.default_rng(3).normal(size=PICTURE.shape)
    found = gradient({RESPONSE: curve}, PICTURE, by_target)

    def total(values: np.ndarray) -> float:
        return float((linearized({RESPONSE: values}, PICTURE).astype(np.float64) * by_target).sum())

    for k in range(len(curve)):
        step = np.zeros(len(curve), np.float32)
        step[k] = 2e-3
        assert found[k] == pytest.approx((total(curve + step) - total(curve - step)) / 4e-3, rel=5e-3, abs=5e-3)


@pytest.mark.parametrize("fix_exponent", [False, True])
def test_coordinates_of_a_curve(fix_exponent: bool) -> None:
    """Steps keep the curve monotone and its fixed knots; the gradient is that of the map from steps to knots."""
    curve = coordinates(BENT, fix_exponent)
    u = curve.latent(BENT)
    np.testing.assert_allclose(curve.values(u), BENT, atol=1e-6)
    wild = curve.values(u + np.random.default_rng(4).normal(0, 2, u.shape).astype(np.float32))
    assert (np.diff(wild) > 0).all()
    assert wild[0] == 0
    assert wild[-1] == 1
    assert (wild[4] == BENT[4]) == fix_exponent
    by_values = np.random.default_rng(5).normal(size=len(BENT)).astype(np.float32)
    found = curve.gradient(BENT, by_values)
    for k in range(len(u)):
        step = np.zeros(len(u), np.float32)
        step[k] = 1e-2
        slope = (curve.values(u + step).astype(np.float64) - curve.values(u - step)) @ by_values / 2e-2
        assert found[k] == pytest.approx(slope, rel=1e-3, abs=1e-4)


# ---------------------------------------- a photographed chart ----------------------------------------

SIZE, VIEWS = 20, 5
EXPOSURES = np.array([[1.0, 1.0, 1.0], [0.7, 0.75, 0.8], [1.3, 1.2, 1.25], [0.85, 0.9, 0.8], [1.1, 1.15, 1.2]])
CAMERA = np.array([0, 0.04, 0.11, 0.2, 0.32, 0.46, 0.62, 0.8, 1], np.float32)
"""The knots of the true curve: the photos are brighter than sRGB."""
MOVED = 3
"""The view whose pose in the capture is wrong."""


def chart() -> np.ndarray:
    """Smooth patches of all brightnesses."""
    patches = np.random.default_rng(0).uniform(0, 1, (8, 8, 3))
    smooth = scipy.ndimage.zoom(patches, (4, 4, 1), order=3, mode="nearest").clip(0, 1)
    return (0.003 + 0.65 * smooth**2).astype(np.float32)


SCENE = """<scene version="3.0.0"><integrator type="pathreplay"><integer name="max_depth" value="2"/></integrator>
  <shape type="rectangle" id="chart"><transform name="to_world"><scale value="2.5"/></transform>
    <bsdf type="diffuse"><texture type="bitmap" name="reflectance"><string name="filename" value="chart.exr"/>
    <boolean name="raw" value="true"/></texture></bsdf></shape>
  <emitter type="directional"><vector name="direction" x="0" y="0" z="-1"/>
    <rgb name="irradiance" value="3.14159265"/></emitter></scene>"""


def poses() -> list[np.ndarray]:
    """Camera to world, in OpenGL's axes."""
    places = []
    for k in range(VIEWS):
        turn = np.radians(4.0 * (k - 2))
        matrix = np.eye(4)
        matrix[:3, :3] = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
        matrix[:3, 3] = [0.25 * (k - 2), 0.1 * (k % 2), 3.0]
        places.append(matrix)
    return places


def photographed(folder: Path) -> dict[str, Any]:
    """Take photos with a phone: exposures, white balance, response, sharpening and noise; and return a job."""
    (folder / "chart.exr").write_bytes(exr_bytes(chart()))
    (folder / "scene.xml").write_text(SCENE)
    scene = mi.load_file(str(folder / "scene.xml"))
    frames, rng = [], np.random.default_rng(1)
    for k, matrix in enumerate(poses()):
        film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
        to_world = mi.ScalarTransform4f((matrix @ np.diag([-1.0, 1, -1, 1])).tolist())
        camera = mi.load_dict({"type": "perspective", "fov": 50, "to_world": to_world, "film": film})
        image = np.array(mi.render(scene, sensor=camera, integrator=mi.load_dict({"type": "path", "max_depth": 2}),
                                   spp=1024, seed=k)) * EXPOSURES[k]  # fmt: skip
        image = image + 0.05 * (image - scipy.ndimage.gaussian_filter(image, (1, 1, 0), mode="nearest"))
        image = (image + rng.normal(0, 1e-3, image.shape)).clip(0, 1)
        (folder / f"{k}.exr").write_bytes(exr_bytes(stored({RESPONSE: CAMERA}, image.astype(np.float32))))
        given = matrix.copy()
        if k == MOVED:
            given[:3, 3] += [0.05, -0.04, 0.0]
        frames.append({"file_path": f"{k}.exr", "transform_matrix": given.tolist()})
    table = {"camera_angle_x": float(np.radians(50)), "w": SIZE, "h": SIZE, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(table))
    return {
        "scene": "scene.xml",
        "loss": "display-l2",
        "capture": {"transforms": "transforms.json"},
        "integrator": {"type": "pathreplay", "max_depth": 2, "boundary": "none"},
        "exposure": {"white_balance": True, "reference": "0", "learning_rate": 0.03},
        "response": {"segments": 8, "learning_rate": 0.1},
        "parameters": [{"key": f"{MOVED}.to_world", "pose": "translation", "learning_rate": 0.004}],
        "iterations": 300,
        "spp": 16,
        "eval_spp": 16,
        "final_learning_rate_ratio": 0.03,
        "preview": {"share": 0.0},
    }


@pytest.mark.slow
def test_exposures_response_and_pose_come_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = optimize(make_config(photographed(tmp_path)), output=tmp_path / "run", progress=False)
    found = result.parameters
    assert np.abs(np.array(found["exposure"]) / EXPOSURES - 1).max() < 0.01
    off = np.abs(np.array(found[RESPONSE]) - CAMERA)
    assert off[1] < 0.03  # few pixels are as dark, and their noise is large
    assert off[2:].max() < 0.01
    assert np.abs(CAMERA - start(8)).max() > 0.15
    moved = np.array(found[f"{MOVED}.to_world:translation"])
    np.testing.assert_allclose(moved, [-0.05, 0.04, 0.0], atol=0.004)


@pytest.mark.parametrize("swept", [True, False])
def test_gradient_of_the_loss_against_finite_differences(tmp_path: Path, swept: bool) -> None:
    """By the knots, in one pass with the image or in two."""
    job = photographed(tmp_path)
    job["parameters"] = [{"key": "chart.bsdf.reflectance.data"}]
    job["loss"] = "l2"  # without weights, which the gradient holds fixed
    job["integrator"]["adjoint"] = "recorded" if swept else "replay"
    problem = build_problem(make_config(job), tmp_path)
    evaluate = Evaluator(problem, problem.integrator)
    values = {v.key: v.start for v in problem.variables} | {RESPONSE: CAMERA}
    shard = Shard((1,), 16, (7,))

    def loss(curve: np.ndarray) -> float:
        return evaluate({**values, RESPONSE: curve}, shard, {}).loss

    found = evaluate(values, shard, {}).gradients[RESPONSE]
    for k in (2, 5):
        step = np.zeros(9, np.float32)
        step[k] = 5e-3
        assert found[k] == pytest.approx((loss(CAMERA + step) - loss(CAMERA - step)) / 1e-2, rel=0.02)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"loss": "l1"}, "not quadratic"),
        ({"optimizer": {"type": "levenberg-marquardt"}}, "does not recover it"),
        ({"response": {"kind": "gamma", "segments": 8}}, "'segments' applies to kind = 'curve' only"),
        ({"exposure": None, "pixel_batch_size": 4}, "needs whole images"),
    ],
)
def test_what_does_not_go_together(changes: dict[str, Any], told: str) -> None:
    job = {"scene": "s.xml", "parameters": [{"key": "a"}], "target": {"images": "a.exr"}, "response": {}, **changes}
    with pytest.raises(PathreplayError, match=told):
        make_config({key: value for key, value in job.items() if value is not None})


def test_display_loss_is_the_squared_difference_on_a_display() -> None:
    target = np.random.default_rng(6).uniform(0.02, 1, (4, 5, 3)).astype(np.float32)
    image = target * 1.01
    on_display = float(np.mean((encoded(image) - encoded(target)) ** 2))
    found = mean_loss(LOSSES["display-l2"], mi.TensorXf(image), mi.TensorXf(target))
    assert float(found.array[0]) == pytest.approx(on_display, rel=0.03)
    assert dr.all(LOSSES["display-l2"](mi.TensorXf(target), mi.TensorXf(target)) == 0, axis=None)
