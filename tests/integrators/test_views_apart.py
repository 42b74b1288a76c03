"""A camera that moves beside views of other cameras: it adds nothing to them, and a job that moves nothing is told."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from pathreplay.errors import PathreplayError
from pathreplay.integrators import parts
from pathreplay.inverse.objective.evaluate import Evaluator, Shard
from pathreplay.inverse.problem.problem import build_problem
from pathreplay.jobs import iterate, make_config, optimize
from pathreplay.scenes.parameters import get_array
from room_job import JOB, SCENE, TEXTURE, room  # noqa: F401 (room: its folder, for every test)

RIGID = {"key": "left.to_world", "pose": "rigid", "initial": {"translation": [0.1, 0, 0]}}
WIDE = {"key": "left.x_fov", "initial": 50.0, "learning_rate": 0.5}
LEFT = {
    **JOB,
    "integrator": {"type": "pathreplay", "max_depth": 3},
    "parameters": [RIGID],
    "learning_rate": 0.01,
    "iterations": 4,
    "target": {**JOB["target"], "spp": 16},  # type: ignore[dict-item]
    "output": "run",
}
STAGES = [{"iterations": 2, "parameters": [TEXTURE]}, {"iterations": 3, "parameters": ["left.*"]}]
STAGED = {
    **{key: value for key, value in LEFT.items() if key != "iterations"},
    "parameters": [{"key": TEXTURE, "initial": 0.5}, RIGID],
    "stages": STAGES,
}


@pytest.mark.parametrize("loss", ["l2", "l1"])
@pytest.mark.parametrize("record", [True, False])
def test_a_camera_adds_nothing_to_the_views_of_others(loss: str, record: bool) -> None:
    """Swept pixel by pixel and not, traced and, from the second call on, recorded."""
    problem = build_problem(make_config({**LEFT, "parameters": [WIDE], "loss": loss}), Path.cwd())
    evaluate = Evaluator(problem, problem.integrator, record)
    values = {v.key: get_array(v.like) + 3 for v in problem.variables}
    for seed in range(3):
        alone = evaluate(values, Shard((0,), 4, (seed,)), {})
        other = evaluate(values, Shard((1,), 4, (seed,)), {})
        both = evaluate(values, Shard((0, 1), 4, (seed, seed)), {})
        assert other.gradients["left.x_fov"].tolist() == [0] and other.loss > 0 and alone.gradients["left.x_fov"] != 0
        assert both.gradients["left.x_fov"] == pytest.approx(alone.gradients["left.x_fov"], rel=1e-4)
        assert both.loss == pytest.approx(alone.loss + other.loss, rel=1e-5)
    assert evaluate.freezes == record


def test_the_loss_of_a_view_that_nothing_reaches_is_that_of_its_picture() -> None:
    problem = build_problem(make_config({**LEFT, "parameters": [WIDE]}), Path.cwd())
    values = {v.key: get_array(v.like) for v in problem.variables}
    found = Evaluator(problem, problem.integrator)(values, Shard((1,), 256, (0,)), {})
    image = np.array(mi.render(problem.scene, sensor=1, integrator=problem.integrator, spp=256, seed=7))
    assert found.loss == pytest.approx(np.mean((image - problem.views[1].target) ** 2) / 2, rel=0.1)


@pytest.mark.parametrize(
    "changes",
    [
        pytest.param({}, marks=pytest.mark.slow),
        pytest.param({"view_batch_size": 1}, marks=pytest.mark.slow),
        {"parameters": [WIDE], "view_batch_size": 1},
    ],
)
def test_a_job_of_two_views_moves_one_of_its_cameras(changes: dict[str, Any]) -> None:
    assert len(optimize(make_config({**LEFT, **changes}), progress=False).history) == 4


def test_a_later_stage_moves_one_of_the_cameras_and_is_gone_on_with() -> None:
    session = iterate(make_config({**STAGED, "view_batch_size": 1, "deterministic": True}))
    whole = [state.values["left.to_world:translation"] for state in session]
    assert (whole[0] == whole[1]).all() and (whole[-1] != whole[1]).any()
    session = iterate(make_config({**STAGED, "view_batch_size": 1, "deterministic": True, "output": "again"}))
    for state in session:
        if state.number == 2:
            session.close()
    after = [state.values["left.to_world:translation"] for state in iterate(resume="again")]
    assert np.array_equal(after[-1], whole[-1])


def test_only_exposures_move() -> None:
    """Where no parameter of the scene does, in a stage."""
    job = {**STAGED, "parameters": [{"key": TEXTURE, "initial": 0.5}], "exposure": {"learning_rate": 0.1}}
    stages = [STAGES[0], {"iterations": 3, "parameters": ["exposure"]}]
    states = list(iterate(make_config({**job, "stages": stages})))
    assert (states[-1].values["exposure"] != states[1].values["exposure"]).any()


@pytest.mark.parametrize(
    "changes",
    [
        {"sensors": ["right"]},
        {"test_views": ["left"]},
        {**STAGED, "stages": [STAGES[0], {**STAGES[1], "sensors": ["right"]}]},
        {**STAGED, "stages": [STAGES[0], {**STAGES[1], "sensors": ["right"]}], "view_batch_size": 1},
    ],
)
def test_cameras_that_no_view_has_are_told_before_the_first_iteration(changes: dict[str, Any], room: Path) -> None:  # noqa: F811
    job = {**LEFT, **changes}
    if "stages" in changes:
        del job["iterations"]
    with pytest.raises(PathreplayError, match=r"'left.to_world'.*'right'"):
        optimize(make_config(job), progress=False)
    assert not (room / "run").exists()


def test_the_only_stage_of_a_job_is_named_too() -> None:
    job = {key: value for key, value in LEFT.items() if key != "iterations"}
    with pytest.raises(PathreplayError, match=r"^stages: stage 1: 'left.to_world' affects none"):
        optimize(make_config({**job, "stages": [{"iterations": 2, "sensors": ["right"]}]}), progress=False)


@pytest.mark.parametrize("first", [TEXTURE, None])
def test_motion_that_is_not_differentiated_is_told_before_the_first_iteration(first: str | None, room: Path) -> None:  # noqa: F811
    moved = {"key": "wall.to_world", "pose": "translation"}
    job = {**STAGED, "integrator": {"type": "pathreplay", "max_depth": 3, "attach": "none"}}
    job |= {"parameters": [moved, *([{"key": TEXTURE, "initial": 0.5}] if first else [])]}
    job |= {"stages": [{"iterations": 1, "parameters": [key]} for key in (first, "wall.to_world") if key]}
    with pytest.raises(PathreplayError, match=r"sensor 'left'.*'wall.to_world'.*attach"):
        optimize(make_config(job), progress=False)
    assert not (room / "run").exists()


def test_a_script_is_told_of_view_and_parameter_where_nothing_moves() -> None:
    """What has gradients in the scene, but not for the paths, is named."""
    scene = mi.load_string(SCENE)
    params = mi.traverse(scene)
    integrator = mi.load_dict({"type": "pathreplay", "attach": "none"})
    moved = mi.Transform4f(params["wall.to_world"])
    x = mi.Float(0)
    dr.enable_grad(x)
    params["wall.to_world"] = mi.Transform4f().translate(mi.Vector3f(x, 0, 0)) @ moved
    params.update()
    image = mi.render(scene, params, sensor=1, integrator=integrator, spp=4)
    with pytest.raises(PathreplayError, match=r"'right'.*'wall.to_world'.*attach"):
        dr.backward(dr.sum(image, axis=None))
    params["wall.to_world"] = moved
    params.update()


@contextmanager
def widening() -> Iterator[tuple[mi.Scene, Any, mi.Float]]:
    """A scene, its parameters, and the field of view of its left camera, which has a gradient in this block."""
    scene = mi.load_string(SCENE)
    params = mi.traverse(scene)
    x = mi.Float(params["left.x_fov"])
    dr.enable_grad(x)
    params["left.x_fov"] = x
    params.update()
    yield scene, params, x
    params["left.x_fov"] = dr.detach(x)
    params.update()


def test_a_script_gets_zero_in_the_view_of_another_camera() -> None:
    with widening() as (scene, params, x):
        for edges in ("none", "all"):
            integrator = mi.load_dict({"type": "pathreplay", "boundary": edges})
            dr.backward(dr.sum(mi.render(scene, params, sensor=1, integrator=integrator, spp=4), axis=None))
            assert dr.grad(x) == 0


def test_a_view_in_parts_keeps_what_another_view_gave(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pass of many samples adds up its parts apart, and gives back what was there, also where it adds nothing."""
    for name, value in (("MOST_AT_ONCE", 20), ("A_PART", 16), ("LEAST_A_PIXEL", 1)):
        monkeypatch.setattr(parts, name, value)
    integrator = mi.load_dict({"type": "pathreplay", "boundary": "none"})
    found = []
    with widening() as (scene, params, x):
        for sensor in (0, 1):
            dr.backward(dr.sum(mi.render(scene, params, sensor=sensor, integrator=integrator, spp=4), axis=None))
            found.append(dr.grad(x)[0])
    assert found[0] != 0 and found[1] == found[0]
