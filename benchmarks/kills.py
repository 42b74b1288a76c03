"""Tests that a run killed at a random moment can be resumed, and ends with the same bytes as an undisturbed run.

    python -m benchmarks.kills [--kills 100] [--seed 0]

The command runs a small job in one thread (`deterministic = true`) undisturbed. Then it kills (SIGKILL) ``--kills``
runs of the job, each at a random moment. These moments lie between shortly before the creation of the run folder and
the end of the run. A killed run is resumed with `--resume`, or started again if nothing was saved. The command prints a
table and all differences. The exit status is 1 if there are differences. 100 kills take about a quarter of an hour on a
quiet core.
"""

from __future__ import annotations

import json
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import safetensors.numpy
import typer

from pathreplay.inverse.loop.checkpoint import HISTORY
from pathreplay.inverse.loop.checksums import SEAL
from pathreplay.runs.run_folder import CHECKPOINT

WALLS = [f"{wall}.reflectance.value" for wall in ("red", "green", "white")]
JOB: dict[str, Any] = {
    "scene": "cornell-box-photo",
    "scene_parameters": {"resolution": 8, "texture": 8},
    "integrator": {"type": "pathreplay", "max_depth": 4},
    "parameters": [
        {"key": "back.bsdf.reflectance.data", "initial": 0.5, "lower": 0.0, "upper": 1.0, "resolutions": [4, 8]},
        *({"key": key, "initial": 0.5, "lower": 0.0, "upper": 1.0} for key in WALLS[:2]),
    ],
    "target": {"spp": 64, "values": {WALLS[0]: [0.6, 0.1, 0.1], WALLS[1]: [0.1, 0.5, 0.1]}},
    "stages": [{"iterations": 20, "downscale": 2, "spp": 16}, {"iterations": 20, "max_depth": 3}],
    "spp": 8,
    "measure_snr": True,
    "eval_spp": 16,
    "checkpoint_every": 2,
    "deterministic": True,
    "output": "run",
}
LIMIT_S = 600


def main(
    kills: Annotated[int, typer.Option(help="Number of kills.")] = 100,
    seed: Annotated[int, typer.Option(help="Seed of the moments.")] = 0,
) -> None:
    """Kill a small run at random moments, resume it, and compare the results."""
    moments = random.Random(seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        whole, made, length = _undisturbed(folder / "whole")
        print(f"undisturbed: {length:.1f} s, of which {made:.1f} s before there is a run folder", flush=True)
        counts: Counter[tuple[str, str]] = Counter()
        for k in range(kills):
            place = folder / f"kill-{k}"
            when, ended = _one(place, whole, moments.uniform(0.9 * made, length))
            counts[when, ended] += 1
            print(f"kill {k + 1} of {kills}: {when}: {ended}", file=sys.stderr, flush=True)
            shutil.rmtree(place)
    print("\n| killed | then | kills |\n| --- | --- | ---: |")
    for (when, ended), count in sorted(counts.items()):
        print(f"| {when} | {ended} | {count} |")
    good = sum(count for (_, ended), count in counts.items() if ended.endswith(SAME))
    print(f"\n{good} of {kills} ended with the bytes of the undisturbed run")
    raise typer.Exit(0 if good == kills else 1)


SAME = "the same bytes"


def _start(folder: Path, *arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "pathreplay.cli", "optimize", *arguments, "--quiet"]
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def _job_in(folder: Path) -> None:
    folder.mkdir()
    (folder / "job.json").write_text(json.dumps(JOB))


def _undisturbed(folder: Path) -> tuple[dict[str, Any], float, float]:
    """Outcome of an undisturbed run, seconds until its folder exists, and total seconds."""
    _job_in(folder)
    if trouble := _finish(_start(folder, "job.json")):  # this run fills Dr.Jit's cache of compiled kernels
        raise SystemExit(f"the first run failed: {trouble}")
    shutil.rmtree(folder / "run")
    begin, process = time.perf_counter(), _start(folder, "job.json")
    while not (folder / "run").exists() and process.poll() is None:
        time.sleep(0.005)
    made = time.perf_counter() - begin
    if trouble := _finish(process):
        raise SystemExit(f"the undisturbed run failed: {trouble}")
    return outcome(folder / "run"), made, time.perf_counter() - begin


def _finish(process: subprocess.Popen[str]) -> str:
    """Wait for the end of a run; returns its error, or ""."""
    _, err = process.communicate(timeout=LIMIT_S)
    return "" if process.returncode == 0 else f"status {process.returncode}, {err.strip()[-300:]}"


def _one(folder: Path, whole: dict[str, Any], after: float) -> tuple[str, str]:
    """Kill a run ``after`` seconds and resume it; returns the phase of the kill, and the verdict."""
    _job_in(folder)
    process = _start(folder, "job.json")
    time.sleep(after)
    process.kill()
    process.communicate(timeout=LIMIT_S)
    run = folder / "run"
    if process.returncode == 0:
        return "after its end", _verdict(run, whole, "nothing to do: ")
    when = _moment(run)
    if not (run / CHECKPOINT).is_file():
        shutil.rmtree(run, ignore_errors=True)
        if trouble := _finish(_start(folder, "job.json")):
            return when, f"begun again: {trouble}"
        return when, _verdict(run, whole, "begun again: ")
    if trouble := _finish(_start(folder, "--resume", "run")):
        if when == "with all written":
            return when, _verdict(run, whole, "nothing to do: ")
        return when, f"resumed: {trouble}"
    return when, _verdict(run, whole, "resumed: ")


def _moment(run: Path) -> str:
    if not (run / CHECKPOINT).is_file():
        return "before the first checkpoint"
    if (run / "report.html").is_file():
        return "with all written"
    done = len(_history(safetensors.numpy.load_file(run / CHECKPOINT)))
    stages = [stage["iterations"] for stage in JOB["stages"]]
    return f"in stage {1 + (done >= stages[0])}" if done < sum(stages) else "while the report is made"


def _history(tensors: Mapping[str, np.ndarray]) -> list[Any]:
    return json.loads(tensors[HISTORY].tobytes())


def outcome(run: Path) -> dict[str, Any]:
    """Everything that must not differ: values, images, checkpoint, and the history except for its seconds."""
    tensors = safetensors.numpy.load_file(run / CHECKPOINT)
    lines = [json.loads(line) for line in (run / "history.jsonl").read_text().splitlines()]
    names = ["parameters.safetensors", "parameters.json", "views.json"]
    files = [run / name for name in names] + sorted((run / "images").glob("*.exr"))
    return {
        **{str(path.relative_to(run)): path.read_bytes() for path in files},
        **{f"checkpoint: {key}": value.tobytes() for key, value in tensors.items() if key not in (HISTORY, SEAL)},
        "history": [{**line, "seconds": 0} for line in lines],
        "checkpoint: history": [{**line, "seconds": 0} for line in _history(tensors)],
    }


def _verdict(run: Path, whole: dict[str, Any], begin: str) -> str:
    found = outcome(run)
    other = sorted(key for key in {*whole, *found} if whole.get(key) != found.get(key))
    return f"{begin}{SAME}" if not other else f"{begin}others in {', '.join(other[:3])}"


if __name__ == "__main__":
    typer.run(main)
