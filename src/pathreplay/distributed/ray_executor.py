"""Evaluates shards in Ray actors, on this machine or on a cluster, with the same results as in a single process.

Each actor keeps the scene and the compiled kernels. Large values are sent once per step. `Scheduler` decides which
actor computes which shard. This choice has no effect on the result: an evaluation is a function of the values, the
shard and the learned state, and evaluations are summed in shard order.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import mitsuba as mi

from pathreplay.distributed.cluster import Cluster, connected, load_ray
from pathreplay.distributed.scheduler import Scheduler, Step
from pathreplay.distributed.worker import Answer, RayActor, Ready, WorkerInit, versions
from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.schema import Config
from pathreplay.inverse.dataset.targets import Targets
from pathreplay.inverse.objective.evaluate import Evaluation, Shard
from pathreplay.inverse.parameters.values import Arrays
from pathreplay.inverse.problem.problem import Problem
from pathreplay.platform.threads import usable_cores
from pathreplay.scenes.descriptions import one_line

THREADS = 4
"""Largest default number of threads per actor. More threads help little: Python traces the kernels in one thread."""

SMALL = 2**16
"""Bytes. Smaller arrays are sent with each request, which is faster than fetching them from the object store."""

SOON_S = 60.0
"""Seconds to wait for the first ready actor before a line is logged. Actors load Mitsuba and the scene meanwhile."""

LOOK_S, AGAIN_S = 0.1, 1.0
"""While no answer arrives: seconds between checks of the cluster's processes, and between checks of its head node."""

Reference = Hashable
"""Ray's reference to an answer, or to arrays in its object store."""

Tell = Callable[[str], None]


@dataclass
class Counts:
    """Statistics of a run, logged at its end."""

    shards: int = 0
    restarts: int = 0
    again: int = 0
    """Number of shards that were computed again because their actor was lost."""
    twice: int = 0
    """Number of late shards that a second actor was also asked to compute."""

    def line(self) -> str:
        return (
            f"{self.shards} shards; {self.restarts} restarts, {self.again} shards computed again, "
            f"{self.twice} late ones by two actors"
        )


@dataclass
class _Call:
    """A pending request to an actor. ``step`` is None for the request that builds the problem."""

    actor: int
    step: Step | None = None
    indices: tuple[int, ...] = ()
    """Indices of the requested shards within the step."""


@dataclass
class WorkerPool:
    """The actors of a run and their pending requests. The executors of the job and its baseline share this pool."""

    cluster: Cluster
    actors: dict[int, Any]
    setup: Reference
    """Ray's reference to the `WorkerInit` of the actors."""
    retries: int
    tell: Tell
    status: Tell = lambda text: None
    """Receives the progress of the current step."""
    counts: Counts = field(default_factory=Counts)
    schedulers: list[Scheduler] = field(default_factory=list)
    """The scheduler of each executor."""
    calls: dict[Reference, _Call] = field(default_factory=dict)
    """Pending requests by Ray's reference to the answer."""
    ready: dict[int, Ready] = field(default_factory=dict)
    logged: set[str] = field(default_factory=set)

    @property
    def ray(self) -> ModuleType:
        return self.cluster.ray

    def __post_init__(self) -> None:
        for number in self.actors:
            self._initialize(number)

    def idle(self) -> list[int]:
        """Return the actors that are ready and have no pending request."""
        busy = {call.actor for call in self.calls.values()}
        return [number for number in self.ready if number not in busy]

    def ask(self, number: int, call: _Call, *request: object) -> None:
        """Send an actor a request to evaluate shards."""
        self.calls[self.actors[number].evaluate.options(max_task_retries=0).remote(*request)] = call

    def sent(self, arrays: Arrays) -> Arrays | Reference:
        """Return the argument of a request that stands for arrays.

        Small arrays are returned themselves. Large arrays are put into the object store, and a reference is returned.
        """
        return arrays if _bytes_of(arrays) < SMALL else self.ray.put(arrays)

    def answered(self, patience: float) -> list[tuple[_Call, Reference]]:
        """Wait at most ``patience`` seconds for an answer; return answered requests, with references to the answers.

        Answered requests are removed from ``calls``. Raises PathreplayError if the cluster is lost.
        """
        end = time.monotonic() + patience
        ready: list[Reference] = []
        self.cluster.require_processes()
        while not ready:
            # Do not wait for the transfer of an answer: the actor can receive its next request meanwhile.
            timeout = min(LOOK_S, max(0.0, end - time.monotonic()))
            ready, _ = self.ray.wait(list(self.calls), num_returns=1, timeout=timeout, fetch_local=False)
            if time.monotonic() >= end:
                break
            if not ready:
                self.cluster.require(AGAIN_S)
        return [(self.calls.pop(reference), reference) for reference in ready]

    def fetch(self, call: _Call, reference: Reference) -> list[Answer] | None:
        """Return one answer per shard of a request. Raises the error of an evaluation that failed.

        Returns None if the actor was lost, or if the request asked the actor to build the problem. Raises
        PathreplayError if no actor is left.
        """
        try:
            answer = self.ray.get(reference)  # does not block: the answer exists, or its actor is lost
        except self.ray.exceptions.RayTaskError as error:
            raise _cause(error) from None
        except self.ray.exceptions.RayError as error:
            self.cluster.require()
            self._lost(call, error)
            return None
        if isinstance(answer, Ready):
            self._add_ready(call.actor, answer)
            return None
        if answer is None:
            self._lost(call, RuntimeError("the actor was restarted"))
        return answer

    def _initialize(self, number: int) -> None:
        self.calls[self.actors[number].hello.remote(self.setup)] = _Call(number)

    def _add_ready(self, number: int, ready: Ready) -> None:
        """Register a ready actor. Raises PathreplayError if its package versions differ from ours."""
        if ready.versions != versions():
            raise PathreplayError(
                f"ray: {ready.host} has {ready.versions}, this machine has {versions()}; install the same on both"
            )
        self.ready[number] = ready
        machines = {actor.machine for actor in self.ready.values()}
        if len(machines) > 1:
            self.log_once(
                f"ray: the actors have different processors ({'; '.join(sorted(machines))}), which may round "
                "differently in the last bit"
            )

    def _lost(self, call: _Call, error: Exception) -> None:
        """Initialize a lost actor, which Ray restarts. If no restart is left, remove the actor.

        Raises PathreplayError if no actor is left.
        """
        number, host = call.actor, getattr(self.ready.pop(call.actor, None), "host", "its machine")
        if call.step is None:  # the initialization failed: all restarts are used up
            del self.actors[number]
            if not self.actors:
                raise PathreplayError(
                    f"ray: all actors are lost ({one_line(error)[:300]}); check Ray's logs, give the actors more "
                    "memory, or raise ray.max_restarts"
                )
            self.log_once(f"ray: actor {number + 1} is permanently lost; {len(self.actors)} are left")
            return
        if any(other.actor == number and other.step is None for other in self.calls.values()):
            return  # another request has already revealed the loss, and the actor is being initialized
        self.counts.restarts += 1
        self.tell(f"ray: actor {number + 1} on {host} was lost and is being restarted; its shards are computed again")
        self._initialize(number)

    def log_once(self, line: str) -> None:
        """Log a line unless the same line was logged before. Several actors may cause the same line."""
        if line not in self.logged:
            self.logged.add(line)
            self.tell(line)


class RayExecutor:
    """`Executor` that evaluates shards in Ray actors, with the integrator of the job or of its ``baseline``.

    ``names`` are the names of the views, for error messages.
    """

    def __init__(self, pool: WorkerPool, names: Sequence[str] = (), baseline: bool = False) -> None:
        self.pool, self.names, self.baseline = pool, names, baseline
        self.scheduler = Scheduler()
        pool.schedulers.append(self.scheduler)

    def run(self, values: Arrays, shards: Sequence[Shard], learned: Arrays) -> Iterator[Evaluation]:
        """Yield evaluations in shard order; see `Executor`.

        Raises PathreplayError if all actors are permanently lost. Errors of evaluations are raised again here.
        """
        if not shards:
            return
        pool, step = self.pool, Step(self.scheduler, shards)
        sent = [pool.sent(dict(arrays)) for arrays in (values, learned)]
        size = _bytes_of(values)
        results: dict[int, Evaluation] = {}
        losses: dict[int, int] = {}
        begin, yielded = time.monotonic(), 0
        while yielded < len(shards):
            if yielded in results:
                yield results.pop(yielded)
                yielded += 1
                continue
            self._hand_out(step, shards, size, *sent)
            late = step.patience() if pool.idle() else None
            patience = SOON_S if late is None else min(SOON_S, max(0.0, late - time.monotonic()))
            answered = pool.answered(patience)
            for call, _ in answered:
                if call.step is not None:
                    call.step.heard(call.indices[0], call.actor)
            self._hand_out(step, shards, size, *sent)
            for call, reference in answered:
                answers = pool.fetch(call, reference)
                if call.step is None:
                    continue
                if answers is None:
                    self._lost(call, step, shards, losses)
                    continue
                for index, answer in zip(call.indices, answers, strict=True):
                    if call.step.finished(index, call.actor, answer.seconds) and call.step is step:
                        results[index] = self._accept(answer)
                pool.status(f"{len(pool.ready)} actors, shard {len(step.done)} of {len(shards)}")
            if not pool.ready and time.monotonic() - begin > SOON_S:
                pool.log_once("ray: no actor is ready yet; check the cluster's free resources with 'ray status'")

    def _hand_out(
        self, step: Step, shards: Sequence[Shard], size: int, values: Arrays | Reference, learned: Arrays | Reference
    ) -> None:
        """Send requests to idle actors. ``size`` is the number of bytes of the values; gradients have the same size."""
        idle = self.pool.idle()
        for number in step.in_turn(idle):
            late = len(step.again)
            first = step.next(number, time.monotonic(), idle)
            if first is None:
                break  # do not ask the remaining idle actors: they may be many, and are unlikely to get a shard
            self.pool.counts.twice += len(step.again) - late
            indices = (first, *step.along(number, size, len(self.pool.ready)))
            self.pool.ask(
                number, _Call(number, step, indices), self.baseline, values, [shards[i] for i in indices], learned
            )

    def _lost(self, call: _Call, step: Step, shards: Sequence[Shard], losses: dict[int, int]) -> None:
        """Reschedule the shards of a request whose actor was lost. The request may belong to an earlier step.

        Raises PathreplayError if a shard of this step was lost too often.
        """
        assert call.step is not None
        for scheduler in self.pool.schedulers:
            scheduler.forget(call.actor)
        for index in call.indices:
            call.step.lost(index, call.actor)
            if call.step is not step or index in step.done:
                continue
            self.pool.counts.again += 1
            losses[index] = losses.get(index, 0) + 1
            if losses[index] > self.pool.retries:
                raise PathreplayError(
                    f"ray: {losses[index]} actors in a row were lost while evaluating "
                    f"{self._name([shards[i] for i in call.indices])}; give them more memory, or raise "
                    "ray.max_task_retries"
                )

    def _accept(self, answer: Answer) -> Evaluation:
        """Return the evaluation of a shard from its first answer, and log each warning text only once."""
        self.pool.counts.shards += 1
        for line in answer.warnings:
            if line not in self.pool.logged:
                self.pool.logged.add(line)
                mi.Log(mi.LogLevel.Warn, line)
        return answer.evaluation

    def _name(self, shards: Sequence[Shard]) -> str:
        views = ", ".join(self.names[n] if self.names else str(n) for shard in shards for n in shard.views)
        return f"the shard of view {views}" if len(shards) == 1 else f"one of the shards of views {views}"


def _bytes_of(arrays: Arrays) -> int:
    return sum(array.nbytes for array in arrays.values())


def _cause(error: Any) -> BaseException:
    """Return the exception that an evaluation has raised in an actor."""
    cause = error.cause
    return cause if isinstance(cause, BaseException) else PathreplayError(f"ray: {one_line(error)}")


def require_executor(config: Config) -> None:
    """Raise PathreplayError if a package that the job's executor needs is missing."""
    if config.executor == "ray":
        load_ray()


@contextmanager
def crew_of(config: Config, base: Path, problem: Problem, tell: Tell, status: Tell) -> Iterator[WorkerPool | None]:
    """Start the actors of a job, yield them, and end them after this block.

    Yields None if the job runs in this process. ``tell`` receives log lines, and ``status`` the progress within a step.
    Raises PathreplayError if the cluster cannot be used or is too small.
    """
    if config.executor != "ray":
        yield None
        return
    cores = usable_cores()
    threads = config.ray.threads or (1 if config.deterministic else max(1, min(THREADS, cores // 2)))
    with connected(config.ray, max(cores, threads * (config.ray.actors or 1))) as cluster:
        ray = cluster.ray
        count = _count(ray, config, threads, problem)
        targets = Targets.of(problem.views)
        setup = ray.put(WorkerInit(config, base.resolve(), targets, mi.variant(), threads))
        kind = ray.remote(**_needs(threads), max_restarts=config.ray.max_restarts, max_task_retries=-1)(RayActor)
        actors = {number: kind.remote() for number in range(count)}
        where = "this machine" if cluster.own else f"a cluster of {sum(node['Alive'] for node in ray.nodes())} nodes"
        plural = "actor" if count == 1 else "actors"
        tell(f"ray: {count} {plural} with {threads} {'thread' if threads == 1 else 'threads'} each on {where}")
        pool = WorkerPool(cluster, actors, setup, config.ray.max_task_retries, tell, status)
        try:
            yield pool
            tell(f"ray: {pool.counts.line()}")
        finally:
            if cluster.is_shared():  # the actors of a private cluster end with the cluster
                for actor in pool.actors.values():
                    ray.kill(actor)


def _needs(threads: int) -> dict[str, float]:
    return {"num_cpus": threads, "num_gpus": 1 if mi.variant().startswith("cuda") else 0}


def _count(ray: ModuleType, config: Config, threads: int, problem: Problem) -> int:
    """Return the number of actors to start. Raises PathreplayError if the cluster has too few cores or GPUs."""
    needs = {"CPU": threads, "GPU": _needs(threads)["num_gpus"]}
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    room = sum(min(int(node.get(name, 0) // n) for name, n in needs.items() if n) for node in nodes)
    if room < (config.ray.actors or 1):
        requested = f"{threads} cores" + (" and a GPU" if needs["GPU"] else "")
        raise PathreplayError(
            f"ray: no room for {config.ray.actors or 1} actors with {requested} each: the cluster has "
            f"{sum(node.get('CPU', 0) for node in nodes):.0f} cores and "
            f"{sum(node.get('GPU', 0) for node in nodes):.0f} GPUs; use fewer actors, or fewer threads"
        )
    if config.ray.actors is not None:
        return config.ray.actors
    views = len(problem.trained())
    return min(room, config.parts * min(views, config.view_batch_size or views))
