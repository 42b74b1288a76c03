"""Stages: each computes what a job of its own would, holds what it should, and is gone on with bit for bit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
import safetensors.numpy

import pathreplay
from pathreplay.errors import PathreplayError
from pathreplay.inverse.dataset.views import View
from pathreplay.inverse.loop import loop
from pathreplay.inverse.loop.events import Stepped
from pathreplay.inverse.objective.evaluate import Evaluator, Shard
from pathreplay.inverse.objective.stages import Staged, part_at, scaled
from pathreplay.inverse.problem.problem import build_problem
from pathreplay.jobs import iterate, make_config, optimize
from pathreplay.library.iterations import run_of
from pathreplay.platform.interrupts import Stop
from pathreplay.platform.threads import one_thread
from pathreplay.scenes.parameters import get_array
from recorded_steps import times_recorded
from room_job import CLOUD, JOB, SCENE, TEXTURE, room  # noqa: F401 (room: its folder, for every test)
from small_job import checkpoint_bits

FILM = {"type": "hdrfilm", "width": 8, "height": 8, "pixel_format": "rgb", "rfilter": {"type": "box"}}
FLOOR = "floor.reflectance.value"
STAGES = [
    {"iterations": 2, "downscale": 2, "spp": 8, "max_depth": 2, "parameters": ["floor.*"]},
    {"iterations": 2, "sensors": ["left"], "parameters": [TEXTURE], "learning_rate_factor": 0.5},
    {"iterations": 3},
]
TWO = {**JOB, "deterministic": True, "output": "run", "target": {**JOB["target"], "spp": 16}}
STAGED = {**{key: value for key, value in TWO.items() if key != "iterations"}, "stages": STAGES}


def staged(**changes: Any) -> Any:
    return make_config({**STAGED, **changes})


def saved(folder: str) -> dict[str, bytes]:
    return checkpoint_bits(Path(folder))


@pytest.mark.parametrize("integrator", [pytest.param("prb", marks=pytest.mark.slow), "pathreplay"])
def test_a_stage_computes_what_a_job_of_its_own_does(integrator: str) -> None:
    """Smaller films, shorter paths, one parameter: against a scene with such a film, and targets of means."""
    config = staged(integrator={"type": integrator, "max_depth": 3})
    problem = build_problem(config, Path.cwd())
    small = SCENE.replace('value="12"', 'value="6"').replace('value="10"', 'value="5"')
    Path("small.xml").write_text(small)
    other = {**TWO, "scene": "small.xml", "integrator": {"type": integrator, "max_depth": 2}}
    single = build_problem(make_config(other), Path.cwd())
    values = {v.key: get_array(v.like) for v in problem.variables}
    with one_thread(True):
        evaluate = Staged(problem, problem.integrator, config.integrator, record=False)
        found = evaluate(values, Shard((0, 1), 8, (3, 4), 0), {})
        views = tuple(scaled(view, 2) for view in problem.views)
        assert views[0].target.shape == (5, 6, 3)
        alone = Evaluator(_with(single, views), single.integrator, record=False)
        expected = alone(values, Shard((0, 1), 8, (3, 4)), {})
        whole = Evaluator(problem, problem.integrator, record=False)(values, Shard((0, 1), 8, (3, 4)), {})
        last = evaluate(values, Shard((0, 1), 8, (3, 4), 2), {})
    assert set(found.gradients) == {FLOOR} and set(last.gradients) == {FLOOR, TEXTURE}
    assert found.loss == pytest.approx(expected.loss, rel=1e-5)
    assert found.gradients[FLOOR] == pytest.approx(expected.gradients[FLOOR], rel=1e-4)
    assert np.abs(found.gradients[FLOOR] / whole.gradients[FLOOR] - 1).max() > 0.01
    for key, gradient in whole.gradients.items():  # the film is whole again
        assert last.gradients[key] == pytest.approx(gradient, rel=1e-5, abs=1e-8)


def _with(problem: Any, views: tuple[View, ...]) -> Any:
    return replace(problem, views=views)


def test_what_is_masked_does_not_reach_smaller_pictures() -> None:
    target = np.ones((4, 4, 3), np.float32)
    weight = np.ones((4, 4, 1), np.float32)
    target[0, 0], weight[0, 0] = 100, 0
    target[2:, 2:], weight[2:, 2:] = 100, 0
    small = scaled(View("a", 0, target, weight), 2)
    assert small.weight is not None
    assert small.target[..., 0].tolist() == [[1, 1], [1, 100]] and small.weight[..., 0].tolist() == [[0.75, 1], [1, 0]]
    assert small.target.dtype == np.float32


def test_a_job_goes_through_its_stages() -> None:
    values, batches = [], []
    session = iterate(staged(final_learning_rate_ratio=0.1))
    for state in session:
        values.append({key: value.copy() for key, value in state.values.items()})
        batches.append(set(state.gradient_norms))
        assert state.render().shape == (10, 12, 3)
    assert batches == [{FLOOR}] * 2 + [{TEXTURE}] * 2 + [{FLOOR, TEXTURE}] * 3
    for k in (0, 1):
        assert (values[k][TEXTURE] == 0.5).all() and (values[k][FLOOR] != 0.5).all()
    for k in (2, 3):
        assert values[k][FLOOR].tobytes() == values[1][FLOOR].tobytes()
        assert (values[k][TEXTURE] != values[k - 1][TEXTURE]).any()
    # Adam's first step is the learning rate: that of iteration 2 of 7, with the stage's factor.
    first = np.abs(values[2][TEXTURE] - 0.5)
    assert first[first > 1e-4] == pytest.approx(0.5 * 0.1 * 0.1 ** (2 / 7), rel=1e-3)
    assert session.result is not None and session.result.iterations == 7
    assert [entry.spp for entry in session.result.history] == [8, 8, 4, 4, 4, 4, 4]


@pytest.mark.parametrize("stops", [True, False])
def test_films_are_whole_again_after_a_run_that_ends_in_a_smaller_stage(stops: bool) -> None:
    config = staged(stages=[{"iterations": 2, "downscale": 2}])
    problem = build_problem(config, Path.cwd())
    run = run_of(problem, None)
    for event in loop.iterate(problem, run, Stop()):
        if stops and isinstance(event, Stepped):
            break
    del event
    assert [tuple(sensor.film().size()) for sensor in problem.scene.sensors()] == [(12, 10)] * 2


def test_films_are_whole_again_after_a_step_in_a_smaller_stage() -> None:
    scene = mi.load_dict(mi.cornell_box() | {"sensor": mi.cornell_box()["sensor"] | {"film": FILM}})
    view = pathreplay.View(target=np.ones((8, 8, 3), np.float32))
    problem = pathreplay.Problem(scene, {"red.reflectance.value": pathreplay.Parameter(initial=0.5)}, view)
    state = pathreplay.init(problem, steps=6, stages=[{"iterations": 6, "downscale": 2}], spp=1)
    for _ in range(6):
        state = pathreplay.step(problem, state)
        assert tuple(scene.sensors()[0].film().size()) == (8, 8)
    executor = next(iter(state._task._known.values()))[1]
    assert times_recorded(executor.evaluate._evaluate) == [1]  # type: ignore[attr-defined]


def test_stages_choose_views_and_batches() -> None:
    config = staged(stages=[{"iterations": 1, "sensors": [1]}, {"iterations": 1, "view_batch_size": 1}])
    problem = build_problem(config, Path.cwd())
    one, two = (part_at(problem, i) for i in (0, 1))
    assert [view.name for view in one.problem.trained().values()] == ["right"]
    assert two.problem.config.view_batch_size == 1 and len(two.problem.trained()) == 2
    assert part_at(problem, 99).number == 1


def test_the_loss_of_a_stage_is_a_mean_over_its_weighted_views() -> None:
    config = staged(view_weights={"left": 9.0}, stages=[{"iterations": 1, "sensors": ["left"]}, {"iterations": 1}])
    problem = build_problem(config, Path.cwd())
    shares = [[view.share for view in part_at(problem, i).problem.trained().values()] for i in (0, 1)]
    assert shares[0] == pytest.approx([1]) and shares[1] == pytest.approx([1.8, 0.2])


GRID = {"parameters": [{"key": TEXTURE, "initial": 0.5, "resolutions": [2, 3, 4]}, {"key": FLOOR, "initial": 0.5}]}
GRIDS = [{"iterations": 2, "downscale": 2}, {"iterations": 2, "parameters": [FLOOR]}, {"iterations": 3}]
CASES = {"surface": STAGED, "grid": {**STAGED, **GRID, "stages": GRIDS}}
CASES["medium"] = {
    **{key: value for key, value in CLOUD.items()},
    "spp": 4, "eval_spp": 4, "deterministic": True, "output": "run",
    "stages": [{"iterations": 2, "downscale": 3, "max_depth": 2}, {"iterations": 3}],
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_stopped_within_and_between_stages_is_undisturbed_to_the_bit(case: str) -> None:
    job = make_config({**CASES[case], "output": "whole"})
    whole = optimize(job, progress=False)
    for stop in range(1, job.iterations):
        for state in iterate(make_config({**CASES[case], "output": f"cut{stop}"})):
            if state.number == stop - 1:
                break
        cut = optimize(resume=f"cut{stop}", progress=False)
        assert cut.iterations == job.iterations
        assert saved(f"cut{stop}") == saved("whole")
        assert {k: v.tobytes() for k, v in cut.parameters.items()} == {
            k: v.tobytes() for k, v in whole.parameters.items()
        }


def test_a_frozen_parameter_has_the_averaged_value_that_the_result_has() -> None:
    """Also where the run is stopped between the stages."""
    stages = [{"iterations": 12, "parameters": [FLOOR]}, {"iterations": 2, "parameters": [TEXTURE]}]
    job = {**STAGED, "learning_rate": 0.3, "spp": 1, "stages": stages}
    result = optimize(make_config({**job, "output": "whole"}), progress=False).parameters[FLOOR].tobytes()
    for state in iterate(make_config({**job, "output": "cut"})):
        if state.number == 11:
            break
    iterates = [
        safetensors.numpy.load_file(f"{name}/checkpoint.safetensors")[f"value:{FLOOR}"].tobytes()
        for name in ("cut", "whole")
    ]
    assert state.values[FLOOR].tobytes() == result and iterates[0] != result and iterates[1] == result
    optimize(resume="cut", progress=False)
    assert saved("cut") == saved("whole")


@pytest.mark.slow
def test_each_stage_may_have_a_resolution_and_what_is_held_waits_for_its_own() -> None:
    shapes = [state.values[TEXTURE].shape for state in iterate(make_config(CASES["grid"]))]
    assert shapes == [(2, 2, 3)] * 4 + [(4, 4, 3)] * 3


@pytest.mark.slow
def test_recorded_passes_and_traced_ones_agree() -> None:
    job = {**STAGED, "integrator": {"type": "pathreplay", "max_depth": 3}}
    job["stages"] = [{**stage, "iterations": 4} for stage in STAGES]
    traced = optimize(make_config(job), progress=False)
    recorded = optimize(make_config({**job, "deterministic": False}), progress=False)
    for key, value in traced.parameters.items():
        assert recorded.parameters[key] == pytest.approx(value, abs=1e-4)


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "not the sum": ({"iterations": 6}, "iterations is 6, but the stages have 7 in total; remove 'iterations'"),
    "odd": ({"measure_snr": True, "stages": [{"iterations": 1, "spp": 3}]}, "a stage has spp = 3; make it even"),
    "none": ({"stages": []}, "'stages'"),
    "empty": ({"stages": [{}]}, "key 'stages.0.iterations' is missing; add it"),
    "misspelt": ({"stages": [{"iterations": 1, "dpp": 3}]}, "unknown key 'stages.0.dpp'; did you mean 'spp'?"),
    "divisor": ({"stages": [{"iterations": 1, "downscale": 4}]}, "12 x 10 pixels of sensor 'left'; use one of 2"),
    "no view": ({"stages": [{"iterations": 1, "sensors": ["up"]}]}, "sensor 'up' is not a view of the job"),
    "held out": (
        {"test_views": ["right"], "stages": [{"iterations": 1, "sensors": ["right"]}]},
        "sensor 'right' is a test view; name training views: left",
    ),
    "no key": (
        {"stages": [{"iterations": 1, "parameters": ["flor.*"]}]},
        "No parameter 'flor.*' in the job, and no similar one; it has wall.bsdf.reflectance.data, floor.",
    ),
    "never": ({"stages": [{"iterations": 1, "parameters": [FLOOR]}]}, f"stages: no stage optimises '{TEXTURE}'"),
    "resolutions": (
        {"parameters": [{"key": TEXTURE, "resolutions": [2, 4]}]},
        "2 resolutions and 0 entries in refine_at",
    ),
    "depth": (
        {"integrator": {"type": "prb_reparam"}, "stages": [{"iterations": 1, "max_depth": 2}]},
        "Integrator 'prb_reparam'",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_makes_no_sense_is_refused_in_one_line(case: str, room: Path) -> None:  # noqa: F811
    change, words = REFUSED[case]
    with pytest.raises(PathreplayError) as told:
        optimize(staged(**change), progress=False)
    assert words in str(told.value) and "\n" not in str(told.value)
    assert not (room / "run").exists()
