"""The gallery: jobs exist, the page is that of the record, images are small, and no time is of a busy machine."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pathreplay.errors import PathreplayError
from pathreplay.jobs import load_config
from places import ROOT

sys.path.insert(0, str(ROOT))  # the benchmarks run from the checkout and are not installed

from benchmarks.gallery import __main__ as command
from benchmarks.gallery import page, runs
from benchmarks.gallery.entries import ENTRIES, Entry
from benchmarks.gallery.runs import Run

RUN = Run("2026-01-01T00:00:00+00:00", "0123", "a processor", 2, "Linux", 150, 31.4, 40.2, 0.02, (0.05, 0.0001))


def finished(folder: Path, entry: Entry, size: int = 32, noise: bool = False) -> Path:
    """A folder as a run leaves it, as far as the gallery reads it."""
    images = folder / entry.name / "images"
    images.mkdir(parents=True)
    random = np.random.default_rng(0)
    for shade, kind in enumerate(page.KINDS):
        pixels = np.full((size, size, 3), 80 * shade, np.uint8)
        pixels = random.integers(0, 256, pixels.shape, np.uint8) if noise else pixels
        for view in {entry.view or "sensor", "another"}:
            Image.fromarray(pixels).save(images / f"{kind}-{view}.png")
    lines = [{"loss": loss, "seconds": 0.5} for loss in (0.05, 0.01)]
    (images.parent / "history.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return images.parent


def test_there_are_thirteen_jobs_and_each_is_valid() -> None:
    assert len(ENTRIES) == len({entry.name for entry in ENTRIES}) == 13
    for entry in ENTRIES:
        load_config(ROOT / "examples" / entry.config)
        assert not entry.prepare or (ROOT / "examples" / entry.prepare).is_file()


def test_the_page_is_that_of_the_record() -> None:
    record = page.read_record()
    assert page.PAGE.read_text(encoding="utf-8") == page.page(record)
    assert {path.stem for path in page.IMAGES.glob("*")} == set(record), "an image for each run, and no other file"
    for path in page.IMAGES.glob("*"):
        assert path.stat().st_size <= page.MOST_BYTES
        with Image.open(path) as image:
            assert image.format == "PNG"


def test_a_time_is_shown_where_the_machine_was_idle_alone() -> None:
    assert "150 iterations, which take 31 seconds (a processor, 2 cores, 2026-01-01)" in page.section(ENTRIES[0], RUN)
    busy = page.section(ENTRIES[0], replace(RUN, others=0.5))
    assert "31" not in busy and "the machine was busy" in busy
    assert "Not run yet" in page.section(ENTRIES[0], None) and "images/" not in page.section(ENTRIES[0], None)


@pytest.mark.parametrize(("size", "noise"), [(32, False), (100, True), (512, True)])
def test_images_show_start_result_and_target_and_are_small(size: int, noise: bool, tmp_path: Path) -> None:
    folder = finished(tmp_path, ENTRIES[0], size, noise)
    data = page.image_of(ENTRIES[0], folder)
    path = tmp_path / "joined.png"
    path.write_bytes(data)
    joined = np.array(Image.open(path).convert("RGB"))
    assert len(data) <= page.MOST_BYTES
    if not noise:
        assert joined.shape == (224, 3 * 224 + 2 * page.GAP, 3)
        assert [joined[100, x, 0] for x in (100, 332, 564)] == [0, 80, 160] and joined[100, 226, 0] == 255


def test_a_missing_view_is_named(tmp_path: Path) -> None:
    folder = finished(tmp_path, ENTRIES[0])
    with pytest.raises(PathreplayError, match=r"no image of view 'above'; it has another, overview"):
        page.image_of(replace(ENTRIES[0], view="above"), folder)


def test_other_processes_stop_a_run_and_their_cores_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock advances by two seconds; the machine was busy for three, and we for one of these."""
    now, busy, own = iter([0.0, 2.0]), iter([10.0, 13.0]), iter([5.0, 6.0])
    monkeypatch.setattr(runs.time, "perf_counter", lambda: next(now))
    monkeypatch.setattr(runs.time, "sleep", lambda seconds: None)
    monkeypatch.setattr(runs, "busy_seconds", lambda: next(busy))
    monkeypatch.setattr(runs, "own_seconds", lambda: next(own))
    with pytest.raises(PathreplayError, match=r"other processes use 1\.0 cores.*--busy"):
        runs.require_idle("cloud")


def test_processor_time_of_the_machine_and_of_ours_increase_together() -> None:
    listener = runs.Listener()
    while runs.own_seconds() < listener.own + 0.3:
        sum(range(10000))
    assert runs.busy_seconds() - listener.busy > 0.2


@pytest.fixture
def written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to which the command writes the record, the page and the images, in place of the checkout."""
    for name, place in (("RECORD", "gallery.json"), ("PAGE", "gallery.md"), ("IMAGES", "images")):
        monkeypatch.setattr(page, name, tmp_path / place)
        if hasattr(command, name):
            monkeypatch.setattr(command, name, tmp_path / place)
    return tmp_path


def test_an_example_with_data_of_other_repositories_is_skipped_without_them(
    written: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With them, the script gets their absolute paths; here it is the only command that runs."""
    called: list[list[str]] = []

    def call(arguments: list[str]) -> None:
        called.append(arguments)
        raise PathreplayError("enough")

    monkeypatch.setattr(runs, "_call", call)
    arguments = ["real-sky", "--busy", "--runs", str(written / "runs"), "--pyrender", "elsewhere"]
    command.main(arguments)
    skipped, _ = capsys.readouterr().out.splitlines()
    assert skipped.startswith("real-sky is skipped") and "--openexr-images FOLDER --pyrender FOLDER" in skipped
    assert not called and page.read_record() == {}
    with pytest.raises(PathreplayError, match="enough"):
        command.main([*arguments, "--openexr-images", str(written)])
    script = [sys.executable, "examples/real-sky/make_assets.py"]
    assert called == [[*script, str(written), str(Path("elsewhere").absolute())]]


def test_runs_are_reused_and_the_page_is_written(written: Path) -> None:
    arguments = ["glass-ball", "--reuse", "--runs", str(written / "runs")]
    with pytest.raises(PathreplayError, match=r"history\.jsonl"):
        command.main(arguments)
    folder = finished(written / "runs", next(entry for entry in ENTRIES if entry.name == "glass-ball"))
    with pytest.raises(PathreplayError, match="not the record of a run"):
        command.main(arguments)
    (folder / "gallery.json").write_bytes(runs._RUN.dump_json(RUN))
    command.main(arguments)
    assert page.read_record() == {"glass-ball": RUN}
    assert (written / "gallery.md").read_text().count("Not run yet") == 12
    assert (written / "images/glass-ball.png").is_file()
    with pytest.raises(PathreplayError, match="there is no entry 'moon'"):
        command.main(["moon"])
