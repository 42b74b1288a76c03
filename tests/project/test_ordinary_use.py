"""Ordinary use: scenes as people have them, each through `check` and through five iterations of `optimize`."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
import safetensors.numpy

from hostile.toml_text import toml
from ordinary_scenes import SCENES, Use, Write
from pathreplay import cli

ITERATIONS = 5
TIMEOUT_S = 120
# Of their kinds others are quick: meshes without coordinates, principled, environment maps.
SLOW = {"plain_obj", "principled_ply", "environment", "smoke", "spectral_room"}

Command = Callable[..., tuple[int, str]]


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Command:
    """`pathreplay ARGUMENTS` in the current folder; returns exit status and output.

    Where another variant than that of the tests is asked for, in a Python of its own.
    """

    def run(variant: str, *arguments: str) -> tuple[int, str]:
        if variant != mi.variant():
            done = subprocess.run(
                [sys.executable, "-m", "pathreplay.cli", *arguments],
                stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=TIMEOUT_S, check=False,
            )  # fmt: skip
            return done.returncode, done.stdout + done.stderr
        monkeypatch.setattr(sys, "argv", ["pathreplay", *arguments])
        with pytest.raises(SystemExit) as end:
            cli.main()
        return int(end.value.code or 0), "".join(capfd.readouterr())

    return run


def check(folder: Path, use: Use, command: Command) -> None:
    """Every parameter that the key names passes."""
    status, words = command(
        use.variant, "check", "scene.xml", "--param", use.key, "--variant", use.variant,
        "--json", "check.json", *use.options,
    )  # fmt: skip
    assert status == 0, words
    verdicts = [entry["verdict"] for entry in json.loads((folder / "check.json").read_text())]
    assert verdicts and set(verdicts) == {"pass"}


def job_of(use: Use) -> dict[str, Any]:
    """Recover the key from a few iterations."""
    return {
        "scene": "scene.xml",
        "variant": use.variant,
        "iterations": ITERATIONS,
        "spp": 16,
        "eval_spp": 16,
        "learning_rate": use.rate,
        "integrator": {"type": "pathreplay", "max_depth": 4},
        "parameters": [{"key": use.key, "initial": use.start, "lower": 0.0}],
        "target": {"values": {use.key: use.truth}, "spp": 64, "integrator": {"type": use.target, "max_depth": 4}},
    }


def losses_of(run: Path) -> list[float]:
    """By iteration; all are finite."""
    losses = [json.loads(line)["loss"] for line in (run / "history.jsonl").read_text().splitlines()]
    assert np.isfinite(losses).all()
    return losses


def optimize(folder: Path, use: Use, command: Command) -> None:
    """Five iterations lower the loss, and everything that the run folder should hold is there."""
    job = job_of(use)
    (folder / "job.toml").write_text(toml(job), encoding="utf-8")
    status, words = command(use.variant, "optimize", "job.toml", "--quiet")
    assert status == 0, words

    run = folder / "runs" / "job"
    losses = losses_of(run)
    assert len(losses) == ITERATIONS
    assert losses[-1] < losses[0]
    for kind in ("target", "start", "result"):
        assert len(list((run / "images").glob(f"{kind}-*.exr"))) == len(use.views)
        assert len(list((run / "images").glob(f"{kind}-*.png"))) == len(use.views)
    found = safetensors.numpy.load_file(run / "parameters.safetensors")
    assert found and all(np.isfinite(value).all() for value in found.values())
    assert (run / "report.html").stat().st_size > 10_000
    assert not list(run.rglob("*.part"))


@pytest.mark.drawn
@pytest.mark.parametrize(
    "write", [pytest.param(s, id=s.__name__, marks=[pytest.mark.slow] * (s.__name__ in SLOW)) for s in SCENES]
)
def test_check_and_optimize(write: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Command) -> None:
    monkeypatch.chdir(tmp_path)
    use = write(tmp_path)
    (tmp_path / "scene.xml").write_text(use.xml, encoding="utf-8")
    check(tmp_path, use, command)
    optimize(tmp_path, use, command)


NOT_BY_PIXELS = {
    "spectral_room": "does not use rgb colours",
    "mono_room": "does not use rgb colours",
    "smoke": "the scene has media",
}


@pytest.mark.slow
@pytest.mark.parametrize("write", [pytest.param(s, id=s.__name__) for s in SCENES])
def test_batches_of_pixels(write: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Command) -> None:
    """They go as far as whole pictures do, in twice the iterations, or one line says why there are none."""
    monkeypatch.chdir(tmp_path)
    use = write(tmp_path)
    (tmp_path / "scene.xml").write_text(use.xml, encoding="utf-8")
    job = {**job_of(use), "iterations": 2 * ITERATIONS, "pixel_batch_size": 48}
    (tmp_path / "job.toml").write_text(toml(job), encoding="utf-8")
    status, words = command(use.variant, "optimize", "job.toml", "--quiet")
    if write.__name__ in NOT_BY_PIXELS:
        assert status == 2 and NOT_BY_PIXELS[write.__name__] in words and not (tmp_path / "runs" / "job").exists()
        return
    assert status == 0, words
    losses = losses_of(tmp_path / "runs" / "job")
    assert np.mean(losses[-3:]) < np.mean(losses[:3])


@pytest.mark.slow
@pytest.mark.parametrize("write", [pytest.param(s, id=s.__name__) for s in SCENES])
def test_numbers_of_the_scene(write: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Command) -> None:
    """Jobs go as far with them as with even ones."""
    monkeypatch.chdir(tmp_path)
    use = write(tmp_path)
    (tmp_path / "scene.xml").write_text(use.xml, encoding="utf-8")
    job = job_of(use)
    job["integrator"] = {**job["integrator"], "sampling": "scene"}
    (tmp_path / "job.toml").write_text(toml(job), encoding="utf-8")
    status, words = command(use.variant, "optimize", "job.toml", "--quiet")
    assert status == 0, words
    losses = losses_of(tmp_path / "runs" / "job")
    assert losses[-1] < losses[0]


@pytest.mark.slow
@pytest.mark.parametrize("write", [pytest.param(s, id=s.__name__) for s in SCENES])
def test_derived_parameters(write: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Command) -> None:
    """What is half as much as in the pictures finds back, by the one factor that it is derived from."""
    monkeypatch.chdir(tmp_path)
    use = write(tmp_path)
    (tmp_path / "scene.xml").write_text(use.xml, encoding="utf-8")
    (tmp_path / "own.py").write_text("def scaled(first, factor):\n    return first * factor.array\n")
    job = job_of(use)
    job["parameters"] = [{"key": "factor", "shape": [1], "initial": 0.5, "learning_rate": 0.1}]
    job["derived"] = [{"key": use.key, "function": "own:scaled", "of": ["factor"]}]
    job["target"] = {"scene": "scene.xml", "spp": 256, "integrator": {"type": use.target, "max_depth": 4}}
    job |= {"iterations": 12, "final_learning_rate_ratio": 0.1}  # Adam goes past, and has few iterations to come back
    (tmp_path / "job.toml").write_text(toml(job), encoding="utf-8")
    status, words = command(use.variant, "optimize", "job.toml", "--quiet")
    assert status == 0, words
    found = safetensors.numpy.load_file(tmp_path / "runs" / "job" / "parameters.safetensors")
    assert found["factor"] == pytest.approx([1], abs=0.12)
