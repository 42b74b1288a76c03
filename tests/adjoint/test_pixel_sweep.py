"""The pixel sweep against finite differences of Mitsuba's images, and what the optimisation loop makes of it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from pathreplay.errors import PathreplayError
from pathreplay.integrators.stateful import StatefulIntegrator
from pathreplay.inverse.config.schema import ITERATION, make_config
from pathreplay.inverse.loop.loop import new_run
from pathreplay.inverse.losses.pixelwise import (
    DISPLAY_FLOOR,
    QUADRATIC,
    RELATIVE_FLOOR,
    display_l2,
    l2,
    relative_l2,
)
from pathreplay.inverse.objective.evaluate import Evaluator, Shard
from pathreplay.inverse.objective.frozen import linear_derivative
from pathreplay.inverse.problem.problem import build_problem
from pathreplay.testing.statistics import gap
from pathreplay.testing.stencil import CENTRAL
from pathreplay.testing.verdict import RESOLUTION, Z_LIMIT
from recorded_steps import steps
from truth import (
    Bench,
    Case,
    add,
    bitmap,
    camera,
    lit_room,
    noise,
    random,
    rgb,
    translate,
    under_sky,
)

SLOW = pytest.mark.slow
MIRROR = {"type": "conductor", "material": "none"}
METAL = {"type": "roughconductor", "alpha": 0.3, "distribution": "ggx"}


def painted_floor() -> dict:
    room = lit_room({"type": "diffuse", "reflectance": rgb(0.6, 0.5, 0.4)})
    room["floor"]["bsdf"]["reflectance"] = bitmap(noise(8, 3, 0.2, 0.9))
    return room


def through_a_lens() -> dict:
    lens = camera(fov=22) | {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 4.0}
    return painted_floor() | {"camera": lens}


FLOOR = "floor.bsdf.reflectance.data"
CASES = [
    Case("painted floor", painted_floor, FLOOR, random(1.0), spp=4, seeds=24),
    Case("painted floor, two samples", painted_floor, FLOOR, random(1.0), spp=2, seeds=32),
    Case("painted floor, many samples", painted_floor, FLOOR, random(1.0), spp=64, seeds=16),
    Case("painted floor, hidden lamps", painted_floor, FLOOR, random(1.0), spp=4, seeds=24,
         options={"hide_emitters": True}),
    Case("painted floor through a lens", through_a_lens, FLOOR, random(1.0), spp=4, seeds=24),
    Case("lamp", lambda: lit_room(MIRROR), "light.emitter.radiance.value", add([1.0, 0.5, 0.2]), spp=4, seeds=24),
    Case("rough metal", lambda: under_sky(METAL), "object.bsdf.alpha.value", add(), spp=8, seeds=24),
    Case("mirror ball moves", lambda: under_sky(MIRROR), "object.to_world", translate(0.5, 0.2, 1), spp=4, seeds=24),
]  # fmt: skip


def swept(bench: Bench, integrator: mi.Integrator, seed: int, offset: np.ndarray, slope: np.ndarray) -> tuple:
    """Image and gradient by the case's t, of a loss with this derivative."""
    t = dr.opaque(mi.Float, 0)
    dr.enable_grad(t)
    bench.put(t)
    loss = (mi.TensorXf(offset.astype(np.float32)), mi.TensorXf(slope.astype(np.float32)))
    sensor = bench.scene.sensors()[0]
    image = integrator.render_value_and_grad(bench.scene, *loss, sensor, seed, bench.case.spp)
    return np.array(image), bench.collect(t)


@pytest.mark.parametrize(
    "case", [pytest.param(c, id=c.name, marks=SLOW if c.name == "painted floor, many samples" else ()) for c in CASES]
)
def test_image_and_gradient_are_those_of_a_quadratic_loss(case: Case, opened) -> None:
    """The loss is Σ W (I - T)² with a target T close to the picture, so that judging a path by itself would show."""
    bench = opened(case)
    plain = bench.integrator("path", rr_depth=case.rr_depth, **case.options)
    expected = np.mean([bench.image(plain, 5000 + seed, 1024) for seed in range(4)], axis=0)
    slope = 2 * bench.weights
    offset = -slope * 0.8 * expected
    adjoint = offset + slope * expected

    ours = bench.integrator(rr_depth=case.rr_depth, **case.options)
    assert ours.supports_pixel_sweep(bench.scene, bench.scene.sensors()[0], case.spp)
    seeds = range(1, case.seeds + 1)
    found = [swept(bench, ours, seed, offset, slope) for seed in seeds]
    differences = (bench.difference(plain, CENTRAL, case.step, 1000 + seed, 256) for seed in range(8))
    reference = [(image * adjoint).sum() for image in differences]

    wrong = gap([gradient for _, gradient in found], reference)
    assert wrong.error < RESOLUTION * abs(np.mean(reference))
    assert abs(wrong.z) < Z_LIMIT, wrong
    assert abs(gap([bench.dot(image) for image, _ in found], bench.dot(expected)).z) < Z_LIMIT


def test_the_same_seed_gives_the_same_gradient_in_one_thread_and_many(opened) -> None:
    bench = opened(CASES[0])
    integrator = bench.integrator()
    adjoint = (-bench.weights, bench.weights)
    threads = dr.thread_count()
    try:
        dr.set_thread_count(1)
        image, one = swept(bench, integrator, 1, *adjoint)
        dr.set_thread_count(max(2, threads))
        again, many = swept(bench, integrator, 1, *adjoint)
        _, other = swept(bench, integrator, 2, *adjoint)
    finally:
        dr.set_thread_count(threads)
    np.testing.assert_allclose(again, image, rtol=1e-5, atol=1e-6)
    assert many == pytest.approx(one, rel=1e-4)
    assert abs(other - one) > 1e-3 * abs(one)


REASONS = ["gaussian filter", "alpha", "xyz", "stratified", "moving camera", "too deep", "one sample"]


@pytest.mark.parametrize("why", REASONS)
def test_what_cannot_be_swept_by_pixels_is_told(why: str, opened) -> None:
    def scene() -> dict:
        room = painted_floor()
        if why == "gaussian filter":
            room["camera"]["film"]["rfilter"] = {"type": "gaussian"}
        if why == "alpha":
            room["camera"]["film"]["pixel_format"] = "rgba"
        if why == "xyz":
            room["camera"]["film"]["pixel_format"] = "xyz"
        if why == "stratified":
            room["camera"]["sampler"] = {"type": "stratified", "sample_count": 4}
        return room

    key, move = ("camera.to_world", translate(1, 0, 0)) if why == "moving camera" else (FLOOR, random(1.0))
    bench = opened(Case(why, scene, key, move))
    integrator = bench.integrator() if why != "too deep" else mi.load_dict({"type": "pathreplay", "max_depth": 1500})
    t = dr.opaque(mi.Float, 0)
    dr.enable_grad(t)
    bench.put(t)
    assert not integrator.supports_pixel_sweep(bench.scene, bench.scene.sensors()[0], 1 if why == "one sample" else 4)


def test_what_cannot_be_swept_by_pixels_is_refused(opened) -> None:
    bench = opened(CASES[0])
    integrator, adjoint = bench.integrator(), mi.TensorXf(bench.weights)
    for spp, message in ((1, "1 samples per pixel"), (1024, "more than the 512 that a record holds")):
        with pytest.raises(PathreplayError, match=message):
            integrator.render_value_and_grad(bench.scene, adjoint, adjoint, spp=spp)
    with pytest.raises(PathreplayError, match="shape"):
        integrator.render_value_and_grad(bench.scene, adjoint[:, :, :1], adjoint, spp=4)
    with pytest.raises(PathreplayError, match="none has gradients: check that the key"):
        integrator.render_value_and_grad(bench.scene, adjoint, adjoint, spp=4)


def test_the_derivative_of_a_quadratic_loss_is_found_at_any_brightness() -> None:
    target = mi.TensorXf(np.float32([0, 0.1, 10, 1e4, 1e6]))
    for loss in QUADRATIC:
        offset, slope = (np.array(term, dtype=np.float64) for term in linear_derivative(loss, target))
        T = np.array(target, dtype=np.float64)
        slopes = {l2: 1, relative_l2: 1 / (T + RELATIVE_FLOOR)}
        slopes[display_l2] = 1.055 / 2.4 * np.clip(T, DISPLAY_FLOOR, 1) ** (1 / 2.4 - 1)
        weight = 2 / T.size * slopes[loss] ** 2
        np.testing.assert_allclose(slope, weight, rtol=1e-5)
        np.testing.assert_allclose(offset, -weight * T, rtol=1e-5)


JOB = {
    "scene": "cornell-box",
    "scene_parameters": {"resolution": 32},
    "parameters": [{"key": "red.reflectance.value"}],
    "target": {"values": {"red.reflectance.value": 0.7}, "spp": 16},
    "spp": 8,
    "iterations": 4,
    "integrator": {"type": "pathreplay", "max_depth": 3, "boundary": "none"},
}


BOXED = {"scene": "cornell-box-photo", "scene_parameters": {"resolution": 32}}
POSE = {
    "parameters": [{"key": "large-box.vertex_positions", "pose": "translation", "initial": {"translation": [0.1] * 3}}],
    "target": {"scene": "cornell-box", "scene_parameters": {"resolution": 32}, "spp": 16},
}
GLASS = {
    "scene": "glass-pane",
    "scene_parameters": {"resolution": 24},
    "parameters": [{"key": "glass.eta", "learning_rate": 0.02}],
    "target": {"values": {"glass.eta": 1.4}, "spp": 16, "integrator": {"type": "path", "max_depth": 6}},
}
BOXED_POSE = BOXED | POSE | {"target": BOXED | {"spp": 16}}


def gradient(config, folder) -> np.ndarray:
    """Of a single step, by the first variable."""
    problem = build_problem(config, folder)
    run = new_run(problem, problem.integrator)
    numbers = [config.seeds(ITERATION, view.sensor)[0] for view in problem.views]
    shard = Shard(tuple(range(len(problem.views))), config.spp, tuple(numbers))
    return Evaluator(problem, problem.integrator)(run.values, shard, {}).gradients[problem.variables[0].key]


@pytest.mark.parametrize("changes", [BOXED, BOXED_POSE], ids=["colour", "pose"])
def test_two_swept_views_add_up(changes: dict, tmp_path) -> None:
    """Also where what the scene has is computed from the variables: each view goes back through that."""
    both = gradient(make_config(JOB | changes), tmp_path)
    alone = [gradient(make_config(JOB | changes | {"sensors": [k]}), tmp_path) for k in (0, 1)]
    assert np.abs(alone).min() > 0
    np.testing.assert_allclose(both, (alone[0] + alone[1]) / 2, rtol=1e-3)


@pytest.mark.parametrize(
    ("changes", "swept"),
    [
        pytest.param({}, False, id="gaussian filter"),
        pytest.param({"loss": "l1", "learning_rate": 0.1}, False, id="l1", marks=SLOW),
        pytest.param({"integrator": {"type": "pathreplay", "adjoint": "replay"}}, False, id="replay", marks=SLOW),
        pytest.param({"integrator": {"type": "prb", "max_depth": 3}}, False, id="prb", marks=SLOW),
        pytest.param({"integrator": {"type": "prb_basic", "max_depth": 3}}, False, id="prb_basic", marks=SLOW),
        pytest.param(POSE, False, id="moving", marks=SLOW),
        pytest.param(
            POSE | {"integrator": {"type": "pathreplay", "attach": "all"}}, False, id="moving, all attached", marks=SLOW
        ),
        pytest.param(GLASS, True, id="index of a plugin in Python", marks=SLOW),
        pytest.param(BOXED, True, id="box filter"),
        pytest.param(BOXED | {"loss": "log"}, False, id="box filter, log"),
        pytest.param(BOXED | {"exposure": {}}, True, id="exposures"),
        pytest.param(BOXED | {"integrator": {"type": "prb", "max_depth": 3}}, False, id="box filter, prb", marks=SLOW),
    ],
)
def test_steps_that_were_recorded_are_those_that_are_traced(
    changes: dict, swept: bool, tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = make_config(JOB | changes)
    problem = build_problem(config, tmp_path)
    calls = []
    if isinstance(problem.integrator, StatefulIntegrator):
        inner = problem.integrator.pixel_pass
        monkeypatch.setattr(problem.integrator, "pixel_pass", lambda *a: calls.append(1) or inner(*a))
    recorded, traced = steps(problem, config, "recorded"), steps(problem, config, "traced")
    np.testing.assert_allclose(recorded, traced, rtol=1e-4)
    # Every step has seeds and values of its own: one that was launched with those of another would show.
    assert (np.abs(np.diff(traced, axis=0)) / traced.max(axis=0)).min() > 1e-3
    assert bool(calls) == swept
