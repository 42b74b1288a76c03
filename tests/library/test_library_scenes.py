"""Problems of several scenes that share parameters: loss and gradient are means, and each scene keeps its own rest."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import pathreplay
from library_scenes import BODY, GREY, SIDE, TEXTURE, WALL, photos_of_room, room, views
from pathreplay import Parameter, PathreplayError, Problem, View
from pathreplay.scenes.loading import load_scene
from small_job import checkpoint_bits
from variant import VARIANT

SKY = "sky.radiance.value"


@pytest.fixture(autouse=True)
def _variant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mi.set_variant(VARIANT)
    monkeypatch.chdir(tmp_path)


def lit(light: float) -> dict[str, Any]:
    return {**room(), "sky": {"type": "constant", "radiance": {"type": "rgb", "value": light}}}


def problem_in(light: float, *keys: str, sensors: tuple[str, ...] = ("left",), **settings: Any) -> Problem:
    scene = mi.load_dict(lit(light))
    photos = [np.array(mi.render(scene, sensor=("left", "right").index(name), spp=256)) for name in sensors]
    wanted = {key: Parameter(initial=0.5) if key == SKY else GREY for key in (WALL, *keys)}
    seen = [View(name, photo) for name, photo in zip(sensors, photos, strict=True)]
    return Problem(lit(0.8 if SKY in keys else light), wanted, seen, **{"spp": 16, "learning_rate": 0.03, **settings})


def test_loss_and_gradient_are_means_over_scenes() -> None:
    """Of scenes with another number of views; what only one has, has half of its gradient."""
    pair = [problem_in(0.5, SKY, spp=256), problem_in(2.0, TEXTURE, sensors=("left", "right"), spp=256)]
    alone = [pathreplay.value_and_grad(problem)(seed=1) for problem in pair]
    loss, gradients = pathreplay.value_and_grad(Problem.joint(pair))(seed=2)
    assert set(gradients) == {WALL, SKY, TEXTURE}
    assert loss == pytest.approx((alone[0][0] + alone[1][0]) / 2, rel=0.02)
    expected = {
        WALL: (alone[0][1][WALL] + alone[1][1][WALL]) / 2,
        SKY: alone[0][1][SKY] / 2,
        TEXTURE: alone[1][1][TEXTURE] / 2,
    }
    for key, gradient in expected.items():
        np.testing.assert_allclose(gradients[key], gradient, atol=0.05 * np.abs(gradient).max())


def test_scenes_with_one_wall_recover_it_and_each_its_light() -> None:
    """The light of one of them is not known, nor is the texture of the other."""
    problem = Problem.joint([problem_in(0.5, SKY), problem_in(2.0, TEXTURE)])
    result = pathreplay.minimize(problem, steps=80, progress=False)
    np.testing.assert_allclose(result.values[WALL], [0.7, 0.3, 0.2], atol=0.03)
    np.testing.assert_allclose(result.values[SKY], 0.5, atol=0.05)
    assert result.render(view="1-left", spp=4).shape == result.render(view=0, spp=4).shape == (SIDE, SIDE, 3)
    assert np.abs(result.render(view="0-left") - result.render(view="1-left")).mean() > 0.1
    other = mi.load_dict(lit(3.0))
    result.apply(other)
    np.testing.assert_allclose(np.array(mi.traverse(other)[SKY]).ravel(), result.values[SKY].ravel(), rtol=1e-5)


def test_two_scenes_alike_are_one_with_twice_the_samples(tmp_path: Path) -> None:
    """Their noise is independent: the variance of the gradient is half of that of one."""
    photos = photos_of_room()

    def one() -> Problem:
        return Problem(room(), {WALL: GREY}, views(photos), spp=2)

    single, double = pathreplay.value_and_grad(one()), pathreplay.value_and_grad(Problem.joint([one(), one()]))
    spread = [np.var([f(seed=seed)[1][WALL] for seed in range(60)], axis=0).sum() for f in (single, double)]
    assert 0.3 < spread[1] / spread[0] < 0.75


def test_it_goes_on_bit_for_bit_steps_and_has_a_folder() -> None:
    def joint() -> Problem:
        return Problem.joint([problem_in(light, deterministic=True, spp=2) for light in (0.5, 2.0)])

    def stop(it: pathreplay.Iteration) -> None:
        if it.number == 1:
            raise ZeroDivisionError

    settings: dict[str, Any] = {"steps": 4, "progress": False, "view_batch_size": 1}
    whole = pathreplay.minimize(joint(), output="whole", **settings)
    with pytest.raises(ZeroDivisionError):
        pathreplay.minimize(joint(), output="run", callbacks=[stop], **settings)
    pathreplay.minimize(joint(), output="run", resume=True, **settings)
    assert checkpoint_bits(Path("run")) == checkpoint_bits(Path("whole"))
    assert {path.name for path in Path("run/images").glob("result-*.exr")} == {
        "result-0-left.exr", "result-1-left.exr",
    }  # fmt: skip
    problem = joint()
    state = pathreplay.init(problem, steps=4, view_batch_size=1)
    for _ in range(4):
        state = pathreplay.step(problem, state)
    np.testing.assert_array_equal(state.values[WALL], whole.values[WALL])


def test_settings_of_a_run_reach_all_scenes() -> None:
    """A bias that is removed from the loss of each scene changes the loss of both together."""
    pair = Problem.joint([problem_in(0.5, loss="log", spp=4), problem_in(2.0, loss="log", spp=4)])
    plain, debiased = (
        pathreplay.minimize(pair, steps=1, progress=False, debias=debias).history[0].loss for debias in (False, True)
    )
    assert abs(debiased - plain) > 0.1 * abs(plain)


def test_media_of_several_scenes_learn_each_for_itself() -> None:
    limits = {"type": "pathreplay", "max_depth": 4}

    def cloud(level: float) -> Problem:
        scene = load_scene("cloud", resolution=12, grid=6, views=1)
        view = View(0, np.full((12, 12, 3), level))
        return Problem(scene, {"*.sigma_t.data": Parameter(initial=1.0)}, view, integrator=limits, spp=2)

    problem = Problem.joint([cloud(0.3), cloud(0.5)])
    state = pathreplay.init(problem)
    for _ in range(3):
        state = pathreplay.step(problem, state)
    names = {name.partition(":")[0] for name in state._learned}
    assert names == {"0", "1"} and len({state._learned[f"{n}:sums"].sum() for n in (0, 1)}) == 2


def test_what_a_shared_parameter_has_in_one_scene_only_is_told() -> None:
    """Parameters of one name would otherwise have the options of the first problem."""
    photos = photos_of_room()

    def lighter(values: Any) -> Any:
        return dr.mean(values, axis=None)

    def problem_of(key: str = WALL, **entry: Any) -> Problem:
        given = Parameter(**{"initial": 0.5, "bounds": (0, 1), **entry})
        return Problem(room(), {key: given}, View("left", photos[0]))

    first = problem_of()
    for other, words in (
        (problem_of(initial=0.25), r"'initial' is 0.5 in problem 0 and 0.25 in problem 1 \(at index \(0,\)\)"),
        (problem_of(initial=[0.5, 0.5, 0.75]), r"'initial' is 0.5 in problem 0 and 0.75 in problem 1 .*index \(2,\)\)"),
        (problem_of(bounds=(0, 0.75)), r"'bounds' is \(0.0, 1.0\) in problem 0 and \(0.0, 0.75\) in problem 1"),
        (
            problem_of("wall.*value", bounds=(None, 1)),
            r"'bounds' is \(0.0, 1.0\) in problem 0 and \(None, 1.0\) in problem 1",
        ),
        (problem_of(parameterization="logit"), "'parameterization' is None in problem 0 and 'logit' in problem 1"),
        (problem_of(learning_rate=0.5), "'learning_rate' is 0.02 in problem 0 and 0.5 in problem 1"),
        (problem_of(regularizer=lighter), "'regularizer' is None in problem 0 and 'lighter' in problem 1"),
    ):
        with pytest.raises(PathreplayError, match=f"^problems: parameter '{WALL}': {words}; .*same") as told:
            Problem.joint([first, other])
        assert "\n" not in str(told.value)
    pair = [problem_of(regularizer=lighter), problem_of("wall.*value", regularizer=lighter)]
    assert set(Problem.joint(pair).initial) == {WALL}
    with pytest.raises(PathreplayError, match="'regularizer' is 'lighter' in problem 0 and 'lambda' in problem 1"):
        Problem.joint([pair[0], problem_of(regularizer=lambda values: 2 * lighter(values))])
    made = [problem_of(regularizer=lambda values: lighter(values)) for _ in range(2)]
    with pytest.raises(PathreplayError, match="is one function 'lambda' in problem 0 and another in problem 1; create"):
        Problem.joint(made)
    functions = [lambda values: lighter(values), lambda values: 2 * lighter(values)]  # of one name
    made = [Parameter(initial=0.5, bounds=(0, 1), regularizer=function) for function in functions]
    pair = [
        Problem(room(), keys, View("left", photos[0]))
        for keys in ({WALL: made[0], TEXTURE: made[1]}, {TEXTURE: made[1]})
    ]
    assert set(Problem.joint(pair).initial) == {WALL, TEXTURE}
    moved = [
        Problem(room(), {BODY: Parameter(pose="translation", initial={"translation": [x, 0, 0]})}, views(photos))
        for x in (0.0, 0.5)
    ]
    with pytest.raises(
        PathreplayError, match=r"'body.*:translation': 'initial' is 0 in problem 0 and 0.5 in problem 1"
    ):
        Problem.joint(moved)


@pytest.mark.parametrize(
    ("first", "second", "words"),
    [
        ({"spp": 16}, {"spp": 64}, "'spp' is 16 in problem 0 and 64 in problem 1"),
        ({}, {"eval_spp": 4}, "'eval_spp' is 128 in problem 0 and 4 in problem 1"),
        ({"seed": 1}, {"seed": 2}, "'seed' is 1 in problem 0 and 2 in problem 1"),
        ({}, {"deterministic": True}, "'deterministic' is False in problem 0 and True in problem 1"),
        ({"optimizer": {"type": "sgd"}}, {}, "'optimizer' is {'type': 'sgd'} in problem 0 and .*adam.* in problem 1"),
        ({}, {"iterations": 300}, "'iterations' is 200 in problem 0 and 300 in problem 1"),
    ],
)
def test_settings_that_cannot_both_hold_are_told(first: Any, second: Any, words: str) -> None:
    photos = photos_of_room()
    pair = [Problem(room(), {WALL: GREY}, View("left", photos[0]), **settings) for settings in (first, second)]
    with pytest.raises(PathreplayError, match=f"^problems: {words}; .*same") as told:
        Problem.joint(pair)
    assert "\n" not in str(told.value)


def test_settings_of_each_scene_may_differ() -> None:
    """Its loss, integrator, and the learning rate of what only this scene has."""
    photos = photos_of_room()
    one = Problem(room(), {WALL: GREY}, View("left", photos[0]), loss="l1", integrator={"type": "prb"})
    two = Problem(room(), {TEXTURE: GREY}, View("right", photos[1], test=False), learning_rate=0.5)
    joint = Problem.joint([one, two])
    assert {v.key: v.learning_rate for v in joint.built.variables} == {WALL: 0.02, TEXTURE: 0.5}


def test_what_scenes_cannot_share_is_told() -> None:
    photos = photos_of_room()
    scene = mi.load_dict(room(), optimize=False)
    one, two = (Problem(scene, {WALL: GREY}, View(name, photos[0])) for name in ("left", "right"))
    coarse = Problem(room(), {TEXTURE: Parameter(initial=0.5, resolutions=[2, 4], refine_at=[3])}, views(photos))
    fine = Problem(room(), {TEXTURE: GREY}, views(photos))
    exposed = Problem(room(), {WALL: GREY}, views(photos), exposure={})
    for problems, words in (
        ([one, two], "have the same scene"),
        ([coarse, fine], "shape"),
        ([one, exposed], "none of 'exposure', 'response' and 'baseline'"),
        ([], "problems: there are none"),
    ):
        with pytest.raises(PathreplayError, match=words) as told:
            Problem.joint(problems)
        assert "\n" not in str(told.value)
    absolute = Problem(room(), {WALL: GREY}, views(photos), loss="l1")
    with pytest.raises(PathreplayError, match=r"'levenberg-marquardt' needs a sum of squares in all scenes, .* 'l1'"):
        pathreplay.minimize(Problem.joint([one, absolute]), "levenberg-marquardt", progress=False)
    smooth = Problem(room(), {WALL: GREY}, views(photos), loss="log")
    with pytest.raises(PathreplayError, match="debias: loss = 'l1' is not smooth"):
        pathreplay.minimize(Problem.joint([smooth, absolute]), debias=True, progress=False)
    with pytest.raises(PathreplayError, match="stages: joint problems do not support stages"):
        pathreplay.minimize(Problem.joint([one, fine]), stages=[{"iterations": 2}], progress=False)
