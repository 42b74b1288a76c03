"""What is measured and what comes back: the records that pass between the command, the workers and the files."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

#: Integrators by the name that the tables give them.
METHODS: dict[str, dict[str, Any]] = {
    "prb": {"type": "prb"},
    "sweep": {"type": "pathreplay", "driver": "sweep"},
    "replay": {"type": "pathreplay", "driver": "replay"},
}


@dataclass(frozen=True)
class Job:
    """Gradient passes of some methods on one scene, in turn (A B C A B C ...), in one process.

    Round k of every method has the seed k. ``warm_up`` rounds before the first compile the kernels and are not kept.
    """

    scene: str
    parameters: tuple[str, ...]  # keys with gradients
    methods: tuple[str, ...]
    max_depth: int
    rr_depth: int
    resolution: int  # pixels, width = height
    spp: int
    rounds: int
    warm_up: int = 2
    threads: int = 0  # 0 = all processors

    @property
    def passes(self) -> int:
        """Gradient passes in all, for the progress bar."""
        return (self.rounds + self.warm_up) * len(self.methods)


@dataclass(frozen=True)
class Point:
    """One method in one job: every sample, or why there is none."""

    scene: str
    parameters: tuple[str, ...]
    method: str
    max_depth: int
    paths: int  # resolution² · spp
    seeds: tuple[int, ...]
    seconds: tuple[float, ...]  # of each gradient pass
    # Of each seed, over the entries of all gradients: mean of (gradient - mean over seeds)² · n / (n - 1). Their mean
    # is the sample variance. Empty if a gradient was not finite.
    squared_errors: tuple[float, ...]
    not_finite: tuple[int, ...]  # seeds with which a gradient had infinite or NaN entries
    peak_mib: float | None  # largest resident size of the process, if the method had one to itself
    error: str | None = None


@dataclass(frozen=True)
class Machine:
    """Where and with what a worker ran."""

    processor: str
    processors: int  # that the process may use
    threads: int  # that Dr.Jit used
    system: str
    python: str
    mitsuba: str
    drjit: str
    pathreplay: str
    libllvm: str
    variant: str


@dataclass(frozen=True)
class Record:
    """One run of a task: what a file under benchmarks/results/ holds."""

    task: str
    command: str
    date: str
    commit: str  # with "+" where the working tree differed from it
    load: tuple[float, float]  # processes waiting for a processor (1 minute mean) before and after
    machines: tuple[Machine, ...]  # one entry, unless jobs used different numbers of threads
    points: tuple[Point, ...]
