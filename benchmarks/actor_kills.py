"""Actors killed at random moments of a run: whether it ends with the bytes of one that computes in its own process.

    python -m benchmarks.actor_kills [--kills 20] [--actors 2] [--seed 0]

runs a job in one process (`deterministic = true`), then by actors of Ray, of which a random one is killed (SIGKILL) now
and then, whatever it is doing, until that has been done as often as asked. Prints what was told of it; ends with status
1 if the run came to anything else, or ended before all kills were done (then it wants more `--iterations`). Takes
about three minutes on two quiet cores. Wants `pip install 'pathreplay[ray]'`.
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
"""Between two kills; an actor is there again after about three."""


def main(
    kills: Annotated[int, typer.Option(help="How many.")] = 20,
    actors: Annotated[int, typer.Option(help="Actors, of one thread each.")] = 2,
    iterations: Annotated[int, typer.Option(help="Of each of the two stages of the run.")] = 800,
    seed: Annotated[int, typer.Option(help="Chooses the moments, and the actors.")] = 0,
) -> None:
    """Kill actors of a run, and compare."""
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
        whole, found = (outcome(Path(name) / which) for which in ("whole", "run"))
    other = sorted(key for key in {*whole, *found} if whole.get(key) != found.get(key))
    print(f"others in {', '.join(other)}" if other else "the same bytes")
    raise typer.Exit(0 if killer.done == kills and not other else 1)


class Killer(threading.Thread):
    """Kills actors of this process, one after the other."""

    def __init__(self, moments: random.Random, kills: int) -> None:
        super().__init__(daemon=True)
        self.moments, self.kills, self.done = moments, kills, 0
        self.over = threading.Event()

    def run(self) -> None:
        """Until all kills are done, or the run is over."""
        while self.done < self.kills and not self.over.wait(self.moments.uniform(0, LONGEST_S)):
            there = [p for p in psutil.Process().children(recursive=True) if _name(p).startswith("ray::RayActor")]
            if there:
                self.moments.choice(sorted(there, key=lambda process: process.pid)).kill()
                self.done += 1


def _name(process: psutil.Process) -> str:
    try:
        return str(process.name())
    except psutil.Error:  # it has just ended
        return ""


if __name__ == "__main__":
    typer.run(main)
