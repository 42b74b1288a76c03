"""Levenberg-Marquardt on images whose noise is known: optimum, bounds, noise, and going on bit for bit."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.optimizer_options import Optimizer
from pathreplay.inverse.optim.adaptive import State
from pathreplay.inverse.optim.levenberg_marquardt import MOST, LevenbergMarquardt
from pathreplay.inverse.parameters.gauss_newton import GaussNewton, Half, Matrix, curvature, model_of
from pathreplay.inverse.parameters.pyramid import Pyramid
from pathreplay.inverse.parameters.reparameterization import Transform
from pathreplay.inverse.parameters.variables import Variable, range_of
from small_job import bits

OPTIONS = Optimizer(type="levenberg-marquardt")
Values = dict[str, np.ndarray]
TRUTH = np.array([0.9, 2.5, 0.4])
START = {"a": np.float32([0.3]), "b": np.float32([[1.0], [1.5]])}
SIZES = {"a": 1, "b": 2}
FREE = {"a": (-np.inf, np.inf), "b": (-np.inf, np.inf)}
SIDE = 16
Y, X = np.mgrid[:SIDE, :SIDE] / SIDE
WEIGHT = np.full((SIDE, SIDE, 1), 2 / SIDE**2)


def flat(values: Values) -> Matrix:
    return np.concatenate([values["a"].ravel(), values["b"].ravel()]).astype(float)


def image(θ: Matrix) -> Matrix:
    return (θ[0] * np.exp(-θ[1] * X) + np.exp(θ[2]) * Y)[:, :, None]


def jacobian(θ: Matrix) -> Matrix:
    decay = np.exp(-θ[1] * X)
    return np.array([decay, -θ[0] * X * decay, np.exp(θ[2]) * Y])[:, :, :, None]


def half(θ: Matrix, rng: np.random.Generator, noise: float, target: Matrix) -> Half:
    """Image and derivatives with noise that is three times as large in a few pixels, and correlated between both."""
    common = rng.normal(0, noise, (SIDE, SIDE, 1)) * np.where(rng.random((SIDE, SIDE, 1)) < 0.05, 3, 1)
    return Half(image(θ) + common - target, jacobian(θ) * (1 + 0.5 * common) + rng.normal(0, noise, (3, SIDE, SIDE, 1)))


def evaluated(θ: Matrix, draw: int, seed: int, noise: float, off: float = 0.0) -> tuple[float, Matrix, GaussNewton]:
    """Loss, gradient and model; ``off`` keeps the target out of reach."""
    rng = np.random.default_rng([seed, draw])
    target = image(TRUTH) + off * np.sin(20 * X * Y)[:, :, None]
    return model_of(half(θ, rng, noise, target), half(θ, rng, noise, target), WEIGHT, SIZES)


def optimiser(bounds: dict[str, tuple[float, float]] = FREE, options: Optimizer = OPTIONS) -> LevenbergMarquardt:
    return LevenbergMarquardt(START, options, bounds)


def go(
    search: LevenbergMarquardt, values: Values, steps: int, seed: int = 0, noise: float = 0.0, off: float = 0.0
) -> list[Values]:
    """The points of so many steps, or as many as it takes."""
    found = []
    while len(found) < steps and not search.finished:
        loss, gradient, model = evaluated(flat(values), search.draw, seed, noise, off)
        gradients = {"a": gradient[:1], "b": gradient[1:, None]}
        search.observe(model)
        values = search.step(values, gradients, {}, loss)
        found.append(values)
    return found


def test_a_direction_in_which_the_loss_is_constant_neither_ends_the_search_nor_the_process() -> None:
    """As the common scale of exposures and albedo; its noise affects no image."""
    matrix = np.array([[1.0, 1, 0], [1, 1, 0], [0, 0, 4]])
    search, noise = optimiser(), 1e-4 * np.eye(3)
    model = GaussNewton(SIZES, matrix, matrix, 0 * noise, noise, np.zeros(3), 0.0)
    assert search._excess(model) == pytest.approx(0.5 * (1e-4 / 2 + 1e-4 / 4), rel=1e-3)
    search.observe(model)
    stepped = search.step(START, {"a": np.float32([1]), "b": np.float32([[1], [0.4]])}, {}, 1.0)
    step = flat(stepped) - flat(START)
    assert step[0] + step[1] == pytest.approx(-1, rel=0.05) and step[2] == pytest.approx(-0.1, rel=0.05)
    assert not search.draw


def test_the_optimum_without_noise_is_found_in_few_steps() -> None:
    found = go(optimiser(), START, 15)
    assert found[0]["b"].shape == (2, 1) and found[0]["b"].dtype == np.float32
    assert flat(found[-1]) == pytest.approx(TRUTH, abs=1e-5)
    assert flat(found[7]) == pytest.approx(TRUTH, abs=1e-3)


def test_bounds_hold_and_the_others_are_solved_for() -> None:
    """The optimum at the bound, by a dense search of the rest."""
    bounds = {"a": (-np.inf, np.inf), "b": (-np.inf, 2.0)}
    found = go(optimiser(bounds), START, 15)
    assert all(point["b"].max() <= 2 for point in found)
    assert found[-1]["b"][0, 0] == 2
    a, c = np.meshgrid(np.linspace(0.7, 0.9, 201), np.linspace(0.3, 0.6, 201), indexing="ij")
    points = np.stack([a, np.full_like(a, 2.0), c], axis=-1).reshape(-1, 3)
    losses = [float(((image(p) - image(TRUTH)) ** 2).sum()) for p in points]
    assert flat(found[-1]) == pytest.approx(points[int(np.argmin(losses))], abs=3e-3)


def test_an_entry_without_effect_stays() -> None:
    search = LevenbergMarquardt({**START, "idle": np.float32([7])}, OPTIONS, {**FREE, "idle": (-1.0, 9.0)})
    values: Values = {**START, "idle": np.float32([7])}
    for _ in range(12):
        loss, gradient, model = evaluated(flat(values), search.draw, 0, 0.05)
        search.observe(model.within({**SIZES, "idle": 1}))
        gradients = {"a": gradient[:1], "b": gradient[1:, None], "idle": np.zeros(1)}
        values = search.step(values, gradients, {}, loss)
    assert values["idle"] == [7]
    assert flat(values) == pytest.approx(TRUTH, abs=0.1)


def test_the_model_is_unbiased_and_knows_its_noise() -> None:
    """Mean and covariance over many seeds; the products of one half would be off by their own noise."""
    θ, noise = np.array([0.8, 2.0, 0.5]), 0.3
    exact = evaluated(θ, 0, 0, 0.0)
    found = [evaluated(θ, 0, seed, noise) for seed in range(600)]
    for name, wanted, values in (
        ("loss", exact[0], [loss - model.excess for loss, _, model in found]),
        ("gradient", exact[1], [gradient for _, gradient, _ in found]),
        ("matrix", exact[2].matrix, [model.matrix for *_, model in found]),
    ):
        z = (np.mean(values, axis=0) - wanted) / (np.std(values, axis=0, ddof=1) / np.sqrt(len(values)))
        print(f"{name}: z = {np.array2string(np.asarray(z), precision=1)}")
        assert np.abs(z).max() < 4
    covariance = np.cov(np.transpose([gradient for _, gradient, _ in found]))
    told = np.mean([model.noise for *_, model in found], axis=0)
    assert np.abs(told - covariance).max() < 0.15 * covariance.diagonal().max()
    robust = np.linalg.eigvalsh(np.mean([model.robust for *_, model in found], axis=0))
    assert robust.min() > 0


def rms(values: list[Values], truth: Matrix) -> Matrix:
    return np.sqrt(np.mean([(flat(each) - truth) ** 2 for each in values], axis=0))


def test_more_iterations_come_closer_and_noise_does_not_displace_the_result() -> None:
    """Of 20 seeds: the error falls like one over the root of the passes, and its mean is zero."""
    runs = [go(optimiser(), START, 170, seed, noise=0.1) for seed in range(20)]
    early, late = (rms([run[n] for run in runs], TRUTH) for n in (15, 165))
    print(f"errors after 16 iterations {early}, after 166 {late}: {early / late} times less (√(160/10) = 4)")
    assert (early / late > 2).all()
    ends = np.array([flat(run[-1]) for run in runs])
    z = (ends.mean(axis=0) - TRUTH) / (ends.std(axis=0, ddof=1) / np.sqrt(len(ends)))
    assert np.abs(z).max() < 4


def test_the_minimum_of_a_target_out_of_reach_is_not_displaced_either() -> None:
    """Where residuals do not vanish, JᵀWr is zero without each of its terms being so."""
    wanted = flat(go(optimiser(), START, 100, noise=0.0, off=0.3)[-1])
    ends = np.array([flat(go(optimiser(), START, 120, seed, noise=0.1, off=0.3)[-1]) for seed in range(15)])
    z = (ends.mean(axis=0) - wanted) / (ends.std(axis=0, ddof=1) / np.sqrt(len(ends)))
    print(f"z = {z}, off by {ends.mean(axis=0) - wanted}")
    assert np.abs(wanted - TRUTH).max() > 0.01 and np.abs(z).max() < 4


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_it_goes_on_bit_for_bit_from_everywhere(noise: float) -> None:
    options = Optimizer(type="levenberg-marquardt", tolerance=2e-6)
    points = [START, *go(optimiser(options=options), START, 60, noise=noise)]
    assert not noise or 10 < len(points) < 61  # ended by itself
    for done in range(len(points)):
        one, other = optimiser(options=options), optimiser(options=options)
        go(one, START, done, noise=noise)
        state = one.state()
        assert set(state.steps.values()) == {done}
        other.restore(state, points[done])
        assert other.finished == one.finished and other.draw == one.draw
        rest = go(other, points[done], 60 - done, noise=noise)
        assert [bits(p) for p in rest] == [bits(p) for p in points[done + 1 :]]
        if rest and not noise:
            assert bits(other.answer({})) == bits(points[-1]) or other.answer({}) == {}


def test_a_run_that_ended_by_its_tolerance_goes_on_with_a_lower_one() -> None:
    """It then takes the steps of a run that had the lower tolerance from the beginning."""
    coarse, fine = (Optimizer(type="levenberg-marquardt", tolerance=tolerance) for tolerance in (1e-3, 2e-6))
    whole = [START, *go(optimiser(options=fine), START, 60, noise=0.1)]
    one, same, other = (optimiser(options=options) for options in (coarse, coarse, fine))
    points = [START, *go(one, START, 60, noise=0.1)]
    done = len(points) - 1
    assert one.finished and done + 5 < len(whole) - 1
    same.restore(one.state(), points[-1])
    other.restore(one.state(), points[-1])
    assert same.finished == one.finished and not other.finished
    rest = go(other, points[-1], 60, noise=0.1)
    assert [bits(p) for p in points + rest] == [bits(p) for p in whole] and other.finished


def test_a_state_that_does_not_fit_is_refused() -> None:
    search = optimiser()
    go(search, START, 5)
    state = search.state()
    wrong = {
        "short": {"levenberg:at": state.arrays["levenberg:at"][:-1]},
        "single": {"levenberg:matrix": state.arrays["levenberg:matrix"].astype(np.float32)},
        "damping": {"levenberg:numbers": -np.abs(state.arrays["levenberg:numbers"])},
        "more": {"first:a": np.zeros(3)},
    }
    for name, change in wrong.items():
        with pytest.raises(ValueError):
            optimiser().restore(State(state.steps, {**state.arrays, **change}), START)
            pytest.fail(name)
    with pytest.raises((KeyError, ValueError)):
        optimiser().restore(State(state.steps, {}), START)


def test_many_parameters_are_refused() -> None:
    values = {"a": np.zeros(MOST + 1, np.float32)}
    with pytest.raises(
        PathreplayError, match=f"{MOST + 1} entries, but optimizer type = 'levenberg-marquardt' takes up to {MOST}"
    ):
        LevenbergMarquardt(values, OPTIONS, {"a": (-1.0, 1.0)})


def test_models_add_up_and_change_coordinates() -> None:
    """As losses do: a sum, a share, more variables, and values v = 3u."""
    θ = np.array([0.8, 2.0, 0.5])
    one, other = evaluated(θ, 0, 1, 0.2)[2], evaluated(θ, 0, 2, 0.2)[2]
    both = (one + other).times(0.5)
    assert both.matrix == pytest.approx(0.5 * (one.matrix + other.matrix))
    assert both.noise == pytest.approx(0.25 * (one.noise + other.noise))
    more = one.within({"b": 2, "idle": 2, "a": 1})
    assert more.matrix[np.ix_([4, 0, 1], [4, 0, 1])] == pytest.approx(one.matrix) and not more.matrix[2:4].any()
    scaled = one.mapped({"b": lambda gradient: 3 * gradient})
    change = np.diag([1, 3, 3])
    for name in ("matrix", "robust", "noise"):
        assert getattr(scaled, name) == pytest.approx(change @ getattr(one, name) @ change)
    assert scaled.spread == pytest.approx(one.spread * [1, 81, 81])
    curved = one.curved("b", np.array([[2.0, 1], [1, 2]]))
    assert curved.matrix[1:, 1:] - one.matrix[1:, 1:] == pytest.approx(np.array([[2.0, 1], [1, 2]]))
    assert replace(curved, matrix=one.matrix).robust[0] == pytest.approx(one.robust[0])


def test_the_curvature_of_a_regularizer_is_its_second_derivative() -> None:
    A = np.array([[2.0, 0.5], [0.5, 1]])

    def penalty(v: np.ndarray) -> tuple[float, np.ndarray]:
        x = v.ravel().astype(float)
        return 0.5 * float(x @ A @ x), (A @ x).astype(np.float32).reshape(v.shape)

    assert curvature(penalty, np.float32([[0.3], [-4]])) == pytest.approx(A, abs=1e-3)
    assert curvature(lambda v: (0.0, -v), np.float32([1, 2])) == pytest.approx(np.zeros((2, 2)))


def test_the_curvature_of_a_regularizer_is_that_within_the_range_of_its_variable() -> None:
    """Beyond it, a regularizer may be undefined; and where there is no other value, there is no curvature."""

    def entropy(v: np.ndarray) -> tuple[float, np.ndarray]:
        assert (v > 0).all() and (v <= 1).all()
        return float((v * np.log(v)).sum()), np.log(v) + 1

    value = np.float32([1e-3, 0.5, 1])
    found = curvature(entropy, value, (0.0, 1.0))
    assert found == pytest.approx(np.diag(1 / value), rel=0.2)
    assert curvature(entropy, np.float32([1]), (1.0, 1.0)) == [[0]]
    for kind, expected in ((None, (-1.0, 0.7)), ("log", (0.0, 0.7)), ("logit", (-1.0, 0.7))):
        transform = None if kind is None else Transform(kind, -1.0, 0.7)  # type: ignore[arg-type]
        for coordinates in (transform, Pyramid([(2, 2, 1)], False, transform)):
            variable = Variable("a", mi.Float(0), (-1.0, 0.7), 1, value, None, coordinates=coordinates)
            assert range_of(variable) == expected
