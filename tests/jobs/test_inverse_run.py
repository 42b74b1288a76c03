"""Whole jobs on a tiny scene: they recover the truth, can be stopped and resumed, and leave whole files or none."""

from __future__ import annotations

import errno
import html
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import safetensors.numpy

from pathreplay.errors import PathreplayError
from pathreplay.inverse.images.io import exr_bytes, read_image
from pathreplay.inverse.loop import loop
from pathreplay.jobs import optimize
from pathreplay.platform.atomic_files import Content, chunks
from pathreplay.runs import run_folder as folders
from room_job import TEXTURE, interrupt_at, room, run  # noqa: F401 (room: its folder, for every test)
from small_job import checkpoint_bits


@pytest.mark.parametrize("integrator", [pytest.param("prb", marks=pytest.mark.slow), "pathreplay"])
def test_recovers_texture_and_colour(integrator: str) -> None:
    result = run(iterations=60, spp=8, integrator={"type": integrator, "max_depth": 3})
    # The start is off by 0.1 to 0.4; what is left is the noise of 8 samples per pixel in Adam's last, decayed steps.
    assert result.errors[TEXTURE] < 0.04
    assert result.errors["floor.reflectance.value"] < 0.04
    assert result.history[-1].loss < 0.25 * result.history[0].loss  # the noise of 8 samples stays in the loss


@pytest.mark.drawn
def test_run_folder_is_complete_and_the_report_self_contained() -> None:
    result = run()
    names = {str(p.relative_to(result.folder)) for p in result.folder.rglob("*") if p.is_file()}
    for kind in ("target", "start", "result"):
        assert {f"images/{kind}-{view}.{end}" for view in ("left", "right") for end in ("exr", "png")} <= names
    start, result_picture = (read_image(result.folder / f"images/{kind}-left.exr") for kind in ("start", "result"))
    assert np.abs(start - result_picture).max() > 0.01  # the start shows the initial values, not those of the scene
    assert {
        "checkpoint.safetensors", "config.json", "history.jsonl", "loss.png", "loss.svg", "parameters.json",
        "parameters.safetensors", "report.html", "run.json", "summary.png",
    } <= names  # fmt: skip
    assert not [name for name in names if name.endswith(folders.PART)]

    page = result.report.read_text()
    links = re.findall(r'(?:src|href)="([^"]{0,40})', page)
    assert len(links) >= 2 * 4 + 3 + 1  # views, texture, loss curve
    assert all(link.startswith("data:") for link in links)
    assert "http://" not in page and "https://" not in page and not re.search(r"url\((?!#)", page)

    saved = safetensors.numpy.load_file(result.folder / "parameters.safetensors")
    assert saved[TEXTURE] == pytest.approx(result.parameters[TEXTURE])
    table = json.loads((result.folder / "parameters.json").read_text())
    assert table["floor.reflectance.value"]["value"] == pytest.approx(result.parameters["floor.reflectance.value"])
    lines = [json.loads(line) for line in (result.folder / "history.jsonl").read_text().splitlines()]
    assert [line["iteration"] for line in lines] == list(range(6))
    assert all(line["gradient_norms"][TEXTURE] > 0 for line in lines)


def test_the_command_of_a_report_repeats_a_job_from_python(room: Path) -> None:
    """The paths of the job refer to the folder in which Python ran, and not to the run folder."""
    first = run(iterations=1, output="run", deterministic=True, target={"scene": "room.xml", "spp": 4})
    found = re.search("<pre>(.*?)</pre>", first.report.read_text())
    assert found is not None
    (room / "elsewhere").mkdir()
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    environment = {k: v for k, v in os.environ.items() if k != "DRJIT_LIBLLVM_PATH"} | {"PATH": path}
    subprocess.run(html.unescape(found[1]), shell=True, cwd=room / "elsewhere", env=environment, check=True)
    assert checkpoint_bits(room / "run-2") == checkpoint_bits(room / "run")


def test_bounds_hold_after_every_step() -> None:
    parameters = [{"key": TEXTURE, "initial": 0.4, "lower": 0.35, "upper": 0.45}]
    result = run(parameters=parameters, learning_rate=0.5)
    texels = result.parameters[TEXTURE]
    assert texels.min() == np.float32(0.35) and texels.max() == np.float32(0.45)


def test_earlier_runs_are_never_touched() -> None:
    first = run(output="runs/mine", iterations=1)
    before = {p: p.read_bytes() for p in first.folder.rglob("*") if p.is_file()}
    assert [run(output="runs/mine", iterations=1).folder.name for _ in range(2)] == ["mine-2", "mine-3"]
    assert before == {p: p.read_bytes() for p in first.folder.rglob("*") if p.is_file()}


def test_stopped_and_resumed_equals_uninterrupted(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = run()
    with monkeypatch.context() as patch:
        interrupt_at(3, patch)
        stopped = run()
    assert stopped.stopped and stopped.iterations == 3
    assert "Stopped after 3 of 6" in stopped.report.read_text()
    resumed = optimize(resume=stopped.folder, progress=False)
    assert resumed.folder == stopped.folder and resumed.iterations == 6 and not resumed.stopped
    # Same numbers but for the order in which threads add floats; Adam's division lifts that rounding a little.
    for key, value in whole.parameters.items():
        assert resumed.parameters[key] == pytest.approx(value, abs=1e-4)
    assert [e.loss for e in resumed.history] == pytest.approx([e.loss for e in whole.history], rel=1e-4)
    with pytest.raises(PathreplayError, match="has all its 6 iterations"):
        optimize(resume=stopped.folder, progress=False)


def test_a_run_does_not_go_on_from_other_initial_values(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are in the report, and regularizers refer to them."""
    with monkeypatch.context() as patch:
        interrupt_at(3, patch)
        stopped = run(parameters=[{"key": TEXTURE}, {"key": "floor.reflectance.*", "initial": 0.5}])
    config, texture = stopped.folder / "config.json", room / "texture.exr"
    plain = config.read_text(), texture.read_bytes()
    for key in ("floor.reflectance.value", TEXTURE):
        if key == TEXTURE:
            texture.write_bytes(exr_bytes(1 - read_image(texture)))
        else:
            config.write_text(plain[0].replace("0.5", "0.9"))
        with pytest.raises(PathreplayError, match=f"The initial value of '{key}' differs from the one at the start"):
            optimize(resume=stopped.folder, progress=False)
        config.write_text(plain[0])
        texture.write_bytes(plain[1])
    assert optimize(resume=stopped.folder, progress=False).iterations == 6


def test_second_ctrl_c_aborts_and_the_checkpoint_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        interrupt_at(3, patch, times=2)
        with pytest.raises(KeyboardInterrupt):
            run(output="aborted", checkpoint_every=2)
    assert not list(Path("aborted").rglob("*" + folders.PART))
    assert not Path("aborted/report.html").exists()
    assert optimize(resume="aborted", progress=False).iterations == 6


def full_disk_at(write: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The given write (from 1) and all later ones find the disk full, after half of their bytes."""
    real, count = folders._write_through, []

    def write_through(path: Path, content: Content, held: int | None) -> None:
        count.append(path)
        data = b"".join(chunks(content))
        if len(count) >= write:
            real(path, data[: len(data) // 2], held)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        real(path, data, held)

    monkeypatch.setattr(folders, "_write_through", write_through)


# Writes of this job: 1-2 config and origin, 3-8 first pictures, their checksums, checkpoint, 9-10 checkpoints, results.
@pytest.mark.parametrize(
    ("write", "resumable"),
    [(1, False), (9, True), *(pytest.param(*case, marks=pytest.mark.slow) for case in ((5, False), (13, True)))],
)
def test_full_disk_leaves_nothing_half_written(write: int, resumable: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    earlier = run(output="runs/a", iterations=1)
    before = {p: p.read_bytes() for p in Path("runs").rglob("*") if p.is_file()}
    with monkeypatch.context() as patch:
        full_disk_at(write, patch)
        with pytest.raises(PathreplayError, match="No space left on the disk for run folder runs/a-2"):
            run(output="runs/a", checkpoint_every=3)
    assert earlier.report.exists()
    assert {p: p.read_bytes() for p in before} == before
    assert not list(Path("runs").rglob("*" + folders.PART))
    assert Path("runs/a-2").exists() == resumable
    if resumable:
        assert not (Path("runs/a-2") / "report.html").exists()
        assert optimize(resume="runs/a-2", progress=False).iterations == 6


def test_a_resume_writes_the_results_that_a_full_disk_has_kept_from_an_extended_run(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The report of the earlier end is not that of the run."""
    with monkeypatch.context() as patch:
        interrupt_at(3, patch)
        run(output="run")
    real, history = folders._write_through, Path("run/history.jsonl")

    def write_through(path: Path, content: Content, held: int | None) -> None:
        if path.name.startswith("views.json"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        real(path, content, held)

    with monkeypatch.context() as patch:
        patch.setattr(folders, "_write_through", write_through)
        with pytest.raises(PathreplayError, match="No space left on the disk"):
            optimize(resume="run", progress=False)
    assert len(history.read_text().splitlines()) == 3 and Path("run/report.html").exists()
    assert optimize(resume="run", progress=False).iterations == 6
    assert len(history.read_text().splitlines()) == 6
    with pytest.raises(PathreplayError, match="has all its 6 iterations"):
        optimize(resume="run", progress=False)


def test_target_files_give_the_same_problem_as_the_scene_that_made_them() -> None:
    first = run(iterations=1)
    files = [str(first.folder / f"images/target-{name}.exr") for name in ("left", "right")]
    second = run(iterations=1, target={"images": files})
    assert second.history[0].loss == pytest.approx(first.history[0].loss, rel=1e-5)
    assert second.errors == {}  # no truth is known


def test_sensors_can_be_chosen_by_name_and_number() -> None:
    result = run(iterations=1, sensors=["right"])
    assert {p.name for p in (result.folder / "images").glob("target-*.exr")} == {"target-right.exr"}
    assert run(iterations=1, sensors=[1]).history[0].loss == pytest.approx(result.history[0].loss, rel=1e-5)


def test_an_integrator_that_fails_is_told_and_leaves_no_folder(room: Path) -> None:
    class Broken(mi.ad.integrators.prb.PRBIntegrator):
        def render_backward(self, *arguments: object, **options: object) -> None:
            raise RuntimeError("not today")

    mi.register_integrator("broken", Broken)
    with pytest.raises(PathreplayError, match="Integrator 'broken' cannot do this job: not today"):
        run(integrator={"type": "broken", "max_depth": 3})
    assert not list(room.glob("runs/*"))


def test_a_folder_that_is_resumed_stays_even_where_no_iteration_can_be_done(monkeypatch: pytest.MonkeyPatch) -> None:
    def aborted(*_: object) -> None:
        raise KeyboardInterrupt

    def failing(*_: object) -> None:
        raise PathreplayError("no iteration can be done")

    monkeypatch.setattr(loop, "iterate", aborted)
    with pytest.raises(KeyboardInterrupt):
        run()
    (folder,) = Path("runs").iterdir()
    monkeypatch.setattr(loop, "iterate", failing)
    with pytest.raises(PathreplayError, match="no iteration"):
        optimize(resume=folder, progress=False)
    assert (folder / "checkpoint.safetensors").is_file()
    with pytest.raises(PathreplayError, match="no iteration"):
        run()
    assert list(Path("runs").iterdir()) == [folder]


def test_a_target_that_cannot_be_rendered_is_told(room: Path) -> None:
    class Blind(mi.ad.integrators.prb.PRBIntegrator):
        def render(self, *arguments: object, **options: object) -> None:
            raise RuntimeError("not today")

    mi.register_integrator("blind", Blind)
    target = {"scene": "room.xml", "integrator": {"type": "blind", "max_depth": 3}}
    with pytest.raises(PathreplayError, match=r"Integrator 'blind' cannot render the target of .*: not today"):
        run(target=target)
    assert not list(room.glob("runs/*"))


@pytest.mark.parametrize("config", [3, {"scene": "room.xml"}, None])
def test_what_is_no_config_is_told(config: object) -> None:
    with pytest.raises(PathreplayError, match="config"):
        optimize(config)
