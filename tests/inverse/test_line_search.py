"""L-BFGS-B: SciPy's, evaluation by evaluation; gone on with bit for bit; in jobs, on one set of random numbers."""

from __future__ import annotations

import types
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
import scipy.optimize

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.optimizer_options import Optimizer
from pathreplay.inverse.config.parameter_options import TransformKind
from pathreplay.inverse.loop.loop import optimiser_of
from pathreplay.inverse.optim.adaptive import State
from pathreplay.inverse.optim.lbfgs import MOST, LineSearch
from pathreplay.inverse.optim.levenberg_marquardt import LevenbergMarquardt
from pathreplay.inverse.parameters.gauss_newton import GaussNewton
from pathreplay.inverse.parameters.mesh import Surface
from pathreplay.inverse.parameters.reparameterization import Transform
from pathreplay.inverse.parameters.variables import Variable, latent_bounds, latents
from pathreplay.jobs import iterate, make_config, optimize
from small_job import bits, checkpoint_bits
from wall_job import JOB

OPTIONS = Optimizer(type="l-bfgs-b", tolerance=1e-9)
RATES = {"a": 0.5, "b": 0.1}
BOUNDS = {"a": (-1.0, 0.75), "b": (-np.inf, np.inf)}
START = {"a": np.float32([-0.5, 0.5]), "b": np.float32([[0.3], [-0.2], [1.0]])}
Values = dict[str, np.ndarray]


def valley(values: Values) -> tuple[float, Values]:
    """Rosenbrock's in `a`, whose optimum (1, 1) is beyond a bound, and a parabola about 3 in `b`; and its gradient."""
    x, y = values["a"].astype(float)
    off = values["b"].astype(float) - 3
    gradient = np.array([-2 * (1 - x) - 40 * x * (y - x * x), 20 * (y - x * x)])
    return float((1 - x) ** 2 + 10 * (y - x * x) ** 2 + (off**2).sum()), {"a": gradient, "b": 2 * off}


def search() -> LineSearch:
    return LineSearch(START, OPTIONS, BOUNDS)


def go(optimiser: LineSearch, values: Values, steps: int) -> list[Values]:
    """The points of so many steps, or as many as it takes."""
    found = []
    while len(found) < steps and not optimiser.finished:
        loss, gradients = valley(values)
        values = optimiser.step(values, {k: np.float64(g) for k, g in gradients.items()}, RATES, loss)
        found.append(values)
    return found


def test_it_is_scipys() -> None:
    """The same points as of a plain call, in the units of the rates; and the optimum at the bound."""
    scale = np.array([0.5, 0.5, 0.1, 0.1, 0.1])
    points: list[np.ndarray] = []
    first = valley(START)[0]

    def plain(x: np.ndarray) -> tuple[float, np.ndarray]:
        v = (x * scale).astype(np.float32)
        points.append(v)
        loss, gradient = valley({"a": v[:2], "b": v[2:, None]})
        return loss / first, np.concatenate([gradient["a"], gradient["b"].ravel()]) * scale / first

    ends = np.array([[-1, 0.75]] * 2 + [[-np.inf, np.inf]] * 3) / scale[:, None]
    start = np.concatenate([START["a"], START["b"].ravel()]).astype(float) / scale
    options = {"maxcor": 10, "ftol": 1e-9, "gtol": 0.0}
    scipy.optimize.minimize(plain, start, jac=True, method="L-BFGS-B", bounds=ends, options=options)
    found = go(search(), START, 1000)
    assert 10 < len(points) < 200 and len(found) == len(points)
    for one, other in zip(found, points[1:], strict=False):
        assert np.concatenate([one["a"], one["b"].ravel()]).tobytes() == other.tobytes()
    assert found[-1]["a"] == pytest.approx([0.75, 0.5625], abs=2e-3)
    assert found[-1]["b"] == pytest.approx(3, abs=1e-3)
    assert all(point["a"].max() <= 0.75 and point["a"].dtype == np.float32 for point in found)


def test_what_it_comes_to_is_the_best_point() -> None:
    optimiser = search()
    points = [START, *go(optimiser, START, 12)]
    losses = [valley(point)[0] for point in points[:-1]]
    assert bits(optimiser.answer({})) == bits(points[int(np.argmin(losses))])
    assert search().answer({}) == {}


@pytest.mark.slow
def test_it_goes_on_bit_for_bit_from_everywhere() -> None:
    points = [START, *go(search(), START, 1000)]
    for done in range(len(points)):
        optimiser = search()
        go(optimiser, START, done)
        state, other = optimiser.state(), search()
        assert set(state.steps.values()) == {done}
        other.restore(state, points[done])
        assert other.finished == optimiser.finished
        rest = go(other, points[done], 1000)
        assert [bits(p) for p in rest] == [bits(p) for p in points[done + 1 :]]
        assert bits(other.answer({})) == bits(points[-1])


def test_a_state_that_does_not_fit_is_refused() -> None:
    optimiser = search()
    go(optimiser, START, 5)
    state = optimiser.state()
    wrong = {
        "other loss": {"search:losses": state.arrays["search:losses"] * np.array([1, 1, 9, 1, 1.0])},
        "short": {"search:losses": state.arrays["search:losses"][:-1]},
        "single": {"search:gradients": state.arrays["search:gradients"].astype(np.float32)},
        "scale": {"search:scale": -state.arrays["search:scale"]},
        "more": {"first:a": np.zeros(3)},
    }
    for name, change in wrong.items():
        with pytest.raises(ValueError):
            search().restore(State(state.steps, {**state.arrays, **change}), START)
            pytest.fail(name)
    with pytest.raises((KeyError, ValueError)):
        search().restore(State(state.steps, {}), START)


def test_many_parameters_are_refused() -> None:
    values = {"a": np.zeros(MOST + 1, np.float32)}
    with pytest.raises(
        PathreplayError, match=f"{MOST + 1} entries, but optimizer type = 'l-bfgs-b' takes up to {MOST}"
    ):
        LineSearch(values, OPTIONS, {"a": (-1.0, 1.0)})


@pytest.mark.parametrize("kind", ["l-bfgs-b", "levenberg-marquardt"])
@pytest.mark.parametrize("transform", ["log", "softplus"])
def test_an_active_bound_of_a_transformed_value_is_solved_for(transform: str, kind: str) -> None:
    """Of two coupled values, where the best first one is beyond its bound: the second is best for the bound."""
    one = np.float32([0.3])
    first = Variable("a", mi.Float(0), (0.0, 1.0), 0.02, one, None, coordinates=Transform(transform, 0.0))  # type: ignore[arg-type]
    second = Variable("b", mi.Float(0), (-np.inf, np.inf), 0.02, 0 * one, None)
    values = {"a": one, "b": 0 * one}
    problem = types.SimpleNamespace(variables=(first, second))
    search = optimiser_of(problem, values, Optimizer(type=kind))  # type: ignore[arg-type]
    matrix, best = np.array([[1.64, 1.6], [1.6, 1.64]]), np.array([2.0, 0.5])

    def by_latent(gradient: np.ndarray) -> np.ndarray:
        assert first.coordinates is not None
        return first.coordinates.gradient(values["a"], np.float32(gradient))

    for _ in range(25):
        off = np.concatenate([values["a"], values["b"]]) - best
        slope = matrix @ off
        if isinstance(search, LevenbergMarquardt):
            noise = 1e-9 * np.eye(2)
            model = GaussNewton({"a": 1, "b": 1}, matrix, matrix, noise, noise, np.zeros(2), 0.0)
            search.observe(model.mapped({"a": by_latent}))
        gradients = {"a": by_latent(slope[:1]), "b": slope[1:]}
        latent = search.step(latents(problem.variables, values), gradients, {"a": 0.02, "b": 0.02}, off @ slope / 2)
        values = {"a": np.minimum(first.coordinates.values(latent["a"]), 1), "b": latent["b"]}  # type: ignore[union-attr]
        if search.finished:
            break
    assert [*values["a"], *values["b"]] == pytest.approx([1, 0.5 + 1.6 / 1.64], abs=1e-4)


@pytest.mark.parametrize("kind", ["l-bfgs-b", "levenberg-marquardt"])
def test_large_steps_of_coincident_vertices_are_refused(kind: str) -> None:
    """Each of two vertices at one place has the gradient of both."""
    positions = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    for points, faces in ((positions, [[0, 1, 2], [1, 2, 3]]), (positions[[0, 1, 2, 3, 1, 2]], [[0, 1, 2], [4, 5, 3]])):
        surface = Surface(points.ravel(), np.array(faces), 2.0)
        variable = Variable("mesh", mi.Float(0), (-np.inf, np.inf), 0.1, points.ravel(), None, coordinates=surface)
        problem = types.SimpleNamespace(variables=(variable,))
        with nullcontext() if len(points) == 4 else pytest.raises(PathreplayError, match="vertices at equal positions"):
            optimiser_of(problem, {"mesh": points.ravel()}, Optimizer(type=kind))  # type: ignore[arg-type]
        optimiser_of(problem, {"mesh": points.ravel()}, Optimizer(type="adam"))  # type: ignore[arg-type]


def test_bounds_of_latents_are_those_that_the_transform_does_not_enforce() -> None:
    def bounds(kind: TransformKind, lower: float, upper: float) -> list[float]:
        transform = Transform(kind, lower, upper)
        return list(latent_bounds(Variable("a", 0, (lower, upper), 1, np.ones(1), None, coordinates=transform)))  # type: ignore[arg-type]

    free = [-np.inf, np.inf]
    assert bounds("log", 0.0, np.inf) == bounds("log", -1.0, np.inf) == bounds("softplus", 0.5, np.inf) == free
    assert bounds("logit", 0.0, 1.0) == free
    assert bounds("log", 0.5, 2.0) == pytest.approx([np.log(0.5), np.log(2)])
    assert bounds("softplus", 0.5, 2.0) == [-np.inf, pytest.approx(np.log(np.expm1(1.5)))]
    assert bounds("softplus", -np.inf, 2.0) == [-np.inf, pytest.approx(np.log(np.expm1(2)))]


# ------------------------------ In a job ------------------------------

KEY = JOB["parameters"][0]["key"]
ENTRY = {**JOB["parameters"][0], "lower": 0.0, "upper": 1.0, "learning_rate": 0.1}
SEARCHED = {**JOB, "optimizer": {"type": "l-bfgs-b"}, "parameters": [ENTRY], "spp": 16, "iterations": 40}


def saved(folder: str) -> dict[str, bytes]:
    return checkpoint_bits(Path(folder))


@pytest.mark.parametrize("transform", [None, pytest.param("logit", marks=pytest.mark.slow)])
def test_a_job_ends_by_itself_and_at_its_best(transform: str | None, wall_room: Path) -> None:
    entry = ENTRY if transform is None else {**ENTRY, "parameterization": transform}
    result = optimize(make_config({**SEARCHED, "parameters": [entry], "output": "run"}), progress=False)
    assert result.iterations < 40 and not result.stopped and "Terminated" in result.report.read_text()
    losses = [entry.loss for entry in result.history]
    assert min(losses) < 1e-2 * losses[0]
    assert result.errors[KEY] < 0.1 * result.history[0].errors[KEY]
    best = int(np.argmin(losses))
    if best:  # errors are after a step, to the point that the next iteration looks at
        assert result.errors[KEY] == pytest.approx(result.history[best - 1].errors[KEY], rel=1e-4)
    with pytest.raises(PathreplayError, match=r"has terminated .*; lower 'tolerance' in its config"):
        optimize(resume="run", progress=False)


@pytest.mark.slow
def test_all_evaluations_see_the_same_random_numbers(wall_room: Path) -> None:
    """So that the loss is a function: at the start values once more, it is the same."""
    states = list(iterate(make_config({**SEARCHED, "output": "run"})))
    from pathreplay.inverse.loop.loop import new_run
    from pathreplay.inverse.objective.evaluate import Shard
    from pathreplay.inverse.problem.problem import build_problem
    from pathreplay.platform.threads import one_thread

    config = make_config(SEARCHED)
    problem = build_problem(config, wall_room)
    with one_thread(True):
        evaluate = new_run(problem, problem.integrator, record=False).executor.evaluate  # type: ignore[attr-defined]
        best = min(states, key=lambda state: state.loss)
        again = evaluate(states[-1].values, Shard((0,), 16, config.seeds(0, 0, 0)[:1]), {})
    assert again.loss == best.loss


@pytest.mark.slow
def test_a_job_that_was_left_goes_on_bit_for_bit(wall_room: Path) -> None:
    whole = optimize(make_config({**SEARCHED, "output": "whole"}), progress=False)
    for stop in range(whole.iterations - 1):
        for state in iterate(make_config({**SEARCHED, "output": f"cut{stop}"})):
            if state.number == stop:
                break
        cut = optimize(resume=f"cut{stop}", progress=False)
        assert saved(f"cut{stop}") == saved("whole") and cut.iterations == whole.iterations
        assert cut.parameters[KEY].tobytes() == whole.parameters[KEY].tobytes()


@pytest.mark.parametrize("transform", [None, pytest.param("logit", marks=pytest.mark.slow)])
def test_a_job_that_ended_goes_on_with_a_lower_tolerance(transform: str | None, wall_room: Path) -> None:
    """It then is the job that had the lower tolerance from the beginning, bit for bit."""
    entry = ENTRY if transform is None else {**ENTRY, "parameterization": transform}
    job = {**SEARCHED, "parameters": [entry], "optimizer": {"type": "l-bfgs-b", "tolerance": 1e-6}}
    whole = optimize(make_config({**job, "output": "whole"}), progress=False)
    coarse = {**job, "optimizer": {"type": "l-bfgs-b", "tolerance": 0.2}, "output": "run"}
    first = optimize(make_config(coarse), progress=False)
    assert first.iterations < whole.iterations - 1 and not first.stopped
    config = Path("run/config.json")
    config.write_text(config.read_text().replace('"tolerance": 0.2', '"tolerance": 1e-6'))
    again = optimize(resume="run", progress=False)
    assert saved("run") == saved("whole") and again.iterations == whole.iterations
    assert again.parameters[KEY].tobytes() == whole.parameters[KEY].tobytes()


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "stages": ({"stages": [{"iterations": 40}]}, "remove 'stages'"),
    "batches": ({"view_batch_size": 1}, "remove 'view_batch_size'"),
    "pixels": ({"pixel_batch_size": 9}, "remove 'pixel_batch_size'"),
    "baseline": ({"baseline": {"type": "prb"}}, "remove 'baseline'"),
    "schedule": ({"final_learning_rate_ratio": 0.5}, "remove 'final_learning_rate_ratio'"),
    "auto": ({"spp": "auto"}, "remove 'spp = 'auto''"),
    "grids": (
        {"parameters": [{"key": "a", "resolutions": [2, 4], "refine_at": [3]}]},
        "remove 'refine_at'",
    ),
    "option": ({"optimizer": {"type": "l-bfgs-b", "beta_1": 0.9}}, "which has history_size, tolerance"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_makes_no_sense_is_refused_in_one_line(case: str) -> None:
    change, words = REFUSED[case]
    with pytest.raises(PathreplayError) as told:
        make_config({**SEARCHED, **change})
    assert words in str(told.value) and "\n" not in str(told.value)


def test_the_rate_of_sgd_is_held_to_no_step(wall_room: Path) -> None:
    """Its step is the rate times the gradient, which may be as small as the rate is large."""
    job = {**JOB, "iterations": 1, "parameters": [{**JOB["parameters"][0], "learning_rate": 1e7}]}
    with pytest.raises(PathreplayError, match="lower 'learning_rate'"):
        optimize(make_config(job), progress=False)
    tiny = {**job, "optimizer": {"type": "sgd"}, "parameters": [{**job["parameters"][0], "lower": 0.0, "upper": 1.0}]}
    assert optimize(make_config(tiny), progress=False).iterations == 1
