"""Compares poses recovered from silhouettes by `pathreplay` and by Mitsuba's `prb_projective`.

    python -m benchmarks.edges_pose [EXAMPLE ...]

The command runs jobs of examples/ with two seeds each, prints a table, and writes reports to runs/edges-pose. Both
integrators have the same initial values, targets, samples and seconds, and run alternately. The overlap of a view is
the fraction of the target's dark area that is also dark in the initial image.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from pathreplay.inverse.config.schema import Config
from pathreplay.inverse.images.io import read_image
from pathreplay.jobs import load_config, optimize

EXAMPLES = Path(__file__).parent.parent / "examples"
RUNS = Path("runs/edges-pose")
JOBS = ("silhouettes", "silhouette-in-mirror")
SEEDS = (0, 1)
DARK = 0.5


def overlap(folder: Path) -> str:
    """Overlap of each view."""
    fractions = []
    for path in sorted((folder / "images").glob("target-*.exr")):
        target, start = (
            read_image(path.with_name(path.name.replace("target", kind))).mean(axis=2) < DARK
            for kind in ("target", "start")
        )
        fractions.append((target & start).sum() / target.sum())
    return ", ".join(f"{fraction:.2f}" for fraction in fractions)


def ended(path: Path) -> tuple[str, str, str, str]:
    """Iterations, seconds, position error and angular error of a run, from its history."""
    entries = [json.loads(line) for line in path.read_text().splitlines()]
    (position, degrees), seconds = entries[-1]["errors"].values(), sum(entry["seconds"] for entry in entries)
    return str(len(entries)), f"{seconds:.0f}", f"{position:.5f}", f"{degrees:.4f}"


def rows(name: str, config: Config) -> None:
    """Run the job, and print a row for each integrator."""
    result = optimize(config, output=RUNS / f"{name}-seed-{config.seed}", progress=False)
    if result.stopped:
        raise SystemExit(f"stopped by {result.stopped_by}")
    runs = {config.integrator.type: "history.jsonl"}
    if config.baseline is not None:
        runs[config.baseline.type] = "baseline/history.jsonl"
    for integrator, history in runs.items():
        cells = name, overlap(result.folder), str(config.seed), integrator, *ended(result.folder / history)
        print(f"| {' | '.join(cells)} |", flush=True)


def main(names: list[str]) -> None:
    """Print the table, row by row."""
    titles = "job", "overlap", "seed", "integrator", "iterations", "seconds", "position / size", "degrees"
    print(f"| {' | '.join(titles)} |\n|{' --- |' * len(titles)}")
    for name in names or JOBS:
        config = load_config(EXAMPLES / name / "config.toml")
        for seed in SEEDS:
            rows(name, config.model_copy(update={"seed": seed}))


if __name__ == "__main__":
    main(sys.argv[1:])
