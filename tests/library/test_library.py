"""The library: problems of objects and arrays, with the gradients and the bits of jobs."""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import PIL.Image
import pytest
import scipy.optimize
from safetensors.numpy import load_file

import pathreplay
from library_scenes import BODY, GREY, SIDE, TEXTURE, WALL, Descent, InPlace, photos_of_room, room, views
from ordinary_scenes import SCENES, Write
from pathreplay import Parameter, PathreplayError, Problem, View
from pathreplay.inverse.images.io import exr_bytes
from pathreplay.jobs import make_config, optimize
from pathreplay.scenes.loading import load_scene
from pathreplay.transport.facts.nodes import with_gradients
from places import ROOT
from variant import MONO, VARIANT

RED = "red.reflectance.value"
README = ROOT / "README.md"
PAGE = ROOT / "docs" / "library.md"
#: Scenes that take long, and that a quick test optimises by the command line (`test_ordinary_use`).
BY_COMMAND = ("three_cameras",)
SHORTER = {
    "steps=30": "steps=4",
    "steps=20": "steps=3",
    "range(10)": "range(3)",
    "spp=256": "spp=64",
    "steps=10": "steps=4",
}
#: The scene's own depth; kernels of edges take seconds to compile.
NO_EDGES = {"type": "pathreplay", "max_depth": 3, "boundary": "none"}


@pytest.fixture(autouse=True)
def _variant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mi.set_variant(VARIANT)
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def photos() -> list[np.ndarray]:
    return photos_of_room()


@pytest.mark.parametrize("side", [32, pytest.param(64, marks=pytest.mark.slow)])
def test_the_script_of_the_readme_recovers_a_texture_and_a_colour(side: int) -> None:
    """With the film that it has, and with a smaller one."""
    script = re.search(r"<!-- begin library-example -->\n```python\n(.*?)```", README.read_text(), re.S)
    assert script is not None
    assert len([line for line in script[1].splitlines() if line.strip()]) <= 12
    names: dict[str, Any] = {}
    text = (
        script[1].replace('"llvm_ad_rgb"', repr(VARIANT)).replace("width=64, height=64", f"width={side}, height={side}")
    )
    assert f"width={side}, " in text
    exec(text, names)
    errors = np.abs(names["result"].values["back.bsdf.reflectance.data"] - names["texels"])
    assert np.median(errors) < 0.04  # boxes hide some texels
    np.testing.assert_allclose(names["result"].values["red.reflectance.value"], [0.57, 0.043, 0.044], atol=0.02)


@pytest.mark.parametrize("whole", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_page_runs_as_it_stands(whole: bool) -> None:
    """Or with fewer steps and samples."""
    text, names = PAGE.read_text().replace('"llvm_ad_rgb"', repr(VARIANT)), dict[str, Any]()
    for long, short in () if whole else SHORTER.items():
        assert long in text
        text = text.replace(long, short)
    for block in re.findall(r"```python\n(.*?)```", text, re.S):
        exec(block, names)
    assert names["result"].history[-1].loss < names["result"].history[0].loss


def test_a_job_and_the_library_give_the_same_bits(photos: list[np.ndarray], tmp_path: Path) -> None:
    (tmp_path / "left.exr").write_bytes(exr_bytes(photos[0]))
    settings = {"spp": 4, "learning_rate": 0.05, "seed": 7, "deterministic": True}
    job = {
        "scene": "cornell-box",
        "scene_parameters": {"resolution": SIDE},
        "parameters": [
            {"key": "red.reflectance.value", "initial": 0.5, "lower": 0.0, "upper": 1.0},
            {"key": "light.emitter.radiance.value", "initial": 9.0, "parameterization": "log"},
        ],
        "target": {"images": ["left.exr"]},
        "iterations": 5,
        **settings,
    }
    folder = optimize(make_config(job), output="run", progress=False).folder
    wanted = {
        "red.reflectance.value": GREY,
        "light.emitter.radiance.value": Parameter(initial=9.0, parameterization="log"),
    }
    problem = Problem(load_scene("cornell-box", resolution=SIDE), wanted, View(0, photos[0]), **settings)
    result = pathreplay.minimize(problem, steps=5, progress=False)
    of_job = load_file(folder / "parameters.safetensors")
    for key in wanted:
        np.testing.assert_array_equal(result.values[key], of_job[key])
    history = [json.loads(line) for line in (folder / "history.jsonl").read_text().splitlines()]
    assert [entry.loss for entry in result.history] == [entry["loss"] for entry in history]


def test_an_evaluation_beside_another_thread_leaves_the_scene_alone(photos: list[np.ndarray]) -> None:
    """A refused call leaves the values of the rendering thread in the scene."""
    problem = Problem(room(), {WALL: Parameter(initial=[0.4, 0.5, 0.6])}, views(photos), spp=4)
    f, state, told = pathreplay.value_and_grad(problem), pathreplay.init(problem), []

    def work() -> None:
        for evaluate in (lambda: f({WALL: [0.9, 0.9, 0.9]}), lambda: pathreplay.step(problem, state)):
            try:
                evaluate()
            except PathreplayError as error:
                told.append(str(error))

    f()
    params = problem.built.params
    with pathreplay.exclusive():
        dr.enable_grad(params[WALL])
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
    assert len(told) == 2 and all("another Python thread is rendering" in text for text in told)
    assert dr.grad_enabled(params[WALL])
    np.testing.assert_allclose(np.array(params[WALL]).ravel(), [0.4, 0.5, 0.6], rtol=1e-6)
    dr.disable_grad(params[WALL])


def test_value_and_grad_is_the_gradient_of_the_loss(photos: list[np.ndarray]) -> None:
    """By finite differences of the loss of images without noise, along a direction."""
    problem = Problem(room(), {WALL: Parameter(initial=[0.4, 0.5, 0.6])}, views(photos), spp=64)
    f = pathreplay.value_and_grad(problem)
    found = np.array([f(seed=seed)[1][WALL] for seed in range(12)])
    start, by = problem.initial[WALL], problem.built.integrator

    def loss(value: np.ndarray) -> float:
        """Of two independent images: their variance is not in it."""
        problem.assign(problem.complete({WALL: value}), problem.scene)
        total = 0.0
        for n, photo in enumerate(photos):
            a, b = (np.array(mi.render(problem.scene, sensor=n, integrator=by, spp=1024, seed=s)) for s in (1, 2))
            total += float(np.mean((a - photo) * (b - photo))) / len(photos)
        return total

    h = 0.05
    for k in range(3):
        step = h * np.eye(3, dtype=np.float32)[k]
        expected = (loss(start + step) - loss(start - step)) / (2 * h)
        error = found[:, k].std(ddof=1) / np.sqrt(len(found))
        assert abs(found[:, k].mean() - expected) < 4 * error + 0.01 * abs(expected), k


@pytest.mark.parametrize(
    "key", ["body.bsdf.eta", "floor.bsdf.reflectance.to_uv", "body.interior_medium.phase_function.g"]
)
def test_numbers_that_a_user_changes_reach_recorded_kernels(key: str, photos: list[np.ndarray]) -> None:
    """Dr.Jit cannot see these parameters, and kernels contain them as constants."""
    body = {**room()["body"], "bsdf": {"type": "dielectric"}}
    if "medium" in key:
        phase = {"type": "hg", "g": 0.5}
        body |= {"bsdf": {"type": "null"}, "interior": {"type": "homogeneous", "sigma_t": 9.0, "phase": phase}}
    problem = Problem(mi.load_dict(room() | {"body": body}), {WALL: GREY}, View("left", photos[0]), spp=4)
    f = pathreplay.value_and_grad(problem)
    before = [f(seed=7)[0] for _ in range(3)][-1]  # the second call records
    params = mi.traverse(problem.scene)
    other = {"eta": 1.1, "to_uv": mi.ScalarTransform3f().scale([3, 2]), "g": -0.7}
    params[key] = other[key.rpartition(".")[2]]
    params.update()
    (loss, gradients), (expected, slopes) = f(seed=7), pathreplay.value_and_grad(problem)(seed=7)
    assert abs(expected - before) > 1e-3 * before
    assert loss == pytest.approx(expected, rel=1e-4)
    np.testing.assert_allclose(gradients[WALL], slopes[WALL], rtol=1e-3, atol=1e-6)


def evaluated(problem: Problem) -> None:
    pathreplay.value_and_grad(problem)(seed=1)


def stepped(problem: Problem) -> None:
    pathreplay.step(problem, pathreplay.init(problem))


def interrupted(problem: Problem) -> None:
    def fail(iteration: Any) -> None:
        raise ValueError

    with pytest.raises(ValueError):
        pathreplay.minimize(problem, steps=2, callbacks=[fail], progress=False)


@pytest.mark.parametrize(
    ("call", "edges"),
    [
        (evaluated, "none"),
        (interrupted, "none"),
        (stepped, "auto"),
    ],
)
def test_a_scene_keeps_no_gradients(call: Callable[[Problem], None], edges: str, photos: list[np.ndarray]) -> None:
    """Gradients left in a scene break forward mode in other scenes. The scene keeps the values of the last call."""
    wanted = {TEXTURE: Parameter(initial=0.25), BODY: Parameter(pose="rigid")}
    problem = Problem(room(), wanted, views(photos), spp=1, integrator={**NO_EDGES, "boundary": edges})
    call(problem)
    assert not with_gradients(problem.scene)
    np.testing.assert_array_equal(mi.traverse(problem.scene)[TEXTURE], np.full((4, 4, 3), 0.25, np.float32))
    scene, x = mi.load_dict(room()), mi.Float(0.5)
    dr.enable_grad(x)
    params = mi.traverse(scene)
    params[WALL] = mi.Color3f(x)
    params.update()
    image = mi.render(scene, params, integrator=mi.load_dict({"type": "pathreplay"}), spp=1)
    dr.forward(x)
    slope = np.array(dr.grad(image))
    params[WALL] = mi.Color3f(0.5)
    params.update()
    assert slope.sum() > 0


def test_regularizers_are_in_loss_and_gradient(photos: list[np.ndarray]) -> None:
    def narrow(values: Any) -> Any:
        return 3 * dr.mean(dr.square(values - 0.25), axis=None)

    plain = pathreplay.value_and_grad(Problem(room(), {WALL: GREY}, views(photos), deterministic=True))
    entry = Parameter(initial=0.5, bounds=(0, 1), regularizer=narrow)
    more = pathreplay.value_and_grad(Problem(room(), {WALL: entry}, views(photos), deterministic=True))
    (loss, grads), (with_it, slopes) = plain(seed=3), more(seed=3)
    assert with_it - loss == pytest.approx(3 * 0.25**2, rel=1e-5)
    np.testing.assert_allclose(slopes[WALL] - grads[WALL], 3 * 2 * 0.25 / 3, rtol=1e-4)


@pytest.mark.parametrize("kind", ["total_variation", "l2_to_initial", "laplacian_weight"])
def test_regularizers_by_name_are_those_of_the_module(kind: str, photos: list[np.ndarray]) -> None:
    """Of a texture or of a body that were shaken; a function of one's own may be made of them."""
    rng, of = np.random.default_rng(5), pathreplay.regularizers
    key = BODY if kind == "laplacian_weight" else TEXTURE
    params = mi.traverse(mi.load_dict(room()))
    own_value = np.array(params[key])
    start = own_value + rng.normal(0, 0.1, own_value.shape)
    function = {
        "total_variation": of.total_variation,
        "l2_to_initial": of.l2_to(start),
        "laplacian_weight": of.laplacian(own_value, np.array(params["body.faces"])) if key == BODY else None,
    }[kind]
    values = {key: start + 0.1 * rng.normal(0, 0.1, start.shape)}
    evaluated = [
        pathreplay.value_and_grad(
            Problem(room(), {key: entry}, views(photos), spp=1, deterministic=True, integrator=NO_EDGES)
        )(values)
        for entry in (
            Parameter(initial=start),
            Parameter(initial=start, **{kind: 0.3}),
            Parameter(initial=start, regularizer=lambda v: 0.3 * function(v)),
        )
    ]
    (plain, none), (by_name, slopes), (own, others) = evaluated
    assert by_name > plain * (1 + 1e-6) and own == pytest.approx(by_name, rel=1e-6)
    np.testing.assert_allclose(others[key] - none[key], slopes[key] - none[key], rtol=1e-3, atol=1e-7)
    assert np.abs(slopes[key] - none[key]).max() > 1e-5


def test_arrays_tensors_bitmaps_and_files_are_targets(photos: list[np.ndarray], tmp_path: Path) -> None:
    (tmp_path / "photo.exr").write_bytes(exr_bytes(photos[0]))
    kinds = [photos[0], mi.TensorXf(photos[0]), mi.Bitmap(photos[0]), tmp_path / "photo.exr"]
    for kind in kinds:
        problem = Problem(room(), {WALL: GREY}, View(0, kind))
        np.testing.assert_allclose(problem.built.views[0].target, photos[0], rtol=1e-6)


def test_files_and_bitmaps_are_read_as_by_a_job(tmp_path: Path) -> None:
    """Masks are stored values, of luminance if coloured. Targets are decoded and composited over black."""
    mask, image = np.full((SIDE, SIDE), 255, np.uint8), np.full((SIDE, SIDE, 4), 128, np.uint8)
    mask[:, :8], image[:, :8, 3] = 64, 0
    PIL.Image.fromarray(mask).save("grey.png")
    PIL.Image.fromarray(mask).convert("RGB").save("colour.png")
    PIL.Image.fromarray(image).save("target.png")

    def by_library(target: Any, weight: Any) -> tuple[np.ndarray, np.ndarray]:
        view = Problem("cornell-box", RED, View(0, target, weight), scene_parameters={"resolution": SIDE}).built.views[
            0
        ]
        return view.target, view.weight

    def by_job(target: str, weight: str) -> tuple[np.ndarray, np.ndarray]:
        job = {
            "scene": "cornell-box",
            "scene_parameters": {"resolution": SIDE},
            "parameters": [{"key": RED}],
            "target": {"images": [target], "masks": [weight]},
        }
        (tmp_path / "job.json").write_text(json.dumps(job))
        view = pathreplay.load_job("job.json").built.views[0]
        return view.target, view.weight

    for name in ("grey.png", "colour.png"):
        target, weight = by_job("target.png", name)
        assert weight[0, 0] / weight[0, 8] == pytest.approx(64 / 255) and target[0, 0].max() == 0 < target[0, 8].min()
        for found in (
            by_library("target.png", name),
            by_library(mi.Bitmap("target.png"), mi.Bitmap(name)),
        ):
            np.testing.assert_allclose(found[0], target, rtol=1e-6)
            np.testing.assert_allclose(found[1], weight, rtol=1e-6)


def test_bitmaps_in_xyz_are_converted(photos: list[np.ndarray]) -> None:
    bitmap = mi.Bitmap(photos[0]).convert(pixel_format=mi.Bitmap.PixelFormat.XYZ)
    view = Problem(room(), {WALL: GREY}, View(0, bitmap)).built.views[0]
    np.testing.assert_allclose(view.target, photos[0], atol=1e-5)


XML = """<scene version="3.0.0">
  <sensor type="perspective"><film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="16"/>
  </film></sensor>
  <emitter type="constant"/>
  <shape type="rectangle" id="wall"><bsdf type="diffuse"><rgb name="reflectance" value="0.7 0.3 0.2"/></bsdf>
    <transform name="to_world"><translate z="3"/></transform></shape>
</scene>"""


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_bitmaps_of_integers_are_decoded(kind: type[np.unsignedinteger]) -> None:
    bitmap = mi.Bitmap(np.full((SIDE, SIDE, 3), np.iinfo(kind).max // 2, kind))
    before = bitmap.srgb_gamma()
    view = Problem(room(), {WALL: GREY}, View(0, bitmap)).built.views[0]
    np.testing.assert_allclose(view.target, 0.5**2.2, rtol=0.05)
    assert bitmap.srgb_gamma() == before


def test_scenes_are_objects_dictionaries_files_and_names(photos: list[np.ndarray], tmp_path: Path) -> None:
    """A dictionary is given twice: it keeps its tensors."""
    (tmp_path / "room.xml").write_text(XML)
    description = room()
    for scene, key in (
        (mi.load_dict(room(), optimize=False), WALL),
        (description, WALL),
        (description, WALL),
        (tmp_path / "room.xml", WALL),
        ("room.xml", WALL),
    ):
        problem = Problem(scene, [key], View(0, photos[0]))
        np.testing.assert_allclose(problem.initial[key], [0.7, 0.3, 0.2], rtol=1e-5)
    by_name = Problem("cornell-box", ["red.reflectance.value"], View(0, np.zeros((256, 256, 3))))
    assert by_name.render(spp=1).shape == (256, 256, 3)


@pytest.mark.parametrize(
    ("optimizer", "rate"),
    [
        ("adam", 0.03),
        ({"type": "sgd", "momentum": 0.5}, 1.0),
        (lambda: mi.ad.Adam(lr=0.03), 0.5),
        (Descent, 0.03),
        ("l-bfgs-b", 0.03),
        ("levenberg-marquardt", 0.03),
        (partial(scipy.optimize.minimize, method="SLSQP"), 0.03),
    ],
    ids=["name", "table", "mitsuba", "own", "scipy", "second order", "any of scipy"],
)
def test_any_optimizer_lowers_the_loss(optimizer: Any, rate: float, photos: list[np.ndarray]) -> None:
    problem = Problem(room(), {WALL: GREY}, views(photos), learning_rate=rate, spp=8)
    made = optimizer() if callable(optimizer) and not isinstance(optimizer, partial) else optimizer
    result = pathreplay.minimize(problem, made, steps=12, progress=False)
    assert result.history[-1].loss < 0.8 * result.history[0].loss


def test_mitsubas_adam_takes_the_steps_of_ours(photos: list[np.ndarray]) -> None:
    settings = {"learning_rate": 0.03, "spp": 4, "deterministic": True}
    problem = Problem(room(), {WALL: GREY}, views(photos), **settings)
    ours = pathreplay.minimize(problem, {"type": "adam", "beta_2": 0.999}, steps=4, progress=False)
    theirs = pathreplay.minimize(problem, mi.ad.Adam(lr=0.03), steps=4, progress=False)
    np.testing.assert_allclose(theirs.values[WALL], ours.values[WALL], rtol=1e-4)


@pytest.mark.parametrize("of_job", ["l-bfgs-b", "levenberg-marquardt"])
def test_an_optimizer_object_in_place_of_a_search_sees_new_random_numbers(
    of_job: str, photos: list[np.ndarray]
) -> None:
    """At a learning rate of almost zero, losses differ by their noise alone."""
    problem = Problem(room(), {WALL: GREY}, views(photos), spp=4, optimizer={"type": of_job})
    state = pathreplay.init(problem, mi.ad.Adam(lr=1e-9))
    for _ in range(2):
        state = pathreplay.step(problem, state)
    history = pathreplay.minimize(problem, mi.ad.Adam(lr=1e-9), steps=2, progress=False).history
    for first, second in (state.history, history):
        assert abs(first.loss - second.loss) > 1e-4 * first.loss


@pytest.mark.parametrize("key", [WALL, "wall.*reflectance*", BODY])
def test_learning_rates_of_parameters_are_those_of_mitsubas_optimizer(key: str, photos: list[np.ndarray]) -> None:
    """The first step of Adam has the length of the rate: of a key, of a glob, and of a pose."""
    entry = Parameter(pose="translation", learning_rate=0.01) if key == BODY else Parameter(learning_rate=0.01)
    problem = Problem(room(), {key: entry, TEXTURE: None}, views(photos), spp=4, integrator=NO_EDGES)
    result = pathreplay.minimize(problem, mi.ad.Adam(lr=0.1), steps=1, progress=False)
    name = f"{BODY}:translation" if key == BODY else WALL
    for each, rate in ((name, 0.01), (TEXTURE, 0.1)):
        assert np.abs(result.values[each] - problem.initial[each]).max() == pytest.approx(rate, rel=1e-2)


@pytest.mark.parametrize(
    "settings",
    [
        {"final_learning_rate_ratio": 0.01, "learning_rate_schedule": "exponential", "steps": 4},
        {"warmup_steps": 3, "steps": 4},
        {"stages": [{"iterations": 2}, {"iterations": 2, "learning_rate_factor": 0.01}]},
    ],
    ids=["schedule", "warm-up", "stages"],
)
def test_schedules_and_stages_scale_the_rate_of_mitsubas_optimizer(
    settings: dict[str, Any], photos: list[np.ndarray]
) -> None:
    problem = Problem(room(), {WALL: GREY}, views(photos), spp=4, deterministic=True, learning_rate=0.03)
    ours = {"type": "adam", "beta_2": 0.999, "iterate_averaging": False}
    results = [pathreplay.minimize(problem, of, progress=False, **settings) for of in (ours, mi.ad.Adam(lr=0.03))]
    np.testing.assert_allclose(results[1].values[WALL], results[0].values[WALL], rtol=1e-4)


def test_frozen_parameters_keep_their_state_in_mitsubas_optimizer(photos: list[np.ndarray]) -> None:
    problem = Problem(room(), {WALL: GREY, TEXTURE: GREY}, views(photos), spp=4, deterministic=True, learning_rate=0.03)
    stages = [{"iterations": 2}, {"iterations": 8, "parameters": [TEXTURE]}, {"iterations": 1}]
    ours = {"type": "adam", "beta_2": 0.999, "iterate_averaging": False}
    results = [pathreplay.minimize(problem, of, stages=stages, progress=False) for of in (ours, mi.ad.Adam(lr=0.03))]
    for key in (WALL, TEXTURE):
        np.testing.assert_allclose(results[1].values[key], results[0].values[key], rtol=1e-4, atol=1e-5)


def test_exposures_and_response_have_their_learning_rates_in_mitsubas_optimizer(photos: list[np.ndarray]) -> None:
    """The first step of Adam has the length of the rate, in the logarithm of exposures and of the exponent."""
    fitted = {"exposure": {"learning_rate": 0.001}, "response": {"kind": "gamma", "learning_rate": 0.002}}
    problem = Problem(room(), {WALL: GREY}, views([photos[0], 2 * photos[1]]), spp=4, **fitted)
    result = pathreplay.minimize(problem, mi.ad.Adam(lr=0.1), steps=1, progress=False)
    for key, rate in (("exposure", 0.001), ("response", 0.002)):
        moved = np.abs(np.log(result.values[key] / problem.initial[key]))
        assert moved.max() == pytest.approx(rate, rel=2e-2), key


def test_losses_of_ones_own_and_by_name(photos: list[np.ndarray]) -> None:
    def own(image: Any, target: Any) -> Any:
        return dr.abs(image - target)

    for loss in (own, "l1", pathreplay.losses.l1):
        problem = Problem(room(), {WALL: GREY}, views(photos), loss=loss, learning_rate=0.03)
        result = pathreplay.minimize(problem, steps=8, progress=False)
        assert result.history[-1].loss < result.history[0].loss


def test_a_pose_a_derived_parameter_and_arrays_as_starts(photos: list[np.ndarray]) -> None:
    start = np.full((4, 4, 3), 0.4, np.float32)
    start[0, 0] = [0.1, 0.2, 0.3]
    wanted = {
        BODY: Parameter(pose="translation", initial={"translation": [0.1, 0, 0]}),
        TEXTURE: Parameter(initial=start),
        "share": Parameter(initial=0.5, shape=[1]),
    }

    def grey(_: Any, share: Any) -> Any:
        return mi.Color3f(share.array)

    derived = {WALL: pathreplay.Derived(grey, of=["share"])}
    problem = Problem(room(), wanted, views(photos), derived=derived, integrator=NO_EDGES)
    assert set(problem.initial) == {f"{BODY}:translation", TEXTURE, "share"}
    np.testing.assert_array_equal(problem.initial[TEXTURE], start)
    result = pathreplay.minimize(problem, steps=2, progress=False)
    assert {BODY, WALL, TEXTURE} <= set(result.values)
    other = mi.load_dict(room())
    result.apply(other)
    np.testing.assert_allclose(np.array(mi.traverse(other)[BODY]), result.values[BODY].ravel(), atol=1e-6)


def test_values_of_a_scene_are_initial_values_and_values(photos: list[np.ndarray]) -> None:
    """As `mi.traverse` gives them; vertices may be points of Dr.Jit or rows, but not columns."""
    params = mi.traverse(mi.load_dict(room()))
    wanted = {key: Parameter(initial=params[key]) for key in (WALL, TEXTURE, BODY)}
    problem = Problem(room(), wanted, views(photos))
    np.testing.assert_allclose(problem.initial[WALL], [0.7, 0.3, 0.2], rtol=1e-5)
    colour, flat = problem.initial[WALL], problem.initial[BODY]
    points = dr.unravel(mi.Point3f, mi.Float(flat))
    for value in (params[BODY], points, flat.reshape(-1, 3)):
        np.testing.assert_array_equal(problem.complete({BODY: value})[BODY], flat)
    for value in (params[WALL], mi.Vector3f(*map(float, colour)), colour[:, None], colour[None]):
        np.testing.assert_array_equal(problem.complete({WALL: value})[WALL], colour)
    with pytest.raises(PathreplayError, match="transpose it, so that each vertex is a row"):
        problem.complete({BODY: np.array(points)})


def test_values_go_to_another_scene_or_it_is_told(photos: list[np.ndarray], tmp_path: Path) -> None:
    """Which stores an index as a plain number, a texture as 8 bits, or one number in place of a colour."""
    PIL.Image.fromarray(np.full((4, 4, 3), 100, np.uint8)).save("texture.png")
    described, eta = room(), "body.bsdf.eta"
    described["body"]["bsdf"] = {"type": "dielectric"}
    floor = {"type": "bitmap", "filename": str(tmp_path / "texture.png")}
    described["floor"]["bsdf"]["reflectance"] = floor
    wanted = {eta: Parameter(initial=1.3), TEXTURE: Parameter(initial=0.25), WALL: Parameter(initial=0.25)}
    problem = Problem(described, wanted, views(photos), spp=1)

    other = mi.load_dict(described)
    before = np.array(mi.traverse(other)[TEXTURE])
    with pytest.raises(PathreplayError, match=f"'{TEXTURE}' cannot be given a value: .* 8-bit .*'variant'") as told:
        problem.assign(problem.initial, other)
    assert "\n" not in str(told.value)
    np.testing.assert_array_equal(np.array(mi.traverse(other)[TEXTURE]), before)
    floor["format"] = "variant"
    other = mi.load_dict(described)
    problem.assign(problem.initial, other)
    params = mi.traverse(other)
    assert params[eta] == pytest.approx(1.3) and np.array(params[TEXTURE]).max() == np.float32(0.25)
    described["wall"]["bsdf"]["reflectance"] = {"type": "uniform", "value": 0.5}
    with pytest.raises(PathreplayError, match=f"'{WALL}' is a Float in this scene and a Color3f in the problem's"):
        problem.assign(problem.initial, mi.load_dict(described))


def test_a_callback_ends_it_and_nothing_is_written(photos: list[np.ndarray], tmp_path: Path) -> None:
    seen: list[tuple[int, float]] = []

    def look(it: pathreplay.Iteration) -> bool:
        seen.append((it.number, float(it.values[WALL][0])))
        return it.number == 2

    problem = Problem(room(), {WALL: GREY}, views(photos))
    result = pathreplay.minimize(problem, steps=50, callbacks=[look], progress=False)
    assert [number for number, _ in seen] == [0, 1, 2] and result.stopped == "a callback"
    assert seen[-1][1] == pytest.approx(float(result.values[WALL][0]))
    assert list(tmp_path.iterdir()) == []


def test_a_complete_run_is_not_stopped(photos: list[np.ndarray]) -> None:
    problem = Problem(room(), {WALL: GREY}, views(photos), spp=1)
    result = pathreplay.minimize(problem, steps=2, progress=False, callbacks=lambda it: it.number == 1)
    assert (result.stopped, len(result.history)) == (None, 2)


def test_a_callback_may_stand_alone_and_compare_arrays(photos: list[np.ndarray]) -> None:
    """The comparison returns a boolean of NumPy. Other results do not end the run."""
    problem = Problem(room(), {WALL: GREY}, views(photos))

    def steps(callback: Callable[[pathreplay.Iteration], object]) -> int:
        return len(pathreplay.minimize(problem, steps=3, callbacks=callback, progress=False).history)

    assert steps(lambda it: it.values[WALL].max() > 0) == 1
    assert steps(lambda it: it.values[WALL]) == steps(lambda it: 1) == 3


def test_stages_take_the_place_of_steps(photos: list[np.ndarray]) -> None:
    problem = Problem(room(), {WALL: GREY, TEXTURE: Parameter(resolutions=[2, 4], refine_at=[2])}, views(photos))
    stages = [{"iterations": 2, "downscale": 2, "parameters": [WALL]}, {"iterations": 3, "max_depth": 2}]
    result = pathreplay.minimize(problem, stages=stages, progress=False)
    assert len(result.history) == 5
    assert set(result.history[0].gradient_norms) == {WALL} < set(result.history[-1].gradient_norms)
    assert result.values[TEXTURE].shape == (4, 4, 3)
    again = pathreplay.minimize(problem, steps=3, progress=False)  # the problem is as it was
    assert len(again.history) == 3 and "3 iterations" in repr(again) and WALL in repr(problem)


def test_l2_to_initial_of_a_refined_grid_has_the_details_of_its_initial_value(photos: list[np.ndarray]) -> None:
    detailed = np.random.default_rng(3).uniform(0.2, 0.8, (4, 4, 3)).astype(np.float32)
    entry = Parameter(initial=detailed, resolutions=[2, 4], refine_at=[1], l2_to_initial=1.0)
    (variable,) = Problem(room(), {TEXTURE: entry}, views(photos), spp=1).built.variables
    assert variable.start.shape == (2, 2, 3)
    assert variable.penalty.of(variable.start)[0] == 0
    assert variable.penalty.of(detailed)[0] == 0


@pytest.mark.parametrize("key", [TEXTURE, "floor.*.data"])
def test_grids_are_refined_at_the_stages_of_the_minimisation(key: str, photos: list[np.ndarray]) -> None:
    """The stages of the problem do not count, and are not changed."""
    own = [{"iterations": 1}, {"iterations": 4}]
    problem = Problem(room(), {key: Parameter(resolutions=[2, 4])}, views(photos), spp=2, stages=own)

    def sides(**settings: Any) -> list[int]:
        seen: list[int] = []
        look = [lambda it: seen.append(len(it.values[TEXTURE]))]
        pathreplay.minimize(problem, progress=False, callbacks=look, **settings)
        return seen

    assert sides(stages=[{"iterations": 3}, {"iterations": 1}]) == [2, 2, 2, 4]
    assert sides() == [2, 4, 4, 4, 4]


def test_a_problem_is_left_as_it_was(photos: list[np.ndarray]) -> None:
    problem = Problem(room(), {WALL: GREY}, views(photos), deterministic=True)
    f = pathreplay.value_and_grad(problem)
    before = f(seed=5)
    first, second = (pathreplay.minimize(problem, steps=3, progress=False) for _ in range(2))
    np.testing.assert_array_equal(first.values[WALL], second.values[WALL])
    after = f(seed=5)
    assert after[0] == before[0] and np.array_equal(after[1][WALL], before[1][WALL])


def test_what_one_minimisation_learns_of_media_is_not_known_to_others() -> None:
    """Nor to gradients that a callback asks for on the way, nor to the minimisation what these have learned."""
    scene, density = load_scene("cloud", resolution=12, grid=6, views=1), "*.sigma_t.data"
    view = View(0, np.full((12, 12, 3), 0.4))
    limits = {"type": "pathreplay", "max_depth": 4}
    problem = Problem(
        scene, {density: Parameter(initial=1.0)}, view, integrator=limits, spp=2, deterministic=True, seed=3
    )
    f = pathreplay.value_and_grad(problem)
    before = f(seed=5)[0]

    def losses(*callbacks: Any) -> list[float]:
        result = pathreplay.minimize(problem, steps=4, progress=False, callbacks=callbacks)
        return [entry.loss for entry in result.history]

    found = losses(), losses(), losses(lambda it: f(it.values, seed=it.number))
    assert found[0] == found[1] == found[2] and f(seed=5)[0] == before


@pytest.mark.parametrize("make", [lambda: "adam", InPlace], ids=["name", "in place"])
def test_an_iteration_that_is_kept_stays_as_it_was(make: Callable[[], Any], photos: list[np.ndarray]) -> None:
    kept: list[pathreplay.Iteration] = []
    problem = Problem(room(), {WALL: Parameter(initial=0.5)}, views(photos))
    pathreplay.minimize(problem, make(), steps=4, callbacks=[kept.append], progress=False)
    assert len({float(it.values[WALL][0]) for it in kept}) == 4


class Foreign:
    """An array of another framework: NumPy can convert it, and its elements are such arrays, too."""

    def __init__(self, values: Any) -> None:
        self.values = np.array(values)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return self.values.astype(dtype or self.values.dtype)

    def __iter__(self) -> Any:
        return iter([Foreign(each) for each in self.values])


def test_initial_values_are_what_numpy_can_convert(photos: list[np.ndarray]) -> None:
    start = np.random.default_rng(0).uniform(0.1, 0.9, (4, 4, 3)).astype(np.float32)
    colour, grey = np.float32([0.1, 0.2, 0.3]), np.full(3, 0.5, np.float32)
    for texture, wall, seen in ((Foreign(start), Foreign(colour), colour), (start.tolist(), Foreign(0.5), grey)):
        wanted = {TEXTURE: Parameter(initial=texture), WALL: Parameter(initial=wall)}
        problem = Problem(room(), wanted, views(photos))
        np.testing.assert_array_equal(problem.initial[TEXTURE], start)
        np.testing.assert_array_equal(problem.initial[WALL], seen)
    with pytest.raises(PathreplayError, match="'initial' is not an array"):
        Problem(room(), {TEXTURE: Parameter(initial=[[1.0], [1.0, 2.0]])}, views(photos))


def test_weights_shares_and_test_views(photos: list[np.ndarray]) -> None:
    mask = np.zeros((SIDE, SIDE))
    mask[:8] = 1
    pair = [View("left", photos[0], weight=mask, share=2.0), View("right", photos[1], test=True)]
    problem = Problem(room(), {WALL: GREY}, pair)
    left, right = problem.built.views
    assert left.weight is not None and left.weight.mean() == pytest.approx(1) and not left.is_test
    assert right.is_test and right.weight is None
    assert problem.render(view=1).shape == (SIDE, SIDE, 3)


def bad(**changes: Any) -> Callable[[list[np.ndarray]], Any]:
    def make(photos: list[np.ndarray]) -> Any:
        given = {"scene": room(), "parameters": {WALL: GREY}, "views": View(0, photos[0])} | changes
        return Problem(given.pop("scene"), given.pop("parameters"), given.pop("views"), **given)

    return make


def loaded_before() -> dict[str, Any]:
    """A description whose tensor is in another scene by now."""
    texture = {"type": "bitmap", "data": mi.TensorXf(np.full((2, 2, 3), 0.5, np.float32)), "raw": True}
    description = {**room(), "ball": {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": texture}}}
    mi.load_dict(description)
    return description


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (bad(parameters={"wal.reflectance": GREY}), "wal.reflectance"),
        (bad(parameters={WALL: 0.5}), "parameters: 0.5 is not a Parameter"),
        (bad(views=np.zeros((16, 16, 3))), "is not a View; write View"),
        (bad(derived={WALL: len}), "is not a Derived"),
        (bad(views=[]), "views: there is none"),
        (bad(views=View(0)), "Target of sensor 'left' is missing"),
        (bad(views=View(0, np.zeros((3, 4, 3)))), "is 4 x 3, but its film is 16 x 16"),
        (bad(views=View(0, "no.exr")), "No image file 'no.exr'"),
        (bad(views=View("middle", np.zeros((16, 16, 3)))), "No sensor 'middle'"),
        (bad(views=[View(0, np.zeros((16, 16, 3))), View("left", np.zeros((16, 16, 3)))]), "is named twice"),
        (bad(views=View(0, np.full((16, 16, 3), np.nan))), "NaN"),
        (bad(views=View(0, np.zeros((16, 16, 3), np.uint8))), r"array of uint8, .* give mi.Bitmap\(array\)"),
        (bad(views=View(0, PIL.Image.new("RGB", (16, 16)))), "array of uint8"),
        (bad(views=View(0, np.zeros((16, 16, 3), np.int64))), "array of int64, whose encoding is unknown"),
        (bad(views=View(0, np.zeros((16, 16, 3), bool))), "array of bool, whose encoding is unknown"),
        (bad(views=View(0, np.zeros((16, 16, 3), complex))), "array of complex128, whose encoding is unknown"),
        (bad(integrator="path"), "computes no gradients"),
        (lambda photos: Problem.joint(Problem(room(), {WALL: GREY}, views(photos))), "this is a single one"),
        (lambda photos: Problem(room(), {WALL: GREY}, views(photos)).render(spp=0), "spp is 0; give an integer of at"),
        (lambda photos: Problem(room(), {WALL: GREY}, views(photos)).render(spp=1.5), "spp is 1.5; give an integer"),
        (lambda photos: pathreplay.value_and_grad(Problem(room(), {WALL: GREY}, views(photos)))(seed=-1), "seed is -1"),
        (bad(views=View(0, np.zeros((16, 16, 3)), weight=np.zeros((16, 16)))), "is black"),
        (bad(views=View(0, np.zeros((16, 16, 3)), weight=np.ones((3, 4)))), r"\(3, 4, 1\); give \(16, 16\)"),
        (bad(target={"alpha": "mask"}), "'target' would be replaced by 'views'; use View\\(target"),
        (bad(test_views=["left"]), "'test_views' would be replaced by 'views'; use View\\(test=True\\)"),
        (bad(output="run"), "problem: only minimize writes a run folder"),
        (lambda photos: pathreplay.init(Problem(room(), {WALL: GREY}, views(photos)), output="run"),
         "init: only minimize"),
        (lambda photos: pathreplay.init(
            Problem(room(), {WALL: GREY}, views(photos), integrator=mi.load_dict({"type": "pathreplay"})),
            stages=[{"iterations": 1, "max_depth": 2}]),
         "is a PathReplayIntegrator object, whose max_depth a stage cannot change"),
        (bad(loss="l3"), "No loss 'l3'"),
        (bad(loss=lambda a, b: "much"), "cannot be computed|returns the str"),
        (bad(loss=lambda a, b: dr.mean(dr.square(a - b), axis=None),
             views=View(0, np.zeros((16, 16, 3)), weight=np.eye(16))),
         "returns one number, but masks or weights of pixels need a tensor of shape \\(16, 16, 3\\)"),
        (bad(integrator={"type": "path"}), "computes no gradients"),
        (bad(integrator={"type": "aov", "aovs": "d:depth", "inner": {"type": "pathreplay"}}), "without 'aov' around"),
        (bad(integrator=mi.load_dict({"type": "aov", "aovs": "d:depth", "inner": {"type": "path"}})), "without 'aov'"),
        (lambda photos: Problem(loaded_before(), {WALL: GREY}, views(photos)), "has moved the tensors"),
        (bad(spp=0), "problem: 'spp' is 0"),
        (bad(parameters={WALL: Parameter(bounds=(1, 0))}), "is not above lower bound"),
        (bad(parameters={WALL: Parameter(bounds=1)}), r"'wall.*': bounds are 1; give \(lower, upper\)"),
        (bad(parameters={WALL: Parameter(bounds=(0, 1, 2))}), r"bounds are \(0, 1, 2\)"),
        (bad(parameters={WALL: Parameter(bounds=([0, 0, 0], 1))}),
         r"^Parameter 'wall.*': bounds are \(\[0, 0, 0\], 1\); give \(lower, upper\)"),
        (bad(parameters={WALL: Parameter(bounds=(0, np.nan))}), r"^Parameter 'wall.*': bounds are \(0, nan\)"),
        (bad(parameters={WALL: Parameter(bounds=(0, 10**400))}), r"^Parameter 'wall.*': bounds are \(0, 1000"),
        (bad(parameters={WALL: Parameter(initial=10**400)}), r"^problem: Parameter 'wall.*': 'initial': 1000"),
        (bad(parameters={WALL: Parameter(bounds=(0, 1e50))}), r"^Parameter 'wall.*': bounds are \(0, 1e\+50\)"),
        (bad(parameters={WALL: Parameter(initial=np.nan)}), "Parameter 'wall.*': 'initial' is nan; give finite n"),
        (bad(parameters={WALL: Parameter(initial=[1, 2, np.inf])}), r"'wall.*': 'initial' is \[1, 2, inf\]; give f"),
        (bad(parameters={WALL: Parameter(learning_rate=-1)}), "Parameter 'wall.*': 'learning_rate' is -1: input"),
        (bad(parameters={BODY: Parameter(pose="rigid", pivot=[0, 1])}),
         r"Parameter 'body.*': 'pivot' is \[0, 1\]; give at least 3 entries"),
        (bad(parameters={}), "^parameters: there are none; give {KEY: Parameter"),
        (bad(parameters=[]), "^parameters: there are none; give {KEY: Parameter"),
        (bad(tolerance=1e-3), "unknown key 'tolerance'; it is a key of 'optimizer'"),
        (bad(parameters={WALL: Parameter(initial=Path("no.exr"))}), "is the image 'no.exr', but"),
        (bad(parameters={WALL: Parameter(initial=np.zeros(5))}), "of shape \\(5,\\)"),
        (bad(parameters={WALL: Parameter(parameterization="cube")}), "parameterization"),
        (bad(parameters={BODY: Parameter(pose="rigid", initial=np.eye(4))}), "'initial' of a pose is a displacement"),
        (bad(scene=5), "scene: 'int' is not a scene of the active variant"),
        (bad(scene={"type": "sphere"}), "describes a Shape, not a scene"),
        (bad(scene="no-such-scene"), "No scene 'no-such-scene'"),
    ],
)  # fmt: skip
def test_what_cannot_work_is_told_in_one_line(make: Callable[..., Any], words: str, photos: list[np.ndarray]) -> None:
    with pytest.raises(PathreplayError, match=words) as told:
        make(photos)
    assert "\n" not in str(told.value)


def test_a_view_answers_to_the_id_of_its_sensor(photos: list[np.ndarray]) -> None:
    """Its own name is valid in the names of files."""
    scene = room()
    scene["Camera 1"] = scene.pop("left")
    problem = Problem(scene, {WALL: GREY}, [View("Camera 1", photos[0]), View("right", photos[1])])
    (name,) = (view.name for view in problem.built.views if view.name != "right")
    assert " " not in name
    np.testing.assert_array_equal(problem.render(view="Camera 1", spp=1), problem.render(view=name, spp=1))
    with pytest.raises(PathreplayError, match=r"No view 'Camera 2'"):
        problem.render(view="Camera 2")


def test_a_method_without_gradients_needs_none(photos: list[np.ndarray]) -> None:
    """SciPy would warn in every iteration, which is an error in these tests."""
    method = partial(scipy.optimize.minimize, method="Nelder-Mead")
    problem = Problem(room(), {WALL: GREY}, views(photos), spp=1)
    assert len(pathreplay.minimize(problem, method, 3, progress=False).history) == 3


def test_what_a_minimisation_cannot_do_is_told(photos: list[np.ndarray]) -> None:
    problem = Problem(room(), {WALL: GREY}, views(photos))
    held = mi.ad.Adam(lr=0.1)
    held["x"] = mi.Float(1)
    unbounded = partial(scipy.optimize.minimize, method="BFGS")
    for optimizer, words in (
        (object(), "has no step"),
        (mi.ad.Adam, "is a class; create an object"),
        (unbounded, "BFGS cannot handle bounds; remove the bounds"),
        (held, "already has variables"),
        ("adem", "adem"),
    ):
        with pytest.raises(PathreplayError, match=words):
            pathreplay.minimize(problem, optimizer, progress=False)
    with pytest.raises(PathreplayError, match="No parameter 'x'"):
        problem.render({"x": 1.0})
    for value, shown in (("red", "'red'"), (10**400, "1000")):
        with pytest.raises(PathreplayError, match=f"is {shown}.*; give an array of numbers"):
            problem.render({WALL: value})
    with pytest.raises(PathreplayError, match="is not a scene of the active variant"):
        problem.assign(problem.initial, room())
    with pytest.raises(PathreplayError, match=r"has the shape \(2,\), not the shape \(3,\); reshape it"):
        pathreplay.value_and_grad(problem)({WALL: [1.0, 2.0]})
    textured = Problem(room(), [TEXTURE], views(photos))
    with pytest.raises(PathreplayError, match=r"has the shape \(4, 4\), not the shape \(4, 4, 3\)"):
        textured.render({TEXTURE: np.zeros((4, 4))})
    assert textured.render({TEXTURE: np.zeros((8, 8, 3))}, spp=1).shape == (SIDE, SIDE, 3)
    with pytest.raises(PathreplayError, match="minimize: 'steps' is 0"):
        pathreplay.minimize(problem, steps=0, progress=False)
    for optimizer, key, told in (
        ("levenberg-marquardt", "tolerance", r'optimizer=\{"type": "levenberg-marquardt", "tolerance": 0.5\}'),
        (None, "beta_1", r'optimizer=\{"type": "adam", "beta_1": 0.5\}'),
        ({"type": "sgd"}, "momentum", r'optimizer=\{"type": "sgd", "momentum": 0.5\}'),
        ("adam", "momentum", r'optimizer=\{"type": "sgd", "momentum": 0.5\}'),
        ({"type": "adam", "beta_2": 0.9}, "beta_1", r'optimizer=\{"type": "adam", "beta_2": 0.9, "beta_1": 0.5\}'),
        (mi.ad.Adam(lr=0.1), "beta_1", "give it to the optimizer object"),
    ):
        with pytest.raises(PathreplayError, match=f"minimize: '{key}' is an option of the optimizer; .*{told}"):
            pathreplay.minimize(problem, optimizer, progress=False, **{key: 0.5})
    stages = [{"iterations": 5}]
    with pytest.raises(PathreplayError, match="steps is 50, but the stages have 5 in total; remove 'steps'"):
        pathreplay.minimize(problem, steps=50, stages=stages, progress=False)
    with pytest.raises(
        PathreplayError, match="warmup_steps = 9 is not less than steps = 5; lower it, or raise 'steps'"
    ):
        pathreplay.minimize(problem, steps=5, warmup_steps=9, progress=False)
    refined = Problem(room(), {TEXTURE: Parameter(resolutions=[4, 8], refine_at=[6])}, views(photos))
    with pytest.raises(
        PathreplayError, match="refine_at 6 is not less than steps = 5; refine earlier, or raise 'steps'"
    ):
        pathreplay.minimize(refined, steps=5, progress=False)
    compared = Problem(room(), {WALL: GREY}, views(photos), baseline={"type": "prb"})
    with pytest.raises(PathreplayError, match="optimizer: an object cannot step the baseline as well"):
        pathreplay.minimize(compared, mi.ad.Adam(lr=0.1), steps=1, progress=False)
    with pytest.raises(PathreplayError, match="minimize: 'response' belongs to the problem; give it to Problem"):
        pathreplay.minimize(problem, response={"kind": "gamma"}, progress=False)
    with pytest.raises(PathreplayError, match=r"'stages.0' is 'iterations': .*; write a table"):
        pathreplay.minimize(problem, stages={"iterations": 2}, progress=False)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"optimizer": {"type": "levenberg-marquardt"}}, "needs a sum of squares, which the function in 'loss' is not"),
        ({"pixel_batch_size": 4}, "the function in 'loss' needs whole images"),
        ({"response": {"kind": "gamma"}}, "the function in 'loss' is not quadratic"),
    ],
)
def test_a_loss_of_ones_own_has_no_other_name(settings: dict[str, Any], words: str, photos: list[np.ndarray]) -> None:
    def own(image: Any, target: Any) -> Any:
        return dr.abs(image - target)

    problem = Problem(room(), {WALL: GREY}, views(photos), loss=own)
    assert repr(problem).endswith("loss own>")
    with pytest.raises(PathreplayError, match=words) as told:
        Problem(room(), {WALL: GREY}, views(photos), loss=own, **settings)
    assert "memory" not in str(told.value)
    if "optimizer" in settings:
        pair = [Problem(room(), {WALL: GREY}, views(photos), loss=loss) for loss in ("l2", own)]
        with pytest.raises(PathreplayError, match="in all scenes, which the function in 'loss' is not"):
            pathreplay.minimize(Problem.joint(pair), "levenberg-marquardt", progress=False)


def test_a_problem_of_another_variant_is_told(photos: list[np.ndarray]) -> None:
    """It can be used again in its variant."""
    problem = Problem(room(), {WALL: GREY}, views(photos), spp=1)
    f, state = pathreplay.value_and_grad(problem), pathreplay.init(problem)
    kept: list[pathreplay.Iteration] = []
    result = pathreplay.minimize(problem, steps=1, progress=False, callbacks=kept.append)
    before = f(seed=3)[0]
    uses: list[Callable[[], object]] = [
        lambda: f(),
        lambda: pathreplay.value_and_grad(problem),
        lambda: problem.render(spp=1),
        lambda: pathreplay.minimize(problem, steps=1, progress=False),
        lambda: pathreplay.init(problem),
        lambda: pathreplay.step(problem, state),
        lambda: kept[0].render(spp=1),
        lambda: result.render(spp=1),
        lambda: Problem.joint([problem, problem]),
    ]
    mi.set_variant(MONO)
    for use in uses:
        with pytest.raises(PathreplayError, match=f"'{VARIANT}', but the active variant is '{MONO}'; call") as told:
            use()
        assert "\n" not in str(told.value)
    mi.set_variant(VARIANT)
    assert f(seed=3)[0] == pytest.approx(before, rel=1e-5)

    def leave(_: pathreplay.Iteration) -> None:
        mi.set_variant(MONO)

    with pytest.raises(PathreplayError, match=f"'{VARIANT}', but the active variant is '{MONO}'"):
        pathreplay.minimize(problem, steps=3, progress=False, callbacks=leave)


def test_values_that_are_not_finite_are_told(photos: list[np.ndarray]) -> None:
    problem = Problem(room(), {WALL: GREY}, views(photos), spp=1)
    f = pathreplay.value_and_grad(problem)
    for value in ([0.5, np.nan, 0.5], np.inf, 1e50):
        for use in (f, problem.render):
            with pytest.raises(PathreplayError, match=f"^Value of '{WALL}' holds . NaN or infinite values"):
                use({WALL: value})


def test_gradients_of_a_loss_that_is_not_finite_are_nan(photos: list[np.ndarray]) -> None:
    """Zeros would look like a minimum."""
    problem = Problem(room(), {WALL: GREY, TEXTURE: GREY}, views(photos), spp=1)
    f = pathreplay.value_and_grad(problem)
    for _ in range(2):  # the second call records
        loss, gradients = f({WALL: 1e30})
        assert not np.isfinite(loss)
        assert all(np.isnan(gradients[key]).all() for key in (WALL, TEXTURE))
        assert {key: g.shape for key, g in gradients.items()} == {WALL: (3,), TEXTURE: (4, 4, 3)}
    loss, gradients = f()
    assert np.isfinite(loss) and all(np.isfinite(g).all() for g in gradients.values())


def test_a_number_is_the_value_of_all_entries(photos: list[np.ndarray]) -> None:
    """As in `Parameter`. A pose has no such value."""
    wanted = {WALL: GREY, TEXTURE: GREY, BODY: Parameter(pose="translation")}
    problem = Problem(room(), wanted, views(photos), spp=1, integrator=NO_EDGES, deterministic=True)
    f = pathreplay.value_and_grad(problem)
    found, expected = (
        f({WALL: 0.25, TEXTURE: np.float32(0.75)}),
        f({WALL: [0.25] * 3, TEXTURE: np.full((4, 4, 3), 0.75)}),
    )
    assert found[0] == expected[0]
    for key, gradient in expected[1].items():
        np.testing.assert_array_equal(found[1][key], gradient)
    with pytest.raises(PathreplayError, match=r"translation' has the shape \(\), not the shape \(3,\)"):
        f({f"{BODY}:translation": 0.5})


def test_targets_of_grey_and_with_alpha(photos: list[np.ndarray]) -> None:
    """A grey target has three equal channels. Arrays with alpha have premultiplied colours, as renderings do."""
    grey, alpha = photos[0][:, :, 1], np.full((SIDE, SIDE, 1), 0.5, np.float32)
    for target, expected in (
        (grey, np.dstack([grey] * 3)),
        (grey[:, :, None], np.dstack([grey] * 3)),
        (np.dstack([photos[0], alpha]), photos[0]),
        (mi.Bitmap(np.dstack([photos[0], alpha])), photos[0]),
    ):
        found = Problem(room(), {WALL: GREY}, View(0, target)).built.views[0].target
        np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize(
    "write", [pytest.param(s, id=s.__name__, marks=[pytest.mark.slow] * (s.__name__ in BY_COMMAND)) for s in SCENES]
)
def test_ordinary_scenes_one_after_the_other(write: Write, tmp_path: Path) -> None:
    """Files of Blender and others, several cameras, media, mono and spectral variants: three steps lower the loss."""
    use = write(tmp_path)
    mi.set_variant(use.variant)
    (tmp_path / "scene.xml").write_text(use.xml, encoding="utf-8")
    sizes, limits = use.views, {"type": "pathreplay", "max_depth": 4}
    nothing = [View(n, np.zeros((height, width, 1))) for n, (width, height) in enumerate(sizes)]
    truth = Problem("scene.xml", {use.key: Parameter(initial=use.truth)}, nothing, integrator=limits)
    photos = [View(n, truth.render(view=n, spp=64)) for n in range(len(sizes))]
    wanted = {use.key: Parameter(initial=use.start, bounds=(0, None))}
    problem = Problem("scene.xml", wanted, photos, integrator=limits, learning_rate=use.rate)
    result = pathreplay.minimize(problem, steps=4, progress=False)
    assert result.history[-1].loss < result.history[0].loss
    assert all(np.isfinite(value).all() for value in result.values.values())
