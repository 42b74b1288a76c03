"""Minimisations in folders: what they write, how they go on, and what is said where that cannot be."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from typer.testing import CliRunner

import pathreplay
from library_scenes import GREY, OPTIMIZERS, SIDE, SLOWLY, TEXTURE, WALL, Descent, Heavy, photos_of_room, room, views
from pathreplay import Parameter, PathreplayError, Problem, View
from pathreplay.cli import app
from pathreplay.jobs import optimize
from pathreplay.report.live_page import PAGE
from small_job import checkpoint_bits, ended, hear_signals, points, wait_for
from variant import VARIANT

RUN = Path("run")


@pytest.fixture(autouse=True)
def _variant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mi.set_variant(VARIANT)
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def photos() -> list[np.ndarray]:
    return photos_of_room()


def problem_of(photos: list[np.ndarray], **settings: Any) -> Problem:
    wanted = {WALL: GREY, TEXTURE: Parameter(initial=0.5, resolutions=[2, 4], refine_at=[3])}
    return Problem(room(), wanted, views(photos), spp=4, **{"deterministic": True, "learning_rate": 0.03, **settings})


def run(problem: Problem, optimizer: Any = None, steps: int = 6, **more: Any) -> pathreplay.Result:
    return pathreplay.minimize(problem, optimizer, steps, progress=False, **more)


def test_a_folder_is_that_of_a_job(photos: list[np.ndarray]) -> None:
    problem = problem_of(photos)
    plain, result = run(problem), run(problem, output="run", preview={"share": 0.5})
    assert result.folder == RUN.absolute() and plain.folder is None
    for key, value in plain.values.items():
        np.testing.assert_array_equal(result.values[key], value)
    assert [entry.loss for entry in result.history] == [entry.loss for entry in plain.history]
    for name in ("report.html", "checkpoint.safetensors", PAGE, "history.jsonl", "images/result-left.exr"):
        assert (RUN / name).is_file(), name
    page = json.loads((RUN / PAGE).read_text())
    assert page["command"] == "pathreplay.minimize(problem, output='run', resume=True)"
    assert "pathreplay.minimize(problem, output=" in (RUN / "report.html").read_text()
    assert run(problem, output="run", steps=4).folder == Path("run-2").absolute()
    told = CliRunner().invoke(app, ["compare", "run", "run-2"])
    assert told.exit_code == 0, told.output


@pytest.mark.parametrize("make", [pytest.param(make, id=name, marks=SLOWLY[name]) for name, make in OPTIMIZERS.items()])
def test_a_run_that_was_left_goes_on_bit_for_bit(make: Callable[[], Any], photos: list[np.ndarray]) -> None:
    """Left by an error in a callback, before and after a grid is refined."""
    whole = run(problem_of(photos), make(), output="whole")
    for last in (1, 4):

        def leave(it: pathreplay.Iteration, last: int = last) -> None:
            if it.number == last:
                raise ZeroDivisionError

        with pytest.raises(ZeroDivisionError):
            run(problem_of(photos), make(), output="run", resume=True, callbacks=[leave])
        assert not (RUN / "report.html").exists()
    result = run(problem_of(photos), make(), output="run", resume=True)
    assert checkpoint_bits(RUN) == checkpoint_bits(Path("whole"))
    assert [entry.iteration for entry in result.history] == list(range(6))
    for key, value in whole.values.items():
        np.testing.assert_array_equal(result.values[key], value)


SCRIPT = """
import numpy as np, mitsuba as mi, pathreplay
mi.set_variant({variant!r})
box = mi.cornell_box()
box["sensor"]["film"].update(width=16, height=16)
grey = pathreplay.Parameter(initial=0.5, bounds=(0, 1))
view = pathreplay.View(target=np.load("photo.npy"))
problem = pathreplay.Problem(box, {{"red.reflectance.value": grey}}, view, spp=2, deterministic=True)
pathreplay.minimize(problem, steps=12, output={output!r}, resume=True, progress=False, checkpoint_every=2)
"""


@pytest.mark.slow
def test_a_script_that_was_killed_is_started_again_and_ends_with_the_same_bits() -> None:
    box = mi.cornell_box()
    box["sensor"]["film"].update(width=16, height=16)
    np.save("photo.npy", np.array(mi.render(mi.load_dict(box), spp=16)))
    environment = {k: v for k, v in os.environ.items() if k != "DRJIT_LIBLLVM_PATH"}

    def started(output: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-c", SCRIPT.format(variant=VARIANT, output=output)]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        return subprocess.Popen(command, env=environment, text=True, preexec_fn=hear_signals, **pipes)

    process = started("run")
    wait_for(RUN / "checkpoint.safetensors", process)
    seen = (RUN / "checkpoint.safetensors").stat().st_mtime
    wait_for(RUN / "checkpoint.safetensors", process, seen)
    process.send_signal(signal.SIGKILL)
    ended(process)
    assert not (RUN / "report.html").exists()
    for output in ("run", "whole"):
        status, _, err = ended(started(output))
        assert status == 0, err
    assert checkpoint_bits(RUN) == checkpoint_bits(Path("whole"))


@pytest.mark.parametrize("joint", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["one scene", "two scenes"])
def test_targets_that_were_rendered_again_do_not_end_a_run(joint: bool, photos: list[np.ndarray]) -> None:
    """Threads sum in any order, so the targets of a second process differ in the last bits: the saved ones are used."""

    def made(factor: float, **settings: Any) -> Problem:
        seen = [photo * np.float32(factor) for photo in photos]
        settings |= {"spp": 1, "eval_spp": 1, "deterministic": True}
        problems = [Problem(room(), {WALL: GREY}, views(seen), **settings) for _ in range(1 + joint)]
        return Problem.joint(problems) if joint else problems[0]

    run(made(1), output="whole", steps=3)
    run(made(1), output="run", steps=3, callbacks=[lambda it: it.number == 0])
    with pytest.raises(PathreplayError, match="another target or weight of view"):
        run(made(1.001), output="run", steps=3, resume=True)
    run(made(1 + 1e-6), output="run", steps=3, resume=True)
    assert checkpoint_bits(RUN) == checkpoint_bits(Path("whole"))


def test_what_cannot_go_on_is_told_in_one_line(photos: list[np.ndarray]) -> None:
    problem = problem_of(photos)
    run(problem, output="run", steps=4)

    def told(words: str, problem: Problem = problem, optimizer: Any = None, **more: Any) -> None:
        with pytest.raises(PathreplayError, match=words) as error:
            run(problem, optimizer, **{"output": "run", "resume": True, **more})
        assert "\n" not in str(error.value)

    told("has all its 4 iterations; raise 'steps'", steps=4)
    told("give 'output'", output=None)
    told("Descent has no state_dict\\(\\) and load_state_dict", optimizer=Descent(), output="other")
    assert not Path("other").exists()
    told("another target or weight of view 'right'", problem_of([photos[0], photos[0]]))
    told("has the parameters", Problem(room(), {WALL: GREY}, views(photos), spp=4))
    told("is not a state array of this optimizer", optimizer="sgd")
    told("'loss' belongs to the problem; give it to Problem", loss="l1")
    told("'response' belongs to the problem; give it to Problem", response={"kind": "gamma"})
    told("unknown key 'checkpoint_evry'; did you mean 'checkpoint_every'", checkpoint_evry=3)
    told("'iterations' is called 'steps' here", iterations=3)
    told("executor = 'ray': objects in memory cannot be sent", executor="ray", output=None, resume=False)
    Path("file").write_text("")
    told("is not a run folder", output="file")
    told("a file has that name; give another 'output'$", output="file", resume=False)
    told("has no name of its own; give 'output' a new name", output="..", resume=False)
    told("cannot be created .*; give another 'output'$", output="file/run", resume=False)
    with pytest.raises(PathreplayError, match=r"started in Python.*minimize\(problem, output='run', resume=True\)"):
        optimize(resume="run", progress=False)
    exported = CliRunner().invoke(app, ["export", "run"])
    assert "result.apply(scene)" in str(exported.exception)
    assert run(problem, output="run", resume=True, steps=5).history[-1].iteration == 4


def test_an_empty_folder_is_resumed_as_a_new_run(photos: list[np.ndarray]) -> None:
    """And again, when it is a run. Without ``resume``, it is left alone."""
    Path("run").mkdir()
    problem = problem_of(photos)
    assert run(problem, output="run", steps=4).folder == Path("run-2").absolute()
    assert run(problem, output="run", steps=4, resume=True).folder == RUN.absolute()
    assert len(run(problem, output="run", steps=5, resume=True).history) == 5
    Path("link").symlink_to("empty")
    Path("empty").mkdir()
    with pytest.raises(PathreplayError, match=r"Run folder link is empty, but cannot be replaced .*; give another 'ou"):
        run(problem, output="link", steps=4, resume=True)
    (Path("empty") / "file").touch()
    with pytest.raises(PathreplayError, match="empty is not a run folder"):
        run(problem, output="empty", steps=4, resume=True)


def test_an_impossible_output_is_noticed_before_images_are_rendered(
    photos: list[np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pathreplay.library.folder_run.render_views", lambda *_: pytest.fail("images are rendered"))
    Path("file").write_text("")
    for resume in (False, True):
        with pytest.raises(PathreplayError, match=r"cannot be created .*; give another 'output'$"):
            run(problem_of(photos), output="file/run", resume=resume)


def test_a_folder_of_a_run_that_cannot_begin_goes_again(photos: list[np.ndarray]) -> None:
    class Broken(Heavy):
        def step(self, *_: Any) -> Any:
            return {}

    with pytest.raises(PathreplayError, match="returned no value"):
        run(problem_of(photos), Broken(), output="deep/run")
    assert not Path("deep").exists()


def test_a_callback_and_the_stop_button_end_it_with_a_report(photos: list[np.ndarray]) -> None:
    problem = problem_of(photos)
    result = run(problem, output="run", callbacks=[lambda it: it.number == 1])
    assert (result.stopped, len(result.history)) == ("a callback", 2) and (RUN / "report.html").is_file()

    def press(it: pathreplay.Iteration) -> None:
        assert it.folder is not None
        (it.folder / "stop").touch()

    result = run(problem, output="run", resume=True, callbacks=[press])
    assert (result.stopped, len(result.history)) == ("the stop button", 4)
    assert len(run(problem, output="run", resume=True).history) == 6


def test_a_notebook_shows_curve_and_images_without_a_folder(
    outputs: list[str],
    photos: list[np.ndarray],
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    problem = problem_of(photos)
    plain = run(problem, steps=4)
    assert outputs == []
    result = pathreplay.minimize(problem, steps=4, preview={"share": 0.5})
    assert capfd.readouterr().err == "" and list(tmp_path.iterdir()) == []
    last = outputs[-1]
    assert "minimize: ended" in last and "4 of 4" in last and len(points(last)) == 4
    assert last.count('src="data:image/webp;base64,') == 3 * 2
    for key, value in plain.values.items():  # who looks on changes nothing
        np.testing.assert_array_equal(result.values[key], value)
    outputs.clear()
    pathreplay.minimize(problem, steps=4, output="run")
    assert "run: ended" in outputs[-1] and "4 of 4" in outputs[-1]


def test_a_signal_ends_a_silent_run_with_a_line(photos: list[np.ndarray], capfd: pytest.CaptureFixture[str]) -> None:
    def terminate(iteration: pathreplay.Iteration) -> None:
        if iteration.number == 1:
            signal.raise_signal(signal.SIGTERM)

    result = run(problem_of(photos), steps=6, callbacks=terminate)
    assert result.stopped == "SIGTERM" and len(result.history) == 2
    assert "SIGTERM: stopping after this iteration" in capfd.readouterr().out


def test_ten_scenes_one_after_the_other_leave_nothing_behind() -> None:
    """Each in a folder; recordings, locks and threads of one are not in the way of the next."""
    threads, handlers = dr.thread_count(), signal.getsignal(signal.SIGINT)
    for n in range(10):
        colour = [0.1 + 0.08 * n, 0.5, 0.3]
        scene = room()
        scene["wall"]["bsdf"]["reflectance"]["value"] = colour
        target = np.array(mi.render(mi.load_dict(scene), sensor=0, spp=64))
        problem = Problem(room(), {WALL: GREY}, View("left", target), spp=16, learning_rate=0.08)
        result = run(problem, output=f"runs/{n}", steps=10)
        assert result.history[-1].loss < 0.5 * result.history[0].loss
        assert np.abs(result.values[WALL] - colour).max() < 0.2, n
    assert len(list(Path("runs").iterdir())) == 10
    assert (dr.thread_count(), signal.getsignal(signal.SIGINT)) == (threads, handlers)
    assert result.render(view="left", spp=4).shape == (SIDE, SIDE, 3)


@pytest.mark.parametrize("other", ["sgd", "rmsprop"])
def test_a_run_does_not_go_on_with_another_optimizer(other: str, photos: list[np.ndarray]) -> None:
    run(problem_of(photos), output="run", steps=4)
    with pytest.raises(PathreplayError, match=r"no state of this optimizer .* resume with the optimizer of the run"):
        run(problem_of(photos), other, output="run", steps=6, resume=True)
