"""Ordinary use: scenes as people have them, each through `check` and through five iterations of `optimize`."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy

from hostile.toml_text import toml
from ordinary_scenes import SCENES, Use, Write

ITERATIONS = 5
SLOW: set[str] = set()


def command(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """`pathreplay` as a user calls it in a folder."""
    return subprocess.run(
        [sys.executable, "-m", "pathreplay.cli", *arguments],
        cwd=folder, env=os.environ | {"DRJIT_LIBLLVM_PATH": ""}, stdin=subprocess.DEVNULL, capture_output=True,
        text=True, timeout=120, check=False,
    )  # fmt: skip


def check(folder: Path, use: Use) -> None:
    """Every parameter that the key names passes."""
    result = command(
        folder, "check", "scene.xml", "--param", use.key, "--seeds", "4", "--spp", "32", "--variant", use.variant,
        "--json", "check.json", *use.options,
    )  # fmt: skip
    assert result.returncode == 0, result.stdout + result.stderr
    verdicts = [entry["verdict"] for entry in json.loads((folder / "check.json").read_text())]
    assert verdicts and set(verdicts) == {"pass"}


def optimize(folder: Path, use: Use) -> None:
    """Five iterations lower the loss, and everything that the run folder should hold is there."""
    job = {
        "scene": "scene.xml",
        "variant": use.variant,
        "iterations": ITERATIONS,
        "spp": 16,
        "picture_spp": 16,
        "learning_rate": 0.05,
        "integrator": {"type": "pathreplay", "max_depth": 4},
        "parameters": [{"key": use.key, "initial": use.start, "lower": 0.0}],
        "target": {"values": {use.key: use.truth}, "spp": 64, "integrator": {"type": use.target, "max_depth": 4}},
    }
    (folder / "job.toml").write_text(toml(job), encoding="utf-8")
    result = command(folder, "optimize", "job.toml", "--quiet")
    assert result.returncode == 0, result.stdout + result.stderr

    run = folder / "runs" / "job"
    losses = [json.loads(line)["loss"] for line in (run / "history.jsonl").read_text().splitlines()]
    assert len(losses) == ITERATIONS
    assert np.isfinite(losses).all()
    assert losses[-1] < losses[0]
    for kind in ("target", "start", "result"):
        assert len(list((run / "images").glob(f"{kind}-*.exr"))) == len(use.views)
        assert len(list((run / "images").glob(f"{kind}-*.png"))) == len(use.views)
    found = safetensors.numpy.load_file(run / "parameters.safetensors")
    assert found and all(np.isfinite(value).all() for value in found.values())
    assert (run / "report.html").stat().st_size > 10_000
    assert not list(run.rglob("*.part"))


@pytest.mark.parametrize(
    "write", [pytest.param(s, id=s.__name__, marks=[pytest.mark.slow] * (s.__name__ in SLOW)) for s in SCENES]
)
def test_check_and_optimize(write: Write, tmp_path: Path) -> None:
    use = write(tmp_path)
    (tmp_path / "scene.xml").write_text(use.xml, encoding="utf-8")
    check(tmp_path, use)
    optimize(tmp_path, use)
