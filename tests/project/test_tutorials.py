"""Mitsuba's tutorials as configs, and the plain loops beside them: both run, and the configs are small and valid."""

from __future__ import annotations

import importlib
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from pathreplay.jobs import load_config, make_config, optimize
from places import ROOT

EXAMPLES = ROOT / "examples/tutorials"
NAMES = sorted(path.stem for path in EXAMPLES.glob("*.toml"))


@pytest.fixture(scope="module")
def assets() -> Path:
    """The meshes, the volume and the sky, which are not kept with the sources."""
    if not (EXAMPLES / "assets/sky.exr").is_file():
        runpy.run_path(str(EXAMPLES / "make_assets.py"))["main"]()
    return EXAMPLES / "assets"


def small(name: str, **changes: Any) -> dict[str, Any]:
    """The job of a tutorial with other numbers, at a small resolution."""
    job = load_config(EXAMPLES / f"{name}.toml").model_dump(exclude_unset=True)
    arguments = {"res": 16, **changes.pop("arguments", {})}
    job["scene_parameters"] = {**job.get("scene_parameters", {}), **arguments}
    job["target"] |= {"spp": 1024, "scene": str(EXAMPLES / job["scene"])}
    job["target"]["scene_parameters"] = {**job["target"].get("scene_parameters", {}), **arguments}
    job["scene"] = str(EXAMPLES / job["scene"])
    return {**job, "eval_spp": 4, **changes}


def test_there_are_five_and_each_is_valid() -> None:
    assert NAMES == sorted(
        ["gradient_based_opt", "volume_optimization", "object_pose_estimation", "shape_optimization",
         "forward_inverse_rendering"]
    )  # fmt: skip
    for name in NAMES:
        assert load_config(EXAMPLES / f"{name}.toml").integrator.type == "pathreplay"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "key"),
    [("gradient_based_opt", "red.reflectance.value"), ("forward_inverse_rendering", "green.reflectance.value")],
)
def test_a_colour_is_found(name: str, key: str, tmp_path: Path) -> None:
    """With a learning rate for fewer steps; at full length the error is below 0.01."""
    job = small(name, iterations=60, learning_rate=0.12, final_learning_rate_ratio=0.1, spp=16)
    result = optimize(make_config(job), output=tmp_path / "run", progress=False)
    assert result.errors[key] < 0.2 * result.history[0].errors[key]


@pytest.mark.slow
def test_a_volume_comes_nearer_to_the_pictures(assets: Path, tmp_path: Path) -> None:
    job = small("volume_optimization", stages=[{"iterations": 12, "spp": 8}, {"iterations": 4, "spp": 16}])
    job["parameters"][0] |= {"resolutions": [4, 8], "refine_at": [12], "learning_rate": 0.05}
    result = optimize(make_config(job), output=tmp_path / "run", progress=False)
    assert np.mean([e.loss for e in result.history[-5:]]) < 0.7 * np.mean([e.loss for e in result.history[:5]])


@pytest.mark.slow
def test_a_pose_is_found(assets: Path, tmp_path: Path) -> None:
    job = small("object_pose_estimation", arguments={"res": 24}, iterations=40)
    job["parameters"][0] |= {"learning_rate": 0.04, "rotation_learning_rate": 4.0}
    result = optimize(make_config(job), output=tmp_path / "run", progress=False)
    error = result.poses["body.vertex_positions"]
    assert error.position < 0.1 and error.degrees < 13  # from 0.27 and 25


@pytest.mark.slow
def test_a_shape_comes_nearer_to_the_pictures(assets: Path, tmp_path: Path) -> None:
    job = small("shape_optimization", iterations=32, spp=8)
    result = optimize(make_config(job), output=tmp_path / "run", progress=False)
    assert np.mean([e.loss for e in result.history[-8:]]) < 0.8 * np.mean([e.loss for e in result.history[:8]])


@pytest.mark.slow
def test_the_plain_loop_and_the_table() -> None:
    """The smallest of them, as the command runs it: its header, a row for each way, four columns of numbers."""
    command = [sys.executable, "-m", "benchmarks.tutorials", "gradient_based_opt", "--quick"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    rows = [line.split(" | ") for line in done.stdout.splitlines()[-2:]]
    assert [row[1] for row in rows] == ["plain loop", "pathreplay"]
    assert all(float(row[3]) > 0 and float(row[4]) > 0 for row in rows)  # after two steps far above noise


def test_a_config_is_shorter_than_the_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT))
    lines = importlib.import_module("benchmarks.tutorials").lines
    for name in NAMES:
        plain, ours = lines(name)
        assert 10 < ours < plain, name


# ------------------------------ Material and light from one picture ------------------------------


@pytest.mark.slow
def test_material_and_light_are_found_in_one_photo(tmp_path: Path) -> None:
    example = ROOT / "examples/one-photo"
    made = runpy.run_path(str(example / "make_photo.py"))
    made["main"](resolution=24, spp=512, into=tmp_path)
    job = load_config(example / "config.toml").model_dump(exclude_unset=True)
    job |= {
        "scene": str(example / "scene.xml"), "scene_parameters": {"res": 24}, "iterations": 200, "eval_spp": 4,
        "target": {"images": [str(tmp_path / "photo.png")]},
    }  # fmt: skip
    found = optimize(make_config(job), output=tmp_path / "run", progress=False).parameters
    before = mi.traverse(mi.load_file(str(example / "scene.xml"), optimize=False))
    for key, truth in made["TRUTH"].items():
        start = np.array(before[key]).ravel()
        assert np.abs(found[key] - truth).max() < 0.4 * np.abs(start - truth).max(), key
