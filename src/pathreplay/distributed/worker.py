"""The Ray actor, which keeps the scene of a job and its compiled kernels, and evaluates shards."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Protocol

import drjit as dr
import mitsuba as mi

from pathreplay.inverse.config.schema import Config
from pathreplay.inverse.dataset.targets import Targets
from pathreplay.inverse.objective.evaluate import Evaluate, Evaluation, Shard
from pathreplay.inverse.objective.stages import evaluator_of
from pathreplay.inverse.parameters.values import Arrays
from pathreplay.inverse.problem.problem import Problem, build_problem
from pathreplay.platform import backend, memory
from pathreplay.platform.threads import one_thread, processor_name
from pathreplay.scenes.descriptions import errors_as


@dataclass(frozen=True)
class WorkerInit:
    """Data from which an actor builds the same problem as the run's own process."""

    config: Config
    base: Path
    targets: Targets
    variant: str
    threads: int


@dataclass(frozen=True)
class Ready:
    """Answer of an actor that has built its problem: its machine, process and package versions."""

    host: str
    process: int
    versions: str
    machine: str
    """Processor and LLVM version, which determine how the actor's kernels round."""


@dataclass(frozen=True)
class Answer:
    """Result of one shard."""

    evaluation: Evaluation
    seconds: float
    warnings: tuple[str, ...]
    """Mitsuba log messages of level Warn and above, emitted during the evaluation."""


def versions() -> str:
    """Return the versions of the packages that must be the same in the run's own process and in all actors."""
    return ", ".join(f"{name} {version(name)}" for name in ("pathreplay", "mitsuba", "drjit", "numpy"))


class Log(Protocol):
    """A log that collects Mitsuba's messages in ``lines``."""

    lines: list[str]


class RayActor:
    """Evaluates shards of one job. Requests change no state except the compiled kernels."""

    def __init__(self) -> None:
        self.problem: Problem | None = None
        self.config: Config
        self.evaluators: dict[bool, Evaluate]
        self.log: Log

    def hello(self, setup: WorkerInit) -> Ready:
        """Build the problem; must be called first. Raises PathreplayError if the problem cannot be built here."""
        backend.set_variant(setup.variant)
        dr.set_thread_count(setup.threads)
        self.evaluators = {}
        self.problem = build_problem(setup.config, setup.base, setup.targets)
        self.config = self.problem.config
        self.log = _capture_log()
        machine = f"{processor_name()}, LLVM {'.'.join(map(str, backend.loaded_version()))}"
        return Ready(platform.node(), os.getpid(), versions(), machine)

    def evaluate(self, baseline: bool, values: Arrays, shards: Sequence[Shard], learned: Arrays) -> list[Answer] | None:
        """Evaluate shards with the integrator of the job or of its baseline.

        Returns None if the actor was restarted, and `hello` has not been called since.
        """
        return None if self.problem is None else [self._answer(baseline, values, shard, learned) for shard in shards]

    def _answer(self, baseline: bool, values: Arrays, shard: Shard, learned: Arrays) -> Answer:
        config = self.config
        plugin = config.baseline if baseline and config.baseline is not None else config.integrator
        self.log.lines.clear()
        begin = time.perf_counter()
        problem = f"Integrator '{plugin.type}' cannot do this job"
        with one_thread(config.deterministic), errors_as(problem), memory.within(config.budget):
            evaluation = self._evaluator(baseline)(values, shard, learned)
        return Answer(evaluation, time.perf_counter() - begin, tuple(self.log.lines))

    def _evaluator(self, baseline: bool) -> Evaluate:
        if baseline not in self.evaluators:
            config, problem = self.config, self.problem
            assert problem is not None
            plugin, integrator = config.integrator, problem.integrator
            if baseline and config.baseline is not None and problem.baseline is not None:
                plugin, integrator = config.baseline, problem.baseline
            self.evaluators[baseline] = evaluator_of(problem, integrator, plugin)
        return self.evaluators[baseline]


def _capture_log() -> Log:
    """Collect Mitsuba's warnings in memory, because nobody reads the terminal of an actor."""

    class LogBuffer(mi.Appender):  # defined here, because the base class depends on the variant
        def __init__(self) -> None:
            super().__init__()
            self.lines: list[str] = []

        def append(self, level: mi.LogLevel, text: str) -> None:
            if level >= mi.LogLevel.Warn:
                self.lines.append(text)

        def log_progress(self, *_: object) -> None:
            pass

    buffer, logger, plain = LogBuffer(), mi.logger(), mi.DefaultFormatter()
    plain.set_has_date(False)
    plain.set_has_log_level(False)
    plain.set_has_thread(False)
    plain.set_has_class(False)
    logger.set_formatter(plain)
    logger.clear_appenders()
    logger.add_appender(buffer)
    return buffer
