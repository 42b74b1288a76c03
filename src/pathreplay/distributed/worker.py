"""What an actor of Ray holds and does: the scene of a job, its compiled kernels, and evaluations of shards by them."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi

from pathreplay.inverse.config.schema import Config
from pathreplay.inverse.dataset.targets import Targets
from pathreplay.inverse.objective.evaluate import Evaluate, Evaluation, Evaluator, Shard
from pathreplay.inverse.objective.stages import Staged
from pathreplay.inverse.parameters.values import Arrays
from pathreplay.inverse.problem.problem import Problem, build_problem
from pathreplay.platform import backend
from pathreplay.platform.threads import one_thread
from pathreplay.scenes.descriptions import told


@dataclass(frozen=True)
class WorkerInit:
    """What an actor needs to know to build the problem of a job as the process has it that sends this."""

    config: Config
    base: Path
    targets: Targets
    variant: str
    threads: int


@dataclass(frozen=True)
class Ready:
    """Who an actor is, when it is ready."""

    host: str
    process: int
    versions: str
    machine: str
    """What decides how its kernels round."""


@dataclass(frozen=True)
class Answer:
    """What an actor has to say of a shard."""

    evaluation: Evaluation
    seconds: float
    warnings: tuple[str, ...]
    """What was logged meanwhile."""


def versions() -> str:
    """Of what has to be the same in all actors, and in the process that asks them."""
    return ", ".join(f"{name} {version(name)}" for name in ("pathreplay", "mitsuba", "drjit", "numpy"))


class RayActor:
    """Evaluates shards of one job; nothing that is sent changes it, but for kernels, which it keeps."""

    def __init__(self) -> None:
        self.problem: Problem | None = None
        self.config: Config
        self.evaluators: dict[bool, Evaluate]
        self.log: Any = None

    def hello(self, setup: WorkerInit) -> Ready:
        """Build the problem: before anything else. Raises PathreplayError for what this machine has not."""
        backend.set_variant(setup.variant)
        dr.set_thread_count(setup.threads)
        self.evaluators = {}
        self.problem = build_problem(setup.config, setup.base, setup.targets)
        self.config = self.problem.config
        self.log = _kept_log()
        machine = f"{_processor()}, LLVM {'.'.join(map(str, backend.loaded_version()))}"
        return Ready(platform.node(), os.getpid(), versions(), machine)

    def evaluate(self, baseline: bool, values: Arrays, shards: Sequence[Shard], learned: Arrays) -> list[Answer] | None:
        """Shards by the job's integrator, or by that of its baseline; None where this actor was started again since."""
        return None if self.problem is None else [self._answer(baseline, values, shard, learned) for shard in shards]

    def _answer(self, baseline: bool, values: Arrays, shard: Shard, learned: Arrays) -> Answer:
        config = self.config
        plugin = config.baseline if baseline and config.baseline is not None else config.integrator
        self.log.lines.clear()
        begin = time.perf_counter()
        with one_thread(config.deterministic), told(f"Integrator '{plugin.type}' cannot do this job"):
            evaluation = self._evaluator(baseline)(values, shard, learned)
        return Answer(evaluation, time.perf_counter() - begin, tuple(self.log.lines))

    def _evaluator(self, baseline: bool) -> Evaluate:
        if baseline not in self.evaluators:
            config, problem = self.config, self.problem
            assert problem is not None
            plugin, integrator = config.integrator, problem.integrator
            if baseline and config.baseline is not None and problem.baseline is not None:
                plugin, integrator = config.baseline, problem.baseline
            record = not config.deterministic
            self.evaluators[baseline] = (
                Evaluator(problem, integrator, record)
                if config.stages is None
                else Staged(problem, config, integrator, plugin, record)
            )
        return self.evaluators[baseline]


def _kept_log() -> Any:
    """Takes the place of what Mitsuba's log is written to: nobody looks at the terminal of an actor."""

    class Kept(mi.Appender):  # type: ignore[misc]  # here, since it belongs to the variant
        def __init__(self) -> None:
            super().__init__()
            self.lines: list[str] = []

        def append(self, level: mi.LogLevel, text: str) -> None:
            if level >= mi.LogLevel.Warn:
                self.lines.append(text)

        def log_progress(self, *_: Any) -> None:
            pass

    kept, logger, plain = Kept(), mi.logger(), mi.DefaultFormatter()
    plain.set_has_date(False)
    plain.set_has_log_level(False)
    plain.set_has_thread(False)
    plain.set_has_class(False)
    logger.set_formatter(plain)
    logger.clear_appenders()
    logger.add_appender(kept)
    return kept


def _processor() -> str:
    """The processor's name, where the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())
