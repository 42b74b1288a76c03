"""Evaluations as a function of values and shard: they add up in any order of computing, and views cost no memory."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest

from pathreplay.inverse.dataset.targets import Targets
from pathreplay.inverse.loop.events import Refined, Started, Stepped, Stopped
from pathreplay.inverse.loop.loop import iterate, new_run, render_views, take_step
from pathreplay.inverse.objective.evaluate import Evaluation, Evaluator, Shard, total
from pathreplay.inverse.problem.problem import Problem, build_problem
from pathreplay.jobs import make_config
from pathreplay.platform.interrupts import Stop
from pathreplay.platform.threads import one_thread
from recorded_steps import times_recorded
from room_job import CLOUD, JOB, TEXTURE, room  # noqa: F401 (room: its folder, for every test)

SWEEP = {"integrator": {"type": "pathreplay", "max_depth": 3, "boundary": "none"}}
POSE = {
    "parameters": [{"key": "wall.to_world", "pose": "rigid", "initial": {"translation": [0.1, 0, 0]}}],
    "target": {"values": {}, "scene": "room.xml", "spp": 8},
}
KINDS: dict[str, dict[str, Any]] = {
    "sweep": SWEEP,
    "prb": {},
    "l1": {**SWEEP, "loss": "l1"},
    "pose": {**SWEEP, **POSE},
    "medium": {**CLOUD, "scene_parameters": {**CLOUD["scene_parameters"], "views": 2}},
}


def problem_of(**changes: Any) -> Problem:
    return build_problem(make_config({**JOB, **changes}), Path.cwd())


def bits(evaluation: Evaluation) -> dict[str, bytes]:
    arrays = {**evaluation.gradients, **{f"learned {name}": value for name, value in evaluation.learned.items()}}
    return {"loss": np.float64(evaluation.loss).tobytes()} | {key: value.tobytes() for key, value in arrays.items()}


@pytest.mark.parametrize("kind", KINDS)
def test_shards_add_up_whatever_was_computed_before(kind: str) -> None:
    """Two views at once, one by one, and in the other order: the same bits, since the sum has an order of its own."""
    problem = problem_of(**KINDS[kind])
    values = new_run(problem, problem.integrator).values
    other = {key: value * np.float32(0.9) for key, value in values.items()}
    left, right, both = Shard((0,), 4, (1,)), Shard((1,), 4, (2,)), Shard((0, 1), 4, (1, 2))
    with one_thread(True):
        evaluate = Evaluator(problem, problem.integrator, record=False)
        known = evaluate(other, Shard((0,), 4, (7,)), {}).learned
        assert bool(known) == (kind == "medium")
        first = total([evaluate(values, left, known), evaluate(values, right, known)])
        late, early = evaluate(values, right, known), evaluate(values, left, known)
        assert bits(total([early, late])) == bits(first)
        at_once = evaluate(values, both, known)
    assert all(np.abs(gradient).max() > 0 for gradient in first.gradients.values())
    assert early.loss != late.loss
    assert bits(at_once) == bits(first)


@pytest.mark.parametrize("kind", ["sweep", "medium"])
def test_what_was_never_learned_is_forgotten(kind: str) -> None:
    """An evaluator that has learned evaluates as a new one does, where it is told to know nothing."""
    problem = problem_of(**KINDS[kind])
    values, shard = new_run(problem, problem.integrator).values, Shard((0, 1), 4, (1, 2))
    with one_thread(True):
        evaluate = Evaluator(problem, problem.integrator, record=False)
        first, again = evaluate(values, shard, {}), evaluate(values, shard, {})
    assert bits(again) == bits(first)


def test_large_variables_with_equal_gradients_add_up(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: F811
    """The gradients of two summands are one array of Dr.Jit, which is not overwritten for both."""
    monkeypatch.setattr("pathreplay.inverse.objective.evaluate.LARGE", 8)
    (room / "own.py").write_text("def total(first, a, b): return first + a + b")
    parameters = [{"key": key, "shape": [2, 2, 3], "initial": 0.1} for key in ("a", "b")]
    problem = problem_of(
        **SWEEP, parameters=parameters, derived=[{"key": TEXTURE, "function": "own:total", "of": ["a", "b"]}]
    )
    values = new_run(problem, problem.integrator).values
    shards = [Shard((view,), 4, (view,)) for view in (0, 1)]
    evaluate = Evaluator(problem, problem.integrator, record=False)
    apart = [{key: value.copy() for key, value in evaluate(values, s, {}).gradients.items()} for s in shards]
    found = total((evaluate(values, s, {}) for s in shards), 0.5, owned=True).gradients
    for key, gradient in found.items():
        np.testing.assert_allclose(gradient, 0.5 * (apart[0][key] + apart[1][key]), rtol=1e-3)


@pytest.mark.parametrize("kind", ["prb", "l1"])
def test_the_graph_holds_one_view(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Variables under differentiation where a loss goes back: as many for four views as for one."""
    problem = problem_of(**KINDS[kind])
    values = new_run(problem, problem.integrator).values
    backward, held = dr.backward, []

    def counting(*arguments: Any, **options: Any) -> None:
        held.append(len(dr.whos_ad(as_string=True).splitlines()))
        backward(*arguments, **options)

    monkeypatch.setattr(dr, "backward", counting)
    evaluate = Evaluator(problem, problem.integrator, record=False)
    evaluate(values, Shard((0, 1), 4, (1, 2)), {})
    held.clear()
    evaluate(values, Shard((0, 1, 0, 1), 4, (1, 2, 3, 4)), {})
    print(f"{kind}: AD variables where each view goes back: {held}")
    assert len(held) == 4 and max(held) == held[0]


COLOURS = [*(f"{wall}.reflectance.value" for wall in ("red", "green", "white")), "light.emitter.radiance.value"]
BOX = {
    "scene": "cornell-box-photo",
    "scene_parameters": {"resolution": 8, "texture": 8},
    "parameters": [{"key": key} for key in COLOURS],
    "target": {"values": {COLOURS[0]: 0.5}, "spp": 4},
}


RECORDED = pytest.mark.parametrize(
    "changes",
    [SWEEP, {}, pytest.param({**SWEEP, "loss": "l1"}, marks=pytest.mark.slow), KINDS["medium"]],
    ids=["sweep", "prb", "l1", "medium"],
)


def weighted(problem: Problem) -> Problem:
    """The problem with weights for the pixels of its first view, which makes its views two kinds."""
    first, *others = problem.views
    weight = np.ones((*first.target.shape[:2], 1), np.float32)
    return replace(problem, views=(replace(first, weight=weight), *others))


@RECORDED
def test_each_kind_of_view_is_recorded_once(changes: dict[str, Any]) -> None:
    """Whatever memory NumPy has put the values in, which differs from step to step. Both views are of one kind."""
    config = make_config({**JOB, **BOX, **changes})
    problem = build_problem(config, Path.cwd())
    run = new_run(problem, problem.integrator)
    for i in range(6):
        take_step(problem, run, i)
    assert times_recorded(run.executor.evaluate) == [1]  # type: ignore[attr-defined]


@RECORDED
def test_a_view_that_comes_later_leaves_recordings_as_they_are(changes: dict[str, Any]) -> None:
    """Its first evaluation changes its sensor, which all recordings hold. Actors take views from each other."""
    problem = build_problem(make_config({**JOB, **BOX, **changes}), Path.cwd())
    problem = build_problem(make_config({**JOB, **BOX, **changes}), Path.cwd(), Targets.of(problem.views))
    problem = weighted(problem)
    values, learned = new_run(problem, problem.integrator).values, {}
    evaluate = Evaluator(problem, problem.integrator)
    for seed, view in enumerate((0, 0, 0, 1, 0, 1, 0, 1)):
        learned = evaluate(values, Shard((view,), 4, (seed,)), learned).learned
    assert times_recorded(evaluate) == [1, 1]


@RECORDED
def test_pictures_leave_recordings_as_they_are(changes: dict[str, Any]) -> None:
    """Those of previews."""
    config = make_config({**JOB, **BOX, **changes})
    problem = weighted(build_problem(config, Path.cwd()))
    run = new_run(problem, problem.integrator)
    for i in range(6):
        take_step(problem, run, i)
        if i % 2:
            render_views(problem, run.values)
    assert times_recorded(run.executor.evaluate) == [1, 1]  # type: ignore[attr-defined]


def test_views_are_not_recorded_where_there_are_too_many(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each recording would hold all of them. Two recordings of two sensors are needed here."""
    problem = weighted(problem_of(**SWEEP))
    values = new_run(problem, problem.integrator).values
    for most, records in ((4, True), (3, False)):
        monkeypatch.setattr("pathreplay.inverse.objective.evaluate.MOST_INPUTS", most)
        evaluate = Evaluator(problem, problem.integrator)
        for seed in range(2):
            evaluate(values, Shard((0, 1), 4, (seed, seed)), {})
        assert bool(evaluate._recordings) == records


def test_a_loss_of_the_users_own_may_hold_arrays_of_numpy(room: Path) -> None:  # noqa: F811
    """Its passes are not recorded: to copy such an array into a recording would end the process."""
    loss = "(i - t) ** 2 * mi.TensorXf(np.float32([[[0.2, 0.7, 0.1]]]))"
    (room / "own.py").write_text(f"import numpy as np, mitsuba as mi\ndef f(i, t): return {loss}")
    config = make_config({**JOB, **SWEEP, **BOX, "loss": "own:f"})
    problem = build_problem(config, Path.cwd())
    run = new_run(problem, problem.integrator)
    for i in range(3):
        take_step(problem, run, i)
    assert run.history[2].loss > 0


def test_observers_hear_of_everything_in_order() -> None:
    grid = [{"key": TEXTURE, "initial": 0.5, "resolutions": [2, 4], "refine_at": [2]}]
    config = make_config({**JOB, "iterations": 3, "parameters": grid})
    problem = build_problem(config, Path.cwd())
    run = new_run(problem, problem.integrator)
    heard = list(iterate(problem, run, Stop()))
    first, second, third = (Stepped(entry) for entry in run.history)
    assert heard == [Started(0, 3), first, second, Refined(TEXTURE, (4, 4, 3)), third, Stopped(3)]
