"""Mitsuba's tutorials as configs, and the plain loops beside them: both run, and the configs are small and valid."""

from __future__ import annotations

import importlib
import json
import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from pathreplay.errors import PathreplayError
from pathreplay.inverse.images.io import exr_bytes, read_image
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
    """At 16 x 16 pixels and 16 samples, 60 steps leave an error of up to a fifth of the first one: it is noise."""
    job = small(name, iterations=120, learning_rate=0.12, final_learning_rate_ratio=0.1, spp=16)
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


# ------------------------------ A bottle under a real sky ------------------------------

SKY, MESH, TEXTURE = "MultiResolution/KernerEnvLatLong.exr", "examples/models/fuze.obj", "examples/models/fuze_uv.jpg"
BOX = [
    *(f"v {x} {y} {z}" for z in (2, 8) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))),
    *(f"vt {u / 4} {v}" for v in (0, 1) for u in range(5)),
    *(f"f {a}/{a} {a % 4 + 1}/{a + 1} {a % 4 + 5}/{a + 6} {a + 4}/{a + 5}" for a in (1, 2, 3, 4)),
]
"""An OBJ file of the four sides of a box whose axis is z, from z = 2 to 8, with a quarter of the texture each."""


def stand_in(folder: Path) -> Path:
    """The files that the script reads, all in one folder: a sky with a small sun, and a box for the bottle."""
    for name in (SKY, MESH):
        (folder / name).parent.mkdir(parents=True)
    sky = np.full((128, 256, 4), 0.25, np.float32)
    sky[:64] = [0.3, 0.5, 0.8, 1.0]
    sky[40, 90] = 400.0
    (folder / SKY).write_bytes(exr_bytes(sky))
    (folder / MESH).write_text("\n".join(BOX))
    columns = np.linspace(0, 255, 512).astype(np.uint8)
    red, green = np.meshgrid(columns, columns)
    Image.fromarray(np.stack([red, green, 255 - red], axis=2)).save(folder / TEXTURE)
    return folder


@pytest.fixture(scope="module")
def real_sky() -> Callable[..., None]:
    """The script of the example."""
    return runpy.run_path(str(ROOT / "examples/real-sky/make_assets.py"))["main"]


def test_assets_have_the_light_the_colours_and_the_height(real_sky: Callable[..., None], tmp_path: Path) -> None:
    checkout, assets = stand_in(tmp_path / "checkout"), tmp_path / "assets"
    real_sky(checkout, checkout, into=assets)
    sky, label = read_image(assets / "sky.exr"), read_image(assets / "label.exr")
    assert sky.shape == (64, 128, 3) and label.shape == (256, 256, 3)
    assert sky[20, 45] == pytest.approx((3 * np.array([0.3, 0.5, 0.8]) + 400) / 4, rel=1e-3)
    assert sky[40, 45] == pytest.approx(0.25, rel=1e-3)
    assert label[128, 200, 0] == pytest.approx(((200.5 / 256 + 0.055) / 1.055) ** 2.4, abs=0.02)  # sRGB decoded
    mesh = mi.load_dict({"type": "ply", "filename": str(assets / "bottle.ply")})
    assert mesh.has_vertex_texcoords()
    np.testing.assert_allclose(mesh.bbox().min, [-1 / 3, 0, -1 / 3], atol=1e-5)
    np.testing.assert_allclose(mesh.bbox().max, [1 / 3, 2, 1 / 3], atol=1e-5)


BAD = {
    "no checkout": (SKY, None, r"KernerEnvLatLong\.exr is no file; give the folder of a checkout of github\.com/Acad"),
    "no mesh": (MESH, None, r"fuze\.obj is no file; give the folder of a checkout of github\.com/mmatl/pyrender"),
    "no image": (SKY, b"version https://git-lfs", r"KernerEnvLatLong\.exr cannot be read"),
    "a small sky": (SKY, exr_bytes(np.ones((30, 60, 3), np.float32)), r"is 60 x 30 with 3 channels; use .* 128 .* 64"),
    "a grey sky": (SKY, exr_bytes(np.ones((64, 128, 1), np.float32)), "is 128 x 64 with 1 channels"),
    "no faces": (MESH, b"v 0 0 0", r"Mesh .*fuze\.obj cannot be read"),
    "a bad face": (MESH, "\n".join([*BOX, "f 1/1 2/2 99/3"]).encode(), r"Mesh .*fuze\.obj cannot be read"),
    "no texture coordinates": (MESH, b"v 0 0 0\nv 1 0 0\nv 0 0 1\nf 1 2 3", r"fuze\.obj has no texture coordinates"),
}


@pytest.mark.parametrize("case", BAD)
def test_data_that_cannot_be_used_is_refused_in_one_line(
    case: str, real_sky: Callable[..., None], tmp_path: Path
) -> None:
    name, content, words = BAD[case]
    checkout = stand_in(tmp_path / "checkout")
    if content is None:
        (checkout / name).unlink()
    else:
        (checkout / name).write_bytes(content)
    with pytest.raises(PathreplayError, match=words) as told:
        real_sky(checkout, checkout, into=tmp_path / "assets")
    assert "\n" not in str(told.value) and not (tmp_path / "assets").exists()


@pytest.mark.slow
def test_texture_and_sky_are_found_from_eight_images(real_sky: Callable[..., None], tmp_path: Path) -> None:
    """Of the stand-ins, by the job of the example; the test view is closer by 10 dB."""
    checkout = stand_in(tmp_path / "checkout")
    real_sky(checkout, checkout, into=tmp_path / "assets")
    changes = [f"scene_parameters={{res=24, assets={str(tmp_path / 'assets')!r}}}", "iterations=150", "target.spp=256"]
    result = optimize(
        ROOT / "examples/real-sky/config.toml",
        output=tmp_path / "run",
        progress=False,
        define=[*changes, "eval_spp=64"],
    )
    assert result.test_views == ("test",)
    before = json.loads((result.folder / "views.json").read_text())["test"]["start"]["psnr"]
    assert result.views["test"].psnr > before + 10
    key = "bottle.bsdf.base_color.data"
    assert result.errors[key] < 0.4 * result.history[0].errors[key]
    below_horizon = result.parameters["sky.data"][33:37]
    assert np.median(below_horizon, axis=(0, 1)) == pytest.approx(0.25, rel=0.05)
