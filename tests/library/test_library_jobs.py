"""Problems that are made of a job's file: what a file says, Python takes over, and may change."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import pathreplay
from pathreplay import Parameter, PathreplayError, View, load_job
from pathreplay.inverse.images.io import exr_bytes
from pathreplay.jobs import iterate, optimize
from pathreplay.output.export import export_run
from room_job import CLOUD
from small_job import checkpoint_bits
from variant import VARIANT
from wall_job import JOB, SCENE

KEY = "wall.bsdf.reflectance.value"
JOBS: dict[str, dict[str, Any]] = {
    "surface": JOB,
    "schedule": {**JOB, "learning_rate_schedule": "cosine", "optimizer": {"type": "sgd", "momentum": 0.5}},
    "stages": {
        **{key: value for key, value in JOB.items() if key != "iterations"},
        "stages": [{"iterations": 3, "downscale": 2}, {"iterations": 2, "spp": 6}],
    },
    "search": {**JOB, "optimizer": {"type": "l-bfgs-b"}},
    "exposure": {**JOB, "exposure": {}, "measure_snr": True},
    "automatic samples": {**JOB, "spp": "auto", "adaptive_spp": {"min": 2, "max": 8}},
    "medium": {**CLOUD, "spp": 2, "eval_spp": 2, "deterministic": True, "iterations": 3},
}


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The job is in a folder beside the one that we are in: its paths start there."""
    mi.set_variant(VARIANT)
    (tmp_path / "jobs").mkdir()
    (tmp_path / "here").mkdir()
    (tmp_path / "jobs/room.xml").write_text(SCENE)
    monkeypatch.chdir(tmp_path / "here")
    return tmp_path / "jobs"


def written(place: Path, job: dict[str, Any] = JOB) -> Path:
    (place / "job.json").write_text(json.dumps(job))
    return place / "job.json"


@pytest.mark.parametrize(
    "kind", [pytest.param(k, marks=[pytest.mark.slow] * (k in ("schedule", "search"))) for k in JOBS]
)
def test_a_file_gives_the_bits_of_its_job(kind: str, place: Path) -> None:
    """In memory and in a folder, which the command line takes for one of its own."""
    path = written(place, JOBS[kind])
    job = optimize(path, output="job", progress=False)
    problem = load_job(path)
    for output in (None, "run"):
        result = pathreplay.minimize(problem, output=output, progress=False)
        assert [entry.loss for entry in result.history] == [entry.loss for entry in job.history], output
        for key, value in job.parameters.items():
            np.testing.assert_array_equal(result.values[key], value)
    assert checkpoint_bits(Path("run")) == checkpoint_bits(Path("job"))
    assert "optimize(load_config(" in Path("run/report.html").read_text()


OF_GREY = """
from pathlib import Path
import pathreplay, mitsuba as mi
from pathreplay.output.export import export_run
mi.set_variant("llvm_ad_mono")
pathreplay.minimize(pathreplay.load_job("../jobs/job.yaml"), output="of-problem", progress=False)
pathreplay.optimize("../jobs/job.yaml", output="of-job", progress=False)
for run in ("of-problem", "of-job"):
    mi.set_variant("llvm_ad_rgb")
    export_run(Path(run))
"""


def test_runs_tell_the_command_line_their_variant(place: Path, run_python: Callable[..., Any]) -> None:
    """The job names none: then it is the active one, which the command line would not choose."""
    job = {**JOB, "iterations": 1, "parameters": [{"key": KEY}], "target": {"values": {KEY: 0.4}, "spp": 2}}
    (place / "job.yaml").write_text(json.dumps(job))
    done = run_python(OF_GREY)
    assert done.returncode == 0, done.stderr
    for run in ("of-problem", "of-job"):
        assert json.loads(Path(run, "config.json").read_text())["variant"] == "llvm_ad_mono"
        assert json.loads(Path(run, "export/values.json").read_text()).keys() == {KEY}


def test_python_and_the_command_line_go_on_with_each_others_runs(place: Path) -> None:
    path = written(place)
    optimize(path, output="whole", progress=False)
    with iterate(path, output="begun-there") as run:
        next(run), next(run)
    pathreplay.minimize(load_job(path), output="begun-there", resume=True, progress=False)
    pathreplay.minimize(load_job(path), output="begun-here", progress=False, callbacks=[lambda it: it.number == 3])
    assert optimize(resume="begun-here", progress=False).iterations == 8
    for name in ("begun-there", "begun-here"):
        assert checkpoint_bits(Path(name)) == checkpoint_bits(Path("whole"))
    with pytest.raises(PathreplayError, match=r"all its 8 iterations; .* \(Python: 'steps'\)"):
        pathreplay.minimize(load_job(path), output="whole", resume=True, progress=False)


def test_a_resume_records_the_settings_that_it_changes(place: Path) -> None:
    path = place / "job.yaml"
    path.write_text(json.dumps({**JOB, "iterations": 3}))
    with iterate(path, output="run") as begun:
        next(begun)
    config, page = Path("run/config.yaml"), Path("run/report.html")
    pathreplay.minimize(load_job(path), output="run", resume=True, progress=False)
    assert config.read_text() == path.read_text() and f"pathreplay optimize {path}" in page.read_text()
    pathreplay.minimize(load_job(path), steps=4, output="run", resume=True, progress=False)
    assert not config.exists() and json.loads(Path("run/config.json").read_text())["iterations"] == 4
    assert str(Path("run/config.json").absolute()) in page.read_text()
    with pytest.raises(PathreplayError, match="all its 4 iterations"):
        optimize(resume="run", progress=False)


def test_what_a_file_says_can_be_changed(place: Path) -> None:
    path = written(place)
    problem = load_job(path, spp=2, define=["seed=5"], target=None, views=View(0, np.full((4, 6, 3), 0.2)))
    assert (problem.built.config.spp, problem.built.config.seed) == (2, 5)
    assert problem.built.views[0].target.max() == np.float32(0.2) and problem.in_memory
    assert load_job(path).initial[KEY].tolist() == pytest.approx([0.2, 0.5, 0.7])
    brighter = Parameter(initial=0.9, bounds=(0, 1))
    assert load_job(path, parameters={KEY: brighter}).initial[KEY].tolist() == pytest.approx([0.9] * 3)
    assert not load_job(path, parameters={KEY: brighter}, integrator={"type": "prb", "max_depth": 3}).in_memory

    def own(image: Any, target: Any) -> Any:
        return dr.abs(image - target)

    by_name, by_hand = (load_job(path, loss=loss) for loss in ("l1", own))
    a, b = (pathreplay.value_and_grad(problem)(seed=1) for problem in (by_name, by_hand))
    assert a[0] == b[0] and np.array_equal(a[1][KEY], b[1][KEY])
    stages = [{"iterations": 2}, {"iterations": 1, "spp": 8}]  # instead of the iterations of the file
    assert len(pathreplay.minimize(load_job(path), stages=stages, progress=False).history) == 3
    own_scene = mi.load_file(str(place / "room.xml"))
    prb = mi.load_dict({"type": "prb", "max_depth": 2})
    own_objects = load_job(path, scene=own_scene, integrator=prb)
    assert own_objects.scene is own_scene and own_objects.built.integrator is prb
    result = pathreplay.minimize(own_objects, "adam", 3, output="run", progress=False)
    job = optimize(path, output="job", progress=False, define=["iterations=3"])
    np.testing.assert_array_equal(result.values[KEY], job.parameters[KEY])
    with pytest.raises(PathreplayError, match="started in Python"):
        optimize(resume="run", progress=False)


def test_targets_of_files_and_masks_go_along(place: Path) -> None:
    image, mask = np.full((4, 6, 3), 0.3, np.float32), np.ones((4, 6, 1), np.float32)
    mask[:2] = 0
    (place / "photo.exr").write_bytes(exr_bytes(image))
    (place / "mask.exr").write_bytes(exr_bytes(mask))
    path = written(place, {**JOB, "target": {"images": ["photo.exr"], "masks": ["mask.exr"]}})
    job = optimize(path, output="job", progress=False)
    for scene in (None, mi.load_file(str(place / "room.xml"))):
        result = pathreplay.minimize(load_job(path, scene=scene), output="run", progress=False)
        np.testing.assert_array_equal(result.values[KEY], job.parameters[KEY])


def test_captures_of_several_jobs_are_joint(place: Path) -> None:
    """Each part of the joint problem has the cameras and images of its own capture."""
    camera = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]
    for n in (0, 1):
        (place / f"photo{n}.exr").write_bytes(exr_bytes(np.full((4, 6, 3), 0.2 + 0.2 * n, np.float32)))
        frames = [{"file_path": f"photo{n}.exr", "transform_matrix": camera}]
        (place / f"capture{n}.json").write_text(json.dumps({"camera_angle_x": 0.6, "frames": frames}))
    job = {key: value for key, value in JOB.items() if key not in ("target", "sensors")}
    captures = [load_job(written(place, {**job, "capture": {"transforms": f"capture{n}.json"}})) for n in (0, 1)]
    result = pathreplay.minimize(pathreplay.Problem.joint(captures), steps=2, progress=False, output="run")
    assert [view.target.max() for view in result.problem.built.views] == [np.float32(0.2), np.float32(0.4)]
    assert len(result.history) == 2


@pytest.mark.parametrize("kind", ["object", "dictionary"])
def test_cameras_of_a_capture_are_not_added_to_a_scene_in_memory(kind: str, place: Path) -> None:
    camera = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]
    (place / "photo.exr").write_bytes(exr_bytes(np.full((4, 6, 3), 0.2, np.float32)))
    frames = [{"file_path": "photo.exr", "transform_matrix": camera}]
    (place / "capture.json").write_text(json.dumps({"camera_angle_x": 0.6, "frames": frames}))
    job = {key: value for key, value in JOB.items() if key not in ("target", "sensors")}
    path = written(place, {**job, "capture": {"transforms": "capture.json"}})
    wall = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}}
    scene: Any = {"type": "scene", "wall": wall}
    if kind == "object":
        scene = mi.load_file(str(place / "room.xml"))
    with pytest.raises(PathreplayError, match=r"scene: cameras of a capture .* give the name of a file, or 'views'"):
        load_job(path, scene=scene)
    known = load_job(path).scene  # it has the camera
    assert load_job(path, scene=known).scene is known


def test_a_run_with_an_integrator_object_is_exported(place: Path) -> None:
    prb = mi.load_dict({"type": "prb", "max_depth": 2})
    problem = load_job(written(place, {**JOB, "iterations": 1}), integrator=prb)
    pathreplay.minimize(problem, output="run", progress=False)
    export_run(Path("run"))
    mi.load_file("run/export/scene.xml")


@pytest.mark.parametrize(
    ("job", "changes", "words"),
    [
        ({}, {"spp": 0}, "'spp' is 0"),
        ({}, {"sppp": 2}, "unknown key 'sppp'; did you mean 'spp'"),
        ({"los": "l2"}, {}, "unknown key 'los'"),
        ({}, {"define": ["spp"]}, "has no '='"),
        ({"parameters": [{"key": "wal"}]}, {}, "No parameter matches 'wal'|wal"),
        ({}, {"integrator": mi.Integrator}, "is no|computes no gradients"),
        ({}, {"views": View("left", np.zeros((4, 6, 3)))}, "No sensor 'left'"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_told(job: dict[str, Any], changes: dict[str, Any], words: str, place: Path) -> None:
    with pytest.raises(PathreplayError, match=words) as told:
        load_job(written(place, {**JOB, **job}), **changes)
    assert "\n" not in str(told.value)


def test_files_that_are_none_are_told(place: Path) -> None:
    with pytest.raises(PathreplayError, match="No config file"):
        load_job("job.toml")
    (place / "job.json").write_text("[1]")
    with pytest.raises(PathreplayError, match="dictionary"):
        load_job(place / "job.json")
