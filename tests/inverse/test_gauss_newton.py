"""Gauss-Newton models of rendered images: against finite differences, and in jobs that end at the noise limit."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import pathreplay
from exposed_job import JOB as EXPOSED
from exposed_job import scene as exposed_scene
from library_scenes import TEXTURE, WALL, photos_of_room, room, views
from pathreplay.errors import PathreplayError
from pathreplay.inverse.objective.evaluate import Evaluation, Evaluator, Shard, total
from pathreplay.inverse.parameters.exposures import EXPOSURE
from pathreplay.inverse.problem.problem import Problem, build_problem, put_values
from pathreplay.jobs import iterate, make_config, optimize
from small_job import checkpoint_bits
from wall_job import JOB

OPTIMIZER = {"type": "levenberg-marquardt"}
KEY = JOB["parameters"][0]["key"]
Values = dict[str, np.ndarray]


def start_of(problem: Problem) -> Values:
    return {variable.key: variable.start for variable in problem.variables}


def flat(values: Values) -> np.ndarray:
    return np.concatenate([value.ravel() for value in values.values()]).astype(float)


def moved(values: Values, entry: int, step: float) -> Values:
    """The values with one entry moved, entries counted through all of them."""
    found = {key: value.copy() for key, value in values.items()}
    for value in found.values():
        if entry < value.size:
            value.flat[entry] += np.float32(step)
            break
        entry -= value.size
    return found


def unbiased(evaluation: Evaluation) -> float:
    """The loss without the variance of the images."""
    assert evaluation.model is not None
    return evaluation.loss - evaluation.model.excess


def test_where_images_are_linear_the_loss_is_its_model(wall_room: Path) -> None:
    """Reflectance and intensity one by one, with common random numbers: every second difference is an entry of H."""
    problem = build_problem(make_config({**JOB, "integrator": {"type": "pathreplay", "max_depth": 2}}), wall_room)
    evaluate, values, shard = (
        Evaluator(problem, problem.integrator),
        start_of(problem),
        Shard((0,), 16, (3,), 0, None, True),
    )
    here = evaluate(values, shard, {})
    assert here.model is not None
    n, step = 3, 0.25
    for i in range(n):
        ends = [unbiased(evaluate(moved(values, i, side), shard, {})) for side in (step, -step)]
        second = (sum(ends) - 2 * unbiased(here)) / step**2
        assert second == pytest.approx(here.model.matrix[i, i], rel=2e-3)
        assert (ends[0] - ends[1]) / (2 * step) == pytest.approx(flat(here.gradients)[i], rel=2e-3, abs=1e-6)


CASES: dict[str, dict[str, Any]] = {
    "lamp": {"parameters": [{"key": "*.position", "initial": [0.2, 0.8, 1.8]}]},
    "pose": {
        "parameters": [{"key": "object_*.to_world", "pose": "rigid", "pivot": [0, 0, 0]}],
    },
    "relative": {"loss": "relative-l2"},
}


@pytest.mark.parametrize("case", ["lamp", "relative", pytest.param("pose", marks=pytest.mark.slow)])
def test_gradients_are_those_of_reverse_mode_and_of_finite_differences(case: str, wall_room: Path) -> None:
    """z over seeds; H against products of finite differences of nearly noiseless images."""
    job = {**JOB, "target": {"values": {KEY: [0.3, 0.5, 0.1]}, "spp": 16}}
    job["integrator"] = {"type": "pathreplay", "max_depth": 3}
    problem = build_problem(make_config({**job, **CASES[case]}), wall_room)
    evaluate, values = Evaluator(problem, problem.integrator), start_of(problem)
    found = [evaluate(values, Shard((0,), 16, (s,), second_order=True), {}) for s in range(12)]
    back = np.array([flat(evaluate(values, Shard((0,), 16, (s,)), {}).gradients) for s in range(12)])
    ahead = np.array([flat(each.gradients) for each in found])
    difference = ahead - back
    z = difference.mean(axis=0) / np.hypot(ahead.std(axis=0, ddof=1), back.std(axis=0, ddof=1)) * np.sqrt(12)
    print(f"{case}: gradient {ahead.mean(axis=0)}, z = {z}")
    assert np.abs(z).max() < 4 and np.abs(ahead.mean(axis=0)).max() > 0

    view, step = problem.views[0], 1 / 64
    slopes = []
    for i in range(ahead.shape[1]):
        ends = [picture(problem, moved(values, i, side)) for side in (step, -step)]
        slopes.append((ends[0] - ends[1]) / (2 * step))
    scale = view.target + 0.01 if "loss" in CASES[case] else np.ones(view.target.shape)
    rows = (np.array(slopes) / scale).reshape(len(slopes), -1)
    expected = 2 * rows @ rows.T / view.target.size
    matrices = np.array([each.model.matrix for each in found if each.model is not None])
    errors = matrices.std(axis=0, ddof=1) / np.sqrt(len(matrices)) + 2e-3 * np.abs(expected).max()
    z = (matrices.mean(axis=0) - expected) / errors
    print(f"{case}: H of 16 samples against finite differences of 4096: |z| up to {np.abs(z).max():.1f}")
    assert np.abs(z).max() < 4


def picture(problem: Problem, values: Values) -> np.ndarray:
    put_values(problem, values)
    return np.array(mi.render(problem.scene, integrator=problem.integrator, spp=4096, seed=mi.UInt32(1)), np.float64)


def run(**changes: Any) -> Any:
    return optimize(make_config({**JOB, "optimizer": OPTIMIZER, "iterations": 8, "spp": 16, **changes}), progress=False)


def test_a_job_reaches_the_noise_limit_in_a_few_steps(wall_room: Path) -> None:
    """Errors that Adam does not reach in as many, from the same start."""
    found, adam = run(), run(optimizer={"type": "adam"}, learning_rate=0.1)
    start = np.sqrt(np.mean((np.array(JOB["parameters"][0]["initial"]) - JOB["target"]["values"][KEY]) ** 2))
    print(f"start {start:.3f}, Levenberg-Marquardt {found.errors[KEY]:.1e}, Adam {adam.errors[KEY]:.1e}")
    assert found.errors[KEY] < 0.02 * start < adam.errors[KEY]
    assert found.history[3].errors[KEY] < 0.05 * start
    assert found.report.exists() and found.iterations == 8


def test_a_job_that_was_left_goes_on_bit_for_bit(wall_room: Path) -> None:
    run(output="whole")
    for stop in (0, 5):
        for state in iterate(
            make_config({**JOB, "optimizer": OPTIMIZER, "iterations": 8, "spp": 16, "output": f"cut{stop}"})
        ):
            if state.number == stop:
                break
        optimize(resume=f"cut{stop}", progress=False)
        assert checkpoint_bits(Path(f"cut{stop}")) == checkpoint_bits(Path("whole"))


def test_a_job_ends_by_itself_with_a_tolerance(wall_room: Path) -> None:
    found = run(optimizer={**OPTIMIZER, "tolerance": 1e-4}, iterations=40, output="run")
    assert 2 < found.iterations < 40 and "less than the tolerance" in found.report.read_text()
    with pytest.raises(PathreplayError, match=r"has terminated .*; lower 'tolerance' in its config"):
        optimize(resume="run", progress=False)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["lamp", "pose"])
def test_recorded_passes_and_shards_of_samples_are_the_same_model(case: str, wall_room: Path) -> None:
    """What the third evaluation replays is what the first has traced; and shards add up."""
    job = {**JOB, "target": {"values": {KEY: [0.3, 0.5, 0.1]}, "spp": 16}, "integrator": {"type": "pathreplay"}}
    problem = build_problem(make_config({**job, **CASES[case]}), wall_room)
    values, shard = start_of(problem), Shard((0,), 16, (3,), second_order=True)
    evaluate, traced = Evaluator(problem, problem.integrator), Evaluator(problem, problem.integrator, record=False)
    for _ in range(3):
        found, plain = evaluate(values, shard, {}), traced(values, shard, {})
        assert found.model is not None and plain.model is not None
        assert found.loss == pytest.approx(plain.loss, rel=1e-5)
        assert found.model.matrix == pytest.approx(plain.model.matrix, rel=1e-3, abs=1e-4 * plain.model.matrix.max())
    other = evaluate(values, Shard((0,), 16, (4,), second_order=True), {})
    both = total([found, other], 0.5)
    assert both.model is not None and other.model is not None
    assert both.model.noise == pytest.approx(0.25 * (found.model.noise + other.model.noise))
    again = pickle.loads(pickle.dumps(found))
    assert again.model.matrix.tobytes() == found.model.matrix.tobytes()


def test_exposures_have_columns_of_their_own(wall_room: Path) -> None:
    """In a scene without noise, against finite differences of the gradient; white balance."""
    from pathreplay.inverse.images.io import exr_bytes

    (wall_room / "room.xml").write_text(exposed_scene())
    for k in range(4):
        (wall_room / f"{k}.exr").write_bytes(exr_bytes(np.full((4, 6, 3), 0.3, np.float32)))
    job = {**EXPOSED, "exposure": {"white_balance": True}, "spp": 4}
    problem = build_problem(make_config(job), wall_room)
    evaluate, values = Evaluator(problem, problem.integrator), start_of(problem)
    values[EXPOSURE] = np.float32([[1.3, 1.1, 0.7], [0.6, 0.5, 0.9], [1.7, 1.4, 1.2], [1, 1, 1]])
    shard = Shard((2, 1, 0), 4, (1, 2, 3), second_order=True)
    found, back = evaluate(values, shard, {}), evaluate(values, Shard((2, 1, 0), 4, (1, 2, 3)), {})
    assert found.model is not None and list(found.model.sizes) == list(values)
    assert flat(found.gradients) == pytest.approx(flat(back.gradients), rel=1e-4, abs=1e-6)
    for i in range(3, 12):
        ends = [unbiased(evaluate(moved(values, i, side), shard, {})) for side in (0.05, -0.05)]
        second = (sum(ends) - 2 * unbiased(found)) / 0.05**2
        assert second == pytest.approx(found.model.matrix[i, i], rel=5e-3, abs=1e-5)
    assert not found.model.matrix[12:].any()  # of the test view


def test_a_job_with_exposures_recovers_them(wall_room: Path) -> None:
    from exposed_job import LEVELS
    from pathreplay.inverse.images.io import exr_bytes

    (wall_room / "room.xml").write_text(exposed_scene())
    for k, level in enumerate(LEVELS):
        (wall_room / f"{k}.exr").write_bytes(exr_bytes(np.full((4, 6, 3), level, np.float32)))
    job = {key: value for key, value in EXPOSED.items() if key != "final_learning_rate_ratio"}
    found = optimize(make_config({**job, "optimizer": OPTIMIZER, "iterations": 12, "spp": 2}), progress=False)
    products = found.parameters[EXPOSURE][:3, 0] * found.parameters["wall.bsdf.reflectance.value"].mean()
    assert products == pytest.approx(LEVELS[:3], rel=1e-3)


@pytest.fixture(scope="module")
def photos() -> list[np.ndarray]:
    return photos_of_room()


def test_minimize_takes_it_by_name_and_steps_are_pure(photos: list[np.ndarray]) -> None:
    """With a joint problem of two scenes, a logarithm, a regularizer and views of one scene."""

    def problem(photo: np.ndarray) -> pathreplay.Problem:
        wanted = {
            WALL: pathreplay.Parameter(initial=0.5, parameterization="log"),
            TEXTURE: pathreplay.Parameter(initial=0.5, bounds=(0, 1), l2_to_initial=1e-4),
        }
        return pathreplay.Problem(room(), wanted, pathreplay.View("left", photo), spp=16)

    both = pathreplay.Problem.joint([problem(photos[0]), problem(photos[0])])
    result = pathreplay.minimize(both, "levenberg-marquardt", steps=4, progress=False)
    assert result.values[WALL] == pytest.approx([0.7, 0.3, 0.2], abs=0.02)
    wanted = {WALL: pathreplay.Parameter(initial=0.5)}
    alone = pathreplay.Problem(room(), wanted, views(photos), spp=8, deterministic=True)
    state = pathreplay.init(alone, OPTIMIZER)
    for _ in range(4):
        before, state = state, pathreplay.step(alone, state)
    again = pathreplay.step(alone, before)
    assert state.values[WALL].tobytes() == again.values[WALL].tobytes()
    assert state.values[WALL] == pytest.approx([0.7, 0.3, 0.2], abs=0.02)


@pytest.mark.parametrize("plugin", ["pathreplay", "prb"])
def test_alpha_does_not_displace_the_result(plugin: str) -> None:
    """The sky behind the ball is transparent; Mitsuba's integrators write alpha itself into the alpha of tangents."""
    film = {"type": "hdrfilm", "width": 8, "height": 8, "pixel_format": "rgba", "rfilter": {"type": "box"}}
    ball = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.4, 0.2]}}
    eye = {
        "type": "perspective",
        "fov": 40,
        "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
    }
    description = {
        "type": "scene",
        "eye": {**eye, "film": film},
        "sun": {"type": "point", "position": [2, 3, 4], "intensity": {"type": "rgb", "value": 40.0}},
        "ball": {"type": "sphere", "radius": 0.7, "bsdf": ball},
    }
    scene = mi.load_dict(description, optimize=False)
    target = np.array(mi.render(scene, integrator=mi.load_dict({"type": "path", "max_depth": 3}), spp=256))
    wanted = {"ball.bsdf.reflectance.value": pathreplay.Parameter(initial=0.5, bounds=(0, 1))}
    integrator = {"type": plugin, "max_depth": 3}
    problem = pathreplay.Problem(scene, wanted, pathreplay.View(target=target), integrator=integrator, spp=16)
    result = pathreplay.minimize(problem, "levenberg-marquardt", steps=4, progress=False)
    assert result.values["ball.bsdf.reflectance.value"] == pytest.approx([0.7, 0.4, 0.2], abs=0.02)


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "loss": ({"loss": "l1"}, "needs a sum of squares, which loss = 'l1' is not; use l2 or relative-l2"),
    "odd": ({"spp": 5}, "splits the samples into halves, but spp is 5; set it to a multiple of 2"),
    "shards": ({"spp": 6, "spp_shards": 2}, "set it to a multiple of 4"),
    "stages": ({"stages": [{"iterations": 8}]}, "remove 'stages'"),
    "batches": ({"view_batch_size": 1}, "remove 'view_batch_size'"),
    "pixels": ({"pixel_batch_size": 9}, "remove 'pixel_batch_size'"),
    "schedule": ({"final_learning_rate_ratio": 0.5}, "remove 'final_learning_rate_ratio'"),
    "auto": ({"spp": "auto"}, "remove 'spp = 'auto''"),
    "option": ({"optimizer": {**OPTIMIZER, "beta_1": 0.9}}, "which has damping, tolerance"),
    "damping": ({"optimizer": {**OPTIMIZER, "damping": 0.0}}, "optimizer.damping"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_makes_no_sense_is_refused_in_one_line(case: str) -> None:
    change, words = REFUSED[case]
    with pytest.raises(PathreplayError) as told:
        make_config({**JOB, "optimizer": OPTIMIZER, **change})
    assert words in str(told.value) and "\n" not in str(told.value)
