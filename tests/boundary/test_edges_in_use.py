"""Edges in jobs and checks: how they are asked for, what is refused, and what outlines alone recover."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from typer.testing import CliRunner

from pathreplay.cli import app
from pathreplay.errors import PathreplayError
from pathreplay.inverse.parameters.mesh import Surface
from pathreplay.inverse.problem.problem import build_problem
from pathreplay.jobs import load_config, make_config, optimize
from pathreplay.scenes.bodies import ball, knobs, mesh
from pathreplay.scenes.loading import load_scene
from pathreplay.testing.objective import integrator_name
from pathreplay.testing.reference import integrator_under_test
from places import ROOT


@pytest.fixture(autouse=True)
def variant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


KEY = "body.vertex_positions"
BODY = {
    "key": KEY,
    "pose": "rigid",
    "initial": {"translation": [0.3, -0.15, 0.3], "rotation": [20, -30, 25]},
    "error_scale": 1.0,
}
JOB: dict[str, Any] = {
    "scene": "silhouettes",
    "scene_parameters": {"resolution": 16},
    "integrator": {"type": "pathreplay", "max_depth": 2, "boundary": "primary"},
    "iterations": 2,
    "spp": 8,
    "eval_spp": 16,
    "parameters": [BODY],
    "target": {"scene": "silhouettes", "spp": 256, "integrator": {"type": "path", "max_depth": 2}},
}


def run(**changes: Any) -> Any:
    return optimize(make_config({**JOB, **changes}), progress=False)


# ------------------------------ How they are asked for ------------------------------


BAD = {
    "of another integrator": (
        {"type": "prb", "boundary": "all"},
        "'boundary' is an option of the integrator 'pathreplay'",
    ),
    "unknown": (
        {"type": "pathreplay", "boundary": "outline"},
        "boundary = 'outline' is unknown: use one of 'auto', 'none'",
    ),
    "below zero": (
        {"type": "pathreplay", "boundary": "all", "boundary_spp": -1},
        "boundary_spp = -1: use a number of segments per pixel >= 0",
    ),
    "half a line": (
        {"type": "pathreplay", "boundary": "all", "boundary_spp": 1.5},
        "boundary_spp = 1.5: use a number of segments per pixel >= 0",
    ),
    "attached": (
        {"type": "pathreplay", "boundary": "all", "attach": "all"},
        "boundary terms need attach = 'delta'",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_what_does_not_fit_is_refused_in_one_line(case: str) -> None:
    integrator, message = BAD[case]
    with pytest.raises(PathreplayError) as caught:
        run(integrator=integrator)
    assert message in str(caught.value) and "\n" not in str(caught.value)
    assert not Path("runs").exists()


def test_a_check_has_the_edges_that_one_asks_for() -> None:
    scene = load_scene("silhouettes", resolution=4)
    asked = integrator_under_test(None, scene, boundary={"boundary": "primary", "boundary_spp": 3})
    assert (asked.boundary, asked.boundary_spp, asked.max_depth) == ("primary", 3, 2)
    assert integrator_name(asked) == "pathreplay, boundary primary"
    assert integrator_name(integrator_under_test(None, scene)) == "pathreplay"
    with pytest.raises(PathreplayError, match="'boundary' is a property of 'pathreplay', and the integrator is 'prb'"):
        integrator_under_test("prb", scene, boundary={"boundary": "all"})
    with pytest.raises(PathreplayError, match="boundary cannot be given along with an integrator object"):
        integrator_under_test(asked, scene, boundary={"boundary": "all"})


def test_the_depth_of_a_check_leaves_the_edges_of_the_scene() -> None:
    own = {"type": "pathreplay", "max_depth": 3, "boundary": "all", "boundary_spp": 5}
    scene = mi.load_dict({"type": "scene", "integrator": own})
    asked = integrator_under_test(None, scene, max_depth=2)
    assert (asked.boundary, asked.boundary_spp, asked.max_depth) == ("all", 5, 2)
    assert integrator_under_test(None, scene, boundary={"boundary": "none"}).boundary == "none"


@pytest.mark.slow
def test_a_check_of_an_outline_passes_with_edges_and_fails_without() -> None:
    scene = ["check", "silhouettes", "--param", KEY, "--seeds", "6", "--spp", "256", "--fd-spp", "2048"]
    passed = CliRunner().invoke(app, scene)
    assert passed.exit_code == 0 and "pathreplay (backward)" in passed.output
    failed = CliRunner().invoke(app, [*scene, "--boundary", "none"])
    assert failed.exit_code == 1 and "pathreplay, boundary none (backward)" in failed.output


# ------------------------------ What is told ------------------------------


@pytest.mark.parametrize(("edges", "told"), [
    ("none", "silhouettes, shadows"), ("primary", "soft shadows"), ("all", ""), ("auto", "several times as long"),
])  # fmt: skip
def test_a_job_says_what_its_edges_leave_out_or_cost(edges: str, told: str) -> None:
    job = {**JOB, "integrator": {**JOB["integrator"], "boundary": edges}}
    notes = " ".join(build_problem(make_config(job), Path.cwd()).notes)
    assert notes.count("docs/boundary.md") == bool(told) and told in notes


@pytest.mark.slow
def test_errors_of_poses_are_in_the_history_and_beside_a_rivals() -> None:
    result = run(baseline={**JOB["integrator"], "boundary": "all"})
    lines = [json.loads(line) for line in (result.folder / "history.jsonl").read_text().splitlines()]
    error = result.poses[KEY]
    assert lines[-1]["errors"] == pytest.approx({f"{KEY}:position": error.position, f"{KEY}:degrees": error.degrees})
    html = result.report.read_text()
    assert f"error of <code>{KEY}:position</code>" in html and f"error of <code>{KEY}:degrees</code>" in html


# ------------------------------ A mesh that stays one ------------------------------


def test_steps_on_a_surface_are_smooth_and_exact() -> None:
    vertices, faces = ball(2)
    positions = np.ravel(knobs(vertices)).astype(np.float32)
    surface = Surface(positions, np.ravel(faces), 20.0)
    assert surface.values(surface.latent(positions)) == pytest.approx(positions, abs=1e-5)
    # By the chain rule: <gradient by u, δu> = <gradient by v, δv>.
    random = np.random.default_rng(1)
    g, δu = (random.normal(size=positions.size).astype(np.float32) for _ in range(2))
    assert surface.gradient(positions, g) @ δu == pytest.approx(g @ surface.values(δu), rel=1e-4)
    # A shift of all vertices is not slowed down, and one of a single vertex is.
    shift = np.tile([1, 2, 3], len(vertices)).astype(np.float32)
    assert surface.values(shift) == pytest.approx(shift, abs=1e-4)
    alone = np.zeros_like(positions)
    alone[0] = 1
    assert 0 < surface.values(alone)[0] < 0.1


def test_copies_of_a_vertex_stay_together() -> None:
    cube = mi.traverse(mi.load_dict({"type": "cube"}))
    positions, faces = np.array(cube["vertex_positions"]), np.array(cube["faces"])
    surface = Surface(positions, faces, 5.0)
    g = np.random.default_rng(2).normal(size=positions.size).astype(np.float32)
    moved = (positions + surface.values(surface.gradient(positions, g))).reshape(-1, 3)
    assert len(np.unique(positions.reshape(-1, 3), axis=0)) == 8
    assert len(np.unique(np.round(moved, 5), axis=0)) == 8


SMOOTH_REFUSED = {
    "bounds": (
        {"key": KEY, "large_steps_lambda": 5, "lower": 0},
        "'large_steps_lambda' excludes 'lower' and 'upper'",
    ),
    "pose": ({**BODY, "large_steps_lambda": 5}, "'large_steps_lambda' does not apply to a pose"),
    "colour": (
        {"key": "body.bsdf.reflectance.value", "large_steps_lambda": 5},
        "not the vertex_positions of a mesh",
    ),
    "zero": ({"key": KEY, "large_steps_lambda": 0}, "'parameters.0.large_steps_lambda' is 0"),
}


@pytest.mark.parametrize("case", SMOOTH_REFUSED)
def test_what_is_no_mesh_takes_no_smooth_steps(case: str) -> None:
    entry, message = SMOOTH_REFUSED[case]
    with pytest.raises(PathreplayError) as caught:
        run(parameters=[entry])
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_a_body_is_closed_and_turned_outwards() -> None:
    vertices, faces = ball(3)
    made = mi.traverse(mesh(knobs(vertices), faces, {"type": "diffuse"}))
    assert len(made["vertex_normals"]) == len(made["vertex_positions"]) == 3 * len(vertices)
    points = knobs(vertices)
    a, b, c = points[faces].transpose(1, 0, 2)
    assert np.einsum("fx,fx->f", a, np.cross(b, c)).min() > 0
    assert np.ptp(points, axis=0).max() == pytest.approx(1)
    sides = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert set(np.unique(sides, axis=0, return_counts=True)[1]) == {2}


@pytest.mark.slow
def test_a_mesh_goes_on_where_it_was_stopped() -> None:
    smooth = {
        "parameters": [{"key": KEY, "large_steps_lambda": 20.0, "learning_rate": 0.1}],
        "final_learning_rate_ratio": 1.0,
    }
    smooth["scene_parameters"] = {"resolution": 8, "views": 1}
    start = np.ravel(knobs(ball(4)[0]))
    smooth["target"] = {**JOB["target"], "values": {"sky.radiance.value": 0.5}}
    whole, half = run(**smooth, iterations=4), run(**smooth, iterations=2)
    config = half.folder / "config.json"
    config.write_text(config.read_text().replace('"iterations": 2', '"iterations": 4'))
    resumed = optimize(resume=half.folder, progress=False)
    assert np.abs(whole.parameters[KEY] - start).max() > 0.01
    assert resumed.parameters[KEY] == pytest.approx(whole.parameters[KEY], abs=1e-3)


# ------------------------------ The examples, shorter ------------------------------


EXAMPLES = ROOT / "examples"


def example(name: str, iterations: int, **changes: Any) -> Any:
    """What comes of an example's first part; it would take several times as many steps to end."""
    changes = {"baseline": None, "eval_spp": 16, "iterations": iterations, "final_learning_rate_ratio": 0.1, **changes}
    return optimize(load_config(EXAMPLES / name / "config.toml").model_copy(update=changes), progress=False)


@pytest.mark.slow
def test_an_outline_tells_where_a_body_is() -> None:
    result = example("silhouettes", 110, spp=16)
    error = result.poses[KEY]
    assert result.history[0].errors[f"{KEY}:position"] > 0.35 and result.history[0].errors[f"{KEY}:degrees"] > 40
    assert error.position < 0.02 and error.degrees < 2


@pytest.mark.slow
def test_borders_of_colours_tell_where_a_camera_stands() -> None:
    result = example("camera-by-edges", 80)
    error = result.poses["camera.to_world"]
    assert error.position < 0.05 and error.degrees < 0.5  # from 0.43 and 9 degrees


@pytest.mark.slow
def test_borders_seen_in_glass_tell_its_index_and_its_place() -> None:
    result = example("glass-ball", 60)
    assert result.errors["glass.eta"] < 0.01 and result.poses["ball.to_world"].position < 0.01  # from 0.08 and 0.1


@pytest.mark.slow
def test_outlines_and_shadows_make_a_body_of_a_ball() -> None:
    result = example("mesh-by-shadows", 30)
    assert result.history[-1].loss < 0.3 * result.history[0].loss
