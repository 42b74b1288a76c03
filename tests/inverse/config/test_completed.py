"""What a job leaves out: its integrator is as the scene says, and its targets are rendered as its own pictures."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from pathreplay.integrators.path_limits import Limits, read_limits
from pathreplay.integrators.stateful import stateful
from pathreplay.inverse.problem.problem import Problem, build_problem
from pathreplay.jobs import make_config
from pathreplay.output.export import export_run
from pathreplay.testing.objective import integrator_name

# A lamp in view, between two walls that light each other: depth and hidden emitters both show.
SCENE = """<scene version="3.0.0">
  <integrator type="{integrator}"><integer name="max_depth" value="2"/><boolean name="hide_emitters" value="true"/>
    {options}</integrator>
  <sensor type="perspective" id="cam"><transform name="to_world"><translate z="-4"/></transform>
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/>
    <string name="pixel_format" value="rgb"/></film></sensor>
  <shape type="cube" id="box"><bsdf type="diffuse" id="paint"><rgb name="reflectance" value="0.5"/></bsdf></shape>
  <shape type="rectangle" id="floor"><bsdf type="diffuse"><rgb name="reflectance" value="0.9"/></bsdf>
    <transform name="to_world"><scale value="4"/><rotate x="1" angle="-90"/><translate y="-1"/></transform></shape>
  <emitter type="constant"/>
</scene>"""
JOB: dict[str, Any] = {
    "scene": "scene.xml", "iterations": 1, "spp": 4, "eval_spp": 4,
    "parameters": [{"key": "box.bsdf.reflectance.value"}], "target": {"scene": "scene.xml", "spp": 256},
}  # fmt: skip


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def problem(own: str = "prb", options: str = "", **changes: Any) -> Problem:
    Path("scene.xml").write_text(SCENE.format(integrator=own, options=options))
    return build_problem(make_config({**JOB, **changes}), Path.cwd())


def problem_of(own: str, options: str) -> Problem:
    """The problem of a scene whose integrator has these properties only."""
    scene = re.sub("<integrator.*</integrator>", f'<integrator type="{own}">{options}</integrator>', SCENE, flags=re.S)
    Path("scene.xml").write_text(scene)
    return build_problem(make_config(JOB), Path.cwd())


def rendered(problem: Problem, **options: Any) -> np.ndarray:
    """An image of the scene by `path`; its random numbers are not those of the target."""
    integrator = mi.load_dict({"type": "path", **options})
    return np.array(mi.render(problem.scene, integrator=integrator, spp=256, seed=mi.UInt32(77)))


def test_a_job_without_integrator_has_the_depth_and_options_of_the_scenes() -> None:
    found = problem()
    assert type(found.integrator).__name__ == "PathReplayIntegrator"
    assert read_limits(found.integrator) == Limits(2, 5, True)
    options = '<string name="boundary" value="primary"/><string name="adjoint" value="replay"/>'
    ours = problem("pathreplay", options).integrator
    assert (ours.boundary, ours.adjoint, read_limits(ours)) == ("primary", "replay", Limits(2, 5, True))
    assert read_limits(problem(integrator={"type": "pathreplay"}).integrator) == Limits(6, 5, False)
    assert read_limits(mi.load_dict({"type": "volprim_rf_basic", "max_depth": 9, "rr_depth": 7})) == Limits(9, 7, False)


@pytest.mark.parametrize(("own", "given"), [("prb", {"type": "pathreplay_particles"}), ("ptracer", {})])
def test_targets_of_light_paths_have_their_caustics(own: str, given: dict[str, str]) -> None:
    """`path` finds no caustic of a light without extent: a target by `path` would be black there."""
    found = problem(own, **({"integrator": given} if given else {}), sensors=["cam"])
    assert stateful(found.integrator).options()["caustics"] == "particles"
    assert stateful(found.judge).options()["caustics"] == "particles"
    assert integrator_name(found.judge) == integrator_name(found.integrator)
    assert read_limits(found.judge) == read_limits(found.integrator)


HIDDEN = '<boolean name="hide_emitters" value="true"/>'
NESTED = f'<integrator type="path"><integer name="max_depth" value="3"/>{HIDDEN}</integrator>'


@pytest.mark.parametrize(
    ("own", "options", "depth"),
    [("direct", HIDDEN, 2), ("aov", f'<string name="aovs" value="z:depth"/>{NESTED}', 3)],
)
def test_limits_of_integrators_without_limits_of_their_own(own: str, options: str, depth: int) -> None:
    """Paths of `direct` have at most two segments. The limits of `aov` are those of the integrator that it contains."""
    found = problem_of(own, options)
    assert read_limits(found.integrator) == read_limits(found.judge) == Limits(depth, 5, True)


def test_options_of_an_integrator_inside_of_others_are_those_of_the_job() -> None:
    """Otherwise a job about caustics would have none, neither in its images nor in its targets."""
    ours = """<integrator type="moment"><integrator type="pathreplay"><string name="caustics" value="particles"/>
      <integer name="max_depth" value="4"/></integrator></integrator>"""
    found = problem_of("aov", f'<string name="aovs" value="z:depth"/>{ours}')
    for integrator in (found.integrator, found.judge):
        assert stateful(integrator).options()["caustics"] == "particles"
        assert read_limits(integrator) == Limits(4, 5, False)


def test_a_scene_without_a_bound_leaves_the_job_the_default_depth() -> None:
    """`path` has none unless it is told, and paths without a bound are walked twice."""
    Path("scene.xml").write_text(SCENE.format(integrator="path", options="").replace('"2"', '"-1"'))
    found = build_problem(make_config(JOB), Path.cwd())
    assert read_limits(found.integrator) == Limits(6, 5, True)
    assert read_limits(mi.load_dict(found.config.target.integrator.model_dump())) == Limits(6, 5, True)


@pytest.mark.parametrize("given", [None, {"type": "pathreplay", "max_depth": 3}])
def test_targets_are_rendered_as_the_job_renders(given: dict[str, Any] | None) -> None:
    """Without any of their own: with the depth of the job, and emitters hidden or not. Nothing has to be told."""
    found = problem(**({} if given is None else {"integrator": given}))
    limits = {"max_depth": 2, "hide_emitters": True} if given is None else {"max_depth": 3}
    assert read_limits(found.judge) == read_limits(mi.load_dict({"type": "path", **limits})) and not found.notes
    (view,) = found.views
    same, other = rendered(found, **limits), rendered(found, max_depth=6 if given is None else 2)
    assert np.abs(view.target - same).mean() < 0.5 * np.abs(view.target - other).mean()


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        ({"max_depth": 6, "hide_emitters": True}, "with max_depth = 6, but the job's 'pathreplay' has max_depth = 2; "),
        ({"max_depth": 2}, "with hide_emitters = False, but the job's 'pathreplay' has hide_emitters = True; "),
        ({"max_depth": 2, "hide_emitters": True}, ""),
    ],
)
def test_targets_that_show_something_else_are_told_in_one_line(asked: dict[str, Any], told: str) -> None:
    found = problem(target={**JOB["target"], "integrator": {"type": "path", **asked}})
    assert len(found.notes) == bool(told)
    assert all(told in note and "\n" not in note for note in found.notes)


def test_targets_of_a_scene_with_media_are_rendered_with_them() -> None:
    made = {"scene": "cloud", "scene_parameters": {"resolution": 4, "grid": 2, "views": 1}}
    key = "cloud.interior_medium.sigma_t.data"
    config = make_config({**JOB, **made, "parameters": [{"key": key}], "target": {"scene": "cloud", "spp": 1}})
    judge = build_problem(config, Path.cwd()).judge
    assert judge.class_name().startswith("Volumetric") and read_limits(judge) is not None


def test_the_target_scene_decides_whether_targets_are_rendered_with_media() -> None:
    """The scene of the job has none. `path` takes the border of a medium for black."""
    fog = """<shape type="cube"><transform name="to_world"><translate z="-2"/></transform><bsdf type="null"/>
      <medium type="homogeneous" name="interior"/></shape></scene>"""
    Path("fog.xml").write_text(SCENE.format(integrator="path", options="").replace("</scene>", fog))
    found = problem("path", target={"scene": "fog.xml", "spp": 1})
    assert found.judge.class_name().startswith("Volumetric") and found.config.target.integrator.type == "volpath"
    assert found.views[0].target.any() and not found.notes


def test_black_targets_are_told_in_one_line() -> None:
    found = problem("path", target={**JOB["target"], "values": {"*.radiance.value": 0.0}})
    (note,) = found.notes
    assert note.startswith("the target of view 'cam' is black: ") and "\n" not in note


def test_a_ptracer_of_the_scene_does_not_tell_whether_it_hides_emitters() -> None:
    """It exposes no such property. Its description does, in a job."""
    (note,) = problem("ptracer").notes
    assert "'ptracer' does not expose its hide_emitters" in note and "hide_emitters = true" in note
    ours = {"type": "pathreplay", "max_depth": 2, "caustics": "particles", "hide_emitters": True}
    theirs = {**JOB["target"], "integrator": {"type": "ptracer", "max_depth": 2, "hide_emitters": True}}
    assert not problem("ptracer", integrator=ours, target=theirs).notes


def test_a_run_is_exported_with_the_depth_that_it_had() -> None:
    from pathreplay.jobs import optimize

    problem()
    folder = optimize(make_config(JOB), progress=False).folder
    export_run(folder, Path("out"))
    assert '<integer name="max_depth" value="2"' in Path("out/scene.xml").read_text()
