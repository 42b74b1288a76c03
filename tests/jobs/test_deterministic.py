"""deterministic = true: runs that were killed and resumed are those that nobody disturbed, bit for bit."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest
import safetensors.numpy

from pathreplay.jobs import optimize
from room_job import CLOUD, TEXTURE
from small_job import checkpoint_bits, ended, kill_at_checkpoint, start, write_job

PATHREPLAY = {"integrator": {"type": "pathreplay", "max_depth": 3}}
REFINED = {"parameters": [{"key": TEXTURE, "initial": 0.5, "lower": 0.0, "resolutions": [2, 8], "refine_at": [3]}]}
JOBS: dict[str, dict[str, Any]] = {
    "sweep": PATHREPLAY,
    "prb": {},
    "coarse to fine": {**PATHREPLAY, **REFINED},
    "medium": CLOUD,
}
SLOW = pytest.mark.slow


def outcome(folder: Path) -> tuple[dict[str, bytes], list[Any]]:
    """All bits of the result, and the history without its seconds."""
    values = safetensors.numpy.load_file(folder / "parameters.safetensors")
    lines = [json.loads(line) for line in (folder / "history.jsonl").read_text().splitlines()]
    return {key: value.tobytes() for key, value in values.items()}, [{**line, "seconds": 0} for line in lines]


def adam(folder: Path) -> dict[str, bytes]:
    return checkpoint_bits(folder)


@SLOW
@pytest.mark.parametrize(
    ("job", "number"),
    [(job, number) for job in JOBS for number in (signal.SIGKILL, signal.SIGTERM)],
)
def test_killed_and_resumed_is_undisturbed_to_the_bit(job: str, number: signal.Signals, tmp_path: Path) -> None:
    config = {**JOBS[job], "iterations": 8, "checkpoint_every": 1, "deterministic": True}
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    for folder in (whole, cut):
        folder.mkdir()
        write_job(folder, **config)
    status, _, err = ended(start(whole, "job.json", "--quiet"))
    assert status == 0, err
    process = start(cut, "job.json", "--quiet")
    kill_at_checkpoint(cut, process, 2, number)
    ended(process)
    assert not (cut / "run/report.html").exists() or number == signal.SIGTERM
    status, out, err = ended(start(cut, "--resume", "run", "--quiet"))
    assert status == 0, err
    assert "in 8 iterations" in out
    assert outcome(cut / "run") == outcome(whole / "run")
    assert adam(cut / "run") == adam(whole / "run")


@pytest.mark.slow
def test_without_it_runs_differ_by_rounding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    job = write_job(tmp_path, **CLOUD, iterations=8)
    before = dr.thread_count()
    dr.set_thread_count(2)
    try:
        first, second = (optimize(job, progress=False).parameters for _ in range(2))
    finally:
        dr.set_thread_count(before)
    gaps = {key: float(np.abs(value - second[key]).max()) for key, value in first.items()}
    print(f"largest difference of two undisturbed runs with two threads: {gaps}")
    # Rounding of float32 at 1 is 1.2e-7; Adam divides by the root of a mean square, which lifts it a little.
    assert max(gaps.values()) < 1e-4


def test_threads_come_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    before = dr.thread_count()
    dr.set_thread_count(2)
    try:
        optimize(write_job(tmp_path, iterations=1, deterministic=True), progress=False)
        assert dr.thread_count() == 2
    finally:
        dr.set_thread_count(before)
