"""Runs that are over, or nearly: side by side, as films, and as events for TensorBoard; by their folders alone."""

from __future__ import annotations

import errno
import io
import json
import shutil
import sys
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import Mock

import numpy as np
import PIL.Image
import pytest
import safetensors.numpy
from typer.testing import CliRunner

from page_samples import HOSTILE
from pathreplay.cli import app
from pathreplay.errors import PathreplayError
from pathreplay.inverse.images.io import exr_bytes
from pathreplay.inverse.loop.checkpoint import _HISTORY, Entry
from pathreplay.jobs import make_config, optimize
from pathreplay.report.live_page import FOLDER
from pathreplay.report.pages.document import document
from pathreplay.report.watch import compare, tensorboard, timelapse
from pathreplay.report.watch.past import pasts
from room_job import JOB, TEXTURE


def png(colour: tuple[int, int, int], size: tuple[int, int] = (40, 30), kind: str = "png") -> bytes:
    buffer = io.BytesIO()
    PIL.Image.new("RGB", size, colour).save(buffer, kind)
    return buffer.getvalue()


def a_run(folder: Path, losses: tuple[float, ...] = (1.0, 0.5, 0.25), **changes: Any) -> Path:
    """As much of a run folder as is looked at."""
    for name in ("images", FOLDER):
        (folder / name).mkdir(parents=True)
    (folder / "config.json").write_text(make_config({**JOB, **changes}).model_dump_json(exclude_unset=True))
    (folder / "run.json").write_text(json.dumps({"base": str(folder), "config": None}))
    history = [Entry(i, loss, 0.5, {TEXTURE: loss}, errors={TEXTURE: 2 * loss}) for i, loss in enumerate(losses)]
    tensors = {"history": np.frombuffer(_HISTORY.dump_json(history), np.uint8)}
    (folder / "checkpoint.safetensors").write_bytes(safetensors.numpy.save(tensors))
    result = {"rmse": 0.1, "psnr": 20 + losses[-1], "ssim": 0.9}
    views = {name: {"is_test": name == "right", "exposure": 1.0, "result": result} for name in ("left", "right")}
    (folder / "views.json").write_text(json.dumps(views))
    for view in views:
        (folder / f"images/target-{view}.png").write_bytes(png((200, 0, 0)))
        (folder / f"images/result-{view}.png").write_bytes(png((0, 200, 0)))
        (folder / f"{FOLDER}/target-{view}.png").write_bytes(png((200, 0, 0)))
        for i in range(len(losses)):
            (folder / f"{FOLDER}/{i:06d}-view-{view}.webp").write_bytes(png((0, 60 * i, 0), kind="webp"))
    for i in range(len(losses)):  # a grid that is refined
        (folder / f"{FOLDER}/{i:06d}-texture-{TEXTURE}.webp").write_bytes(png((9, 9, 60 * i), (2 + i, 2 + i), "webp"))
    (folder / f"images/texture-result-{TEXTURE}.png").write_bytes(png((1, 2, 3)))
    return folder


def test_a_table_has_what_runs_came_to_and_where_they_differ(tmp_path: Path) -> None:
    runs = pasts([a_run(tmp_path / "a"), a_run(tmp_path / "b", (1.0, 0.1), spp=32, loss="l1")])
    table = compare.table(runs)
    rows = {row.name: row.cells for row in table.rows}
    assert [head.text for head in table.heads] == ["", "a", "b"]
    assert rows["iterations"] == ("3 of 6", "2 of 6") and rows["seconds"] == ("1.5", "1.0")
    assert rows["loss"] == ("1 → 0.25 (l2)", "1 → 0.1 (l1)") and rows[f"error of {TEXTURE}"] == ("0.5", "0.2")
    assert rows["PSNR, test views"] == ("20.25 dB", "20.1 dB")
    assert rows["job: spp"] == ("4", "32") and rows["job: loss"] == ("'l2'", "'l1'") and len(rows) == 10


def test_integrators_that_a_job_leaves_out_are_no_difference(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With `--set`, the saved config is completed from the scene; otherwise it is the file."""
    monkeypatch.chdir(tmp_path)
    Path("job.toml").write_text(
        'scene = "cornell-box"\niterations = 1\nspp = 1\neval_spp = 1\nscene_parameters = {resolution = 16}\n'
        '[target]\nscene = "cornell-box"\nscene_parameters = {resolution = 16}\nspp = 1\n'
        '[[parameters]]\nkey = "red.reflectance.value"\ninitial = 0.3\n'
    )
    for folder, changes in (("a", ()), ("b", ("learning_rate=0.5",))):
        optimize(Path("job.toml"), output=folder, define=changes, progress=False)
    names = [row.name for row in compare.table(pasts([Path("a"), Path("b")])).rows]
    assert [name for name in names if name.startswith("job: ")] == ["job: learning_rate"]


def test_a_page_has_curves_of_both_and_pictures_that_can_be_wiped(tmp_path: Path) -> None:
    page = compare.page(pasts([a_run(tmp_path / "a"), a_run(tmp_path / "b", (1.0, 0.1), loss="l1")]))
    assert [picture.kind for picture in page.views[0].pictures] == ["target", "a", "b"] and page.views[1].is_test
    assert (page.left, page.right) == ("a", "b") and "different losses (l1, l2)" in page.notices[0]
    by_seconds = page.plots[1]
    assert by_seconds.along == "second" and [s.x for s in by_seconds.series] == [(0.5, 1.0, 1.5), (0.5, 1.0)]
    assert [p.kind for p in page.parameters[0].pictures] == ["a", "b"]
    assert document(page).count(b"data:image/png") == 2 * 3 + 2


def test_errors_are_those_of_the_results(tmp_path: Path) -> None:
    """The result may be a mean of iterates. A run that goes on has none yet."""
    runs = [a_run(tmp_path / "a"), a_run(tmp_path / "b")]
    table = {
        TEXTURE: {"shape": [3], "rmse": 0.125},
        "eye": {"pose": "rigid", "error": {"position": 2.0, "degrees": 3.0}},
    }
    (runs[0] / "parameters.json").write_text(json.dumps(table))
    rows = {row.name: row.cells for row in compare.table(pasts(runs)).rows}
    assert rows[f"error of {TEXTURE}"] == ("0.125", "0.5")
    assert (rows["error of eye:position"], rows["error of eye:degrees"]) == (("2", ""), ("3", ""))


def test_runs_with_different_targets_say_so(tmp_path: Path) -> None:
    runs = [a_run(tmp_path / name) for name in "abc"]
    assert compare.page(pasts(runs)).notices == ()  # without targets
    image = np.random.default_rng(0).uniform(0.1, 1, (3, 4, 3)).astype(np.float32)
    scales = {"left": (1, 1 + 1e-6, 1), "right": (1, 2, 1)}  # sums in another order; twice as bright
    for view, factors in scales.items():
        for run, factor in zip(runs, factors, strict=True):
            (run / f"images/target-{view}.exr").write_bytes(exr_bytes(np.float32(factor) * image))
    (notice,) = compare.page(pasts(runs)).notices
    assert "different targets in right." in notice and notice.endswith("those of a.")
    for run in runs:
        (run / "images/target-right.png").unlink()
    assert compare.page(pasts(runs)).notices == (notice,)


def test_a_comparison_shows_parameters_that_the_last_stage_freezes(tmp_path: Path) -> None:
    runs = pasts([a_run(tmp_path / "a"), a_run(tmp_path / "b")])
    for run in runs:
        run.history[-1].gradient_norms.clear()
    page = compare.page(runs)
    assert [plot.code for plot in page.plots if plot.title == "gradient norm of"] == [TEXTURE]
    assert [parameter.key for parameter in page.parameters] == [TEXTURE]


def test_a_gradient_norm_that_is_infinite_is_not_drawn(tmp_path: Path) -> None:
    runs = pasts([a_run(tmp_path / "a"), a_run(tmp_path / "b")])
    runs[0].history[1].gradient_norms[TEXTURE] = float("inf")
    page = compare.page(runs)
    (plot,) = (plot for plot in page.plots if plot.title == "gradient norm of")
    assert plot.series[0].y == (1.0, None, 0.25)
    assert document(page)


def test_runs_of_one_name_are_told_apart(tmp_path: Path) -> None:
    folders = [a_run(tmp_path / one / "run") for one in ("x", "y")]
    assert [past.name for past in pasts(folders)] == [str(folder) for folder in folders]
    with pytest.raises(PathreplayError, match="given twice"):
        pasts([folders[0], folders[0]])


def test_large_pictures_are_made_smaller(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = a_run(tmp_path / "a")
    (run / "images/result-left.png").write_bytes(png((5, 6, 7), (400, 300)))
    monkeypatch.setattr(compare, "MOST_PIXELS", 6 * 1200)
    page = compare.page(pasts([run, a_run(tmp_path / "b")]))
    import base64

    data = base64.b64decode(page.views[0].pictures[1].src.partition(",")[2])
    assert PIL.Image.open(io.BytesIO(data)).size == (40, 30)


DAMAGE = {
    "no checkpoint": (lambda run: (run / "checkpoint.safetensors").unlink(), "cannot be read"),
    "a checkpoint that is none": (
        lambda run: (run / "checkpoint.safetensors").write_bytes(b"x" * 99),
        "cannot be read",
    ),
    "a history that is none": (
        lambda run: (run / "checkpoint.safetensors").write_bytes(
            safetensors.numpy.save({"history": np.frombuffer(b"[{}]", np.uint8)})
        ),
        "its history is damaged",
    ),
    "a history of an older version that is none": (
        lambda run: (run / "checkpoint.safetensors").write_bytes(
            safetensors.numpy.save({"x": np.zeros(1, np.float32)}, {"history": "[{}]"})
        ),
        "its history is damaged",
    ),
    "views that are none": (lambda run: (run / "views.json").write_text("{"), "is not JSON"),
    "a picture that is none": (lambda run: (run / "images/result-left.png").write_text("x"), "cannot be read"),
    "no config": (lambda run: (run / "config.json").unlink(), "config or run.json missing"),
    "no run": (lambda run: (run / "run.json").unlink(), "is not a run folder"),
}


@pytest.mark.parametrize("case", DAMAGE)
def test_damage_is_told_in_one_line(case: str, tmp_path: Path) -> None:
    damage, words = DAMAGE[case]
    folders = [a_run(tmp_path / "a"), a_run(tmp_path / "b")]
    damage(folders[0])
    with pytest.raises(PathreplayError, match=words):
        compare.page(pasts(folders))


@pytest.mark.parametrize("word", HOSTILE[:3], ids=range(3))
def test_names_in_a_comparison_are_text(word: str, tmp_path: Path) -> None:
    name = word.replace("/", "")
    page = compare.page(pasts([a_run(tmp_path / name), a_run(tmp_path / "b")]))
    assert document(page).count(b"<script") == 2


def test_the_command_prints_the_table_and_writes_the_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs = [str(a_run(tmp_path / "[bold]a")), str(a_run(tmp_path / "b", spp=32))]
    app(["compare", *runs, "--output", str(tmp_path / "both.html")], standalone_mode=False)
    out = capsys.readouterr().out
    assert "[bold]a" in out and "32" in out and (tmp_path / "both.html").read_bytes().startswith(b"<!doctype html>")
    with pytest.raises(PathreplayError, match="at least two runs"):
        app(["compare", runs[0]], standalone_mode=False)
    with pytest.raises(PathreplayError, match="cannot be written"):
        app(["compare", *runs, "--output", str(tmp_path / "none/both.html")], standalone_mode=False)


def test_a_film_shows_target_and_run_through_time(tmp_path: Path) -> None:
    run = a_run(tmp_path / "a")
    assert timelapse.film(run, tmp_path / "film.webp", "right", 3.0) == 3
    with PIL.Image.open(tmp_path / "film.webp") as film:
        assert film.n_frames == 3 and film.width % 2 == film.height % 2 == 0
        for i in range(3):
            film.seek(i)
            frame = film.convert("RGB")
            assert frame.getpixel((100, 100)) == pytest.approx((200, 0, 0), abs=6)
            assert frame.getpixel((500, 100)) == pytest.approx((0, 60 * i, 0), abs=6)
            assert frame.getpixel((900, 100)) == pytest.approx((9, 9, 60 * i), abs=6)
    assert not list(tmp_path.glob(".*part*"))


def test_a_texture_of_one_row_fits_into_a_film(tmp_path: Path) -> None:
    run = a_run(tmp_path / "a")
    for path in (run / FOLDER).glob("*-texture-*.webp"):
        path.write_bytes(png((9, 9, 60), (256, 1), "webp"))
    assert timelapse.film(run, tmp_path / "film.webp") == 3
    with PIL.Image.open(tmp_path / "film.webp") as film:
        assert film.width == 2 * 384 + 4 * timelapse.HEIGHT + 2 * 4


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="there is no ffmpeg here")
def test_a_film_may_be_mp4(tmp_path: Path) -> None:
    timelapse.film(a_run(tmp_path / "a"), tmp_path / "film.mp4")
    assert (tmp_path / "film.mp4").read_bytes()[4:8] == b"ftyp"


def test_films_that_cannot_be_made_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = a_run(tmp_path / "a")
    for output, view, words in (
        ("film.gif", None, "neither .webp nor .mp4"),
        ("film.webp", "top", "no frames of view 'top'; name a view with frames: left, right"),
        ("none/film.webp", None, "cannot be written"),
        ("a/run.json/film.webp", None, "cannot be written"),
    ):
        with pytest.raises(PathreplayError, match=words):
            timelapse.film(run, tmp_path / output, view)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(PathreplayError, match="ffmpeg, which is not installed"):
        timelapse.film(run, tmp_path / "film.mp4")
    shutil.rmtree(run / FOLDER)
    with pytest.raises(PathreplayError, match="no frames in previews"):
        timelapse.film(run, tmp_path / "film.webp")
    assert not list(tmp_path.glob("*film*"))
    with pytest.raises(PathreplayError, match="is not a run folder"):
        timelapse.film(tmp_path, tmp_path / "film.webp")


def test_events_are_what_tensorboard_reads(tmp_path: Path) -> None:
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    (run,) = pasts([a_run(tmp_path / "a")])
    assert tensorboard.write_events(run, tmp_path / "events/a") == 3
    read = accumulator.EventAccumulator(str(tmp_path / "events/a"))
    read.Reload()
    assert set(read.Tags()["tensors"]) == {"loss", "penalty", f"error/{TEXTURE}", f"gradient_norm/{TEXTURE}"}
    events = read.Tensors("loss")
    assert [event.tensor_proto.float_val[0] for event in events] == [1.0, 0.5, 0.25]
    assert [event.step for event in events] == [0, 1, 2]
    assert events[1].wall_time - events[0].wall_time == pytest.approx(0.5, abs=1e-3)
    with pytest.raises(PathreplayError, match="exists; remove it"):
        tensorboard.write_events(run, tmp_path / "events/a")


class Writer:
    """Stands for TensorBoard's writer, which makes missing folders."""

    def __init__(self, folder: str) -> None:
        Path(folder).mkdir(parents=True, exist_ok=True)
        Path(folder, "events").touch()

    def add_scalar(self, tag: str, value: float, step: int, wall_time: float) -> None:
        pass

    def close(self) -> None:
        pass


@pytest.fixture
def tensorboard_here(monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("tensorboard.summary")
    module.Writer = Writer
    monkeypatch.setitem(sys.modules, "tensorboard", ModuleType("tensorboard"))
    monkeypatch.setitem(sys.modules, "tensorboard.summary", module)


@pytest.mark.usefixtures("tensorboard_here")
def test_no_events_are_left_of_a_disk_that_is_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (run,) = pasts([a_run(tmp_path / "a")])
    with monkeypatch.context() as patch:
        patch.setattr(Writer, "close", Mock(side_effect=OSError(errno.ENOSPC, "No space left on device")))
        with pytest.raises(PathreplayError, match="No space left on the disk"):
            tensorboard.write_events(run, tmp_path / "events/a")
    assert not any((tmp_path / "events").iterdir())
    assert tensorboard.write_events(run, tmp_path / "events/a") == 3
    assert [path.name for path in (tmp_path / "events/a").iterdir()] == ["events"]


@pytest.mark.usefixtures("tensorboard_here")
def test_events_of_runs_of_one_name_have_folders_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    runs = [str(a_run(Path(one))) for one in ("x/run", "y/run", "z")]
    told = CliRunner().invoke(app, ["tensorboard", *runs, "--output", "events"])
    assert told.exit_code == 0, told.output
    assert sorted(path.name for path in Path("events").iterdir()) == ["x_run", "y_run", "z"]


def test_without_tensorboard_there_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tensorboard.summary", None)
    (run,) = pasts([a_run(tmp_path / "a")])
    with pytest.raises(PathreplayError, match="pip install 'pathreplay\\[tensorboard\\]'"):
        tensorboard.write_events(run, tmp_path / "events/a")
