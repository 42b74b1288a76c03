"""The benchmark of inverse problems: loops reach marks, the search picks the better rate, gradients agree, tables."""

from __future__ import annotations

import gc
import math
import sys
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import pathreplay
from places import ROOT

sys.path.insert(0, str(ROOT))  # the benchmarks run from the checkout and are not installed

from benchmarks import plots
from benchmarks.inverse.loops import ENTRIES, Differences, Own, Plain, entries_of
from benchmarks.inverse.problem import Made, Problem, Task, Unknown
from benchmarks.inverse.problems import PROBLEMS
from benchmarks.inverse.search import LOST, MARKS, MIDDLE, best, followed, reached, searched
from benchmarks.measures.job import Curve, Machine, Point, Record
from benchmarks.scenes.parts import sensor
from benchmarks.tasks import quality

COLOUR = "floor.bsdf.reflectance.value"


def tiny() -> Problem:
    """The colour of a floor beside a ball, under an even sky; one view and one held-out view of 6 x 6 pixels."""
    paint = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.5, 0.7]}}
    views = {"left": sensor(6, [-2, -3, 2], [0, 0, 0], 40), "right": sensor(6, [2, -3, 2], [0, 0, 0], 40)}
    for view in views.values():
        view["film"]["pixel_format"] = "rgb"
    ball = {"type": "sphere", "center": [0.3, 0, 0.5], "radius": 0.5}
    scene = {"type": "scene", "sky": {"type": "constant"}, "floor": {"type": "rectangle", "bsdf": paint}, "ball": ball}
    unknowns = {COLOUR: Unknown(0.45, 0.0, 1.0)}
    limits = {"max_depth": 4, "rr_depth": 16}
    return Problem({**scene, **views}, unknowns, ("left",), ("right",), limits, target_paths=2**15, judge_paths=2**12)


@pytest.fixture(scope="module")
def task() -> Task:
    return Task(tiny())


LOOPS = [lambda *args: Plain(*args, "prb"), lambda *args: Differences(*args, "path"), Own]


@pytest.mark.parametrize(
    "begin",
    [pytest.param(LOOPS[0], marks=pytest.mark.slow), *LOOPS[1:]],
    ids=["plain", "differences", "pathreplay"],
)
def test_a_loop_reaches_the_marks_and_one_that_stands_still_does_not(begin: Any, task: Task) -> None:
    gc.collect()  # `prb` traces the emitters of dropped scenes, too, and some of them lack eval_direction
    moving = followed(begin(task, 0.02, 64, 0), task.error, MIDDLE, budget=60)
    still = followed(begin(task, 1e-9, 64, 0), task.error, MIDDLE, budget=0.3)
    assert [reached(still, mark)[0] for mark in MARKS] == [math.inf] * 3
    assert moving.errors[-1] <= MIDDLE * moving.errors[0]
    early, late = (reached(moving, mark) for mark in MARKS[:2])
    assert 0 < early[0] < late[0] <= moving.seconds[-1] and 0 < early[1] < late[1] <= moving.steps[-1]
    assert still.errors[0] == pytest.approx(moving.errors[0], rel=1e-5), "another run starts at the initial values"


def test_a_reset_loop_repeats_its_first_iterations(task: Task) -> None:
    for loop in (Plain(task, 0.03, 4, 0, "prb"), Own(task, 0.03, 4, 0)):
        found = []
        for _ in range(2):
            loop.step()
            found.append(loop.values()[COLOUR])
            loop.reset()
            np.testing.assert_allclose(loop.values()[COLOUR], 0.45)
        np.testing.assert_allclose(*found, rtol=1e-4)


def test_plain_loops_and_ours_have_the_same_gradient(task: Task) -> None:
    """In expectation: the difference of means over seeds is at most four standard errors."""
    seeds, plain, differences = range(24), Plain(task, 0.01, 256, 0, "prb"), Differences(task, 0.01, 256, 0, "path")
    differentiate = pathreplay.value_and_grad(Own(task, 0.01, 256, 0).problem)

    def gradient(loop: Plain, seed: int) -> np.ndarray:
        loop.reset()
        loop._differentiate(0, seed)
        return np.array(dr.grad(loop.optimizer[COLOUR]))[:, 0]

    found = [np.stack([gradient(loop, seed) for seed in seeds]) for loop in (plain, differences)]
    found.append(np.stack([differentiate(seed=seed)[1][COLOUR] for seed in seeds]))
    means, errors = zip(*((g.mean(0), g.std(0, ddof=1) / len(seeds) ** 0.5) for g in found), strict=True)
    assert np.abs(means[0]).max() > 50 * errors[0].max(), "the noise would hide a wrong factor"
    for k in (1, 2):
        assert (np.abs(means[k] - means[0]) < 4 * np.hypot(errors[0], errors[k])).all(), (means, errors)


def test_the_error_is_zero_at_the_truth_alone(task: Task) -> None:
    truth = np.array([0.2, 0.5, 0.7], np.float32)
    assert task.error({COLOUR: truth}) == pytest.approx(0, abs=1e-6)
    assert task.error({COLOUR: truth + 0.01}) > 1e-3


def test_derived_parameters_are_computed_from_the_loaded_scene() -> None:
    """Not from the values that another loop has left in it."""
    made = {COLOUR: Made(lambda first, shade: mi.Color3f(first + shade.array), ("shade",))}
    shaded = Task(replace(tiny(), unknowns={"shade": Unknown(0.2, -0.2, 0.2, (1,))}, derived=made))
    for loop in (Plain(shaded, 0.01, 16, 0, "prb"), Differences(shaded, 0.01, 16, 0, "path"), Own(shaded, 0.01, 16, 0)):
        loop.step()
        assert shaded.error(loop.values()) > 0.01
    image = Own(shaded, 0.01, 16, 0).problem.render({"shade": [0.0]}, spp=4096)
    assert image.mean() == pytest.approx(shaded.targets[0].mean(), rel=0.01)


# ------------------------------ Search and curves, without rendering ------------------------------


class Descent:
    """A value that a step multiplies by 1 - rate, as the clock advances by one second."""

    def __init__(self, rate: float) -> None:
        self.rate, self.now = rate, 0.0
        self.reset()

    def reset(self) -> None:
        self.value = 1.0

    def step(self) -> None:
        self.value *= 1 - self.rate
        self.now += 1

    def values(self) -> dict[str, np.ndarray]:
        return {"x": np.array(self.value)}


def descended(rate: float, budget: float = 1000, goal: float = 1e-3) -> Curve:
    loop = Descent(rate)
    return followed(loop, lambda values: float(abs(values["x"])), goal, budget, clock=lambda: loop.now)


def test_the_search_picks_the_rate_that_reaches_the_middle_mark_first() -> None:
    curves = list(searched((0.01, 0.1), (4, 8), lambda rate, spp, budget: descended(rate * spp / 8, budget), 1000))
    assert [(curve.rate, curve.spp) for curve in curves] == [(0.01, 4), (0.1, 4), (0.01, 8), (0.1, 8)]
    assert {(best(curves, mark).rate, best(curves, mark).spp) for mark in MARKS} == {(0.1, 8)}
    assert curves[2].seconds[-1] < reached(curves[1], MIDDLE)[0] + 1.01, "it is stopped once it cannot be the best"
    late = [replace(descended(rate, budget=3), rate=rate, searched=True) for rate in (0.2, 0.3, 0.1)]
    assert {reached(curve, MARKS[1])[0] for curve in late} == {math.inf}
    assert best(late, MARKS[1]).rate == 0.3, "where none reaches it, the last error decides"


def test_each_mark_has_its_own_choice() -> None:
    """A fast rate reaches the first mark, and then stays at its noise; a slow one reaches the second mark."""
    times = tuple(float(n) for n in range(6))
    known = {"spp": 4, "seed": 0, "steps": tuple(range(6)), "seconds": times, "searched": True}
    fast = Curve(rate=0.1, errors=(1, 0.3, 0.2, 0.2, 0.2, 0.2), **known)
    slow = Curve(rate=0.01, errors=(1, 0.8, 0.5, 0.3, 0.2, 0.09), **known)
    assert [best([fast, slow], mark).rate for mark in MARKS] == [0.1, 0.01, 0.01]
    runs = [replace(curve, searched=False, seed=1) for curve in (fast, slow)]
    both = point("pathreplay", 0.1, curves=(fast, slow, *runs))
    assert [[curve.rate for curve in quality.runs(both, mark)] for mark in MARKS] == [[0.1], [0.01], [0.01]]
    cells = quality.table(record(both)).splitlines()[-1].split("|")[3:8]
    assert [cell.strip() for cell in cells] == ["0.1, 4", "0.91", "0.01, 4", "4.87", "not reached"]


def test_marks_are_interpolated_and_budgets_are_kept() -> None:
    curve = descended(0.1)
    for mark in MARKS:
        exact = math.log(mark) / math.log(0.9)
        assert reached(curve, mark) == (pytest.approx(exact, rel=1e-6), pytest.approx(exact, rel=1e-6))
    assert descended(0.1, budget=3).steps[-1] == 3
    lost = descended(float("nan"))
    assert lost.errors[-1] == LOST and reached(lost, MARKS[0])[0] == math.inf


def test_each_problem_has_a_plain_loop_and_ours() -> None:
    assert len(PROBLEMS) == 8
    for name in PROBLEMS:
        found = entries_of(name)
        assert "pathreplay" in found and "pathreplay" not in found[0] and set(found) <= set(ENTRIES)
        assert ("pathreplay, pyramid" in found) == PROBLEMS[name].has_grid


# ------------------------------ Table and figure ------------------------------


def point(method: str, rate: float, **more: Any) -> Point:
    curve = replace(descended(rate), rate=0.01, spp=4)
    curves = replace(curve, searched=True), replace(curve, seed=1)
    known = {"scene": "cloud", "parameters": (), "max_depth": 0, "paths": 1, "measure": "quality", "peak_mib": None}
    known |= {"seeds": (0,), "seconds": (1.0,), "squared_errors": (), "not_finite": (), "curves": curves}
    return Point(method=method, **known | more)


def record(*points: Point) -> Record:
    machine = Machine("a processor", 2, 1, "Linux", "3.11", "3.9.1", "1.5.0", "0.1.0", "23.1.4", "llvm_ad_rgb")
    return Record("quality", "pathreplay bench quality", "2026-01-01", "0123", (0.1, 0.2), (machine,), points)


def test_the_table_compares_with_the_best_plain_loop() -> None:
    slow, fast = (point(f"{name}, plain loop", rate) for name, rate in (("prb", 0.05), ("prbvolpath", 0.1)))
    failed = replace(point("prb_projective, plain loop", 0.1), error="not attached", curves=())
    lines = quality.table(record(slow, fast, point("pathreplay", 0.19), failed)).splitlines()[2:]
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]
    assert [row[8] for row in cells] == ["2.05 at 1/30", "1.00 at 1/30", "0.50 at 1/30", ""]
    assert cells[2][2:8] == ["0.01, 4", "5.21", "0.01, 4", "10.93", "16.14", "11"]
    assert cells[3][2] == "raises: not attached"
    short = replace(fast, curves=tuple(replace(descended(0.1, budget=12), searched=s) for s in (True, False)))
    last = quality.table(record(short, point("pathreplay", 0.19))).splitlines()[-1].split("|")[9]
    assert last.strip() == "0.50 at 1/3; < 0.91 at 1/10", "the plain loop stopped after 12 s"
    still = point("pathreplay", 0.0)
    still = replace(still, curves=tuple(replace(descended(0.0, budget=5), searched=s) for s in (True, False)))
    assert "not reached" in quality.table(record(fast, still)).splitlines()[-1]


def test_curves_are_drawn() -> None:
    failed = replace(point("prb_projective, plain loop", 0.1), error="not attached", curves=())
    figure = plots.DRAW["quality-curves"](record(failed, point("prb, plain loop", 0.1), point("pathreplay", 0.2)))
    lines = {line.get_label(): line for line in figure.axes[0].get_lines()}
    assert {"prb, plain loop", "pathreplay"} <= set(lines)
    assert lines["pathreplay"].get_ydata()[0] == pytest.approx(0.8)
