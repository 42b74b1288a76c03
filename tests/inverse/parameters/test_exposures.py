"""Exposures of views are recovered with the rest: derivatives, the scale that is fixed, and what is told of them."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from exposed_job import JOB, KEY, folder, scene  # noqa: F401 (folder: for every test)
from pathreplay.errors import PathreplayError
from pathreplay.inverse.images.io import exr_bytes
from pathreplay.inverse.objective.evaluate import Evaluator, Shard
from pathreplay.inverse.parameters.exposures import EXPOSURE, Factors, fitted
from pathreplay.inverse.parameters.values import Arrays
from pathreplay.inverse.problem.problem import Problem, build_problem
from pathreplay.jobs import make_config, optimize

LAMP = """<shape type="rectangle"><transform name="to_world"><scale value="2"/><rotate x="1" angle="180"/>
    <translate z="1.5"/></transform><emitter type="area"><rgb name="radiance" value="3"/></emitter></shape>"""


def start_of(problem: Problem) -> dict[str, np.ndarray]:
    return {variable.key: variable.start for variable in problem.variables}


SLOW = pytest.mark.slow
# Of each pixel for itself; what losses of neighbourhoods are of flat pictures is not what is asked here.
PLAIN = ("l2", "relative-l2", "l1", "log")


@pytest.mark.parametrize(
    ("white_balance", "loss", "filter"),
    [
        (True, "l2", "box"),
        *(pytest.param(*each, marks=SLOW) for each in itertools.product([False], PLAIN, ["box", "gaussian"])),
        *(pytest.param(True, loss, "gaussian", marks=SLOW) for loss in PLAIN),
    ],
)
def test_gradients_are_those_of_finite_differences(white_balance: bool, loss: str, filter: str, folder: Path) -> None:
    """In a scene without noise, swept (box) or not; of factors and of the scene, that are seen through the factors."""
    (folder / "room.xml").write_text(scene(filter=filter))
    problem = build_problem(make_config({**JOB, "loss": loss, "exposure": {"white_balance": white_balance}}), folder)
    evaluator = Evaluator(problem, problem.integrator)
    rows = np.array([[1.3, 1.1, 0.7], [0.6, 0.5, 0.9], [1.7, 1.4, 1.2], [1, 1, 1]], np.float32)
    values = {**start_of(problem), EXPOSURE: rows if white_balance else rows[:, :1].copy()}
    shard = Shard((2, 1, 0), 4, (1, 2, 3))
    found = evaluator(values, shard, {}).gradients
    assert found[EXPOSURE].shape == values[EXPOSURE].shape and not found[EXPOSURE][3].any()
    for key in (EXPOSURE, KEY):
        for place in np.ndindex(values[key].shape):
            steps = []
            for step in (0.01, -0.01):
                moved = values[key].copy()
                moved[place] += step
                steps.append(evaluator({**values, key: moved}, shard, {}).loss)
            expected = (steps[0] - steps[1]) / 0.02
            assert found[key][place] == pytest.approx(expected, abs=2e-4 + 1e-3 * abs(expected)), (key, place)


@SLOW
def test_recorded_passes_have_the_same_gradient(folder: Path) -> None:
    problem = build_problem(make_config(JOB), folder)
    evaluator = Evaluator(problem, problem.integrator)
    shard = Shard((0,), 4, (7,))
    values: Arrays = start_of(problem)
    first, *others = (evaluator(values, shard, {}).gradients[EXPOSURE] for _ in range(4))
    for other in others:
        assert other == pytest.approx(first, rel=1e-5)
    moved = {**values, EXPOSURE: values[EXPOSURE] * np.float32(2)}
    assert evaluator(moved, shard, {}).gradients[EXPOSURE][0, 0] != pytest.approx(first[0, 0], rel=0.1)


@SLOW
@pytest.mark.parametrize("filter", ["box", "gaussian"])
def test_noise_does_not_darken_exposures(filter: str, folder: Path) -> None:
    """With one sample per pixel the mean of the derivative is that of pictures without noise.

    The derivative is 2 mean((e I - T) I): of one rendering, the variance of I would be added to it.
    """
    (folder / "room.xml").write_text(scene(light=LAMP, filter=filter))
    problem = build_problem(make_config({**JOB, "spp": 1}), folder)
    evaluator = Evaluator(problem, problem.integrator)
    values = start_of(problem)
    found = [evaluator(values, Shard((0,), 1, (seed,)), {}).gradients[EXPOSURE][0, 0] for seed in range(2000)]
    error = np.std(found) / np.sqrt(len(found))
    exact = np.mean([evaluator(values, Shard((0,), 4096, (s,)), {}).gradients[EXPOSURE][0, 0] for s in (1, 2, 3)])
    variance = evaluator(values, Shard((0,), 1, (5,)), {}).loss  # of the order of what would be added
    assert abs(np.mean(found) - exact) < 4 * error
    assert error < 0.1 * variance  # so that it would be seen


@SLOW
def test_exposures_and_scene_are_recovered_up_to_the_scale_that_is_fixed() -> None:
    """Of three views with 0.8, 0.4 and 0.2 the geometric mean is 0.4, which is then the reflectance."""
    result = optimize(make_config(JOB), progress=False)
    assert result.parameters[KEY] == pytest.approx([0.4] * 3, abs=0.01)
    assert result.parameters[EXPOSURE].ravel() == pytest.approx([2, 1, 0.5, 1.5], abs=0.03)
    views = json.loads((result.folder / "views.json").read_text())
    assert views["eye-3"]["recovered_exposure"] == pytest.approx([1.5], abs=0.03) and views["eye-3"]["is_test"]
    assert all(view["result"]["psnr"] > 35 for view in views.values())
    assert "recovered exposure" in result.report.read_text()


@SLOW
@pytest.mark.parametrize("given", [{"reference": "eye-1"}, {"reference": 1}, {"fix_scale": False}])
def test_a_view_can_be_the_reference(given: dict[str, Any]) -> None:
    job = {**JOB, "parameters": [{"key": KEY, "initial": 0.4, "learning_rate": 1e-9}], "exposure": given}
    result = optimize(make_config(job), progress=False)
    assert result.parameters[EXPOSURE].ravel() == pytest.approx([2, 1, 0.5, 1.5], abs=0.02)
    if "reference" in given:
        assert result.parameters[EXPOSURE][1, 0] == 1


@SLOW
def test_white_balance_has_a_factor_for_each_colour(folder: Path) -> None:
    tint = np.array([1.2, 1.0, 0.5], np.float32)
    (folder / "0.exr").write_bytes(exr_bytes(np.full((4, 6, 3), 0.4, np.float32) * tint))
    (folder / "1.exr").write_bytes(exr_bytes(np.full((4, 6, 3), 0.4, np.float32) / tint))
    job = {**JOB, "sensors": [0, 1, 3], "target": {"images": ["0.exr", "1.exr", "3.exr"]}}
    result = optimize(make_config({**job, "exposure": {"white_balance": True}}), progress=False)
    assert result.parameters[KEY] == pytest.approx([0.4] * 3, abs=0.01)
    assert result.parameters[EXPOSURE] == pytest.approx(np.array([tint, 1 / tint, [1.5] * 3]), rel=0.03)


@SLOW
def test_a_run_that_goes_on_has_the_exposures_of_one_that_did_not_stop(folder: Path) -> None:
    job = {**JOB, "iterations": 8, "deterministic": True, "final_learning_rate_ratio": 1.0}
    whole = optimize(make_config(job), output="whole", progress=False)
    part = optimize(make_config({**job, "iterations": 4}), output="part", progress=False)
    config = part.folder / "config.json"
    config.write_text(config.read_text().replace('"iterations": 4', '"iterations": 8'))
    again = optimize(resume=part.folder, progress=False)
    assert again.parameters[EXPOSURE].tobytes() == whole.parameters[EXPOSURE].tobytes()


def test_the_geometric_mean_of_those_that_are_learned_from_stays_one() -> None:
    values = np.exp(np.random.default_rng(0).normal(size=(5, 3))).astype(np.float32)
    factors = Factors([0, 2, 3])
    found = factors.values(factors.latent(values))
    assert np.log(found[[0, 2, 3]]).mean(axis=0) == pytest.approx(np.zeros(3), abs=1e-6)
    assert found / found[0] == pytest.approx(values / values[0], rel=1e-5)
    assert Factors([]).values(factors.latent(values)) == pytest.approx(values, rel=1e-5)


def test_held_out_views_are_fitted_where_their_mask_is() -> None:
    rng = np.random.default_rng(0)
    picture = rng.uniform(0.1, 1, (4, 6, 4)).astype(np.float32)
    target = picture * np.array([2, 0.5, 1, 1], np.float32)
    target[:, 3:] = 9
    weight = np.zeros((4, 6, 1), np.float32)
    weight[:, :3] = 2
    assert fitted(picture, target, weight, True) == pytest.approx([2, 0.5, 1], rel=1e-5)
    assert fitted(np.zeros((2, 2, 3), np.float32), np.ones((2, 2, 3), np.float32), None, False) == pytest.approx([1])


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "both": (
        {"exposure": {"fix_scale": False, "reference": 0}},
        "exposure: fix_scale = false and 'reference' exclude each other",
    ),
    "no view": ({"exposure": {"reference": "eye-9"}}, "No sensor 'eye-9' in the scene"),
    "held out": ({"exposure": {"reference": "eye-3"}}, "the reference 'eye-3' is a test view; name a training view"),
    "misspelt": ({"exposure": {"white_ballance": True}}, "did you mean 'white_balance'?"),
    "no number": ({"exposure": True}, "'exposure' is True"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_exposures_cannot_be_is_refused_in_one_line(case: str, folder: Path) -> None:
    changes, words = REFUSED[case]
    with pytest.raises(PathreplayError) as told:
        optimize(make_config({**JOB, **changes}), progress=False)
    assert words in str(told.value) and "\n" not in str(told.value)


def test_one_channel_has_no_white_balance(folder: Path) -> None:
    (folder / "room.xml").write_text(scene(film="luminance"))
    with pytest.raises(PathreplayError, match="'white_balance' needs colour images"):
        build_problem(make_config({**JOB, "exposure": {"white_balance": True}}), folder)


@SLOW
def test_views_count_as_much_as_they_weigh(folder: Path) -> None:
    """The best constant for 0.8 and 0.2 is their mean by weight."""
    job = {**JOB, "test_views": [], "sensors": [0, 2], "target": {"images": ["0.exr", "2.exr"]}}
    del job["exposure"]
    result = optimize(make_config({**job, "view_weights": {"eye-0": 3.0}, "iterations": 100}), progress=False)
    assert result.parameters[KEY] == pytest.approx([(3 * 0.8 + 0.2) / 4] * 3, abs=0.01)
