"""A job of a second, in a process of its own: to be killed, stopped, and gone on with."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy

from pathreplay.inverse.loop.checkpoint import HISTORY
from pathreplay.inverse.loop.checksums import SEAL
from pathreplay.jobs import make_config
from pathreplay.platform import interrupts
from room_job import JOB, SCENE

#: Far above what a small job takes on a loaded machine.
TIMEOUT_S = 120
ERROR = "pathreplay: error: "


def write_job(folder: Path, **changes: Any) -> Path:
    """Scene and job in ``folder``; returns the config."""
    from pathreplay.inverse.images.io import exr_bytes

    (folder / "room.xml").write_text(SCENE)
    texels = np.array([[0.1, 0.4], [0.6, 0.9]], np.float32)[:, :, None] * np.array([1, 0.8, 0.6], np.float32)
    (folder / "texture.exr").write_bytes(exr_bytes(texels))
    config = folder / "job.json"
    config.write_text(make_config({**JOB, "output": "run", **changes}).model_dump_json(exclude_unset=True))
    return config


def hear_signals() -> None:
    """In a child: what the tests' own parent ignores (nohup, a shell's background jobs) is not to be ignored there."""
    for number in interrupts.ENDING:
        signal.signal(number, signal.SIG_DFL)


def start(folder: Path, *arguments: str) -> subprocess.Popen[str]:
    """The command `pathreplay optimize ARGUMENTS` under way in ``folder``."""
    environment = {k: v for k, v in os.environ.items() if k != "DRJIT_LIBLLVM_PATH"}
    command = [sys.executable, "-m", "pathreplay.cli", "optimize", *arguments]
    return subprocess.Popen(
        command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        preexec_fn=hear_signals,
    )  # fmt: skip


def wait_for(path: Path, process: subprocess.Popen[str], newer_than: float = 0.0) -> None:
    """Until the file is there (again), or the process has ended before: then the test fails."""
    end = time.monotonic() + TIMEOUT_S
    while not path.exists() or path.stat().st_mtime <= newer_than:
        if process.poll() is not None:
            pytest.fail(f"ended before {path} was there: {process.communicate()}")
        assert time.monotonic() < end, f"no {path}"
        time.sleep(0.005)


def ended(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    """Status, stdout and stderr."""
    try:
        out, err = process.communicate(timeout=TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        raise
    return process.returncode, out, err


def checkpoint_bits(folder: Path) -> dict[str, bytes]:
    """What the checkpoint in a run folder holds, bit for bit: values, what the optimiser remembers, what was learned.

    Without its history and its seal, which know how many seconds the run took.
    """
    tensors = safetensors.numpy.load_file(folder / "checkpoint.safetensors")
    return {name: value.tobytes() for name, value in tensors.items() if name not in (HISTORY, SEAL)}


def kill_at_checkpoint(folder: Path, process: subprocess.Popen[str], which: int, number: signal.Signals) -> None:
    """Send a signal once the checkpoint has been written anew ``which`` times."""
    path, seen = folder / "run/checkpoint.safetensors", 0.0
    for _ in range(which + 1):
        wait_for(path, process, seen)
        seen = path.stat().st_mtime
    process.send_signal(number)


def bits(values: Mapping[str, np.ndarray]) -> dict[str, Any]:
    return {key: (value.dtype, value.shape, value.tobytes()) for key, value in values.items()}


def points(html: str) -> list[tuple[float, float]]:
    line = re.search(r'points="([^"]*)"', html)
    return [tuple(map(float, pair.split(","))) for pair in line[1].split()] if line else []
