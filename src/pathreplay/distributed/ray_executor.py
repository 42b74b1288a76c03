"""Shards evaluated by actors of Ray, which hold scene and kernels: on this machine or on a cluster, with the same bits.

Large values are sent once in a step. `Scheduler` decides who computes what. It does not matter: an evaluation is a
function of values, shard and what was learned, and evaluations are added up in the order of the shards.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
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
from pathreplay.scenes.descriptions import one_line

THREADS = 4
"""Cores of an actor at most, if the job does not say: its Python, which traces kernels, keeps one of them busy."""

SMALL = 2**16
"""Bytes that take less time to go with each question than to be fetched."""

SOON_S = 60.0
"""Seconds after which it is told that no actor is there yet: loading Mitsuba and a scene takes some."""

LOOK_S, AGAIN_S = 0.1, 1.0
"""Seconds without an answer after which it is looked for the processes of the cluster, and for its head."""

Tell = Callable[[str], None]


@dataclass
class Counts:
    """What happened to a run."""

    shards: int = 0
    restarts: int = 0
    again: int = 0
    """Shards that were computed again since their actor was lost."""
    twice: int = 0
    """Shards that were late, and given to another actor as well."""

    def line(self) -> str:
        return (
            f"{self.shards} shards; {self.restarts} restarts, {self.again} shards computed again, "
            f"{self.twice} late ones by two actors"
        )


@dataclass
class _Call:
    """What an actor was asked and has not answered. ``step`` is None for a greeting."""

    actor: int
    step: Step | None = None
    indices: tuple[int, ...] = ()
    """Of shards of the step."""


@dataclass
class WorkerPool:
    """The actors of a run, and what they are asked; the executors of a job and of its baseline share them."""

    cluster: Cluster
    actors: dict[int, Any]
    setup: Any
    """Ray's reference to what they need to know."""
    retries: int
    tell: Tell
    status: Tell = lambda text: None
    """Told how far a step is, again and again."""
    counts: Counts = field(default_factory=Counts)
    schedulers: list[Scheduler] = field(default_factory=list)
    """What is known of them for each who asks."""
    calls: dict[Any, _Call] = field(default_factory=dict)
    """By Ray's reference to the answer."""
    ready: dict[int, Ready] = field(default_factory=dict)
    said: set[str] = field(default_factory=set)

    @property
    def ray(self) -> Any:
        return self.cluster.ray

    def __post_init__(self) -> None:
        for number in self.actors:
            self._greet(number)

    def idle(self) -> list[int]:
        """Actors that are there, and have nothing to do."""
        busy = {call.actor for call in self.calls.values()}
        return [number for number in self.ready if number not in busy]

    def ask(self, number: int, call: _Call, *question: Any) -> None:
        """Have an actor evaluate shards."""
        self.calls[self.actors[number].evaluate.options(max_task_retries=0).remote(*question)] = call

    def sent(self, arrays: Arrays) -> Any:
        """What actors are asked with: what is large is sent now, and they get it from the store of their machine."""
        return arrays if _bytes_of(arrays) < SMALL else self.ray.put(arrays)

    def answered(self, patience: float) -> list[tuple[_Call, Any]]:
        """Calls that have been answered, and the references to fetch the answers by; waits at most so many seconds.

        Raises PathreplayError where the cluster is lost.
        """
        end = time.monotonic() + patience
        ready: list[Any] = []
        self.cluster.require_processes()
        while not ready:
            # Where the answer is does not matter yet: whoever gave it can go on while it is on its way.
            some = min(LOOK_S, max(0.0, end - time.monotonic()))
            ready, _ = self.ray.wait(list(self.calls), num_returns=1, timeout=some, fetch_local=False)
            if time.monotonic() >= end:
                break
            if not ready:
                self.cluster.require(AGAIN_S)
        return [(self.calls.pop(reference), reference) for reference in ready]

    def fetch(self, call: _Call, reference: Any) -> list[Answer] | None:
        """What was answered to each shard; None where there is nothing, since the actor was lost, or to a greeting.

        Raises PathreplayError where no actor is left; what an evaluation raised.
        """
        try:
            answer = self.ray.get(reference)  # which is there, or its actor is lost
        except self.ray.exceptions.RayTaskError as error:
            raise _cause(error) from None
        except self.ray.exceptions.RayError as error:
            self.cluster.require()
            self._lost(call, error)
            return None
        if isinstance(answer, Ready):
            self._there(call.actor, answer)
            return None
        if answer is None:
            self._lost(call, RuntimeError("it was started again"))
        return answer

    def _greet(self, number: int) -> None:
        self.calls[self.actors[number].hello.remote(self.setup)] = _Call(number)

    def _there(self, number: int, hello: Ready) -> None:
        """An actor is ready. Raises PathreplayError if it is of other versions."""
        if hello.versions != versions():
            raise PathreplayError(
                f"ray: {hello.host} has {hello.versions}, this machine {versions()}; install the same on both"
            )
        self.ready[number] = hello
        machines = {each.machine for each in self.ready.values()}
        if len(machines) > 1:
            self.say_once(
                f"ray: the actors have different processors ({'; '.join(sorted(machines))}), which may round "
                "differently in the last bit"
            )

    def _lost(self, call: _Call, error: Exception) -> None:
        """An actor does not answer any more: it is greeted again, unless Ray has given it up."""
        number, host = call.actor, getattr(self.ready.pop(call.actor, None), "host", "its machine")
        if call.step is None:  # it was being started as often as it may
            del self.actors[number]
            if not self.actors:
                raise PathreplayError(
                    f"ray: all actors are lost ({one_line(error)[:300]}); look into Ray's logs, give them more memory, "
                    "or raise ray.max_restarts"
                )
            self.say_once(f"ray: actor {number + 1} is lost for good; {len(self.actors)} are left")
            return
        if any(other.actor == number and other.step is None for other in self.calls.values()):
            return  # known: it was given other shards meanwhile
        self.counts.restarts += 1
        self.tell(f"ray: actor {number + 1} on {host} was lost and is started again; its shards are computed again")
        self._greet(number)

    def say_once(self, line: str) -> None:
        """Tell what may come from several actors."""
        if line not in self.said:
            self.said.add(line)
            self.tell(line)


class RayExecutor:
    """Evaluates shards by actors of Ray: an `Executor`. ``baseline`` says whose integrator."""

    def __init__(self, pool: WorkerPool, names: Sequence[str] = (), baseline: bool = False) -> None:
        self.pool, self.names, self.baseline = pool, names, baseline
        self.scheduler = Scheduler()
        pool.schedulers.append(self.scheduler)

    def run(self, values: Arrays, shards: Sequence[Shard], learned: Arrays) -> Iterator[Evaluation]:
        """See `Executor`. Raises PathreplayError where actors are lost for good, and what evaluations raise."""
        if not shards:
            return
        pool, step = self.pool, Step(self.scheduler, shards)
        sent = [pool.sent(dict(each)) for each in (values, learned)]
        size = _bytes_of(values)
        found: dict[int, Evaluation] = {}
        losses: dict[int, int] = {}
        begin, given = time.monotonic(), 0
        while given < len(shards):
            if given in found:
                yield found.pop(given)
                given += 1
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
                        found[index] = self._taken(answer)
                pool.status(f"{len(pool.ready)} actors, shard {len(step.done)} of {len(shards)}")
            if not pool.ready and time.monotonic() - begin > SOON_S:
                pool.say_once("ray: no actor is ready yet; is there room for them? 'ray status' tells")

    def _hand_out(self, step: Step, shards: Sequence[Shard], size: int, values: Any, learned: Any) -> None:
        """Give idle actors what they have to do. Values, and so gradients, have ``size`` bytes."""
        idle = self.pool.idle()
        for number in step.in_turn(idle):
            late = len(step.again)
            first = step.next(number, time.monotonic(), idle)
            if first is None:
                break  # what is nothing for one is hardly anything for the others, of whom there may be many
            self.pool.counts.twice += len(step.again) - late
            indices = (first, *step.along(number, size, len(self.pool.ready)))
            self.pool.ask(
                number, _Call(number, step, indices), self.baseline, values, [shards[i] for i in indices], learned
            )

    def _lost(self, call: _Call, step: Step, shards: Sequence[Shard], losses: dict[int, int]) -> None:
        """An actor was lost at a call, which may be one of a step before."""
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
                    f"ray: {self._name([shards[i] for i in call.indices])} has ended {losses[index]} actors, one "
                    "after the other; give them more memory, or raise ray.max_task_retries"
                )

    def _taken(self, answer: Answer) -> Evaluation:
        """What the first answer to a shard has found."""
        self.pool.counts.shards += 1
        for line in answer.warnings:
            if line not in self.pool.said:
                self.pool.said.add(line)
                mi.Log(mi.LogLevel.Warn, line)
        return answer.evaluation

    def _name(self, shards: Sequence[Shard]) -> str:
        views = ", ".join(self.names[n] if self.names else str(n) for shard in shards for n in shard.views)
        return f"the shard of view {views}" if len(shards) == 1 else f"one of the shards of views {views}"


def _bytes_of(arrays: Arrays) -> int:
    return sum(array.nbytes for array in arrays.values())


def _cause(error: Any) -> BaseException:
    """What an evaluation has raised, as it would have been raised here."""
    cause = error.cause
    return cause if isinstance(cause, BaseException) else PathreplayError(f"ray: {one_line(error)}")


def require_executor(config: Config) -> None:
    """Raise PathreplayError unless what the job's executor needs is installed."""
    if config.executor == "ray":
        load_ray()


@contextmanager
def crew_of(config: Config, base: Path, problem: Problem, tell: Tell, status: Tell) -> Iterator[WorkerPool | None]:
    """The actors of a job, until the end of the block; None where it computes in this process. Raises PathreplayError.

    ``tell`` is given lines that stay, ``status`` what is so for a moment.
    """
    if config.executor != "ray":
        yield None
        return
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    threads = config.ray.threads or (1 if config.deterministic else max(1, min(THREADS, cores // 2)))
    wanted = max(cores, threads * (config.ray.actors or 1))
    with connected(config.ray, wanted) as cluster:
        ray = cluster.ray
        count = _count(ray, config, threads, problem)
        targets = Targets.of(problem.views)
        setup = ray.put(WorkerInit(config, base.resolve(), targets, mi.variant(), threads))
        kind = ray.remote(**_needs(threads), max_restarts=config.ray.max_restarts, max_task_retries=-1)(RayActor)
        actors = {number: kind.remote() for number in range(count)}
        where = "this machine" if cluster.own else f"a cluster of {len(ray.nodes())} nodes"
        tell(f"ray: {count} actors with {threads} {'thread' if threads == 1 else 'threads'} each on {where}")
        pool = WorkerPool(cluster, actors, setup, config.ray.max_task_retries, tell, status)
        try:
            yield pool
            tell(f"ray: {pool.counts.line()}")
        finally:
            if cluster.has_others():  # it goes on without these actors; our own ends with all that is in it
                for actor in pool.actors.values():
                    ray.kill(actor)


def _needs(threads: int) -> dict[str, float]:
    return {"num_cpus": threads, "num_gpus": 1 if mi.variant().startswith("cuda") else 0}


def _count(ray: Any, config: Config, threads: int, problem: Problem) -> int:
    """How many actors there are to be. Raises PathreplayError where there is no room for them."""
    needs = {"CPU": threads, "GPU": _needs(threads)["num_gpus"]}
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    room = sum(min(int(node.get(name, 0) // n) for name, n in needs.items() if n) for node in nodes)
    if room < (config.ray.actors or 1):
        asked = f"{threads} cores" + (" and a GPU" if needs["GPU"] else "")
        raise PathreplayError(
            f"ray: no room for {config.ray.actors or 1} actors with {asked} each: the cluster has "
            f"{sum(node.get('CPU', 0) for node in nodes):.0f} cores and "
            f"{sum(node.get('GPU', 0) for node in nodes):.0f} GPUs; ask for fewer, or for fewer threads"
        )
    if config.ray.actors is not None:
        return config.ray.actors
    views = len(problem.trained())
    return min(room, config.parts * min(views, config.view_batch_size or views))
