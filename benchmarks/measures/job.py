"""What is measured and what comes back: the records that pass between the command, the workers and the files."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Any, Literal, Protocol

import numpy as np

#: What a pass is, and by that what runs it: see `worker.MEASURES`.
Kind = Literal[
    "gradient",  # a backward pass
    "image",  # a primal one, with the noise of the image
    "events",  # a primal one: the mean number of real events a path
    "truth",  # a derivative, to hold against finite differences
    "noise",  # the error of a replay
    "step",  # an optimisation step
    "edges",  # a derivative by what moves, in parts
    "number",  # a derivative by one number that moves something
    "cold start",  # the start of a process, without cached kernels
    "warm start",  # and with them
    "flight",  # way to the first real collision in a grid
    "transmittance",  # and through it, with its squared error
    "whole run",  # an optimisation from beginning to end
    "sum",  # a backward pass, and the error of its sum over samples
    "iterations",  # of a job with many views, by this process or by actors
]


@dataclass(frozen=True)
class Job:
    """Passes of some methods on one scene, in turn (A B C A B C ...), in one process: all that a worker is told.

    Scenes are named in `benchmarks.scenes`, methods in `methods.py` or where the measure is; a name is all there is.

    Round k of every method has the seed k. ``warmup`` rounds before the first compile the kernels and are not kept;
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
    warmup: int = 2
    restart: int = 0  # make all integrators anew every so many rounds; 0 = never
    threads: int = 0  # 0 = all processors
    patience: float = 0  # seconds after which a method sits out the rounds that are left; 0 = endless
    measure: Kind = "gradient"
    # Of gradient passes. Adjoint image: one everywhere, or a smooth wave (both over the number of entries).
    weights: Literal["even", "wave"] = "even"
    # Announce new parameters before each pass, as an optimiser does: majorants are then made anew; this is timed.
    update: bool = False
    reference: str | None = None  # the method whose mean tells how far the means of the others are off

    @property
    def passes(self) -> int:
        """Passes in all, for the progress bar."""
        return (self.rounds + self.warmup) * len(self.methods)

    @property
    def limits(self) -> dict[str, int]:
        """What every integrator is given."""
        return {"max_depth": self.max_depth, "rr_depth": self.rr_depth}

    def encode(self) -> str:
        """The job as one argument of a command; `decode` reads it."""
        return json.dumps(asdict(self))

    @staticmethod
    def decode(text: str) -> Job:
        """The job that was encoded."""
        return Job(**{name: tuple(fact) if isinstance(fact, list) else fact for name, fact in json.loads(text).items()})


class Measure(Protocol):
    """What runs the passes of a job, made from the job."""

    def __call__(self, method: str, seed: int) -> tuple[float, np.ndarray]:
        """Seconds of one pass and what came of it, as one flat array; raises what the method raises."""

    def forget(self) -> None:
        """Begin anew: what the methods have learned is gone. Nothing is to be done where they do not learn."""

    def conclude(self, kept: dict[str, list[np.ndarray]]) -> dict[str, dict[str, Any]]:
        """By method: fields of `Point` that follow from the arrays of all rounds together."""


@dataclass(frozen=True)
class Point:
    """One method in one job: every sample, or why there is none."""

    scene: str
    parameters: tuple[str, ...]
    method: str
    max_depth: int
    paths: int  # resolution² · spp
    seeds: tuple[int, ...]
    seconds: tuple[float, ...]  # of each pass
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
    z: float | None = None  # the difference from a reference, in standard errors, where there is one
    verdict: str | None = None  # of task `truth`: see pathreplay.testing.verdict


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
