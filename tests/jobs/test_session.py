"""Runs as loops over iterations: what one shows, and what is left whoever ends the loop."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest

import pathreplay
from pathreplay.errors import PathreplayError
from pathreplay.jobs import RunResult, iterate, make_config, optimize
from pathreplay.platform import memory
from pathreplay.platform.interrupts import ENDING
from room_job import CLOUD
from small_job import checkpoint_bits
from wall_job import JOB

pytestmark = pytest.mark.usefixtures("wall_room")

KEY = JOB["parameters"][0]["key"]
MEDIUM = {**CLOUD, "spp": 4, "eval_spp": 4, "deterministic": True, "iterations": 3}


def job(**changes: Any) -> Any:
    return make_config({**JOB, "iterations": 4, "output": "run", **changes})


def saved(folder: str = "run") -> dict[str, bytes]:
    """What a checkpoint holds, bit for bit."""
    return checkpoint_bits(Path(folder))


@pytest.mark.parametrize("changes", [{}, pytest.param(MEDIUM, marks=pytest.mark.slow)], ids=["surface", "medium"])
def test_a_loop_that_looks_comes_where_optimize_comes(changes: dict[str, Any]) -> None:
    whole = optimize(job(**changes), progress=False)
    seen: list[pathreplay.Iteration] = []
    session = pathreplay.iterate(job(**changes))
    for state in session:
        picture = state.render()
        assert picture.shape == state.render(state.views[0]).shape and np.isfinite(picture).all()
        seen.append(state)
    assert isinstance(session.result, RunResult) and session.result.folder.name == "run-2"
    assert [state.number for state in seen] == [entry.iteration for entry in whole.history]
    assert [state.loss for state in seen] == [entry.loss for entry in whole.history]
    for key, value in seen[-1].values.items():
        assert value.tobytes() == whole.parameters[key].tobytes()
        assert np.abs(seen[0].values[key] - value).max() > 0
        assert seen[0].gradient_norms[key] > 0
    assert saved("run-2") == saved("run")
    # A state keeps its values, and so its picture, after the run has gone on.
    assert np.abs(seen[0].render() - seen[-1].render()).max() > 0
    assert (seen[-1].render() == picture).all()


def test_who_leaves_the_loop_leaves_a_checkpoint_that_goes_on() -> None:
    whole = optimize(job(output="whole"), progress=False)
    threads, handler = dr.thread_count(), signal.getsignal(signal.SIGINT)
    for state in iterate(job()):
        if state.number == 1:
            break
    assert (dr.thread_count(), signal.getsignal(signal.SIGINT)) == (threads, handler)
    assert not Path("run/report.html").exists()
    assert optimize(resume="run", progress=False).iterations == 4
    assert saved() == saved("whole")
    assert whole.report.is_file()


def test_a_loop_can_be_resumed_and_finished_early() -> None:
    with iterate(job()) as session:
        next(session)
    with iterate(resume="run") as session:
        state = next(session)
        assert state.number == 1
        result = session.stop()
    assert result.stopped and result.stopped_by == "stop()" and result.iterations == 2
    assert result.report.is_file() and session.stop() is result
    assert "stopped early by stop()" in result.describe()


def test_an_error_in_the_loop_leaves_a_checkpoint() -> None:
    with pytest.raises(ZeroDivisionError), iterate(job()) as session:
        for state in session:
            if state.number == 2:
                1 / 0  # noqa: B018
    with iterate(resume="run") as session:  # the lock is free
        assert next(session).number == 3


def test_nothing_is_done_before_the_first_state() -> None:
    session = iterate(job())
    session.close()
    assert not Path("run").exists()
    with pytest.raises(PathreplayError, match="was closed"):
        session.stop()
    with pytest.raises(PathreplayError, match="did you mean"):
        iterate(Path("jab.toml")) if Path("job.toml").write_text("") == 0 else None


TOML = """scene = "room.xml"
iterations = {iterations}
spp = 1
eval_spp = 1
output = "run"
parameters = [{{key = "wall.bsdf.reflectance.value", initial = 0.5}}]
target = {{values = {{"wall.bsdf.reflectance.value" = 0.2}}, spp = 1}}
"""


@pytest.mark.parametrize("change", ["edited", "moved"])
def test_the_folder_has_the_job_that_was_read(change: str) -> None:
    file, text = Path("job.toml"), TOML.format(iterations=2).replace("\n", "\r\n").encode()
    file.write_bytes(text)
    with iterate("job.toml") as session:
        if change == "edited":
            file.write_text(TOML.format(iterations=3))
        else:
            file.rename("other.toml")
        next(session)
    assert Path("run/config.toml").read_bytes() == text
    assert optimize(resume="run", progress=False).iterations == 2


def test_a_job_in_a_file_with_a_suffix_in_capitals_goes_on() -> None:
    Path("job.JSON").write_text(job(iterations=2).model_dump_json(exclude_unset=True))
    with iterate("job.JSON") as session:
        next(session)
    assert optimize(resume="run", progress=False).iterations == 2


def test_a_run_that_never_began_lets_go_of_its_folder() -> None:
    with iterate(job()) as session:
        next(session)
    session = iterate(resume="run")
    with pytest.raises(PathreplayError, match="is in use"):
        iterate(resume="run")
    del session
    assert optimize(resume="run", progress=False).iterations == 4


def test_two_loops_that_alternate_leave_nothing_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    handlers = {number: signal.getsignal(number) for number in ENDING}
    with iterate(job(memory_limit="100 GB", iterations=2)) as first, iterate(job(iterations=3)) as second:
        for one, other in zip(first, second, strict=False):
            assert one.number == other.number
        assert first.result is not None and next(second).number == 2
    assert handlers == {number: signal.getsignal(number) for number in ENDING}
    monkeypatch.setattr(memory, "taken", lambda: 10**15)
    memory.require_kept()


def test_a_view_that_is_not_there_is_told() -> None:
    with iterate(job()) as session:
        with pytest.raises(PathreplayError, match="No view 'left'; there are view-0"):
            next(session).render("left")


def test_threads_are_the_callers_between_iterations() -> None:
    before = dr.thread_count()
    dr.set_thread_count(2)
    try:
        with iterate(job()) as session:
            next(session)
            assert dr.thread_count() == 2
    finally:
        dr.set_thread_count(before)
