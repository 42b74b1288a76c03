"""What is measured and what comes back: the records that pass between the command, the workers and the files."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

#: Integrators by the name that the tables give them.
METHODS: dict[str, dict[str, Any]] = {
    "prb": {"type": "prb"},
    "sweep": {"type": "pathreplay", "driver": "sweep"},
    "replay": {"type": "pathreplay", "driver": "replay"},
    "volpath": {"type": "volpath"},
    "prbvolpath": {"type": "prbvolpath"},
    "score": {"type": "pathreplay", "volume_gradient": "score"},
    "branch": {"type": "pathreplay", "volume_gradient": "score", "branch": True},
    "listing": {"type": "pathreplay", "volume_gradient": "listing"},
}


@dataclass(frozen=True)
class Job:
    """Gradient passes of some methods on one scene, in turn (A B C A B C ...), in one process.

    Round k of every method has the seed k. ``warm_up`` rounds before the first compile the kernels and are not kept;
    after them all integrators are made anew, and again every ``restart`` rounds: what a method learns from its passes
    it learns in rounds that are kept.
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
    restart: int = 0  # make all integrators anew every so many rounds; 0 = never
    threads: int = 0  # 0 = all processors
    # A gradient pass, or a primal one with the noise of the image, or the mean number of real events a path.
    measure: Literal["gradient", "image", "events"] = "gradient"
    # Adjoint image: one everywhere, or a smooth wave (both over the number of entries).
    weights: Literal["even", "wave"] = "even"
    # Announce new parameters before each pass, as an optimiser does: majorants are then made anew; this is timed.
    update: bool = False
    reference: str | None = None  # the method whose mean tells how far the means of the others are off

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
    # Of each seed, as squared_errors, but of the gradient of a grid along smooth directions, the first to be optimised.
    smooth_errors: tuple[float, ...] = ()
    # Of each seed, with d = gradient - reference of that seed: mean over entries of d · (mean of d over other seeds).
    # Their mean estimates the squared bias without bias. Empty if there is no reference.
    bias_products: tuple[float, ...] = ()
    measure: str = "gradient"
    mean: float | None = None  # of what was measured, over entries and seeds


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
