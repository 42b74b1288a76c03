"""Steps as pure functions of a problem and a state: what they give, and that they change nothing."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import pathreplay
from library_scenes import GREY, OPTIMIZERS, SEARCHES, SLOWLY, TEXTURE, WALL, Descent, photos_of_room, room, views
from pathreplay import Parameter, PathreplayError, Problem, State, View
from pathreplay.platform import memory
from variant import VARIANT


@pytest.fixture(autouse=True)
def _variant() -> None:
    mi.set_variant(VARIANT)


@pytest.fixture(scope="module")
def photos() -> list[np.ndarray]:
    return photos_of_room()


def problem_of(photos: list[np.ndarray], **settings: Any) -> Problem:
    wanted = {WALL: GREY, TEXTURE: Parameter(initial=0.5, bounds=(0, 1), resolutions=[2, 4], refine_at=[2])}
    return Problem(room(), wanted, views(photos), spp=4, **{"learning_rate": 0.03, "deterministic": True, **settings})


def wall_of(photos: list[np.ndarray], **settings: Any) -> Problem:
    return Problem(room(), {WALL: GREY}, views(photos), spp=4, learning_rate=0.03, deterministic=True, **settings)


def frozen(state: State) -> dict[str, bytes]:
    return {key: value.tobytes() for key, value in state.values.items()}


MAKERS: dict[str, Callable[[], Any]] = {**OPTIMIZERS, **SEARCHES}


@pytest.mark.parametrize("name", [pytest.param(name, marks=SLOWLY[name]) for name in MAKERS])
def test_steps_are_those_of_minimize_and_change_no_state(name: str, photos: list[np.ndarray]) -> None:
    """Forwards; then again from a state in the middle, and from the first, of the same states."""
    make, problem = MAKERS[name], (wall_of if name in SEARCHES else problem_of)(photos)
    wanted = pathreplay.minimize(problem, make(), steps=5, progress=False)
    states = [pathreplay.init(problem, make(), steps=5)]
    for _ in range(5):
        states.append(pathreplay.step(problem, states[-1]))
    kept = [frozen(state) for state in states]
    assert [entry.loss for entry in states[-1].history] == [entry.loss for entry in wanted.history]
    for key, value in states[-1].values.items():
        np.testing.assert_array_equal(value, wanted.values[key])
    for begin in (3, 0):
        state = states[begin]
        for n in range(begin + 1, 6):
            state = pathreplay.step(problem, state)
            assert frozen(state) == kept[n], (begin, n)
    assert [frozen(state) for state in states] == kept
    assert [len(state.history) for state in states] == list(range(6)) and "after 5 steps" in repr(states[-1])


def test_functions_of_a_problem_keep_its_memory_limit(
    photos: list[np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = wall_of(photos, memory_limit="1 GB")
    loss = pathreplay.value_and_grad(problem)
    monkeypatch.setattr(memory, "taken", lambda: 2 * 10**9)
    for evaluate in (loss, lambda: pathreplay.step(problem, pathreplay.init(problem))):
        with pytest.raises(PathreplayError, match="uses 2 GB of memory, and its 'memory_limit' is 1 GB"):
            evaluate()
    memory.require_kept()


def test_stages_and_schedules_are_those_of_minimize(photos: list[np.ndarray]) -> None:
    settings = {
        "stages": [{"iterations": 2, "downscale": 2, "parameters": [WALL]}, {"iterations": 2, "max_depth": 2}],
        "final_learning_rate_ratio": 0.1,
    }
    problem = problem_of(photos)
    wanted = pathreplay.minimize(problem, progress=False, **settings)
    state = pathreplay.init(problem, **settings)
    for _ in range(4):
        state = pathreplay.step(problem, state)
    for key, value in state.values.items():
        np.testing.assert_array_equal(value, wanted.values[key])
    assert pathreplay.step(problem, state).history[-1].iteration == 4  # the schedule ends nothing


def test_scenes_that_share_a_parameter_take_turns() -> None:
    """Two lights of which each scene has one: the wall's colour is common to both."""

    def scene_in(light: float) -> dict[str, Any]:
        return {**room(), "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [light, light, 1.0]}}}

    def problem_in(light: float) -> Problem:
        photo = np.array(mi.render(mi.load_dict(scene_in(light)), sensor=0, spp=256))
        return Problem(scene_in(light), {WALL: GREY}, View("left", photo), spp=16, learning_rate=0.03)

    problems = [problem_in(light) for light in (0.5, 2.0)]
    state = pathreplay.init(problems[0])
    for n in range(60):
        state = pathreplay.step(problems[n % 2], state)
    np.testing.assert_allclose(state.values[WALL], [0.7, 0.3, 0.2], atol=0.02)


def test_an_optimizer_of_mitsuba_keeps_its_rate_in_every_problem(photos: list[np.ndarray]) -> None:
    problems = [Problem(room(), {WALL: GREY}, views(photos), spp=4, learning_rate=rate) for rate in (0.03, 0.3)]
    state = pathreplay.init(problems[0], mi.ad.Adam(lr=0.01))
    for problem in problems:
        after = pathreplay.step(problem, state)
        np.testing.assert_allclose(np.abs(after._next[WALL] - state._next[WALL]), 0.01, rtol=1e-3)  # Adam's first step


def test_a_finished_search_stays_where_it_is(photos: list[np.ndarray]) -> None:
    problem = wall_of(photos)
    state = pathreplay.init(problem, {"type": "l-bfgs-b", "tolerance": 0.5})
    for _ in range(40):
        state = pathreplay.step(problem, state)
    assert state.finished and len(state.history) < 40
    assert pathreplay.step(problem, state) is state


def test_what_cannot_be_stepped_is_told(photos: list[np.ndarray]) -> None:
    problem = wall_of(photos)
    state = pathreplay.init(problem)
    assert np.isnan(state.loss)
    with pytest.raises(PathreplayError, match=r"The state has the parameters .*; start again with init"):
        pathreplay.step(problem_of(photos), state)
    with pytest.raises(PathreplayError, match="has no state_dict"):
        pathreplay.init(problem, Descent())
    with pytest.raises(PathreplayError, match=r"init: executor = 'ray' is for minimize.*set executor to 'local'"):
        pathreplay.init(problem, executor="ray")
    with pytest.raises(PathreplayError, match="init: unknown key 'warm_up'"):
        pathreplay.init(problem, warm_up=3)
