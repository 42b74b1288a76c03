"""What of the pictures a job learns from: masks, views that are held out, losses of its own; and how alike they end."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.user_functions import Modules
from pathreplay.inverse.images.io import exr_bytes, read_image
from pathreplay.inverse.images.metrics import MOST_DB, Likeness
from pathreplay.inverse.loop.batches import batch
from pathreplay.inverse.losses.pixelwise import find_loss
from pathreplay.jobs import make_config, optimize
from pathreplay.platform.threads import spare_thread

KEY = "wall.bsdf.reflectance.data"
SCENE = """<scene version="3.0.0">
  <sensor type="orthographic" id="{first}"><transform name="to_world"><scale x="2" y="1"/>
    <lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="4"/>
      <string name="pixel_format" value="rgb"/><rfilter type="box"/></film></sensor>
  <sensor type="orthographic" id="other"><transform name="to_world"><scale x="2" y="1"/>
    <lookat origin="0,0,3" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="4"/>
      <string name="pixel_format" value="rgb"/><rfilter type="box"/></film></sensor>
  <shape type="rectangle" id="wall"><transform name="to_world"><scale x="2" y="1"/></transform>
    <bsdf type="diffuse"><texture type="bitmap" name="reflectance"><string name="filename" value="wall.exr"/>
      <boolean name="raw" value="true"/><string name="filter_type" value="nearest"/></texture></bsdf></shape>
  <emitter type="directional"><vector name="direction" value="0,0,-1"/>
    <rgb name="irradiance" value="3.14159265"/></emitter>
</scene>"""
JOB: dict[str, Any] = {
    "scene": "room.xml",
    "integrator": {"type": "pathreplay", "max_depth": 2},
    "sensors": ["one"],
    # A few steps down a parabola: of the two rows of texels that Mitsuba makes, each is one of 12 numbers, or of 6.
    "optimizer": {"type": "sgd"},
    "learning_rate": 2.0,
    "learning_rate_schedule": "constant",
    "iterations": 20,
    "spp": 1,
    "eval_spp": 1,
    "parameters": [{"key": KEY, "lower": 0.0, "upper": 1.0}],
    "target": {"images": ["target.exr"]},
}
LEFT = np.repeat([[1, 1, 1, 1, 0, 0, 0, 0]], 4, axis=0).astype(np.float32)[:, :, None]
"""The left half of a picture."""


@pytest.fixture(autouse=True)
def room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "room.xml").write_text(SCENE.format(first="one"))
    files = {
        "wall": np.full((1, 2, 3), 0.5),  # a left and a right half
        "target": np.full((4, 8, 3), 0.8),
        "mask": LEFT,
        "dark": 0 * LEFT,
        "small": LEFT[:2],
        "with-alpha": np.concatenate([0.8 * LEFT.repeat(3, axis=2), LEFT], axis=2),
    }
    for name, image in files.items():
        (tmp_path / f"{name}.exr").write_bytes(exr_bytes(image.astype(np.float32)))
    return tmp_path


def halves(result: Any) -> list[float]:
    """The mean colour of the wall's halves, in the order of the picture's."""
    found = result.parameters[KEY].mean(axis=(0, 2)).tolist()
    seen = read_image(result.folder / "images" / "result-one.exr").mean(axis=(0, 2))
    return found if (found[0] < found[1]) == (seen[0] < seen[-1]) else found[::-1]


@pytest.mark.parametrize(
    "target", [{"images": ["target.exr"], "masks": ["mask.exr"]}, {"images": ["with-alpha.exr"], "alpha": "mask"}]
)
@pytest.mark.parametrize("sweeps", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_only_what_the_mask_leaves_is_learned_from(target: dict[str, Any], sweeps: bool) -> None:
    integrator = {"type": "pathreplay" if sweeps else "prb", "max_depth": 2}
    result = optimize(make_config({**JOB, "target": target, "integrator": integrator}), progress=False)
    left, right = halves(result)
    assert left == pytest.approx(0.8, abs=1e-3)
    assert right == 0.5
    # As many pixels count as with no mask at all: the loss is a mean over the mask.
    assert result.history[0].loss == pytest.approx(0.09, rel=1e-3)
    table = json.loads((result.folder / "views.json").read_text())["one"]
    assert table["result"]["rmse"] < 1e-3 < 0.29 < table["start"]["rmse"]


def test_a_run_goes_on_with_its_mask(room: Path) -> None:
    job = {**JOB, "target": {"images": ["target.exr"], "masks": ["mask.exr"]}, "deterministic": True}
    whole = optimize(make_config(job), output="whole", progress=False)
    part = optimize(make_config({**job, "iterations": 10}), output="part", progress=False)
    config = json.loads((part.folder / "config.json").read_text())
    (part.folder / "config.json").write_text(json.dumps({**config, "iterations": 20}))
    for name in ("target", "mask"):
        (room / f"{name}.exr").unlink()
    went_on = optimize(resume=part.folder, progress=False)
    assert went_on.iterations == 20
    assert went_on.parameters[KEY].tobytes() == whole.parameters[KEY].tobytes()
    assert halves(whole)[1] == 0.5


def test_views_that_are_held_out_are_looked_at_only(room: Path) -> None:
    (room / "bright.exr").write_bytes(exr_bytes(np.full((4, 8, 3), 0.9, np.float32)))
    job = {**JOB, "sensors": None, "test_views": ["other"], "target": {"images": ["target.exr", "bright.exr"]}}
    result = optimize(make_config(job), progress=False)
    alone = optimize(make_config(JOB), progress=False)
    assert result.parameters[KEY].mean() == pytest.approx(0.8, abs=1e-3)
    assert result.history[0].loss == pytest.approx(alone.history[0].loss, rel=1e-4)
    assert result.test_views == ("other",)
    assert result.views["one"].psnr > 30 > result.views["other"].psnr
    assert "test views (1): PSNR" in result.describe()
    html = result.report.read_text()
    assert "recovered from 1 image, 1 test view" in html and "other (test view)" in html


def test_a_job_may_bring_its_loss(room: Path) -> None:
    (room / "my_losses.py").write_text("def double(image, target):\n    return 2 * (image - target) ** 2\n")
    result = optimize(make_config({**JOB, "loss": "my_losses:double", "iterations": 2}), progress=False)
    assert result.history[0].loss == pytest.approx(0.18, rel=1e-3)


def test_batches_have_every_view_once_in_a_round() -> None:
    views = [0, 2, 3, 5, 7]
    seen = [batch(views, 2, 3, i) for i in range(12)]
    assert [len(each) for each in seen] == 4 * [2, 2, 1]
    rounds = np.concatenate(seen).reshape(4, 5)
    assert (np.sort(rounds, axis=1) == [0, 2, 3, 5, 7]).all()
    assert len({tuple(each) for each in rounds.tolist()}) > 1
    assert seen != [batch(views, 2, 4, i) for i in range(12)]
    assert batch(views, 5, 0, 3) == [7, 5, 3, 2, 0] == batch(views, None, 0, 1)


@pytest.mark.slow
def test_a_batch_stands_for_all_views(room: Path) -> None:
    """Of two views with the same target, one has the loss and the gradient of both."""
    both = {**JOB, "sensors": None, "target": {"images": ["target.exr", "target.exr"]}}
    all_of, one_of = (
        optimize(make_config({**both, **more}), output=str(k), progress=False)
        for k, more in enumerate(({}, {"view_batch_size": 1}))
    )
    assert [e.loss for e in all_of.history] == pytest.approx([e.loss for e in one_of.history], rel=1e-3, abs=1e-8)
    assert one_of.parameters[KEY] == pytest.approx(all_of.parameters[KEY], abs=1e-5)
    assert one_of.parameters[KEY].mean() == pytest.approx(0.8, abs=1e-3)


BROKEN = "def shapes(image, target):\n    return image[1:] * target\n\n\nnumber = 3\n"
REFUSED = {
    "black": ({"target": {"images": ["target.exr"], "masks": ["dark.exr"]}}, "mask 'dark.exr' is black"),
    "small": ({"target": {"images": ["target.exr"], "masks": ["small.exr"]}}, "Mask 'small.exr' is 8 x 2"),
    "too many": ({"target": {"images": ["target.exr"], "masks": ["mask.exr"] * 2}}, "2 masks for 1 sensors"),
    "two masks": (
        {"target": {"images": ["target.exr"], "masks": ["mask.exr"], "alpha": "mask"}},
        "'masks' and alpha = 'mask' both define a mask",
    ),
    "no alpha": ({"target": {"images": ["target.exr"], "alpha": "mask"}}, "has no alpha channel for alpha = 'mask'"),
    "no picture": ({"target": {"values": {KEY: 0.5}, "alpha": "mask"}}, "alpha = 'mask' applies to 'images' only"),
    "nothing left": ({"test_views": [0]}, "Every sensor of the job is a test view"),
    "elsewhere": ({"test_views": ["other"]}, "sensor 'other' is not among 'sensors'"),
    "unknown view": ({"test_views": ["third"]}, "No sensor 'third' in the scene"),
    "no module": ({"loss": "not_there:loss"}, "Loss 'not_there:loss' cannot be imported (No module named 'not_there')"),
    "no function": ({"loss": "broken:loss"}, "has no attribute 'loss'"),
    "a number": ({"loss": "broken:number"}, "is not a function of image and target, but 3"),
    "another shape": ({"loss": "broken:shapes"}, "Loss 'broken:shapes'"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_count_is_refused_in_one_line(case: str, room: Path) -> None:
    (room / "broken.py").write_text(BROKEN)
    change, words = REFUSED[case]
    with pytest.raises(PathreplayError) as told:
        optimize(make_config({**JOB, **change}), progress=False)
    assert words in str(told.value) and "\n" not in str(told.value)
    assert not (room / "runs").exists()


def test_flip_is_that_of_flip_evaluator_where_the_mask_is() -> None:
    """Black against white is 0.9674, as the package says of plain pictures."""
    pytest.importorskip("flip_evaluator")
    black, white = np.zeros((8, 8, 3), np.float32), np.ones((8, 8, 3), np.float32)
    assert Likeness.of(black, black, 1.0, flip=True).flip == 0
    assert Likeness.of(black, white, 1.0, flip=True).flip == pytest.approx(0.9674, abs=1e-3)
    assert Likeness.of(black[:, :, :1], white[:, :, :1], 1.0, flip=True).flip == pytest.approx(0.9674, abs=1e-3)
    assert Likeness.of(black, white, 1.0).flip is None
    # 67 pixels per degree blur by more than this: what the mask hides would reach into what it shows.
    half = np.repeat([[2.0] * 4 + [0.0] * 4], 8, axis=0).astype(np.float32)[:, :, None]
    both = np.where(half > 0, black, white).astype(np.float32)
    assert Likeness.of(both, black, 1.0, half, flip=True).flip == 0 < Likeness.of(both, black, 1.0, flip=True).flip
    one, other = (np.where(half > 0, white, hidden).astype(np.float32) for hidden in (black, white))
    masked, whole = (Likeness.of(one, black, 1.0, weight, flip=True).flip for weight in (half, None))
    assert masked == Likeness.of(other, black, 1.0, half, flip=True).flip > whole > 0


def test_flip_is_left_out_where_the_package_is_absent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pathreplay.inverse.images.metrics.has_flip", lambda: False)
    assert Likeness.of(np.zeros((2, 2, 3)), np.ones((2, 2, 3)), 1.0, flip=True).flip is None


def test_likeness_has_its_closed_forms() -> None:
    rng = np.random.default_rng(0)
    image = rng.uniform(0.1, 0.9, (24, 32, 3)).astype(np.float32)
    assert Likeness.of(image, image, 1.0) == Likeness(MOST_DB, 1.0)
    # Two grey pictures: no variance, and so the luminance term alone; 0.5 and 0.6 as a display shows them.
    a, b = (np.full((9, 9, 1), ((x + 0.055) / 1.055) ** 2.4, np.float32) for x in (0.5, 0.6))
    found = Likeness.of(a, b, 1.0)
    assert found.psnr == pytest.approx(20, abs=1e-3)
    assert found.ssim == pytest.approx((2 * 0.3 + 1e-4) / (0.25 + 0.36 + 1e-4), abs=1e-5)
    # Upside down, structure is opposed.
    assert Likeness.of(image, 1 - image, 1.0).ssim < 0
    half = np.where(np.arange(32) < 16, 2.0, 0.0).astype(np.float32)[None, :, None] * np.ones((24, 1, 1), np.float32)
    other = np.where(half > 0, image, 0).astype(np.float32)
    assert Likeness.of(image, other, 1.0, half) == Likeness(MOST_DB, pytest.approx(1))
    one = Likeness.of(image, (other * 0.9).astype(np.float32), 1.0, half)
    assert one == Likeness.of(image, np.where(half > 0, other * 0.9, 7).astype(np.float32), 1.0, half)
    assert Likeness.of(image, image[::-1], 1.0, np.full_like(half, 1.0)) == Likeness.of(image, image[::-1], 1.0)


def test_a_display_ends_at_white() -> None:
    with spare_thread():
        bright, brighter = (np.full((4, 4, 3), x, np.float32) for x in (2.0, 3.0))
    assert Likeness.of(bright, brighter, 1.0).psnr == MOST_DB > Likeness.of(bright, brighter, 0.3).psnr


def test_a_mask_that_is_lost_is_missed(room: Path) -> None:
    job = {**JOB, "iterations": 1, "target": {"images": ["target.exr"], "masks": ["mask.exr"]}}
    folder = optimize(make_config(job), progress=False).folder
    (folder / "images" / "weight-one.exr").write_bytes(exr_bytes(LEFT[:2]))
    with pytest.raises(PathreplayError, match=r"weight-one\.exr has changed since it was written"):
        optimize(resume=folder, progress=False)
    (folder / "images" / "weight-one.exr").unlink()
    with pytest.raises(PathreplayError, match="The mask of sensor 'one' in the run folder"):
        optimize(resume=folder, progress=False)


def test_losses_of_one_name_in_two_folders_are_two(tmp_path: Path) -> None:
    for k in (1, 3):
        (tmp_path / str(k)).mkdir()
        (tmp_path / str(k) / "mine.py").write_text(f"def loss(image, target):\n    return {k} * (image - target)\n")
    found = [find_loss("mine:loss", Modules(tmp_path / str(k))) for k in (1, 3)]
    assert [each(mi.TensorXf([2.0]), mi.TensorXf([1.0])).array[0] for each in found] == [1, 3]
