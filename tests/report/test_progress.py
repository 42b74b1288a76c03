"""Progress where there is no terminal: lines on stderr, and a result that prints short."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import numpy as np
import pytest

from pathreplay.inverse.loop.checkpoint import Entry
from pathreplay.inverse.loop.verdict import Verdict
from pathreplay.report import progress
from pathreplay.report.result import RunResult


def lines(total: int) -> None:
    with progress.Progress(True) as bar:
        bar.say("preparing")
        bar.start(0, total)
        for i in range(total):
            bar.advance(1 / (i + 1))


def test_lines_at_the_beginning_and_the_end(capsys: pytest.CaptureFixture[str]) -> None:
    lines(40)
    out, err = capsys.readouterr()
    assert out == ""
    told = err.splitlines()
    assert told[0] == "pathreplay: preparing"
    assert "iteration 1 of 40, loss 1," in told[2] and "iteration 40 of 40, loss 0.025" in told[-1]
    assert len(told) == 4  # quicker than a line every ten seconds


def test_a_line_now_and_then(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    clock = iter(range(0, 100_000, 3))
    monkeypatch.setattr(progress.time, "monotonic", lambda: float(next(clock)))
    lines(40)
    assert 8 <= len(capsys.readouterr().err.splitlines()) < 40


def test_who_only_looks_like_a_notebook_gets_lines(run_python) -> None:
    code = """
class ZMQInteractiveShell: pass
import builtins
builtins.get_ipython = ZMQInteractiveShell  # how rich tells a notebook; it then draws with ipywidgets, or nothing
from rich.console import Console
from pathreplay.platform import backend
backend.set_variant("llvm_ad_rgb")
from pathreplay.report.progress import Progress
print(Console().is_jupyter)
with Progress(True) as bar:
    bar.start(0, 2); bar.advance(0.5); bar.advance(0.25)
"""
    done = run_python(code)
    assert done.stdout == "True\n"
    assert "iteration 2 of 2, loss 0.25" in done.stderr and "ipywidgets" not in done.stderr


def test_silence_where_it_is_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    with progress.Progress(False) as bar:
        bar.say("preparing")
        bar.start(0, 1)
        bar.advance(1.0)
    assert capsys.readouterr() == ("", "")


def test_a_signal_that_comes_while_a_line_is_printed_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    class Printing(io.StringIO):
        def write(self, text: str) -> int:
            raise RuntimeError("reentrant call inside <_io.BufferedWriter name='<stderr>'>")

    monkeypatch.setattr(sys, "stderr", Printing())
    with progress.Progress(True) as bar:
        bar.say("SIGTERM: stopping after this iteration")


def test_a_result_prints_short() -> None:
    history = tuple(Entry(i, 0.5, 1.0, {"a": 1.0}) for i in range(1000))
    values = {"a": np.zeros((100, 100, 3), np.float32)}
    result = RunResult(
        Path("runs/x"), Path("runs/x/report.html"), 1000, False, None, history, values, {}, {}, {}, (), Verdict()
    )
    assert repr(result) == "<RunResult: 1000 iterations, loss 0.5, 1 parameters, runs/x/report.html>"
