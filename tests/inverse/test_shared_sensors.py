"""Views whose cameras differ only in arrays share one recorded pass, and get what passes of their own compute."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from pathreplay.inverse.objective.evaluate import Evaluation, Evaluator, Shard
from pathreplay.inverse.problem.problem import Problem, build_problem
from pathreplay.jobs import make_config
from pathreplay.scenes.parameters import get_array
from recorded_steps import times_recorded
from room_job import JOB, SCENE, TEXTURE, room  # noqa: F401 (room: its folder, for every test)

#: Cameras as captures have them: of one size, each with its place, its lens and its principal point.
CAPTURE = """<sensor type="perspective" id="{name}"><float name="fov" value="{fov}"/>{more}
    <float name="principal_point_offset_x" value="{offset}"/><float name="principal_point_offset_y" value="-{offset}"/>
    <transform name="to_world"><lookat origin="{x},1,3.5" target="0,-0.4,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="12"/><integer name="height" value="{height}"/>
      <string name="pixel_format" value="rgb"/>{filter}</film></sensor>"""
BOX, SOFT = '<rfilter type="box"/>', '<rfilter type="gaussian"><float name="stddev" value="{}"/></rfilter>'


def camera(name: str, x: float, fov: float = 50, offset: float = 0.0, **parts: Any) -> str:
    return CAPTURE.format(name=name, x=x, fov=fov, offset=offset, **{"more": "", "filter": BOX, "height": 10} | parts)


ALIKE = [camera("a", -1.5), camera("b", 0.2, 60, 0.1), camera("c", 1.4, 45, 0.02)]
UNLIKE = {
    "near": camera("near", 0.5, more='<float name="near_clip" value="3.3"/>'),
    "high": camera("high", 0.5, height=11),
    "soft": camera("soft", 0.5, filter=SOFT.format(0.401)),
    "softer": camera("softer", 0.5, filter=SOFT.format(0.402)),
    "other": camera("other", 0.5, more='<sampler type="stratified"/>'),
    "moving": camera("moving", 0.5),
}
MOVES = {"key": "moving.to_world", "pose": "rigid", "initial": {"translation": [0.1, 0, 0]}}


def problem_of(cameras: list[str], **changes: Any) -> Problem:
    before, after = SCENE.index("<sensor"), SCENE.index("<bsdf")
    Path("room.xml").write_text(SCENE[:before] + "\n".join(cameras) + SCENE[after:])
    job = {**JOB, "integrator": {"type": "pathreplay", "max_depth": 3}, **changes}
    return build_problem(make_config({**job, "target": {**JOB["target"], "spp": 4}}), Path.cwd())  # type: ignore[dict-item]


def evaluations(evaluate: Evaluator, rounds: int, **shard: Any) -> list[Evaluation]:
    """Every view alone, in turn."""
    problem = evaluate.problem
    values = {v.key: np.full_like(get_array(v.like), 0.4) for v in problem.variables}
    shards = [Shard((view,), 4, (10 * n + view,), **shard) for n in range(rounds) for view in range(len(problem.views))]
    return [evaluate(values, shard, {}) for shard in shards]


def recorded_and_traced(problem: Problem) -> tuple[Evaluator, Evaluator]:
    return Evaluator(problem, problem.integrator), Evaluator(problem, problem.integrator, record=False)


def assert_same(found: list[Evaluation], wanted: list[Evaluation]) -> None:
    for a, b in zip(found, wanted, strict=True):
        assert a.gradients.keys() == b.gradients.keys() and a.gradients
        assert a.loss == pytest.approx(b.loss, rel=1e-5)
        for key, gradient in a.gradients.items():
            np.testing.assert_allclose(gradient, b.gradients[key], rtol=1e-3, atol=1e-5 * np.abs(gradient).max())


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"loss": "l1"},
        {"loss": "log", "debias": True},
        {"exposure": {}},
        {"integrator": {"type": "prb", "max_depth": 3}},
        {"parameters": [{"key": "wall.to_world", "pose": "rigid", "initial": {"translation": [0.1, 0, 0]}}]},
    ],
    ids=["sweep", "l1", "debias", "exposure", "prb", "edges"],
)
def test_shared_passes_give_the_losses_and_gradients_of_each_view(changes: dict[str, Any]) -> None:
    problem = problem_of(ALIKE, **changes)
    recorded, traced = recorded_and_traced(problem)
    found, wanted = evaluations(recorded, 2), evaluations(traced, 2)
    assert times_recorded(recorded) == [1] and not times_recorded(traced)
    assert len({evaluation.loss for evaluation in wanted}) == 6
    assert_same(found, wanted)


def test_cameras_inside_a_medium_share_passes() -> None:
    """The medium is optimised, too."""
    fog = """<medium type="homogeneous" id="fog"><float name="albedo" value="0.5"/><float name="sigma_t" value="0.1"/>
      </medium>"""
    cameras = [each.replace("</sensor>", '<ref id="fog"/></sensor>') for each in ALIKE]
    problem = problem_of([fog, *cameras], parameters=[*JOB["parameters"], {"key": "*.sigma_t.value.value"}])  # type: ignore[misc]
    recorded, traced = recorded_and_traced(problem)
    found, wanted = evaluations(recorded, 2), evaluations(traced, 2)
    assert times_recorded(recorded) == [1]
    assert_same(found, wanted)


def test_views_have_pixels_and_shares_of_their_own() -> None:
    """The fraction of pixels that a mask leaves differs from view to view, and so does the weight of a view."""
    problem, views = problem_of(ALIKE), []
    for n, view in enumerate(problem.views):
        weight = np.zeros((10, 12, 1), np.float32)
        weight[: 4 + 2 * n] = 10 / (4 + 2 * n)
        views.append(replace(view, weight=weight, share=0.5 * (1 + n)))
    problem = replace(problem, views=tuple(views))
    recorded, traced = recorded_and_traced(problem)
    for pixels in (None, 60):  # the first mask leaves 48
        assert_same(evaluations(recorded, 3, pixels=pixels), evaluations(traced, 3, pixels=pixels))
    assert times_recorded(recorded) == [1, 1, 1]  # with all pixels, with 48 and with 60


def test_cameras_whose_constants_differ_share_nothing() -> None:
    still = {"type": "pathreplay", "max_depth": 3, "boundary": "none"}  # kernels of edges take seconds to compile
    parameters = [*JOB["parameters"], MOVES]  # type: ignore[misc]
    problem = problem_of([*ALIKE, *UNLIKE.values()], parameters=parameters, integrator=still)
    recorded, traced = recorded_and_traced(problem)
    assert_same(evaluations(recorded, 3), evaluations(traced, 3))
    assert times_recorded(recorded) == [1] * (1 + len(UNLIKE))


def test_two_kinds_do_not_disturb_each_other() -> None:
    """Square and portrait, in turn."""
    square = [camera(name, x, height=12) for name, x in (("d", -1.0), ("e", 0.6), ("f", 1.0))]
    turned = [camera(name, x, height=16) for name, x in (("g", -1.0), ("h", 0.6), ("i", 1.0))]
    problem = problem_of([each for pair in zip(square, turned, strict=True) for each in pair])
    recorded, traced = recorded_and_traced(problem)
    assert_same(evaluations(recorded, 3), evaluations(traced, 3))
    assert times_recorded(recorded) == [1, 1]


def test_an_evaluator_that_comes_later_leaves_recordings_as_they_are() -> None:
    """That of a baseline, say: it begins when the other has made its first step."""
    problem = problem_of(ALIKE)
    first, second = (Evaluator(problem, problem.integrator) for _ in range(2))
    for _ in range(2):
        evaluations(first, 1)
        evaluations(second, 1)
    assert times_recorded(first) == times_recorded(second) == [1]


def test_a_view_is_seen_from_where_its_camera_is_put_later() -> None:
    """By hand, between two steps."""
    problem = problem_of(ALIKE)
    evaluate = Evaluator(problem, problem.integrator)
    evaluations(evaluate, 2)
    params = mi.traverse(problem.scene.sensors()[1])
    params["to_world"] = mi.Transform4f().look_at([-1.5, 1, 3.5], [0, -0.4, 0], [0, 1, 0])
    params["x_fov"], params["principal_point_offset_x"], params["principal_point_offset_y"] = 50.0, 0.0, 0.0
    params.update()
    traced = Evaluator(problem, problem.integrator, False)
    assert_same(evaluations(evaluate, 1), evaluations(traced, 1))
    assert times_recorded(evaluate) == [1]


def test_derivatives_by_forward_mode_share_passes() -> None:
    problem = problem_of(ALIKE, parameters=[{"key": "floor.reflectance.*", "initial": 0.5}])
    recorded, traced = recorded_and_traced(problem)
    found, wanted = (evaluations(each, 2, second_order=True) for each in (recorded, traced))
    assert_same(found, wanted)
    assert recorded._jacobians is not None
    made = recorded._jacobians._recordings._frozen.values()
    assert [each.n_recordings for each in made] == [1, 1]  # the image, and its derivative
    assert TEXTURE not in found[0].gradients
