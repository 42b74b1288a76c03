"""What people see of a parameter and what Mitsuba stores: there and back, derivatives between them, whole jobs."""

from __future__ import annotations

import gc
import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import PIL.Image
import pytest
import safetensors.numpy

from pathreplay.inverse.images.io import exr_bytes, read_image
from pathreplay.inverse.parameters.grids import rmse
from pathreplay.jobs import make_config, optimize
from pathreplay.output.export import export_run
from pathreplay.scenes.loading import load_scene_for
from pathreplay.scenes.parameters import get_array, to_value
from pathreplay.scenes.stored import AS_STORED, form_of

SKY = np.random.default_rng(0).uniform(0.1, 1, (4, 8, 3)).astype(np.float32)
OTHER = np.random.default_rng(1).uniform(0.1, 1, (4, 8, 3)).astype(np.float32)
SCENE = """<scene version="3.0.0">
  <sensor type="perspective" id="cam"><float name="fov" value="60"/>
    <transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film></sensor>
  <shape type="sphere" id="ball"><bsdf type="diffuse"/></shape>
  <emitter type="envmap" id="env"><string name="filename" value="sky.exr"/></emitter>
</scene>"""
JOB: dict[str, Any] = {
    "scene": "scene.xml",
    "integrator": {"type": "prb", "max_depth": 3},
    "iterations": 3,
    "spp": 4,
    "eval_spp": 4,
    "learning_rate": 0.01,
    "final_learning_rate_ratio": 0.1,
    "target": {"values": {"env.data": "other.exr"}, "spp": 16, "integrator": {"type": "path", "max_depth": 3}},
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.xml").write_text(SCENE)
    (tmp_path / "sky.exr").write_bytes(exr_bytes(SKY))
    (tmp_path / "other.exr").write_bytes(exr_bytes(OTHER))
    return tmp_path


def sky_scene() -> Any:
    return mi.load_dict({"type": "scene", "env": {"type": "envmap", "bitmap": mi.Bitmap(SKY)}}, optimize=False)


def test_a_sky_is_seen_as_in_its_file_and_stored_as_mitsuba_does() -> None:
    params = mi.traverse(sky_scene())
    form, stored = form_of(params, "env.data"), params["env.data"]
    assert stored.shape == (4, 10, 3)  # what this file is about; another Mitsuba may store it otherwise
    seen = form.see(stored)
    assert np.array_equal(get_array(seen), SKY)
    assert np.array_equal(get_array(form.store(seen)), get_array(stored))
    finer = to_value(mi.TensorXf(np.zeros((8, 16, 3), np.float32)), np.repeat(np.repeat(SKY, 2, 0), 2, 1))
    assert np.array_equal(get_array(form.see(form.store(finer))), get_array(finer))


def test_derivatives_of_a_sky_are_those_of_its_columns() -> None:
    """Mean radiance from many directions, by each texel that is seen, against central differences."""
    scene = sky_scene()
    params = mi.traverse(scene)
    form = form_of(params, "env.data")
    d = np.random.default_rng(2).normal(size=(3, 5000)).astype(np.float32)
    si = dr.zeros(mi.SurfaceInteraction3f, d.shape[1])
    si.wi = -dr.normalize(mi.Vector3f(d))

    def mean(seen: Any) -> Any:
        params["env.data"] = form.store(seen)
        params.update()
        return dr.mean(scene.environment().eval(si)[1])

    seen = mi.TensorXf(SKY)
    dr.enable_grad(seen)
    dr.backward(mean(seen))
    gradient = np.array(dr.grad(seen))
    assert gradient.sum() == pytest.approx(1, abs=1e-4)  # weights of an interpolation: nothing gets lost at the ends
    for column in (0, 3, 7):
        step = np.zeros_like(SKY)
        step[1, column, 1] = 0.05
        up, down = (mean(mi.TensorXf(SKY + sign * step))[0] for sign in (1, -1))
        # Linear: what differs is the rounding of two means of 5000 numbers, over the step.
        assert gradient[1, column, 1] == pytest.approx((up - down) / 0.1, abs=2e-5)
        assert gradient[1, column, 1] > 0.01


def test_half_precision_is_seen_in_full_and_others_as_they_are() -> None:
    texels = mi.Bitmap((SKY * 65535).astype(np.uint16))
    texture = {"type": "bitmap", "bitmap": texels, "raw": True}
    scene = mi.load_dict(
        {"type": "scene", "s": {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": texture}}}, optimize=False
    )
    params = mi.traverse(scene)
    key = "s.bsdf.reflectance.data"
    form = form_of(params, key)
    seen = form.see(params[key])
    assert get_array(seen).dtype == np.float32
    assert np.array_equal(get_array(form.store(seen)), get_array(params[key]))
    dr.enable_grad(seen)
    dr.backward(dr.sum(mi.TensorXf(form.store(seen)), axis=None))
    assert (np.array(dr.grad(seen)) == 1).all()
    assert form_of(params, "s.to_world") is AS_STORED


def test_a_sky_goes_through_a_job_column_by_column(folder: Path) -> None:
    given = [{"key": "env.data", "initial": "other.exr", "lower": 0.0}]
    start = optimize(make_config({**JOB, "parameters": given, "iterations": 1, "learning_rate": 1e-9}), progress=False)
    # The file that the target was given, given as the start: no error but rounding of the step.
    assert start.parameters["env.data"] == pytest.approx(OTHER, abs=1e-7)
    assert start.errors["env.data"] < 1e-7

    result = optimize(make_config({**JOB, "parameters": [{"key": "env.data"}]}), progress=False)
    assert result.errors["env.data"] < np.sqrt(np.mean((SKY - OTHER) ** 2))
    saved = safetensors.numpy.load_file(result.folder / "parameters.safetensors")
    assert saved["env.data"].shape == SKY.shape
    assert json.loads((result.folder / "parameters.json").read_text())["env.data"]["shape"] == [4, 8, 3]
    assert "8 x 4 texels" in result.report.read_text()
    with PIL.Image.open(result.folder / "images/texture-result-env.data.png") as picture:
        assert picture.size == (8, 4)
    # What is saved is what was rendered: a scene with that sky shows the result.
    (folder / "sky.exr").write_bytes(exr_bytes(saved["env.data"]))
    again = optimize(make_config({**JOB, "parameters": [{"key": "env.data"}], "iterations": 1}), progress=False)
    pictures = [read_image(r.folder / f"images/{kind}-cam.exr") for r, kind in ((result, "result"), (again, "start"))]
    assert pictures[1] == pytest.approx(pictures[0], abs=1e-5)


def test_a_sky_without_name_is_seen_without_shapes(folder: Path) -> None:
    bare = SCENE.replace(' id="env"', "").replace('<shape type="sphere" id="ball"><bsdf type="diffuse"/></shape>', "")
    (folder / "scene.xml").write_text(bare)
    target = {"images": ["other.exr"]}
    (folder / "other.exr").write_bytes(exr_bytes(np.ones((8, 8, 3), np.float32)))
    job = {**JOB, "parameters": [{"key": "*.data"}], "target": target, "iterations": 1}
    result = optimize(make_config(job), progress=False)
    assert [value.shape for value in result.parameters.values()] == [SKY.shape]


def test_a_sky_is_refined_by_its_own_columns(folder: Path) -> None:
    levels = [{"key": "env.data", "initial": 0.5, "lower": 0.0, "resolutions": [4, 8], "refine_at": [2]}]
    result = optimize(make_config({**JOB, "parameters": levels}), progress=False)
    assert result.parameters["env.data"].shape == (4, 8, 3)


def test_eight_bit_images_in_memory_become_numbers() -> None:
    paint = {"type": "bitmap", "bitmap": mi.Bitmap(np.zeros((2, 2, 3), np.uint8))}
    ball = {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": paint}}
    scene, notes = load_scene_for({"type": "scene", "ball": ball}, ["*.data"])
    assert isinstance(mi.traverse(scene)["ball.bsdf.reflectance.data"], mi.TensorXf)
    assert notes == ("stored the texels of images in memory as floating-point numbers: they carry derivatives",)


def test_eight_bit_textures_become_numbers_where_they_are_asked_for(folder: Path) -> None:
    """As a parameter, in the values of a target, in a run that is gone on with, and in what is exported."""
    png = '<texture type="bitmap" name="reflectance"><string name="filename" value="{}"/></texture>'
    rng = np.random.default_rng(1)
    for name in ("t.png", "u.png"):
        PIL.Image.fromarray(rng.integers(20, 235, (4, 4, 3), np.uint8)).save(folder / name)
    paints = [f'<bsdf type="diffuse" id="{id}">{png.format(f"{id}.png")}</bsdf>' for id in ("t", "u")]
    text = SCENE.replace('<bsdf type="diffuse"/>', '<ref id="t"/>').replace("<shape", "".join(paints) + "<shape", 1)
    (folder / "scene.xml").write_text(text)
    key, job = "t.reflectance.data", {**JOB, "iterations": 1, "output": "run"}
    entry = {"key": key, "initial": 0.5, "lower": 0.0, "upper": 1.0}
    result = optimize(make_config({**job, "parameters": [entry], "target": {"scene": "scene.xml"}}), progress=False)
    truth = (np.asarray(PIL.Image.open(folder / "t.png")) / 255.0 + 0.055) / 1.055
    assert result.parameters[key].dtype == np.float32
    assert result.errors[key] == pytest.approx(rmse(result.parameters[key], truth**2.4), rel=1e-3)
    config = folder / "run/config.json"
    config.write_text(json.dumps({**json.loads(config.read_text()), "iterations": 2}))
    assert optimize(resume=folder / "run", progress=False).iterations == 2
    export_run(folder / "run")
    scene = mi.traverse(mi.load_file(str(folder / "run/export/scene.xml"), optimize=False))
    assert isinstance(scene[key], mi.TensorXf) and isinstance(scene["u.reflectance.data"], mi.TensorXu8)
    del scene
    gc.collect()
    other = {**job, "parameters": [{"key": "env.data"}], "target": {"values": {"*.data": 0.5}}}
    assert optimize(make_config(other), progress=False).iterations == 1


SPECTRAL = """
import mitsuba as mi, numpy as np, drjit as dr
from pathreplay.platform.backend import set_variant
set_variant("llvm_ad_spectral")
from pathreplay.errors import PathreplayError
from pathreplay.scenes.parameters import get_array
from pathreplay.scenes.spectra import WAVELENGTHS
from pathreplay.scenes.stored import form_of

rgb = np.random.default_rng(0).uniform(0.05, 0.95, (4, 8, 3)).astype(np.float32)
def ball(**reflectance):
    return {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": reflectance}}
grid = mi.VolumeGrid(np.random.default_rng(1).uniform(0.05, 1, (2, 3, 4, 3)).astype(np.float32))
scene = mi.load_dict({"type": "scene",
    "env": {"type": "envmap", "bitmap": mi.Bitmap(5 * rgb)},
    "texture": ball(type="bitmap", bitmap=mi.Bitmap(rgb)),
    "normals": ball(type="bitmap", bitmap=mi.Bitmap(rgb), raw=True),
    "colour": ball(type="rgb", value=[0.6, 0.1, 0.2]),
    "fog": {"type": "cube", "bsdf": {"type": "null"}, "interior": {"type": "heterogeneous", "sigma_t": 1.0,
        "albedo": {"type": "gridvolume", "grid": grid}}},
    "lamp": {"type": "rectangle", "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [3, 2, 1]}}},
}, optimize=False)
params = mi.traverse(scene)
colours = {"env.data": 5 * rgb, "texture.bsdf.reflectance.data": rgb, "normals.bsdf.reflectance.data": rgb,
           "colour.bsdf.reflectance.value": np.array([0.6, 0.1, 0.2], np.float32),
           "fog.interior_medium.albedo.data": np.array(grid)}
for key, given in colours.items():
    form = form_of(params, key)
    seen = form.see(params[key])
    assert get_array(seen).shape == given.shape, key
    # Float32 through a parabola in nanometres; values to 5.
    assert np.abs(get_array(form.see(form.store(seen))) - get_array(seen)).max() < 1e-4, key
    assert np.abs(form.of_colours(key, given) - get_array(seen)).max() < 1e-4, key

# What is seen is what Mitsuba evaluates there, and derivatives by it are those of differences.
key = "colour.bsdf.reflectance.value"
form, bsdf = form_of(params, key), scene.shapes()[2].bsdf()
si = dr.zeros(mi.SurfaceInteraction3f, 1)
si.wi, si.wavelengths = mi.Vector3f(0, 0, 1), mi.Spectrum(*WAVELENGTHS, 500.0)
seen = mi.Color3f(form.see(params[key]))
def reflectance(value):
    params[key] = form.store(value)
    params.update()
    return dr.pi * bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(0, 0, 1))
assert np.abs(np.array(reflectance(seen)).ravel()[:3] - get_array(seen)).max() < 1e-5
dr.enable_grad(seen)
dr.backward(reflectance(seen)[3])
gradient, detached = get_array(dr.grad(seen)), get_array(seen)
for i in range(3):
    up, down = (reflectance(mi.Color3f(*map(float, detached + s * 0.01 * np.eye(3)[i]))) for s in (1, -1))
    assert abs(gradient[i] - (up[3][0] - down[3][0]) / 0.02) < 2e-3, (i, gradient, up, down)
try:
    form_of(params, "lamp.emitter.radiance.value").of_colours("lamp", np.ones(3))
except PathreplayError as error:
    assert "rgb variant" in str(error) and "\\n" not in str(error)
else:
    raise AssertionError("brightness of a lamp was taken")
try:
    form.of_colours(key, np.array([0.5, 0.5, 1.5]))
except PathreplayError as error:
    assert "0.5 to 1.5" in str(error)
else:
    raise AssertionError("a reflectance above 1 was taken")

# A colour that a bound has set to 0 or 1 has the gradient of its neighbours, and can leave the bound again.
for key, form, evaluated, others in (
    (key, form, lambda: dr.pi * bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(0, 0, 1)), (0.001, 0.999)),
    ("env.data", form_of(params, "env.data"), lambda: scene.environment().eval(around), (0.001, 1.0)),
):
    around = dr.zeros(mi.SurfaceInteraction3f, 1)
    around.wi, around.wavelengths = mi.Vector3f(0, -0.6, 0.8), si.wavelengths
    found = []
    for number in (0.0, others[0], others[1], 1.0):
        seen = dr.zeros(type(form.see(params[key])), dr.shape(form.see(params[key]))) + number
        if not dr.is_tensor_v(seen):
            seen = mi.Color3f(*[number] * 3)
        dr.enable_grad(seen)
        params[key] = form.store(seen)
        params.update()
        dr.backward(evaluated()[3])
        found.append(np.abs(get_array(dr.grad(seen))).sum())
    assert found[0] > 0.5 * found[1] > 0 and found[3] > 0.5 * found[2] > 0, (key, found)

# A dictionary is loaded twice with the same result: Mitsuba converts its bitmaps in place.
from pathreplay.scenes.loading import load_scene_for
spec = {"type": "scene", "wall": {"type": "rectangle", "bsdf": {"type": "diffuse",
    "reflectance": {"type": "bitmap", "bitmap": mi.Bitmap(np.tile(np.float32([0.6, 0.3, 0.1]), (2, 2, 1)))}}}}
for _ in range(2):
    texture = mi.traverse(load_scene_for(spec, [])[0])
    name = next(name for name in texture.keys() if name.endswith("reflectance.data"))
    texel = get_array(form_of(texture, name).see(texture[name]))[0, 0]
    assert np.abs(texel - form.of_colours("", np.float32([[[0.6, 0.3, 0.1]]]))[0, 0]).max() < 0.02, texel
print("fine")
"""


def test_spectra_are_seen_at_three_wavelengths(run_python: Callable[..., subprocess.CompletedProcess[str]]) -> None:
    done = run_python(SPECTRAL)
    assert done.stdout.strip().endswith("fine"), done.stderr


MONO = """
import mitsuba as mi, numpy as np
from pathreplay.platform.backend import set_variant
set_variant("llvm_ad_mono")
from pathreplay.scenes.parameters import get_array
from pathreplay.scenes.stored import form_of
rgb = np.random.default_rng(0).uniform(0.05, 0.95, (4, 8, 3)).astype(np.float32)
params = mi.traverse(mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(rgb)}))
form = form_of(params, "data")
seen = form.see(params["data"])
assert seen.shape == (4, 8, 1)
assert np.array_equal(get_array(form.store(seen)), get_array(params["data"]))
print("fine")
"""


def test_a_sky_has_one_channel_in_mono(run_python: Callable[..., subprocess.CompletedProcess[str]]) -> None:
    done = run_python(MONO)
    assert done.stdout.strip().endswith("fine"), done.stderr
