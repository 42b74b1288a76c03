"""What a run says of its values: still moving, as exact as noise allows, or not told apart by the pictures."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pathreplay.inverse.config.schedules import rate
from pathreplay.inverse.loop.loop import new_run
from pathreplay.inverse.loop.movement import MOST_PARTS, SHORTEST, parts_of, still_moves
from pathreplay.inverse.loop.trade_offs import columns_of, trade_offs
from pathreplay.inverse.loop.verdict import Verdict, verdict_of
from pathreplay.inverse.problem.problem import build_problem
from pathreplay.jobs import make_config, optimize

# ------------------------------ Whether values still move ------------------------------


def descended(seed: int, n: int, learning_rate: float, noise: float, decay: float = 1.0, slope: float = 1.0) -> Any:
    """The history of 200 steps of Adam, from 1 down a parabola with its end at 0; and where it ends."""
    random, x, m, v, history = np.random.default_rng(seed), np.ones(n), 0.0, 0.0, []
    for i in range(200):
        g = slope * x + noise * random.normal(size=n)
        m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g * g
        step = m / (1 - 0.9 ** (i + 1)) / (np.sqrt(v / (1 - 0.999 ** (i + 1))) + 1e-8)
        x = x - learning_rate * rate("exponential", i, 200, decay) * step
        history.append(SimpleNamespace(slopes={"x": parts_of(g)}, means={"x": parts_of(x, mean=True)}))
    return history, float(np.abs(x).mean())


CASES = {
    "one number arrives": ({"n": 1, "learning_rate": 0.02, "noise": 0.3}, False),
    "many numbers arrive": ({"n": 100, "learning_rate": 0.02, "noise": 0.3}, False),
    "without noise": ({"n": 3, "learning_rate": 0.02, "noise": 1e-3}, False),
    "noise and nothing else": ({"n": 3, "learning_rate": 0.02, "noise": 1, "slope": 0}, False),
    "too slow": ({"n": 3, "learning_rate": 0.002, "noise": 0.3}, True),
    "one number, too slow": ({"n": 1, "learning_rate": 0.002, "noise": 0.3}, True),
    "rates fell too early": ({"n": 3, "learning_rate": 0.02, "noise": 0.3, "decay": 0.01}, True),
    "until they stand nearly still": ({"n": 100, "learning_rate": 0.02, "noise": 0.3, "decay": 1e-4}, True),
}


@pytest.mark.parametrize("case", CASES)
def test_gradients_say_whether_values_have_arrived(case: str) -> None:
    """By twenty runs, of which one may be mistaken; the truth is known: at the end of the way the value is 0."""
    options, moves = CASES[case]
    runs = [descended(seed, **options) for seed in range(20)]
    if options.get("slope") != 0:
        assert all((end > 0.2) == moves for _, end in runs)
    assert sum(still_moves(history, "x") != moves for history, _ in runs) <= 1


def test_few_iterations_say_nothing() -> None:
    history, _ = descended(1, 3, 0.002, 0.3)
    assert still_moves(history[: SHORTEST - 1], "x") is None
    assert still_moves(history[:SHORTEST], "x") is True
    assert still_moves(history, "x", begin=len(history) - SHORTEST + 1) is None
    assert still_moves(history, "another") is None


@pytest.mark.parametrize("steps", [24, 60])
def test_values_that_swing_around_their_end_still_move(steps: int) -> None:
    """Adam overshoots. The mean gradient of the last iterations is then far below their deviation."""
    for seed in range(20):
        history, _ = descended(seed, 3, 0.1, 0.01)
        assert still_moves(history[:steps], "x") is True and still_moves(history, "x") is False


def test_values_at_a_bound_do_not_move() -> None:
    history = [SimpleNamespace(slopes={"x": [1 + n % 2]}, means={"x": [0.0]}) for n in range(30)]
    assert still_moves(history, "x") is False


def test_large_values_that_move_in_small_steps_still_move() -> None:
    """Their means differ in the seventh digit only."""
    values = 2e5 - np.float32(2) ** -6 * np.arange(30)
    history = [
        SimpleNamespace(
            slopes={"x": parts_of(np.float32([1 + 0.1 * (n % 2)]))}, means={"x": parts_of(np.float32([x]), True)}
        )
        for n, x in enumerate(values)
    ]
    assert still_moves(history, "x") is True


def test_parts_are_sums_and_means_of_neighbours() -> None:
    assert parts_of(np.arange(16.0).reshape(2, 8)) == [1, 5, 9, 13, 17, 21, 25, 29]
    assert parts_of(np.arange(16.0), mean=True) == [0.5, 2.5, 4.5, 6.5, 8.5, 10.5, 12.5, 14.5]
    assert parts_of(np.float32([1 / 3])) == [0.333333] and parts_of(np.zeros(0)) == []
    assert len(parts_of(np.ones(101))) == MOST_PARTS and sum(parts_of(np.ones(101))) == 101


# ------------------------------ Trade-offs ------------------------------


def test_parameters_of_which_one_undoes_the_other_are_named() -> None:
    random = np.random.default_rng(1)
    a, b, c = (random.normal(size=(50, n)) for n in (3, 1, 2))
    free = {"a": a, "b": b, "c": c}
    assert trade_offs(free) == ()
    assert trade_offs({**free, "d": 5 * a[:, 1:2] - a[:, :1]}) == (("a", "d"),)
    assert trade_offs({**free, "d": -1e-6 * b + 1e-8 * random.normal(size=b.shape)}) == (("b", "d"),)
    assert trade_offs({**free, "d": b + 0.3 * random.normal(size=b.shape)}) == ()


def test_values_stay_in_the_range_of_their_parameterization(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A parameter with logarithmic steps has no bounds, and is differentiated at positive values only."""
    monkeypatch.chdir(tmp_path)
    Path("scene.xml").write_text(SCENE)
    job = {
        "scene": "scene.xml", "target": {"scene": "scene.xml", "spp": 1}, "spp": 1, "learning_rate": 0.1,
        "parameters": [{"key": PAINT, "initial": 0.5, "parameterization": "log"}],
    }  # fmt: skip
    problem = build_problem(make_config(job), tmp_path)
    seen: list[np.ndarray] = []

    def rendered(problem: object, values: dict[str, np.ndarray], spp: int) -> np.ndarray:
        seen.append(values[PAINT])
        return values[PAINT]

    monkeypatch.setattr("pathreplay.inverse.loop.trade_offs._rendered", rendered)
    columns, unseen = columns_of(problem, {PAINT: np.full(3, 1e-4, np.float32)})
    assert not unseen and columns[PAINT].shape == (3, 3)
    assert len(seen) == 6 and min(value.min() for value in seen) > 0


# ------------------------------ In a run ------------------------------

SCENE = """<scene version="3.0.0">
  <sensor type="perspective" id="cam"><transform name="to_world"><translate z="-4"/></transform>
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/>
    <rfilter type="box"/><string name="pixel_format" value="rgb"/></film></sensor>
  <shape type="rectangle" id="wall"><transform name="to_world"><scale value="3"/><rotate y="1" angle="180"/></transform>
    <bsdf type="diffuse" id="paint"><rgb name="reflectance" value="0.6 0.4 0.5"/></bsdf></shape>
  <shape type="sphere" id="behind"><point name="center" x="0" y="0" z="-9"/>
    <bsdf type="diffuse" id="unseen"><rgb name="reflectance" value="0.5"/></bsdf></shape>
  <emitter type="point" id="lamp"><point name="position" x="0" y="0" z="-3"/>
    <rgb name="intensity" value="20"/></emitter>
</scene>"""
PAINT, LAMP, UNSEEN = "wall.bsdf.reflectance.value", "lamp.intensity.value", "behind.bsdf.reflectance.value"
#: Keys, learning rate, and what is said.
RUNS: dict[str, tuple[list[str], float, Verdict]] = {
    "converges": ([PAINT], 0.1, Verdict(arrived=(PAINT,))),
    "still moves": ([PAINT], 0.001, Verdict(moving=(PAINT,))),
    "light x albedo": ([LAMP, PAINT], 0.1, Verdict(arrived=(LAMP, PAINT), trade_offs=((LAMP, PAINT),))),
    "unseen": ([PAINT, UNSEEN], 0.1, Verdict(arrived=(PAINT, UNSEEN), unseen=(UNSEEN,))),
}


@pytest.mark.parametrize("case", RUNS)
def test_a_run_says_what_came_of_its_values(case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("scene.xml").write_text(SCENE)
    keys, learning_rate, verdict = RUNS[case]
    moves = bool(verdict.moving)
    job = {
        "scene": "scene.xml", "target": {"scene": "scene.xml", "spp": 64}, "iterations": 60 if moves else 180, "spp": 4,
        "eval_spp": 4, "integrator": {"type": "pathreplay", "max_depth": 2}, "loss": "relative-l2",
        "parameters": [
            {"key": key, "lower": 0, "initial": 0.2 if key == PAINT else 16 if key == LAMP else 0.5,
             "learning_rate": learning_rate * (20 if key == LAMP else 1)}
            for key in keys
        ],
    }  # fmt: skip
    result = optimize(make_config(job), progress=False)
    assert result.verdict == verdict
    last = result.describe().splitlines()[-1]
    assert last == str(verdict) and all(key in last for pair in verdict.trade_offs for key in pair)
    assert str(verdict)[1:].replace("'", "&#39;") in result.report.read_text()


def test_a_parameter_that_the_last_stage_freezes_is_named_as_untested(tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text(SCENE)
    job = {
        "scene": "scene.xml", "target": {"scene": "scene.xml", "spp": 1}, "iterations": 2 * SHORTEST,
        "integrator": {"type": "pathreplay", "max_depth": 2}, "parameters": [{"key": PAINT}, {"key": LAMP}],
    }  # fmt: skip
    problem = build_problem(make_config(job), tmp_path)
    run = new_run(problem, problem.integrator)
    run.history += [SimpleNamespace(slopes={PAINT: [(-1.0) ** n]}, means={PAINT: [float(n)]}) for n in range(40)]
    verdict = verdict_of(problem, run, stopped=True)
    assert (verdict.arrived, verdict.untested) == ((PAINT,), (LAMP,))


@pytest.mark.parametrize("floor", [False, True])
def test_what_moves_together_is_told_apart_by_what_stands_still(
    floor: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A camera and the only thing that it sees, to the last sample; and the same above a floor."""
    still = '<shape type="rectangle"><transform name="to_world"><translate z="1"/></transform></shape>' * floor
    body = '<shape type="cube" id="cube"><transform name="to_world"><scale value="0.4"/></transform></shape>'
    made = SCENE[: SCENE.index("<shape")] + still + body + '<emitter type="constant"/></scene>'
    (tmp_path / "scene.xml").write_text(made)
    keys = "cam.to_world", "cube.vertex_positions"
    start = {"translation": [0.1, 0.1, 0.1]}
    job = {
        "scene": "scene.xml", "target": {"scene": "scene.xml", "spp": 1},
        "integrator": {"type": "pathreplay", "max_depth": 2, "boundary": "none"},
        "parameters": [{"key": key, "pose": "translation", "initial": start} for key in keys],
    }  # fmt: skip
    problem = build_problem(make_config(job), tmp_path)
    values = new_run(problem, problem.integrator).values
    columns, unseen = columns_of(problem, values)
    pair = tuple(f"{key}:translation" for key in keys)
    assert unseen == () and trade_offs(columns) == (() if floor else (pair,))
    monkeypatch.setattr("pathreplay.inverse.loop.trade_offs.FREE_SAMPLES", 100)  # of 64 pixels, by 12 pictures
    assert columns_of(problem, values) == ({}, ()) and columns_of(problem, values, taken=160 * 64 * 12)[0]


def test_a_verdict_is_one_line_that_names_what_to_do() -> None:
    whole = Verdict(("a",), ("b", "c", "d"), (("b", "c"),), ("e",))
    said = str(whole)
    assert "'b' against 'c'" in said and "affect: 'e'" in said and "moving: 'a'" in said and "noise: 'd'" in said
    assert "\n" not in said and "noise: all" in str(Verdict(arrived=("a", "b")))
    for moving, arrived in ((("a",), ()), ((), ("a",))):
        assert ["learning" in str(Verdict(moving, arrived, searches=searches)) for searches in (False, True)] == [
            True,
            False,
        ]
    assert str(Verdict(arrived=("a",), untested=("b",))).endswith("improve them; too few iterations to test: 'b'")
    assert "noise: 'a': " in str(Verdict(arrived=("a",), untested=("b",)))
    assert str(Verdict(("a",), untested=("b", "c"), unseen=("c",))).endswith(
        "oscillate; too few iterations to test: 'b'"
    )
    assert str(Verdict(untested=("a",))) == str(Verdict())
    assert str(Verdict()) == (
        "values: fewer than 20 iterations in the last stage or at the last resolution, too few to test convergence"
    )
