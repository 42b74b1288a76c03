"""Iterate averaging: the formula, its error under drift and noise, and jobs with and without it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

import pathreplay
from pathreplay.inverse.config.optimizer_options import Optimizer
from pathreplay.inverse.optim import averaging
from pathreplay.inverse.optim.adaptive import DrJitOptimiser, State
from pathreplay.inverse.optim.averaging import LONG, SHORT, Averaged
from pathreplay.jobs import make_config, optimize
from small_job import bits
from wall_job import JOB

Arrays = dict[str, np.ndarray]


class Replayed:
    """An optimiser whose iterates are given."""

    finished = ""

    def __init__(self, iterates: Sequence[np.ndarray]) -> None:
        self.iterates, self.count = iterates, 0

    def step(
        self, values: Arrays, gradients: Arrays, rates: Mapping[str, float], loss: float = 0.0
    ) -> dict[str, np.ndarray]:
        self.count += 1
        return {"x": self.iterates[self.count - 1].astype(np.float32)}

    def answer(self, values: Arrays) -> dict[str, np.ndarray]:
        return {}

    def state(self) -> State:
        return State({"x": self.count}, {})

    def restore(self, state: State, values: Arrays) -> None:
        self.count = state.steps["x"]


def averaged(iterates: Sequence[np.ndarray]) -> np.ndarray:
    """The result after these iterates, from an initial value far away."""
    optimiser, x = Averaged(Replayed(iterates)), {"x": np.full_like(iterates[0], 1e3, np.float32)}
    for _ in iterates:
        x = optimiser.step(x, {}, {})
    return optimiser.answer(x)["x"]


def mean(iterates: Sequence[np.ndarray], eta: int) -> np.ndarray:
    """The weighted mean, whose i-th weight is proportional to Π_{k<η} (i + k)."""
    weights = np.array([np.prod([float(i + k) for k in range(eta)]) for i in range(1, len(iterates) + 1)])
    return np.tensordot(weights / weights.sum(), np.array(iterates, float), 1)


def test_the_result_combines_the_last_iterate_with_the_short_mean() -> None:
    rng = np.random.default_rng(0)
    iterates = [np.array([1.0, 2.0, -1.0]) + rng.normal(size=3) for _ in range(60)]
    short, long = mean(iterates, SHORT), mean(iterates, LONG)
    distances = [np.sum((x - mean(iterates[: i + 1], SHORT)) ** 2) for i, x in enumerate(iterates)]
    share = 1 - np.sum((long - short) ** 2) / mean([np.array(d) for d in distances], SHORT)
    assert 0.5 < share < 1
    assert averaged(iterates) == pytest.approx(iterates[-1] + share * (short - iterates[-1]), rel=1e-5)


def test_the_result_is_the_last_iterate_while_values_move_steadily() -> None:
    for iterates in ([np.array([0.1 * n]) for n in range(50)], [np.array([2.0 - 0.9**n]) for n in range(20)]):
        assert averaged(iterates)[0] == np.float32(iterates[-1][0])
    assert averaged([np.array([3.0])])[0] == 3


@pytest.mark.parametrize("drift", [0.0, 0.003, 0.01, 0.03, 0.1, 0.3])
def test_the_result_has_at_most_the_error_of_the_last_iterate(drift: float) -> None:
    """Iterates 300 x drift away from the minimum approach it, with correlated noise of variance 1."""
    rng, n, size = np.random.default_rng(1), 300, 64
    errors = []
    for _ in range(20):
        noise, iterates = rng.normal(size=size), []
        for i in range(n):
            noise = 0.9 * noise + np.sqrt(1 - 0.81) * rng.normal(size=size)
            iterates.append(noise + drift * (n - i))
        last, found = iterates[-1] - drift, averaged(iterates) - drift
        errors.append((np.mean(last**2), np.mean(found**2)))
    last_error, error = np.mean(errors, axis=0)
    assert error < 1.03 * last_error, (drift, error, last_error)
    if drift <= 0.003:
        assert error < 0.5 * last_error


def test_each_variable_has_its_own_combination() -> None:
    moving = {"still": np.zeros(4, np.float32), "fast": np.zeros(4, np.float32)}
    optimiser = Averaged(DrJitOptimiser(moving, Optimizer(type="sgd")))
    x, rng = moving, np.random.default_rng(2)
    for _ in range(80):
        gradients = {"still": x["still"] + rng.normal(size=4).astype(np.float32), "fast": np.full(4, -1, np.float32)}
        x = optimiser.step(x, gradients, {"still": 0.5, "fast": 0.1})
    found = optimiser.answer(x)
    np.testing.assert_array_equal(found["fast"], x["fast"])
    assert np.linalg.norm(found["still"]) < 0.7 * np.linalg.norm(x["still"])


def test_a_large_variable_keeps_its_last_iterate(monkeypatch: pytest.MonkeyPatch) -> None:
    """A variable that is refined beyond the limit loses its means, also in a checkpoint."""
    monkeypatch.setattr(averaging, "MOST", 4)
    optimiser, x = Averaged(DrJitOptimiser({"x": np.zeros(4, np.float32)})), {"x": np.zeros(4, np.float32)}
    for size, names in ((4, {"short:x", "long:x", "scatter:x"}), (5, set())):
        x = {"x": np.zeros(size, np.float32)}
        for _ in range(3):
            x = optimiser.step(x, {"x": np.ones(size, np.float32)}, {"x": 0.1})
        assert {name for name in optimiser.state().arrays if name.startswith(("short", "long", "scatter"))} == names
        assert set(optimiser.answer(x)) == ({"x"} if names else set())
        again = Averaged(DrJitOptimiser(x))
        again.restore(optimiser.state(), x)
        assert bits(again.answer(x)) == bits(optimiser.answer(x))


def test_averaging_changes_the_result_of_a_job_but_not_its_iterates(wall_room: Path) -> None:
    key = JOB["parameters"][0]["key"]
    target = {**JOB["target"], "spp": 4096}  # the minimum of a noisy target would be elsewhere
    fast = {**JOB, "target": target, "iterations": 40, "learning_rate": 0.1, "spp": 1}
    on, off = (
        optimize(make_config({**fast, "optimizer": {"iterate_averaging": switch}}), progress=False)
        for switch in (True, False)
    )
    assert [e.loss for e in on.history] == pytest.approx([e.loss for e in off.history], rel=1e-4)
    truth = np.float32(JOB["target"]["values"][key])
    errors = [np.linalg.norm(np.ravel(result.parameters[key]) - truth) for result in (on, off)]
    assert errors[0] < 0.7 * errors[1], errors
    assert optimize(make_config(fast), progress=False).parameters[key] == pytest.approx(on.parameters[key], abs=1e-5)


@pytest.mark.parametrize("before", [True, False])
def test_a_run_may_go_on_with_another_averaging(before: bool, wall_room: Path) -> None:
    (wall_room / "job.json").write_text(json.dumps({**JOB, "spp": 2}))
    problem = pathreplay.load_job("job.json")
    results = [
        pathreplay.minimize(problem, {"type": "adam", "iterate_averaging": averages}, steps=steps, output="run", **more)
        for averages, steps, more in ((before, 3, {}), (not before, 6, {"resume": True}))
    ]
    assert [len(result.history) for result in results] == [3, 6]
    assert results[1].history[:3] == results[0].history


def test_a_step_returns_the_average_and_goes_on_from_the_iterate(wall_room: Path) -> None:
    (wall_room / "job.json").write_text(json.dumps({**JOB, "spp": 2, "learning_rate": 0.1}))
    problem = pathreplay.load_job("job.json")
    state = pathreplay.init(problem, {"type": "adam", "iterate_averaging": True})
    plain = pathreplay.init(problem, {"type": "adam", "iterate_averaging": False})
    middle = state
    for n in range(24):
        state, plain = pathreplay.step(problem, state), pathreplay.step(problem, plain)
        middle = state if n == 11 else middle
    assert [e.loss for e in state.history] == [e.loss for e in plain.history]
    assert bits(state._next) == bits(dict(plain.values)) != bits(dict(state.values))
    for _ in range(12):
        middle = pathreplay.step(problem, middle)
    assert bits(dict(middle.values)) == bits(dict(state.values)), "an earlier state goes on as before"
