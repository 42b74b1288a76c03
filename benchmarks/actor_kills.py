"""Tests that killing actors at random moments of a run does not change its results.

    python -m benchmarks.actor_kills [--kills 20] [--actors 2] [--seed 0]

The command runs a job in one process (`deterministic = true`), then by Ray actors. During the second run it kills
(SIGKILL) a random actor at random moments, ``--kills`` times in all, and prints the log of the run. The exit status is
1 if any byte of the results differs, or if the run ended before all kills were done. In the second case, use more
``--iterations``. The command takes about three minutes on two quiet cores, and needs `pip install 'pathreplay[ray]'`.
"""

from __future__ import annotations

import random
import tempfile
import threading
import time
from pathlib import Path
from typing import Annotated, Any

import psutil
import typer

from pathreplay.jobs import make_config, optimize

from .kills import JOB, outcome

LONGEST_S = 6.0
"""Maximum time between two kills; a restarted actor is ready after about three seconds."""


def main(
    kills: Annotated[int, typer.Option(help="Number of kills.")] = 20,
    actors: Annotated[int, typer.Option(help="Number of actors, with one thread each.")] = 2,
    iterations: Annotated[int, typer.Option(help="Iterations of each of the two stages.")] = 800,
    seed: Annotated[int, typer.Option(help="Seed of the moments and of the choice of actors.")] = 0,
) -> None:
    """Run a job with and without kills of its actors, and compare the results."""
    stages = [{**stage, "iterations": iterations} for stage in JOB["stages"]]
    job: dict[str, Any] = {**JOB, "stages": stages, "checkpoint_every": iterations, "spp_shards": 2}
    with tempfile.TemporaryDirectory() as name:
        begin = time.perf_counter()
        optimize(make_config({**job, "output": f"{name}/whole"}), progress=False)
        print(f"in one process: {time.perf_counter() - begin:.0f} s", flush=True)
        killer = Killer(random.Random(seed), kills)
        killer.start()
        begin = time.perf_counter()
        config = make_config({**job, "output": f"{name}/run", "executor": "ray", "ray": {"actors": actors}})
        try:
            optimize(config)
        finally:
            killer.over.set()
            killer.join()
        print(f"by {actors} actors: {time.perf_counter() - begin:.0f} s, {killer.done} of {kills} kills done")
        expected, result = (outcome(Path(name) / which) for which in ("whole", "run"))
    differing = sorted(key for key in {*expected, *result} if expected.get(key) != result.get(key))
    print(f"different bytes in {', '.join(differing)}" if differing else "the same bytes")
    raise typer.Exit(0 if killer.done == kills and not differing else 1)


class Killer(threading.Thread):
    """Kills actors of this process at random moments."""

    def __init__(self, moments: random.Random, kills: int) -> None:
        super().__init__(daemon=True)
        self.moments, self.kills, self.done = moments, kills, 0
        self.over = threading.Event()

    def run(self) -> None:
        """Kill until all kills are done, or the run is over."""
        while self.done < self.kills and not self.over.wait(self.moments.uniform(0, LONGEST_S)):
            alive = [p for p in psutil.Process().children(recursive=True) if _name(p).startswith("ray::RayActor")]
            if alive:
                self.moments.choice(sorted(alive, key=lambda process: process.pid)).kill()
                self.done += 1


def _name(process: psutil.Process) -> str:
    try:
        return str(process.name())
    except psutil.Error:  # the process has just ended
        return ""


if __name__ == "__main__":
    typer.run(main)
