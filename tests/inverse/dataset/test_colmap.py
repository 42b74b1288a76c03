"""COLMAP's models: cameras, lenses and pictures are where pycolmap says that they are.

`tests/data/colmap` was written by pycolmap 4.2.1: seven images, each by a lens of another model, as text and binary,
and the pixels at which it sees four points of the world.
"""

from __future__ import annotations

import json
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.target_options import Capture
from pathreplay.inverse.dataset.capture import Shot, read_capture
from pathreplay.inverse.dataset.undistortion import Lens
from pathreplay.inverse.images.io import exr_bytes, picture_size, png_bytes
from pathreplay.inverse.problem.problem import build_problem
from pathreplay.jobs import make_config
from pathreplay.scenes.loading import load_scene_for
from places import DATA

DATA = DATA / "colmap"
TOLD = json.loads((DATA / "pixels.json").read_text())
POINTS, PIXELS = np.array(TOLD["points"]), {name: np.array(found) for name, found in TOLD["pixels"].items()}
WIDTH, HEIGHT = 120, 80
SCENE = """<scene version="3.0.0">
  <shape type="rectangle" id="wall"><bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf></shape>
  <emitter type="constant"/>
</scene>"""


def dots(places: np.ndarray) -> np.ndarray:
    """A picture of soft dots, one channel for each place (pixels, from the upper left corner)."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    squares = [(u - x) ** 2 + (v - y) ** 2 for x, y in places]
    return np.exp(-np.stack(squares, axis=2) / (2 * 2.0**2)).astype(np.float32)


def centres(picture: np.ndarray) -> np.ndarray:
    """Where the dots of a picture are."""
    u, v = np.meshgrid(np.arange(picture.shape[1]) + 0.5, np.arange(picture.shape[0]) + 0.5)
    weight = np.where(picture > 0.05, picture, 0).astype(np.float64)
    return np.stack([(weight * axis[:, :, None]).sum((0, 1)) for axis in (u, v)], 1) / weight.sum((0, 1))[:, None]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "room.xml").write_text(SCENE)
    shutil.copytree(DATA / "binary", tmp_path / "sparse" / "0")
    shutil.copytree(DATA / "text", tmp_path / "text" / "0")
    (tmp_path / "images" / "sub").mkdir(parents=True)
    for name in PIXELS:
        (tmp_path / "images" / name).write_bytes(png_bytes(np.ones((HEIGHT, WIDTH, 3), np.float32)))
    return tmp_path


def shots_of(model: str = "sparse/0", **more: Any) -> dict[str, Shot]:
    return read_capture(Capture(colmap=model, **more), Path(), picture_size)


def test_a_model_that_is_a_link_has_the_images_beside_the_link(folder: Path) -> None:
    (folder / "some" / "where").mkdir(parents=True)
    (folder / "sparse" / "0").rename(folder / "some" / "where" / "else")
    (folder / "sparse" / "0").symlink_to(folder / "some" / "where" / "else")
    assert all(shot.image.is_relative_to(folder / "images") for shot in shots_of().values())


def seen(shots: dict[str, Shot]) -> dict[str, np.ndarray]:
    """Where the cameras of the scene see the points: a row for each."""
    import mitsuba as mi

    scene, _ = load_scene_for("room.xml", [], None, {name: shot.camera for name, shot in shots.items()})
    found = {}
    for sensor in scene.sensors():
        si = mi.SurfaceInteraction3f()
        rows = []
        for point in POINTS:
            si.p = mi.Point3f(point.tolist())
            ds, _ = sensor.sample_direction(si, mi.Point2f(0.5))
            rows.append(np.array(ds.uv).ravel())
        found[sensor.id()] = np.array(rows)
    return found


@pytest.mark.parametrize("model", ["sparse/0", "text/0"])
def test_points_are_seen_where_pycolmap_sees_them(model: str, folder: Path) -> None:
    shots = shots_of(model)
    assert list(shots) == [f"shot_{k}" for k in range(7)]
    places = seen(shots)
    for (name, pixels), shot in zip(PIXELS.items(), shots.values(), strict=True):
        lens = shot.lens or Lens(WIDTH, HEIGHT, 150, 150, 61, 39)
        straight = (places[Path(name).stem.replace(" ", "_")] - [lens.cx, lens.cy]) / lens.fx
        x, y, there = lens.bent(*straight.T)
        bent = np.stack([lens.fx * x + lens.cx, lens.fy * y + lens.cy], 1)
        assert there.all() and bent == pytest.approx(pixels, abs=2e-3), name
    assert [shot.lens is None for shot in shots.values()] == [True] + [False] * 6


@pytest.mark.parametrize("name", PIXELS)
def test_what_a_lens_bends_is_put_where_the_pinhole_sees_it(name: str, folder: Path) -> None:
    """Dots at pycolmap's pixels are, in the resampled picture, where the camera of the scene sees the points."""
    shots = shots_of()
    key = Path(name).stem.replace(" ", "_")
    picture = dots(PIXELS[name])
    if (lens := shots[key].lens) is not None:
        picture, there = lens.undone(picture)
        assert 0.7 < there.mean() <= 1
    assert centres(picture) == pytest.approx(seen(shots)[key], abs=0.1)


def test_a_job_takes_pictures_and_masks_of_a_model(folder: Path) -> None:
    masks = folder / "masks" / "sub"
    masks.mkdir(parents=True)
    half = np.repeat([[1.0] * 60 + [0.0] * 60], HEIGHT, axis=0).astype(np.float32)[:, :, None]
    for name in PIXELS:
        (masks / f"{Path(name).name}.png").write_bytes(png_bytes(half))
    for sub in ("sparse/0", "text/0"):
        capture = {"colmap": sub, "images": "images", "masks": "masks", "width": 24, "test_every": 3}
        job = {"scene": "room.xml", "capture": capture, "parameters": [{"key": "wall.bsdf.reflectance.value"}]}
        problem = build_problem(make_config(job), folder)
        assert [view.is_test for view in problem.views] == [True, False, False] * 2 + [True]
        for view in problem.views:
            assert view.target.shape == (16, 24, 3) and view.weight is not None
            assert view.weight[8, 8] > 1 and view.weight[8, 20] == 0
        assert any("images undistorted to a pinhole camera" in note for note in problem.notes)


def test_opaque_pictures_that_are_undistorted_are_not_called_transparent(folder: Path) -> None:
    """The border that undistortion leaves empty does not count, so that it is not compared with black."""
    for name in PIXELS:
        PIL.Image.new("RGBA", (WIDTH, HEIGHT), (255, 255, 255, 255)).save(folder / "images" / name)
    job = {"scene": "room.xml", "capture": {"colmap": "sparse/0", "images": "images", "width": 24}}
    problem = build_problem(make_config({**job, "parameters": [{"key": "wall.bsdf.reflectance.value"}]}), folder)
    assert any("undistorted" in note for note in problem.notes)
    assert not any("transparent" in note for note in problem.notes)


def patched(name: str, at: int, layout: str, *values: Any) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        path = folder / "sparse" / "0" / name
        data = bytearray(path.read_bytes())
        struct.pack_into(layout, data, at, *values)
        path.write_bytes(data)

    return spoil


def exchanged(name: str, old: str, new: str) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        (folder / "sparse" / "0" / "cameras.bin").unlink()
        for each in ("cameras.txt", "images.txt"):
            text = (DATA / "text" / each).read_text()
            assert each != name or old in text
            (folder / "sparse" / "0" / each).write_text(text.replace(old, new) if each == name else text)

    return spoil


def cut(folder: Path) -> None:
    path = folder / "sparse" / "0" / "images.bin"
    path.write_bytes(path.read_bytes()[:500])


def emptied(folder: Path) -> None:
    (folder / "sparse" / "0" / "images.bin").write_bytes(bytes(8))


REFUSED: dict[str, tuple[Callable[[Path], Any], str]] = {
    "no model": (lambda folder: shutil.rmtree(folder / "sparse"), "No COLMAP model in sparse/0"),
    "no images": (lambda folder: (folder / "sparse/0/images.bin").unlink(), "images.bin does not exist"),
    "no pictures": (lambda folder: shutil.rmtree(folder / "images"), "give the folder of the images"),
    "cut short": (cut, "images.bin is not a supported COLMAP file (it is truncated)"),
    "nothing registered": (emptied, "images.bin has no images; register some"),
    "too many": (patched("images.bin", 0, "<Q", 10**12), "(it has 1000000000000 images)"),
    "too many cameras": (patched("cameras.bin", 0, "<Q", 10**12), "(it has 1000000000000 cameras)"),
    "another lens": (patched("cameras.bin", 12, "<i", 10), "the camera model 'number 10'; undistort"),
    "no place": (patched("images.bin", 12, "<d", float("nan")), "which are not a valid camera pose"),
    "no camera": (patched("images.bin", 68, "<I", 77), "refers to camera 77, which the model lacks"),
    "no focal length": (patched("cameras.bin", 32, "<d", 0.0), "has the focal length 0"),
    "another size": (patched("cameras.bin", 16, "<Q", 200), "is 200 x 80 in the model, but its file is 120 x 80"),
    "many points": (patched("images.bin", 87, "<Q", 2**60), "the file is truncated"),
    "text of another lens": (exchanged("cameras.txt", "OPENCV_FISHEYE", "FOV"), "the camera model 'FOV'"),
    "text without numbers": (
        exchanged("images.txt", " 1 sub", " one sub"),
        "images.txt is not a supported",
    ),
    "text with too few": (exchanged("cameras.txt", "PINHOLE 120 80", "PINHOLE 120"), "cameras.txt is not a supported"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_models_that_cannot_be_used_are_refused_in_one_line(case: str, folder: Path) -> None:
    spoil, words = REFUSED[case]
    spoil(folder)
    with pytest.raises(PathreplayError) as told:
        shots_of()
    assert words in str(told.value) and "\n" not in str(told.value)


def test_pixels_beyond_the_picture_and_beyond_the_fold_do_not_count() -> None:
    grey = np.ones((HEIGHT, WIDTH, 1), np.float32)
    pincushion = Lens(WIDTH, HEIGHT, 100, 100, 60, 40, (0.5, 0, 0, 0, 0, 0))
    picture, there = pincushion.undone(grey)
    assert there[40, 60] == 1 and there[0, 0] == 0 and picture[0, 0] == 0
    # x' = x (1 - r²) turns back at r = 1 / sqrt(3), though it stays within the picture.
    folding = Lens(WIDTH, HEIGHT, 60, 60, 60, 40, (-1.0, 0, 0, 0, 0, 0))
    _, there = folding.undone(grey)
    radius = np.hypot(np.arange(WIDTH) + 0.5 - 60, 0.5) / 60
    assert (there[40, :, 0] == (radius < 1 / np.sqrt(3) + 1e-3)).all()
    assert exr_bytes(there)  # single precision, as pictures are
