"""What is measured and what comes back: the records that pass between the command, the workers and the files."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

#: Integrators by the name that the tables give them. One that does not load is a row that says so.
METHODS: dict[str, dict[str, Any]] = {
    "prb": {"type": "prb"},
    "prb_basic": {"type": "prb_basic"},
    "tape": {"type": "pathreplay_tape"},
    "rb": {"type": "pathreplay_rb"},
    "rb linear": {"type": "pathreplay_rb", "linear": True},
    "sweep": {"type": "pathreplay", "driver": "sweep"},
    "replay": {"type": "pathreplay", "driver": "replay"},
    "volpath": {"type": "volpath"},
    "prbvolpath": {"type": "prbvolpath"},
    "score": {"type": "pathreplay"},
    "no branch": {"type": "pathreplay", "branch": False},
    "listing": {"type": "pathreplay_listing"},
}

#: Mitsuba's own: what ours is compared with, and not held to anything when two records are compared.
STOCK = ("prb", "prb_basic", "prbvolpath", "volpath", "finite differences", "half steps")

# What a pass is, and by that which module runs it: see `worker.MEASURES`.
Kind = Literal["gradient", "image", "events", "truth", "noise", "step", "cold start", "warm start"]


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
    patience: float = 0  # seconds after which a method sits out the rounds that are left; 0 = endless
    # A gradient pass, a primal one with the noise of the image, the mean number of real events a path, a derivative
    # to hold against finite differences, the error of a replay, an optimisation step, or the start of a process.
    measure: Kind = "gradient"
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
    measure: Kind = "gradient"
    mean: float | None = None  # of what was measured, over entries and seeds
    values: tuple[float, ...] = ()  # of each seed, where what was measured is one number
    z: float | None = None  # of task `truth`: the difference from the reference, in standard errors
    verdict: str | None = None  # of task `truth`: see pathreplay.check.verdict


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
    commit: str  # with "+" where the working tree differed from it, or changed while it was measured
    load: tuple[float, float]  # processes waiting for a processor (1 minute mean) before and after
    machines: tuple[Machine, ...]  # one entry, unless jobs used different numbers of threads
    points: tuple[Point, ...]
    sittings: int = 1  # runs that it took: more than one where it was interrupted and gone on with
