"""What takes the place of an optimiser or an executor: every one of them keeps its promise."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
import pytest

from end_of_page import run_at_the_end
from pathreplay.inverse.config.optimizer_options import Optimizer
from pathreplay.inverse.objective.evaluate import Evaluate, Evaluation, Executor, Local, Shard, total
from pathreplay.inverse.optim.adaptive import DrJitOptimiser, Optimiser, State
from pathreplay.inverse.optim.averaging import Averaged
from small_job import bits

Make = Callable[..., Optimiser]
OPTIMISERS = {
    "adam": {},
    "amsgrad": {"type": "adam", "amsgrad": True},
    "uniform": {"type": "adam", "uniform": True},
    "adamw": {"type": "adamw", "weight_decay": 1e-3},
    "sgd": {"type": "sgd"},
    "nesterov": {"type": "sgd", "momentum": 0.5, "nesterov": True},
    "rmsprop": {"type": "rmsprop", "alpha": 0.9},
}
AVERAGED = {"adam, averaged": {}, "sgd, averaged": {"type": "sgd"}}
EXECUTORS = [Local]

GOAL = {"colour": np.float32([0.2, -0.4, 0.9]), "grid": np.linspace(-1, 1, 24, dtype=np.float32).reshape(2, 3, 4, 1)}
RATES = {"colour": 0.05, "grid": 0.1}
Arrays = dict[str, np.ndarray]


@pytest.fixture(params=[*OPTIMISERS, *AVERAGED])
def make(request: pytest.FixtureRequest) -> Make:
    if request.param in OPTIMISERS:
        return partial(DrJitOptimiser, options=Optimizer(**OPTIMISERS[request.param]))
    return lambda values: Averaged(DrJitOptimiser(values, Optimizer(**AVERAGED[request.param])))


def start() -> Arrays:
    return {key: np.zeros_like(value) for key, value in GOAL.items()}


def go_on(optimiser: Optimiser, values: Arrays, steps: int) -> Arrays:
    """That many steps down Σ (v - goal)²."""
    for _ in range(steps):
        values = optimiser.step(values, {key: 2 * (value - GOAL[key]) for key, value in values.items()}, RATES)
    return values


def test_an_optimiser_gets_there(make: Make) -> None:
    values = go_on(make(start()), start(), 200)
    for key, goal in GOAL.items():
        assert values[key].shape == goal.shape and values[key].dtype == np.float32
        np.testing.assert_allclose(values[key], goal, atol=0.06 if "rmsprop" in str(make) else 0.02)


def test_an_optimiser_leaves_what_it_was_given(make: Make) -> None:
    values = start()
    go_on(make(values), values, 1)
    assert bits(values) == bits(start())


@pytest.mark.parametrize("done", [0, 3])
def test_a_restored_optimiser_goes_on_bit_for_bit(make: Make, done: int) -> None:
    optimiser = make(start())
    values = go_on(optimiser, start(), done)
    state = optimiser.state()
    assert state.steps == dict.fromkeys(GOAL, done)
    other = make(start())
    other.restore(state, values)
    assert bits(other.state().arrays) == bits(state.arrays)
    assert bits(go_on(other, values, 3)) == bits(go_on(optimiser, values, 3))


def test_an_optimiser_begins_anew_on_another_shape_only_there(make: Make) -> None:
    optimiser = make({"grid": np.zeros(2, np.float32), "colour": start()["colour"]})
    old = {"grid": np.zeros(2, np.float32), "colour": start()["colour"]}
    optimiser.step(old, {"grid": np.ones(2, np.float32), "colour": -GOAL["colour"]}, RATES)
    values = go_on(optimiser, start(), 1)
    assert optimiser.state().steps == {"grid": 1, "colour": 2}
    assert bits({"grid": values["grid"]}) == bits({"grid": go_on(make(start()), start(), 1)["grid"]})


def test_what_does_not_come_stays_as_it_is(make: Make) -> None:
    optimiser = make(start())
    values = go_on(optimiser, start(), 2)
    before = optimiser.state()
    optimiser.step({"colour": values["colour"]}, {"colour": GOAL["colour"]}, {"colour": 0.1})
    after = optimiser.state()
    assert after.steps == {"colour": 3, "grid": 2}
    kept = [name for name in before.arrays if name.endswith(":grid")]
    assert bits({k: after.arrays[k] for k in kept}) == bits({k: before.arrays[k] for k in kept})


def test_a_state_of_other_variables_is_refused(make: Make) -> None:
    optimiser = make(start())
    go_on(optimiser, start(), 1)
    other = [{"other": np.zeros(3, np.float32)}]
    if optimiser.state().arrays:  # plain gradient descent remembers nothing that had a shape
        other.append({"grid": np.zeros(5, np.float32)})
    for values in other:
        with pytest.raises((KeyError, ValueError)):
            make(values).restore(optimiser.state(), values)


def test_a_state_of_another_optimiser_is_refused() -> None:
    optimiser = DrJitOptimiser(start())
    go_on(optimiser, start(), 1)
    with pytest.raises(ValueError, match="is not a state array of this optimizer"):
        DrJitOptimiser(start(), Optimizer(type="sgd")).restore(optimiser.state(), start())


AT_THE_END = """
from types import SimpleNamespace
from pathreplay.inverse.config.optimizer_options import Optimizer
from pathreplay.inverse.optim.adaptive import DrJitOptimiser, State
from pathreplay.library.optimizers import OfMitsuba

x = {"x": at_the_end(np.ones(15, np.float32))}
rates = {"x": 0.5}
problem = SimpleNamespace(variables=[], config=SimpleNamespace(exposure=None, response=None, parameters=[]))
problem.variables = [SimpleNamespace(key="x", learning_rate=0.5)]
for make in (lambda: DrJitOptimiser(x), lambda: OfMitsuba(mi.ad.Adam(lr=0.5), x, problem)):
    optimiser, other = make(), make()
    optimiser.step(x, x, rates)
    state = optimiser.state()
    other.restore(State(state.steps, {name: at_the_end(array) for name, array in state.arrays.items()}), x)
    print((other.step(x, x, rates)["x"] == optimiser.step(x, x, rates)["x"]).all())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="protects a page of memory")
def test_states_and_values_are_taken_from_the_end_of_memory() -> None:
    assert run_at_the_end(AT_THE_END) == ["True", "True"]


def test_averaging_may_begin_and_end_within_a_run() -> None:
    """Iterates go on in any case. Means that are not there begin with the next step, and can be stored again."""
    plain, averaging = DrJitOptimiser(start()), Averaged(DrJitOptimiser(start()))
    values = go_on(plain, start(), 5)
    go_on(averaging, start(), 5)
    without, begins, anew = (
        DrJitOptimiser(start()),
        Averaged(DrJitOptimiser(start())),
        Averaged(DrJitOptimiser(start())),
    )
    without.restore(averaging.state(), values)
    begins.restore(plain.state(), values)
    assert begins.answer(values) == {}
    after = go_on(plain, values, 4)
    assert bits(go_on(without, values, 4)) == bits(after) == bits(go_on(begins, values, 4))
    anew.restore(begins.state(), after)
    assert bits(anew.state().arrays) == bits(begins.state().arrays)
    assert bits(anew.answer(after)) == bits(begins.answer(after)) != {}
    arrays = dict(averaging.state().arrays)
    for change in ({"scatter:grid": np.float64([1, 5])}, {"scatter:grid": np.float64([1, 0.5])}):
        with pytest.raises(ValueError, match="iterates in 5 steps"):
            anew.restore(State(averaging.state().steps, {**arrays, **change}), values)
    del arrays["long:grid"]
    with pytest.raises(KeyError):
        anew.restore(State(averaging.state().steps, arrays), values)


def counting(values: Mapping[str, np.ndarray], shard: Shard, learned: Mapping[str, np.ndarray], /) -> Evaluation:
    """The view as loss; what was known and the seed, added up, as what was learned."""
    gradients = {"a": values["a"] * shard.samples}
    return Evaluation(float(shard.views[0]), gradients, {}, {"sum": learned["sum"] + np.float32(shard.seeds)})


@pytest.mark.parametrize("make", EXECUTORS)
def test_an_executor_gives_results_in_the_order_of_the_shards(make: type[Local]) -> None:
    evaluate: Evaluate = counting
    executor: Executor = make(evaluate)
    shards = [Shard((view,), 2 + view, (10 * view,)) for view in (3, 0, 2)]
    found = list(executor.run({"a": np.float32([1, 2])}, shards, {"sum": np.float32([7])}))
    assert [each.loss for each in found] == [3, 0, 2]
    assert [each.gradients["a"].tolist() for each in found] == [[5, 10], [2, 4], [4, 8]]
    assert [each.learned["sum"].tolist() for each in found] == [[37], [7], [27]]  # none waits for another
    assert total(found).learned["sum"].tolist() == [np.float32(71) / np.float32(3)]
    assert list(executor.run({"a": np.float32([1, 2])}, [], {})) == []
