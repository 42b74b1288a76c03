"""Signals to a run in a process of its own: the first stops it with everything written, a second Ctrl-C aborts it."""

from __future__ import annotations

import contextlib
import os
import pty
import signal
import sys
import time
import weakref
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from pathreplay.jobs import optimize
from pathreplay.platform import interrupts
from pathreplay.platform.interrupts import stopping
from small_job import TIMEOUT_S, ended, hear_signals, kill_at_checkpoint, start, wait_for, write_job

ENDLESS = {"iterations": 100_000, "checkpoint_every": 1}


@pytest.mark.parametrize(
    "number", [signal.SIGTERM, *(pytest.param(n, marks=pytest.mark.slow) for n in (signal.SIGHUP, signal.SIGINT))]
)
def test_first_signal_stops_with_everything_written(number: signal.Signals, tmp_path: Path) -> None:
    process = start(tmp_path, str(write_job(tmp_path, **ENDLESS)), "--quiet")
    kill_at_checkpoint(tmp_path, process, 2, number)
    status, out, err = ended(process)
    name = "Ctrl-C" if number == signal.SIGINT else number.name
    assert (status, err) == (0, "")
    assert f"stopped early by {name}; resume with: pathreplay optimize --resume run" in out
    assert (tmp_path / "run/report.html").is_file()


def test_signals_that_wait_come_after_an_error_too() -> None:
    came: list[int] = []
    with interrupts.handled(lambda number, frame: came.append(number)), pytest.raises(ValueError):
        with interrupts.undisturbed():
            signal.raise_signal(signal.SIGTERM)
            raise ValueError
    assert came == [signal.SIGTERM]


def test_two_ctrl_c_at_once_abort_in_one_line(tmp_path: Path) -> None:
    # Rendering the last images takes so long that the second signal arrives before the run has ended.
    process = start(tmp_path, str(write_job(tmp_path, **ENDLESS, eval_spp=20_000)), "--quiet")
    kill_at_checkpoint(tmp_path, process, 2, signal.SIGINT)
    for _ in range(2):
        time.sleep(0.02)
        process.send_signal(signal.SIGINT)
    status, out, err = ended(process)
    assert (status, out) == (130, "")
    assert err == "pathreplay: aborted; resume from the last checkpoint with: pathreplay optimize --resume run\n"
    assert not list((tmp_path / "run").rglob("*.part"))


@pytest.mark.parametrize("number", [pytest.param(signal.SIGINT, marks=pytest.mark.slow), signal.SIGTERM])
def test_before_the_run_folder_a_signal_ends_in_one_line(number: signal.Signals, tmp_path: Path) -> None:
    # Preparation lasts: so many samples for the targets.
    target = {"scene": "room.xml", "spp": 400_000, "integrator": {"type": "path", "max_depth": 3}}
    process = start(tmp_path, str(write_job(tmp_path, target=target)), "--quiet")
    wait_for(Path(f"/proc/{process.pid}/task"), process)
    while "/llvm_ad_rgb." not in Path(f"/proc/{process.pid}/maps").read_text():
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(number)
    time.sleep(0.02)
    process.send_signal(number)
    status, out, err = ended(process)
    assert (status, out) == (128 + number, "")
    assert err == f"pathreplay: ended by {interrupts.name_of(number)}\n"
    assert not (tmp_path / "run").exists()


@pytest.mark.slow  # other tests end a run by a signal, and see all that it writes
def test_a_closed_terminal_does_not_stop_the_writing(tmp_path: Path) -> None:
    write_job(tmp_path, **ENDLESS)
    pid, terminal = pty.fork()
    if pid == 0:  # with a progress bar, on a terminal of its own
        os.chdir(tmp_path)
        hear_signals()
        os.execv(sys.executable, [sys.executable, "-m", "pathreplay.cli", "optimize", "job.json"])
    end, times = time.monotonic() + TIMEOUT_S, set[float]()
    os.set_blocking(terminal, False)
    # The first checkpoint is written with the folder, before signals request a stop.
    while len(times) < 2 and time.monotonic() < end:
        with contextlib.suppress(FileNotFoundError):
            times.add((tmp_path / "run/checkpoint.safetensors").stat().st_mtime)
        time.sleep(0.01)
        with contextlib.suppress(BlockingIOError):
            os.read(terminal, 100_000)
    os.close(terminal)  # the kernel sends SIGHUP
    done, end = 0, time.monotonic() + TIMEOUT_S
    while not done and time.monotonic() < end:
        time.sleep(0.01)
        done, status = os.waitpid(pid, os.WNOHANG)
    if not done:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
    assert done and os.WIFEXITED(status)
    assert (tmp_path / "run/history.jsonl").is_file() and (tmp_path / "run/report.html").is_file()


def test_handlers_come_back_and_scheduler_signals_may_come_twice() -> None:
    before = {number: signal.getsignal(number) for number in interrupts.ENDING}
    said: list[str] = []
    with stopping(said.append, "out") as stop:
        assert stop.by is None
        for number in (signal.SIGTERM, signal.SIGTERM, signal.SIGHUP):
            signal.raise_signal(number)
        assert stop.by == "SIGTERM" and len(said) == 1
        with pytest.raises(KeyboardInterrupt, match="out"):
            signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)  # at once after the other: one wish
    assert before == {number: signal.getsignal(number) for number in interrupts.ENDING}


@pytest.mark.parametrize("block", [interrupts.raised, lambda: stopping(lambda text: None, "out")])
def test_a_signal_within_a_callback_of_a_weak_reference_ends_the_block(
    block: Callable[[], AbstractContextManager[object]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Python ignores the exception there, prints a traceback, and goes on: the command would run to its end."""
    before = {number: signal.getsignal(number) for number in interrupts.ENDING}
    monkeypatch.setattr(interrupts, "_raised_at", [])
    told: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", told.append)
    lost = set()
    try:
        with pytest.raises(KeyboardInterrupt):
            with block():
                if block is not interrupts.raised:
                    signal.raise_signal(signal.SIGINT)  # requests a stop; only the next one aborts
                watch = weakref.ref(lost, lambda _: signal.raise_signal(signal.SIGINT))
                del lost
                assert watch() is None
                for _ in range(100):
                    time.sleep(0.02)
                pytest.fail("the signal was not repeated")
        assert not told and sys.unraisablehook == told.append
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 0, 2), (1, 2, 0), (2, 0, 1)])
def test_blocks_with_handlers_end_in_any_order(order: tuple[int, ...]) -> None:
    came: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda number, frame: came.append(-1))
    try:
        blocks = [interrupts.handled(lambda number, frame, n=n: came.append(n)) for n in range(3)]
        for block in blocks:
            block.__enter__()
        active = [-1, 0, 1, 2]
        for n in order:
            blocks[n].__exit__(None, None, None)
            active.remove(n)
            signal.raise_signal(signal.SIGTERM)
            assert came[-1] == active[-1]
    finally:
        signal.signal(signal.SIGTERM, before)


def test_what_is_ignored_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    try:
        with stopping(lambda text: None, "") as stop:
            signal.raise_signal(signal.SIGHUP)
        assert stop.by is None
    finally:
        signal.signal(signal.SIGHUP, before)


def test_signals_wait_for_the_end_of_a_write() -> None:
    seen: list[int] = []
    with interrupts.handled(lambda number, frame: seen.append(number)):
        with interrupts.undisturbed():
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGTERM)
            assert seen == []
        assert seen == [signal.SIGINT, signal.SIGTERM]


def test_other_threads_are_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import threading

    monkeypatch.chdir(tmp_path)
    config = write_job(tmp_path, iterations=1)
    results = []
    thread = threading.Thread(target=lambda: results.append(optimize(config, progress=False)))
    thread.start()
    thread.join()
    assert results[0].iterations == 1
