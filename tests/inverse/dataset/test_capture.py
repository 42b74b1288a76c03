"""Captures: cameras of a transforms.json see what they should, and jobs learn from their pictures."""

from __future__ import annotations

import json
import math
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.schema import Capture
from pathreplay.inverse.dataset.capture import read_capture
from pathreplay.inverse.dataset.transforms_json import photos_of_json
from pathreplay.inverse.images.io import exr_bytes, picture_size, png_bytes, read_image
from pathreplay.inverse.parameters.exposures import exposed
from pathreplay.inverse.problem.problem import build_problem
from pathreplay.jobs import make_config, optimize
from pathreplay.output.export import export_run
from pathreplay.scenes.loading import load_scene_for
from places import ROOT

WIDTH, HEIGHT = 12, 8
KEY = "wall.bsdf.reflectance.value"
SCENE = """<scene version="3.0.0">
  <sensor type="perspective" id="other"><film type="hdrfilm"/></sensor>
  <shape type="rectangle" id="wall"><transform name="to_world"><scale value="9"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf></shape>
  <emitter type="directional"><vector name="direction" value="0,0,-1"/>
    <rgb name="irradiance" value="3.14159265"/></emitter>
</scene>"""


def placed(x: float, turn: float = 0.0) -> list[list[float]]:
    """An OpenGL camera at (x, 0, 5) that looks along -z, turned about y by so many degrees."""
    c, s = math.cos(math.radians(turn)), math.sin(math.radians(turn))
    return [[c, 0, s, x], [0, 1, 0, 0], [-s, 0, c, 5], [0, 0, 0, 1]]


FRAMES = [{"file_path": f"./pictures/shot {k}", "transform_matrix": placed(0.3 * k, 5 * k)} for k in range(4)]
PLAIN: dict[str, Any] = {"camera_angle_x": 0.6, "frames": FRAMES}
JOB: dict[str, Any] = {
    "scene": "room.xml",
    "integrator": {"type": "pathreplay", "max_depth": 2},
    "optimizer": {"type": "sgd"},
    "learning_rate": 1.0,
    "learning_rate_schedule": "constant",
    "iterations": 10,
    "spp": 1,
    "eval_spp": 1,
    "capture": {"transforms": "capture/transforms.json", "test_every": 3},
    "parameters": [{"key": KEY, "lower": 0.0}],
}


def write(table: Any) -> None:
    Path("capture/transforms.json").write_text(table if isinstance(table, str) else json.dumps(table))


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "room.xml").write_text(SCENE)
    pictures = tmp_path / "capture" / "pictures"
    pictures.mkdir(parents=True)
    grey = np.full((HEIGHT, WIDTH, 3), 0.8, np.float32)
    for name in (*(f"shot {k}" for k in range(4)), "shot_0"):
        (pictures / f"{name}.exr").write_bytes(exr_bytes(grey))
    write(PLAIN)
    return tmp_path


def seen(camera: mi.Sensor, point: list[float]) -> np.ndarray:
    """Where a point of the world is on the picture, in pixels from its upper left."""
    si = mi.SurfaceInteraction3f()
    si.p = mi.Point3f(point)
    ds, _ = camera.sample_direction(si, mi.Point2f(0.5))
    return np.array(ds.uv).ravel()


@pytest.mark.parametrize("lens", [{}, {"cx": 4.5, "cy": 4.75}, {"fl_x": 15.0, "fl_y": 15.0, "cx": 7.0, "cy": 3.0}])
@pytest.mark.parametrize("scale", [1, 4])
def test_cameras_are_pinholes_as_the_file_says(lens: dict[str, float], scale: int) -> None:
    """Against the projection that the formats define: x = cx + fl X / -Z, y = cy - fl Y / -Z, in the camera's axes.

    ``scale``: intrinsics are those of a larger picture.
    """
    given = {key: value * scale for key, value in lens.items()}
    write({**PLAIN, **given, "w": WIDTH * scale, "h": HEIGHT * scale})
    shots = read_capture(Capture(transforms="capture/transforms.json"), Path(), picture_size)
    assert list(shots) == ["shot_0", "shot_1", "shot_2", "shot_3"]
    cameras = {name: shot.camera for name, shot in shots.items()}
    scene, _ = load_scene_for("room.xml", [], None, cameras)
    assert [sensor.id() for sensor in scene.sensors()] == ["other", *shots]
    fl = lens.get("fl_x", 0.5 * WIDTH / math.tan(0.3))
    for frame, camera in zip(FRAMES, scene.sensors()[1:], strict=True):
        for point in ([0.4, 0.2, 0.0], [-0.7, -0.5, 1.0]):
            X, Y, Z, _ = np.linalg.inv(frame["transform_matrix"]) @ [*point, 1]
            expected = lens.get("cx", WIDTH / 2) - fl * X / Z, lens.get("cy", HEIGHT / 2) + fl * Y / Z
            assert seen(camera, point) == pytest.approx(expected, abs=1e-3)


WIDE, HIGH = 0.5 * WIDTH / math.tan(0.3), 0.5 * HEIGHT / math.tan(0.25)


@pytest.mark.parametrize(
    ("table", "frame", "focal"),
    [
        ({"camera_angle_x": 0.6, "camera_angle_y": 0.5}, {}, (WIDE, HIGH)),
        ({"camera_angle_y": 0.5}, {}, (HIGH, HIGH)),
        ({"fl_y": 9.0}, {}, (9.0, 9.0)),
        ({"camera_angle_x": 0.6, "fl_y": 9.0}, {}, (WIDE, 9.0)),
        ({"fl_x": 8.0, "fl_y": 9.0, "camera_angle_x": 0.6, "camera_angle_y": 0.5}, {}, (8.0, 9.0)),
        ({"camera_angle_x": 0.9, "camera_angle_y": 0.5, "fl_y": 9.0}, {"camera_angle_x": 0.6}, (WIDE, WIDE)),
        ({"fl_x": 8.0, "fl_y": 9.0}, {"camera_angle_y": 0.5}, (HIGH, HIGH)),
        ({"camera_angle_x": 0.6, "camera_angle_y": 0.5}, {"fl_x": 20.0}, (20.0, 20.0)),
        ({"fl_x": 8.0, "fl_y": 9.0}, {"camera_angle_x": 0.6, "camera_angle_y": 0.5}, (WIDE, HIGH)),
    ],
)
def test_focal_lengths_of_both_axes_are_read(
    table: dict[str, float], frame: dict[str, float], focal: tuple[float, float]
) -> None:
    """If a frame gives one focal length, those of the file are ignored for both axes: pixels then stay square."""
    write({**table, "frames": [{**FRAMES[0], **frame}]})
    (photo,) = photos_of_json(Path("capture/transforms.json"), picture_size)
    assert (photo.lens.fx, photo.lens.fy) == pytest.approx(focal)


def test_a_job_learns_from_a_capture() -> None:
    result = optimize(make_config(JOB), progress=False)
    assert result.parameters[KEY] == pytest.approx([0.8] * 3, abs=1e-3)
    assert result.test_views == ("shot_0", "shot_3")
    assert set(result.views) == {"shot_0", "shot_1", "shot_2", "shot_3"}
    assert min(each.psnr for each in result.views.values()) > 50
    assert "capture/transforms.json" in result.report.read_text()


def spoil_file(change: dict[str, Any]) -> None:
    write({**PLAIN, "frames": [{**FRAMES[0], **change}, *FRAMES[1:]]})


@pytest.mark.slow
def test_a_run_does_not_go_on_with_other_cameras(folder: Path) -> None:
    first = optimize(make_config({**JOB, "iterations": 2}), progress=False)
    job = first.folder / "config.json"
    job.write_text(job.read_text().replace('"iterations": 2', '"iterations": 3'))
    spoil_file({"transform_matrix": placed(0.01)})
    with pytest.raises(PathreplayError, match="other cameras than when this run was started; restore it"):
        optimize(resume=first.folder, progress=False)
    spoil_file({"colour": "blue"})  # which nobody looks at
    mark = first.folder / "capture.sha256"
    kept = mark.read_bytes()
    for spoil in (mark.unlink, lambda: mark.write_bytes(b"\xff"), lambda: mark.write_bytes(b"0" * 2**20)):
        spoil()
        with pytest.raises(PathreplayError, match="The capture has "):
            optimize(resume=first.folder, progress=False)
    mark.write_bytes(kept)
    assert optimize(resume=first.folder, progress=False).iterations == 3


def test_lenses_of_a_transforms_json_are_undone(folder: Path) -> None:
    """What is seen through a lens is put where the pinhole sees it."""
    u, v = np.meshgrid(np.arange(60) + 0.5, np.arange(40) + 0.5)
    k1, k2, p1, p2 = -0.2, 0.05, 0.01, -0.02

    def dot(x: float, y: float) -> np.ndarray:
        return np.repeat(np.exp(-((u - x) ** 2 + (v - y) ** 2) / 3)[:, :, None], 3, axis=2).astype(np.float32)

    x, y = 0.3, -0.25  # in the plane at distance 1
    r2 = x * x + y * y
    f = 1 + k1 * r2 + k2 * r2 * r2
    bent = x * f + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * f + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
    (folder / "capture" / "bent.exr").write_bytes(exr_bytes(dot(50 * bent[0] + 29, 55 * bent[1] + 21)))
    lens = {"camera_model": "OPENCV", "fl_x": 50, "fl_y": 55, "cx": 29, "cy": 21}
    lens |= {"k1": k1, "k2": k2, "p1": p1, "p2": p2}
    write({**lens, "frames": [{"file_path": "bent.exr", "transform_matrix": placed(0)}]})
    problem = build_problem(make_config({**JOB, "capture": {"transforms": "capture/transforms.json"}}), folder)
    (view,) = problem.views
    centre = [(view.target[:, :, 0] * axis).sum() / view.target[:, :, 0].sum() for axis in (u, v)]
    assert centre == pytest.approx([50 * x + 29, 50 * y + 21], abs=0.1)
    assert view.weight is not None and view.weight.mean() == pytest.approx(1, abs=1e-6)
    assert "taken with a distorting lens" in " ".join(problem.notes)


def test_pictures_are_brought_to_the_width_of_renderings() -> None:
    job = {**JOB, "capture": {"transforms": "capture/transforms.json", "width": 6}, "sensors": ["shot_1", "shot_2"]}
    result = optimize(make_config(job), progress=False)
    assert set(result.views) == {"shot_1", "shot_2"} and result.test_views == ()
    assert picture_size(result.folder / "images" / "target-shot_1.exr") == (6, 4)
    assert result.parameters[KEY] == pytest.approx([0.8] * 3, abs=1e-3)


def test_masks_and_intrinsics_of_a_frame_are_its_own(folder: Path) -> None:
    half = np.repeat([[1.0] * 6 + [0.0] * 6], HEIGHT, axis=0).astype(np.float32)[:, :, None]
    spoiled = np.where(half > 0, 0.8, 0.1).repeat(3, axis=2).astype(np.float32)
    (folder / "capture" / "pictures" / "shot 1.exr").write_bytes(exr_bytes(spoiled))
    (folder / "capture" / "mask.png").write_bytes(png_bytes(half))
    frame = {**FRAMES[1], "mask_path": "mask.png", "fl_x": 20.0}
    write({**PLAIN, "frames": [FRAMES[0], frame]})
    shots = read_capture(Capture(transforms="capture/transforms.json"), Path(), picture_size)
    fovs = [shot.camera["fov"] for shot in shots.values()]
    assert fovs == pytest.approx([math.degrees(0.6), 2 * math.degrees(math.atan(0.3))])
    result = optimize(make_config({**JOB, "capture": {"transforms": "capture/transforms.json"}}), progress=False)
    assert result.parameters[KEY] == pytest.approx([0.8] * 3, abs=1e-3)


def test_a_folder_has_a_mask_for_each_picture(folder: Path) -> None:
    """Called like the picture with .png behind, or in place of its ending; it counts with what alpha leaves."""
    (folder / "masks").mkdir()
    left, top = np.zeros((2, HEIGHT, WIDTH, 1), np.float32)
    left[:, :6], top[:4] = 1, 1
    for k in range(4):
        name = f"shot {k}.exr.png" if k % 2 else f"shot {k}.png"
        (folder / "masks" / name).write_bytes(png_bytes(left))
        see_through = np.concatenate([np.full((HEIGHT, WIDTH, 3), 0.8, np.float32) * top, top], axis=2)
        (folder / "capture" / "pictures" / f"shot {k}.exr").write_bytes(exr_bytes(see_through))
    capture = {"transforms": "capture/transforms.json", "masks": "masks"}
    for view in build_problem(make_config({**JOB, "capture": capture}), folder).views:
        assert view.weight is not None and (view.weight == 2 * left).all()
    lens = {**PLAIN, "k1": 1e-9, "camera_model": "OPENCV"}  # bends nothing that could be seen, and yet is undone
    write(lens)
    for view in build_problem(make_config({**JOB, "capture": capture}), folder).views:
        assert view.weight is not None and view.weight == pytest.approx(2 * left, abs=1e-5)
    with pytest.raises(PathreplayError, match="the capture has masks, which exclude alpha = 'mask'"):
        build_problem(make_config({**JOB, "capture": capture, "target": {"alpha": "mask"}}), folder)
    both = {"capture": {"transforms": "capture/transforms.json"}, "target": {"alpha": "mask"}}
    for view in build_problem(make_config({**JOB, **both}), folder).views:
        assert view.weight is not None and view.weight == pytest.approx(2 * top, abs=1e-5)


def test_masks_are_found_in_the_subfolders_of_their_photos(folder: Path) -> None:
    """Two photos of the same name do not share a mask."""
    frames = [{"file_path": f"pictures/{side}/1.png", "transform_matrix": np.eye(4).tolist()} for side in "ab"]
    (folder / "capture" / "twins.json").write_text(json.dumps({"camera_angle_x": 0.6, "frames": frames}))
    masks = folder / "masks"
    masks.mkdir()
    for side in "ab":
        (folder / "capture" / "pictures" / side).mkdir(parents=True)
        picture = png_bytes(np.full((HEIGHT, WIDTH, 3), 0.5, np.float32))
        (folder / "capture" / "pictures" / side / "1.png").write_bytes(picture)
        (masks / side).mkdir()
        (masks / side / "1.png").write_bytes(png_bytes(np.ones((HEIGHT, WIDTH, 1), np.float32)))
    capture = Capture(transforms="capture/twins.json", masks="masks")
    shots = read_capture(capture, folder, picture_size)
    assert [shot.mask for shot in shots.values()] == [masks / side / "1.png" for side in "ab"]
    (masks / "1.png").write_bytes((masks / "a" / "1.png").read_bytes())
    for side in "ab":
        (masks / side / "1.png").unlink()
    with pytest.raises(PathreplayError, match="would be the mask of both") as told:
        read_capture(capture, folder, picture_size)
    assert "\n" not in str(told.value)


def test_films_of_a_capture_have_alpha_to_be_compared(folder: Path) -> None:
    see_through = np.full((HEIGHT, WIDTH, 4), 0.25, np.float32)
    for k in range(4):
        (folder / "capture" / "pictures" / f"shot {k}.exr").write_bytes(exr_bytes(see_through))
    problem = build_problem(make_config({**JOB, "target": {"alpha": "compare"}, "exposure": {}}), folder)
    assert all(view.target == pytest.approx(see_through) for view in problem.views)
    factors = {variable.key: variable.start * 3 for variable in problem.variables}
    assert exposed(factors, 0, see_through)[2, 3].tolist() == [0.75, 0.75, 0.75, 0.25]


def with_frame(**changes: Any) -> dict[str, Any]:
    return {**PLAIN, "frames": [{**FRAMES[0], **changes}]}


REFUSED: dict[str, tuple[Any, str]] = {
    "no JSON": ("{", "is not a valid transforms.json"),
    "a list": ([1], "is not a valid transforms.json"),
    "no frames": ({"frames": []}, "'frames'"),
    "no lens": ({"frames": FRAMES}, "has none of fl_x, fl_y, camera_angle_x and camera_angle_y"),
    "another lens": ({**PLAIN, "camera_model": "EQUIRECTANGULAR"}, "camera_model 'EQUIRECTANGULAR'; undistort"),
    "k4 of whom": ({**PLAIN, "k1": 0.1, "k4": -0.01}, "has k4 = -0.01, which OpenCV and Nerfstudio define differently"),
    "bent without end": ({**PLAIN, "k1": 1e300}, "is not a valid transforms.json ('k1'"),
    "other shape": ({**PLAIN, "w": 12, "h": 12}, "is 12 x 12 in the capture, but its file is 12 x 8"),
    "no picture": (with_frame(file_path="gone"), "image 'gone' does not exist"),
    "no name": (with_frame(file_path="/"), "is a folder"),
    "a long name": (with_frame(file_path="x" * 4096), "cannot be reached"),
    "a far camera": (with_frame(transform_matrix=placed(1e300)), "'frames.0.transform_matrix"),
    "a NUL": (with_frame(file_path="go\0ne"), "cannot be reached"),
    "sheared": (with_frame(transform_matrix=np.diag([1, 2, 1, 1]).tolist()), "is not a rigid motion"),
    "a mirror": (with_frame(transform_matrix=np.diag([-1, 1, 1, 1]).tolist()), "is not a rigid motion"),
    "not finite": (json.dumps(PLAIN).replace("0.6", "NaN"), "is not a valid transforms.json"),
    "two names": (
        {**PLAIN, "frames": [FRAMES[0], {**FRAMES[0], "file_path": "./pictures/shot_0"}]},
        "The images './pictures/shot 0' and './pictures/shot_0' of the capture would both get the name 'shot_0'",
    ),
    "twice": ({**PLAIN, "frames": [FRAMES[0], FRAMES[0]]}, "would both get the name 'pictures_shot_0'"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_captures_that_cannot_be_used_are_refused_in_one_line(case: str, folder: Path) -> None:
    table, words = REFUSED[case]
    write(table)
    with pytest.raises(PathreplayError) as told:
        optimize(make_config(JOB), progress=False)
    assert words in str(told.value) and "\n" not in str(told.value)
    assert not (folder / "runs").exists()


JOBS_REFUSED = {
    "two sources": (
        {"capture": {"transforms": "a.json", "colmap": "sparse/0"}},
        "give either 'transforms' (a transforms.json)",
    ),
    "no source": ({"capture": {"width": 6}}, "give either 'transforms' (a transforms.json) or 'colmap'"),
    "folder of a file": ({"capture": {"transforms": "a.json", "images": "b"}}, "'images' applies to 'colmap' only"),
    "no masks": ({"capture": {"transforms": "capture/transforms.json", "masks": "gone"}}, "has no shot 0.exr.png"),
    "all of a weight": ({"view_weights": {"shot_0": 2.0}}, "view_weights: 'shot_0' is a test view"),
    "weight of nobody": ({"view_weights": {"shot_9": 2.0}}, "No sensor 'shot_9' in the scene"),
    "weight of another": ({"view_weights": {"other": 2.0}, "sensors": ["shot_1"]}, "'other' is not among 'sensors'"),
    "no alpha to compare": ({"target": {"alpha": "compare"}}, "has no alpha channel for alpha = 'compare'"),
    "no file": ({"capture": {"transforms": "gone.json"}}, "gone.json; give the path of a transforms.json"),
    "pictures twice": ({"target": {"images": ["a.png"]}}, "come from 'capture'; remove either 'target.images'"),
    "another camera": ({"sensors": ["other", "shot_1"]}, "'other' is not a camera of the capture"),
    "no alpha": ({"target": {"alpha": "mask"}}, "has no alpha channel for alpha = 'mask'"),
    "every": ({"capture": {"transforms": "capture/transforms.json", "test_every": 1}}, "capture.test_every"),
    "misspelt": ({"capture": {"transform": "capture/transforms.json"}}, "did you mean 'transforms'?"),
}


@pytest.mark.parametrize("case", JOBS_REFUSED)
def test_jobs_that_do_not_go_with_a_capture_are_refused_in_one_line(case: str) -> None:
    changes, words = JOBS_REFUSED[case]
    with pytest.raises(PathreplayError) as told:
        optimize(make_config({**JOB, **changes}), progress=False)
    assert words in str(told.value) and "\n" not in str(told.value)


def test_an_object_of_the_same_name_is_told(folder: Path) -> None:
    (folder / "room.xml").write_text(SCENE.replace('id="wall"', 'id="shot_1"'))
    with pytest.raises(PathreplayError, match="has an object 'shot_1'"):
        optimize(make_config({**JOB, "parameters": [{"key": "shot_1.bsdf.reflectance.value"}]}), progress=False)


def small_capture(folder: Path) -> tuple[Path, Path]:
    """The folder of the example, and one with twelve small pictures that its script has made."""
    example, pictures = ROOT / "examples" / "capture", folder / "small"
    script = [sys.executable, str(example / "make_capture.py"), str(pictures)]
    subprocess.run([*script, "--views", "12", "--width", "24", "--spp", "256"], check=True, capture_output=True)
    return example, pictures


@pytest.mark.slow
def test_the_example_finds_texture_roughness_and_sky(folder: Path) -> None:
    """A small version, by its own script and config."""
    example, pictures = small_capture(folder)
    assert len(json.loads((pictures / "transforms.json").read_text())["frames"]) == 12
    changes = [f"capture.transforms={pictures / 'transforms.json'}", "iterations=300", "eval_spp=64"]
    result = optimize(example / "config.toml", output="found", progress=False, define=changes)
    assert result.test_views == ("00", "06")
    before = json.loads((result.folder / "views.json").read_text())
    for name in result.test_views:
        assert result.views[name].psnr > before[name]["start"]["psnr"] + 6
    assert result.parameters["ball.bsdf.roughness.value"].item() < 0.4
    paint = runpy.run_path(str(example / "make_capture.py"))["paint"]()
    found = result.parameters["ball.bsdf.base_color.data"]
    assert np.corrcoef(found[4:12].ravel(), paint[4:12].ravel())[0, 1] > 0.8


@pytest.mark.slow
def test_a_run_in_stages_with_exposures_comes_out_with_its_cameras(folder: Path) -> None:
    """Its scene renders to the pictures that the run shows, less their exposures, which are told beside it."""
    paint = np.random.default_rng(5).uniform(0.1, 0.9, (16, 16, 3)).astype(np.float32)
    (folder / "paint.exr").write_bytes(exr_bytes(paint))
    texture = '<texture type="bitmap" name="reflectance"><string name="filename" value="paint.exr"/></texture>'
    (folder / "room.xml").write_text(SCENE.replace('<rgb name="reflectance" value="0.5"/>', texture))
    for k in range(4):
        (folder / f"capture/pictures/shot {k}.exr").write_bytes(
            exr_bytes(np.full((HEIGHT, WIDTH, 3), 0.2 * (k + 1), "f4"))
        )
    key = "wall.bsdf.reflectance.data"
    changes = {
        "parameters": [{"key": key, "lower": 0.0, "learning_rate": 0.01}],
        "exposure": {"learning_rate": 0.1},
        "iterations": 4,
        "stages": [{"iterations": 2, "downscale": 2}, {"iterations": 2, "max_depth": 3}],
        "spp": 4,
        "eval_spp": 256,
        "output": "run",
    }
    result = optimize(make_config({**JOB, **changes}), progress=False)
    assert np.ptp(result.parameters["exposure"]) > 0.1
    export_run(result.folder)
    scene = mi.load_file(str(folder / "run/export/scene.xml"))
    numbers = json.loads((folder / "run/export/values.json").read_text())
    assert np.ravel(numbers["exposure"]) == pytest.approx(result.parameters["exposure"].ravel())
    np.testing.assert_allclose(mi.traverse(scene)[key], result.parameters[key], atol=1e-6)
    views = {sensor.id(): n for n, sensor in enumerate(scene.sensors())}
    shown = [read_image(folder / f"run/images/result-shot_{k}.exr") for k in range(4)]
    for k in range(4):
        image = np.array(mi.render(scene, sensor=views[f"shot_{k}"], spp=256))
        errors = [np.abs(exposed(result.parameters, k, image) - each).mean() for each in shown]
        assert errors[k] < 0.02 * shown[k].mean() and errors[k] == min(errors), errors


@pytest.mark.slow
def test_exposures_of_a_capture_are_found(folder: Path) -> None:
    """Of the example's pictures at exposures of half to twice, with noise; texture, roughness and sky are given."""
    example, pictures = small_capture(folder)
    logs = np.random.default_rng(3).uniform(-0.7, 0.7, 12)
    factors = np.exp(logs - logs[[k for k in range(12) if k % 6]].mean())
    for k, factor in enumerate(factors):
        path = pictures / f"{k:02d}.exr"
        path.write_bytes(exr_bytes(read_image(path) * np.float32(factor)))
    truth = runpy.run_path(str(example / "make_capture.py"))
    for name in ("paint", "sky"):
        (folder / f"{name}.exr").write_bytes(exr_bytes(truth[name]()))
    known = [folder / "paint.exr", truth["ROUGHNESS"], folder / "sky.exr"]
    changes = [f"parameters.{n}.initial={value}" for n, value in enumerate(known)]
    changes += [f"parameters.{n}.learning_rate=1e-9" for n in range(3)]
    changes += [f"capture.transforms={pictures / 'transforms.json'}", "exposure.learning_rate=0.1", "iterations=60"]
    result = optimize(
        example / "config.toml",
        output="found",
        progress=False,
        define=[*changes, "view_batch_size=10", "eval_spp=64"],
    )
    assert result.parameters["exposure"].ravel() == pytest.approx(factors, rel=0.03)


def test_pictures_go_with_their_cameras_whatever_views_are_called(folder: Path) -> None:
    """A sensor without a name is called view-0, and so is the first picture of this capture."""
    (folder / "room.xml").write_text(SCENE.replace(' id="other"', ""))
    for k in range(4):
        (folder / "capture" / "pictures" / f"shot {k}.exr").rename(folder / "capture" / f"view-{k}.exr")
    write({**PLAIN, "frames": [{**frame, "file_path": f"view-{k}.exr"} for k, frame in enumerate(FRAMES)]})
    config = make_config({**JOB, "sensors": ["view-2", "view-0"], "capture": {"transforms": "capture/transforms.json"}})
    problem = build_problem(config, folder)
    assert [problem.scene.sensors()[view.sensor].id() for view in problem.views] == ["view-2", "view-0"]
    for k in range(4):
        grey = np.full((HEIGHT, WIDTH, 3), k / 10, np.float32)
        (folder / "capture" / f"view-{k}.exr").write_bytes(exr_bytes(grey))
    assert [view.target.mean() for view in build_problem(config, folder).views] == pytest.approx([0.2, 0.0])


def test_what_is_behind_transparent_pixels_does_not_bleed(folder: Path) -> None:
    """A PNG holds any colour where it is transparent, here black beside white."""
    opaque = np.repeat([[1.0] * 5 + [0.0] * 7], HEIGHT, axis=0).astype(np.float32)[:, :, None]
    (folder / "capture" / "alpha.png").write_bytes(png_bytes(np.concatenate([opaque] * 4, axis=2)))
    write(with_frame(file_path="alpha.png"))
    changes = {"capture": {"transforms": "capture/transforms.json", "width": 6}, "target": {"alpha": "mask"}}
    (view,) = build_problem(make_config({**JOB, **changes}), folder).views
    assert view.weight is not None
    counts = view.weight[:, :, 0] > 0.05
    assert counts.any() and view.target[counts] == pytest.approx(1.0, abs=0.02)


FOGGY = """<scene version="3.0.0">
  <shape type="cube" id="room"><transform name="to_world"><scale value="50"/></transform>
  <bsdf type="null"/><medium type="homogeneous" name="interior" id="fog"><float name="sigma_t" value="0.1"/>
  <float name="albedo" value="0"/></medium></shape><emitter type="constant" id="sky"/></scene>"""


def test_cameras_inside_a_medium(folder: Path) -> None:
    """A camera sees the constant sky through the fog that surrounds it, up to the wall at its distance."""
    (folder / "room.xml").write_text(FOGGY)
    job = {**JOB, "parameters": [{"key": "sky.radiance.value"}], "integrator": {"type": "pathreplay", "max_depth": 1}}
    job["capture"] = {**JOB["capture"], "medium": "fog"}
    problem = build_problem(make_config(job), folder)
    sensor = problem.scene.sensors()[0]
    image = np.array(mi.render(problem.scene, sensor=sensor, integrator=problem.integrator, spp=256))
    assert image.mean() == pytest.approx(np.exp(-0.1 * 55), rel=0.3)  # from z = 5 to the far wall at -50
    job["capture"]["medium"] = "mist"
    with pytest.raises(PathreplayError, match=r"capture\.medium 'mist' is the id of no medium .*; it has fog"):
        build_problem(make_config(job), folder)
