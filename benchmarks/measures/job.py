"""Data classes of jobs and results, which the command, the workers and the files exchange."""

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
    "light paths",  # a backward pass, in processor seconds
    "caustic",  # whole caustic designs: the error of the image against time
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
    "quality",  # whole optimisations: the held-out error against time
]


@dataclass(frozen=True)
class Job:
    """The complete input of a worker: passes of some methods on one scene, in alternation (A B C A B C ...).

    Scenes and methods are given by name: see `benchmarks.scenes`, `methods.py` and the module of the measure.

    Round k of every method has the seed k. The first ``warmup`` rounds compile the kernels and are discarded. After
    these rounds, and after every ``restart`` further rounds, all integrators are created again. Everything that a
    method learns from its passes is thereby learned in rounds that are kept.
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
    # Of optimisations: seconds of each, and the grid that is searched for every method.
    budget: float = 0
    rates: tuple[float, ...] = ()
    samples: tuple[int, ...] = ()

    @property
    def passes(self) -> int:
        """Total number of passes, for the progress bar."""
        return (self.rounds + self.warmup) * len(self.methods)

    @property
    def limits(self) -> dict[str, int]:
        """Path limits of all integrators, as plugin properties."""
        return {"max_depth": self.max_depth, "rr_depth": self.rr_depth}

    def encode(self) -> str:
        """Return the job as one command-line argument, which `decode` reads."""
        return json.dumps(asdict(self))

    @staticmethod
    def decode(text: str) -> Job:
        """Return the job that `encode` has written."""
        return Job(**{name: tuple(fact) if isinstance(fact, list) else fact for name, fact in json.loads(text).items()})


class Measure(Protocol):
    """Runs the passes of the job from which it is constructed."""

    def __call__(self, method: str, seed: int) -> tuple[float, np.ndarray]:
        """Run one pass; return its seconds, and its result as one flat array. Errors of the method are raised."""

    def forget(self) -> None:
        """Discard everything that the methods have learned. Does nothing for methods that do not learn."""

    def conclude(self, kept: dict[str, list[np.ndarray]]) -> dict[str, dict[str, Any]]:
        """Return the fields of `Point` that are computed from the results of all rounds, by method."""


@dataclass(frozen=True)
class Curve:
    """The held-out error during one optimisation, at some iterations, the first of which is 0."""

    rate: float  # learning rate, as a fraction of the range of each parameter
    spp: int
    seed: int
    steps: tuple[int, ...]
    seconds: tuple[float, ...]  # of the iterations alone
    errors: tuple[float, ...]
    warm_up: float = 0.0  # seconds of the first iterations, in which kernels are compiled, and which are not counted
    searched: bool = False  # whether it belongs to the search


@dataclass(frozen=True)
class Point:
    """The samples of one method in one job, or the error message of the method."""

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
    curves: tuple[Curve, ...] = ()  # of task `quality`


@dataclass(frozen=True)
class Machine:
    """Hardware and software versions of a worker."""

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
    """One run of a task, the content of a file in benchmarks/results/."""

    task: str
    command: str
    date: str
    commit: str  # with "+" where the working tree differed from it, or changed while it was measured
    load: tuple[float, float]  # processes waiting for a processor (1 minute mean) before and after
    machines: tuple[Machine, ...]  # one entry, unless jobs used different numbers of threads
    points: tuple[Point, ...]
    sittings: int = 1  # runs that it took: more than one where it was interrupted and gone on with
