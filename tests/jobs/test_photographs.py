"""Jobs from photographs: what is read, what is written, what is refused, and a run from the first to the last file."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mitsuba as mi
import numpy as np
import PIL.Image
import pytest

import pathreplay
from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.schema import load_config
from pathreplay.inverse.dataset.photos import Photo
from pathreplay.inverse.dataset.undistortion import Lens
from pathreplay.inverse.images.io import exr_bytes, png_bytes
from pathreplay.jobs.photographs.pictures import BLOCK, frames_of, prepare
from pathreplay.jobs.photographs.plan import LEAST, PASSES, TRACED, Speed, plan_stages
from pathreplay.jobs.photographs.reading import find_photos
from pathreplay.jobs.photographs.region import find_region, sky_rows
from pathreplay.jobs.photographs.timing import TIMED_SPP, measure_poses
from pathreplay.output.surface_scene import export_surface

VIEWS, SIZE, FOV = 10, 32, 0.75


def looking(back: np.ndarray) -> np.ndarray:
    """Camera to world, in OpenGL's axes, of a camera that looks at the point (1, 0, 0)."""
    right = np.cross([0, 1, 0], back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 2] = right, np.cross(back, right), back
    matrix[:3, 3] = 4 * back + np.array([1, 0, 0])
    return matrix


def cameras() -> list[np.ndarray]:
    """Cameras on all sides."""
    heights = [0.85 * (1 - 2 * (k + 0.5) / VIEWS) for k in range(VIEWS)]
    turns = [k * math.pi * (3 - math.sqrt(5)) for k in range(VIEWS)]
    return [
        looking(np.array([math.sqrt(1 - y * y) * math.cos(turn), y, math.sqrt(1 - y * y) * math.sin(turn)]))
        for y, turn in zip(heights, turns, strict=True)
    ]


def painted(colours: np.ndarray) -> dict[str, Any]:
    """A lamp of many colours."""
    bitmap = mi.Bitmap(colours.astype(np.float32))
    return {"type": "area", "radiance": {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "nearest"}}


def striped_ball(radius: float) -> dict[str, Any]:
    stripes = np.where(np.arange(8)[None, :, None] % 2, [0.9, 0.2, 0.1], [0.1, 0.3, 0.8]) * np.ones((4, 1, 1))
    return {"type": "sphere", "center": [1, 0, 0], "radius": radius, "emitter": painted(stripes)}


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photos of a striped ball at (1, 0, 0) in front of a grey sky."""
    scene = {"type": "scene", "ball": striped_ball(1.0), "sky": {"type": "constant", "radiance": 0.4}}
    return take_photos(scene, cameras(), tmp_path_factory.mktemp("capture"))


@pytest.fixture(scope="module")
def wall_capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photos from one side of a striped ball in front of a wall of many colours."""
    place = mi.ScalarTransform4f().translate([1, 0, -1.2]).scale([8, 8, 1])
    paint = np.tile(np.random.default_rng(0).uniform(0.1, 0.9, (8, 8, 3)), (2, 2, 1))
    wall = {"type": "rectangle", "to_world": place, "emitter": painted(paint)}
    turns = [(math.radians(-45 + 90 * i / 4), math.radians(-20 + 20 * j)) for j in range(3) for i in range(5)]
    backs = [(math.sin(a) * math.cos(e), math.sin(e), math.cos(a) * math.cos(e)) for a, e in turns]
    scene = {"type": "scene", "ball": striped_ball(0.8), "wall": wall}
    return take_photos(scene, [looking(np.array(back)) for back in backs], tmp_path_factory.mktemp("wall"))


def take_photos(described: dict[str, Any], placed: list[np.ndarray], folder: Path, depth: int = 1) -> Path:
    scene = mi.load_dict(described)
    frames = []
    for k, matrix in enumerate(placed):
        film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
        place = mi.ScalarTransform4f((matrix @ np.diag([-1.0, 1, -1, 1])).tolist())
        camera = mi.load_dict({"type": "perspective", "fov": math.degrees(FOV), "to_world": place, "film": film})
        integrator = mi.load_dict({"type": "path", "max_depth": depth})
        image = np.array(mi.render(scene, sensor=camera, integrator=integrator, spp=64, seed=k))
        (folder / f"{k}.png").write_bytes(png_bytes(image))
        frames.append({"file_path": f"{k}.png", "transform_matrix": matrix.tolist()})
    write(folder, frames)
    return folder


def write(folder: Path, frames: list[dict[str, Any]]) -> None:
    table = {"camera_angle_x": FOV, "w": SIZE, "h": SIZE, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(table))


def test_a_job_is_written(capture: Path, tmp_path: Path) -> None:
    written = pathreplay.from_photos(capture, tmp_path / "job", minutes=1.0)
    config = load_config(written.job)
    assert config.capture is not None
    assert config.capture.test_every == 5
    assert {entry.key.split(".")[-2] for entry in config.parameters} == {"sigma_t", "radiance", "sky"}
    assert (written.folder / "images" / "view_3.png").is_file()
    assert not (written.folder / "masks").exists()
    scene = mi.load_file(str(written.folder / "scene.xml"))
    box = scene.shapes()[0].bbox()
    assert (np.array(box.min) < [0, -1, -1]).all()
    assert (np.array(box.max) > [2, 1, 1]).all()


def test_the_region_is_what_cameras_see(capture: Path) -> None:
    region = find_region(frames_of(find_photos(capture).photos, None))
    np.testing.assert_allclose(region.centre, [1, 0, 0], atol=0.4)
    assert (region.size > 2).all()
    assert (region.size < 6.5).all()


@pytest.mark.parametrize(
    ("width", "height", "focal", "rows"),
    [(160, 90, 45, 16), (90, 160, 45, 16), (160, 90, 150, 32), (160, 90, 300, 64), (160, 90, 9000, 128)],
)
def test_the_sky_is_as_fine_as_photographs_need(
    capture: Path, width: int, height: int, focal: float, rows: int
) -> None:
    """A sky of 16 rows has 8 pixels along 90 degrees."""
    frames = [
        replace(frame, width=width, height=height, focal=focal)
        for frame in frames_of(find_photos(capture).photos, None)
    ]
    assert sky_rows(frames) == rows


def test_frames_without_an_image_are_left_out(capture: Path, tmp_path: Path) -> None:
    frames = [{"file_path": str(capture / f"{k}.png"), "transform_matrix": m.tolist()} for k, m in enumerate(cameras())]
    write(tmp_path, [*frames, {**frames[0], "file_path": "lost.png"}])
    found = find_photos(tmp_path)
    assert len(found.photos) == VIEWS
    assert "lost.png" in found.notes()[0]
    write(tmp_path, [{**frames[0], "file_path": "lost.png"}, *frames[:2]])
    with pytest.raises(PathreplayError, match=r"2 of 3 images exist in .*; add the image files"):
        find_photos(tmp_path)


@pytest.mark.parametrize(("count", "others"), [(1, ""), (2, " (and 1 other)"), (3, " (and 2 others)")])
def test_ignored_metadata_of_photos_is_told(count: int, others: str, capture: Path, tmp_path: Path) -> None:
    """Photos that a phone has marked as turned by 90 degrees."""
    shutil.copytree(capture, tmp_path / "turned")
    turned = PIL.Image.Exif()
    turned[274] = 6
    for name in ("1.png", "2.png", "3.png")[:count]:
        with PIL.Image.open(capture / name) as picture:
            picture.save(tmp_path / "turned" / name, exif=turned)
    notes = pathreplay.from_photos(tmp_path / "turned", tmp_path / "job", minutes=0.01).notes
    assert any(note.startswith(f"photo '1.png'{others} has an Exif orientation: it is ignored") for note in notes)


@pytest.mark.parametrize(
    ("matrix", "told"),
    [
        (np.diag([2.0, 2, 2, 1]), r"its axes have the lengths 2, 2, 2\)"),
        (np.array([[1, 0.6, 0, 0], [0, 0.8, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), r"its axes are not at right angles"),
        (np.diag([-1.0, 1, 1, 1]), r"it contains a reflection"),
        (np.diag([1.0, 1, 1, 2]), r"its last row is \[0\.0, 0\.0, 0\.0, 2\.0\]"),
    ],
)
def test_poses_that_are_not_rigid_are_told_of_the_own_file(
    matrix: np.ndarray, told: str, capture: Path, tmp_path: Path
) -> None:
    places = cameras()
    places[2] = places[2] @ matrix
    frames = [{"file_path": str(capture / f"{k}.png"), "transform_matrix": m.tolist()} for k, m in enumerate(places)]
    write(tmp_path, frames)
    with pytest.raises(PathreplayError, match=told) as error:
        pathreplay.from_photos(tmp_path, tmp_path / "job", minutes=0.01)
    assert str(error.value).startswith(f"{tmp_path}/transforms.json: frame")
    assert not (tmp_path / "job").exists()


def test_what_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(PathreplayError, match=r"neither transforms.json nor a COLMAP model .* recover the poses"):
        find_photos(tmp_path)
    with pytest.raises(PathreplayError, match="No folder"):
        find_photos(tmp_path / "nowhere")
    (tmp_path / "a.stl").write_bytes(b"")
    for options, told in [
        ({"minutes": -1.0}, "minutes is -1.0"),
        ({"test_every": 1}, "test_every is 1"),
        ({"test_every": 2.5}, "test_every is 2.5; give a whole number"),
        ({"width": 4}, "width is 4"),
    ]:
        with pytest.raises(PathreplayError, match=told):
            pathreplay.from_photos(tmp_path, tmp_path / "job", **options)
    assert not (tmp_path / "job").exists()


def test_no_mesh_of_another_kind(capture: Path, tmp_path: Path) -> None:
    (tmp_path / "a.stl").write_bytes(b"")
    with pytest.raises(PathreplayError, match="is not a PLY or OBJ file"):
        pathreplay.from_photos(capture, tmp_path / "job", mesh=tmp_path / "a.stl")


def test_a_given_mesh_gets_a_reflectance(capture: Path, tmp_path: Path) -> None:
    mi.load_dict({"type": "cube"}).write_ply(str(tmp_path / "cube.ply"))
    written = pathreplay.from_photos(capture, tmp_path / "job", mesh=tmp_path / "cube.ply", minutes=0.01)
    params = mi.traverse(mi.load_file(str(written.folder / "scene.xml")))
    keys = [entry.key for entry in load_config(written.job).parameters]
    assert set(keys) <= set(params.keys())
    assert any("reflectance" in key or "vertex_color" in key for key in keys)


@pytest.mark.parametrize("alpha", ["", " 255"])
def test_the_colours_of_a_given_mesh_are_replaced(alpha: str, capture: Path, tmp_path: Path) -> None:
    """Scanners write PLY files with a colour per vertex, sometimes with alpha, and without texture coordinates."""
    channels = ["red", "green", "blue"] + ["alpha"] * bool(alpha)
    head = ["ply", "format ascii 1.0", "element vertex 3", *(f"property float {axis}" for axis in "xyz")]
    head += [*(f"property uchar {name}" for name in channels), "element face 1"]
    head += ["property list uchar int vertex_indices", "end_header"]
    rows = [f"0 0 0 255 0 0{alpha}", f"1 0 0 0 255 0{alpha}", f"0 1 0 0 0 255{alpha}", "3 0 1 2"]
    (tmp_path / "scan.ply").write_text("\n".join([*head, *rows, ""]))
    written = pathreplay.from_photos(capture, tmp_path / "job", mesh=tmp_path / "scan.ply", minutes=0.01)
    colours = mi.traverse(mi.load_file(str(written.folder / "scene.xml")))["mesh.vertex_color"]
    assert np.array(colours) == pytest.approx([0.5] * 9)


def test_prepared_images_are_those_of_a_pinhole(tmp_path: Path) -> None:
    """A photo of a distorting lens with oblong pixels, of a pattern whose undistorted image is known."""
    lens = Lens(160, 120, 150.0, 165.0, 84.0, 58.0, (0.08, -0.03, 0.0, 0.0, 0.0, 0.0), (0.002, -0.001))

    def pattern(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.stack([0.5 + 0.4 * np.sin(9 * x), 0.5 + 0.4 * np.cos(7 * y), 0.5 + 0.3 * x * y], axis=-1)

    u, v = np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5)
    x, y = (u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy
    x0, y0 = x.copy(), y.copy()
    for _ in range(50):  # the point of the plane whose distorted image is the pixel
        bent = lens.bent(x, y)
        x, y = x + x0 - bent[0], y + y0 - bent[1]
    (tmp_path / "a.exr").write_bytes(exr_bytes(pattern(x, y).astype(np.float32)))
    photo = Photo("a", "a.exr", tmp_path / "a.exr", None, lens, np.eye(4))
    (frame,) = frames_of([photo], 80)
    prepared = prepare(photo, frame)
    assert prepared.image.shape == (frame.height, frame.width, 3)
    assert frame.width % BLOCK == frame.height % BLOCK == 0
    u, v = np.meshgrid(np.arange(frame.width) + 0.5, np.arange(frame.height) + 0.5)
    expected = pattern((u - frame.cx) / frame.focal, (v - frame.cy) / frame.focal)
    inside = np.ones(u.shape, bool) if prepared.weight is None else prepared.weight[:, :, 0] > 0.99
    assert inside.mean() > 0.8
    assert np.abs(prepared.image - expected)[inside].max() < 0.03


@pytest.mark.parametrize(("channels", "words"), [(5, "has 5 channels, but a photo has 3"), (3, "NaN or infinite")])
def test_photos_that_are_none_are_told(channels: int, words: str, tmp_path: Path) -> None:
    image = np.ones((16, 16, channels), np.float32)
    image[0, 0, 0] = 1 if channels > 3 else np.nan
    mi.Bitmap(image).write(str(tmp_path / "a.exr"))
    photo = Photo("a", "a.exr", tmp_path / "a.exr", None, Lens(16, 16, 16.0, 16.0, 8.0, 8.0), np.eye(4))
    with pytest.raises(PathreplayError, match=words):
        prepare(photo, frames_of([photo], 16)[0])


def test_stages_fit_into_the_time() -> None:
    speed = Speed(samples=1e6, tracing=0.05, compiling=1.0)
    plan = plan_stages(speed, 30, 40, 160, 280)
    assert [stage.downscale for stage in plan] == [8, 4, 2, 1]
    assert [stage.first for stage in plan] == [True, False, False, False]
    resolutions = [stage.resolution for stage in plan]
    assert resolutions == sorted(set(resolutions))
    short = plan_stages(speed, 0.2, 40, 160, 280)
    assert len(short) < len(plan)
    assert all(stage.iterations >= LEAST for stage in plan + short)


def test_stages_that_refine_poses_are_planned_with_their_own_speed() -> None:
    speed, posed = Speed(samples=9e6, tracing=0.05, compiling=1.0), Speed(samples=9e5, tracing=0.6, compiling=10.0)
    free, refined = (plan_stages(speed, 30, 40, 160, 280, each) for each in (None, posed))
    assert free[0].spp == refined[0].spp and free[0].iterations > refined[0].iterations > 0.4 * free[0].iterations
    assert all(b.iterations < 0.5 * a.iterations for a, b in zip(free[1:], refined[1:], strict=True))
    assert [stage.iterations for stage in plan_stages(speed, 1, 40, 160, 280, posed)] == [LEAST]


@pytest.mark.usefixtures("without_edge_terms")  # the clock is simulated
def test_passes_with_poses_are_measured(capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Planned is what was measured: a clock says 7 s of the first pass, at least 1 s of small and 3 s of large ones."""
    written = pathreplay.from_photos(capture, tmp_path / "job", minutes=0.01)
    frames = frames_of(find_photos(capture).photos[:3], 16)
    times = iter([time for seconds in (7, 2, 1, 2, 4, 3, 3) for time in (0.0, float(seconds))])
    monkeypatch.setattr("pathreplay.jobs.photographs.timing.time", SimpleNamespace(perf_counter=times.__next__))
    posed = measure_poses(written.folder / "scene.xml", frames, 1.0)
    samples = frames[1].width * frames[1].height * TIMED_SPP
    assert PASSES * samples / posed.samples == pytest.approx(3 - 1)
    assert (TRACED * posed.tracing, TRACED * posed.compiling) == pytest.approx((1, 7 - 1))


def test_a_fast_machine_renders_more_samples_in_about_the_same_number_of_iterations() -> None:
    slow, fast = (plan_stages(Speed(speed, 0.05, 1.0), 30, 40, 160, 280) for speed in (9e6, 200e6))
    assert [stage.downscale for stage in slow] == [stage.downscale for stage in fast]
    for a, b in zip(slow, fast, strict=True):
        assert b.spp > a.spp and 0.7 * a.iterations < b.iterations < 2 * a.iterations


@pytest.mark.slow
def test_from_photos_to_a_mesh(wall_capture: Path, tmp_path: Path) -> None:
    """Images come close to the photos, and plain Mitsuba shows the ball in front of the wall."""
    written = pathreplay.from_photos(wall_capture, tmp_path / "job", minutes=3.0)
    result = pathreplay.optimize(written.job, output=tmp_path / "run", progress=False)
    rows = json.loads((result.folder / "views.json").read_text()).values()
    print(result.describe())
    assert [row["is_test"] for row in rows] == [True, False, False, False, False] * 3
    assert all(row["result"]["psnr"] > row["start"]["psnr"] + 4 for row in rows if not row["is_test"])
    export_surface(result.folder)
    scene = mi.load_file(str(result.folder / "surface" / "scene.xml"))
    target = np.array(mi.Bitmap(str(result.folder / "images" / "target-view_1.exr")))
    spread = np.abs(target - target.mean((0, 1))).mean()
    assert np.abs(np.array(mi.render(scene, sensor=1, spp=16)) - target).mean() < 0.8 * spread


@pytest.mark.slow
def test_a_given_mesh_gets_its_texture_back(tmp_path: Path) -> None:
    """The geometry is given; its texture and the sky are recovered, up to a common factor per colour."""
    (tmp_path / "photos").mkdir()
    mi.load_dict({"type": "cube", "to_world": mi.ScalarTransform4f().translate([1, 0, 0])}).write_ply(
        str(tmp_path / "cube.ply")
    )
    rng = np.random.default_rng(3)
    truth = rng.uniform(0.1, 0.9, (4, 4, 3)).repeat(8, 0).repeat(8, 1)
    paint = {"type": "diffuse", "reflectance": {"type": "bitmap", "data": mi.TensorXf(truth), "raw": True}}
    sky = np.linspace(1.0, 0.2, 16, dtype=np.float32)[:, None, None] * np.ones((1, 32, 3), np.float32)
    scene = {
        "type": "scene",
        "cube": {"type": "ply", "filename": str(tmp_path / "cube.ply"), "bsdf": {"type": "twosided", "bsdf": paint}},
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(sky)},
    }
    photos = take_photos(scene, cameras(), tmp_path / "photos", 3)
    written = pathreplay.from_photos(photos, tmp_path / "job", mesh=tmp_path / "cube.ply", minutes=2.0)
    result = pathreplay.optimize(written.job, output=tmp_path / "run", progress=False)
    rows = [row for row in json.loads((result.folder / "views.json").read_text()).values() if row["is_test"]]
    print(result.describe())
    assert all(row["result"]["psnr"] > row["start"]["psnr"] + 6 for row in rows)
    found = np.array(result.parameters["mesh.bsdf.brdf_0.reflectance.data"]).reshape(32, 8, 32, 8, 3).mean((1, 3))
    correlations = [np.corrcoef(found[..., k].ravel(), truth[..., k].ravel())[0, 1] for k in range(3)]
    assert min(correlations) > 0.95
