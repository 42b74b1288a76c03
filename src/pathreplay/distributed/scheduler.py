"""Assigns the shards of a step to actors, based on measured durations. Results do not depend on the assignment.

A step is an iteration of the optimisation. Each actor evaluates the same views in every step, because it has compiled
their kernels. An actor that has finished its own shards takes one from the actor with the most remaining work, so that
all actors finish at about the same time. If no shard is waiting, an idle actor repeats a running shard that takes much
longer than expected, and the first result counts. Several short shards are sent in one request, because each request
has a fixed cost.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field

from pathreplay.inverse.objective.evaluate import Shard

Actor = int
"""Number of an actor, which stays the same if the actor is restarted."""

LATE = 2.0
"""A request is late after LATE times its expected duration, which includes compiling the kernels of its first shard.

The factor exceeds the timing noise of a shared machine. A second actor that starts the late shard can still be first.
"""

WARM = 2
"""Evaluations after which an actor has a view's kernels: the first traces them, the second records them for replay."""

SHORTEST_S, LONGEST_S = 0.01, 0.1
"""Smallest and largest time limit, in seconds, of a request of several short shards.

`benchmarks.schedule --measure` measures the fixed cost of a request.
"""

AHEAD = 0.7
"""Largest fraction of an actor's remaining work in one request; other actors can still take the rest."""

TOGETHER = 2**26
"""Largest number of bytes of gradients in a request of several shards."""

SMOOTHING = 0.5
"""Weight of the previous estimate when a new duration of a shard kind is averaged in."""

Kind = tuple[tuple[int, ...], int, int]
"""Kind of a shard: views, samples and stage. Shards of the same kind have the same expected duration."""


def kind_of(shard: Shard) -> Kind:
    """Return the kind of a shard: the views, samples and stage, which determine its duration."""
    return shard.views, shard.samples, shard.stage


@dataclass
class Scheduler:
    """Measurements of shards and actors that are kept from step to step.

    An evaluation is warm if the actor has the kernels of the shard, and cold otherwise.
    """

    seconds: dict[Kind, float] = field(default_factory=dict)
    """Warm duration per shard kind; the cold duration until a warm duration is known."""
    warm: set[Kind] = field(default_factory=set)
    """Kinds whose duration in ``seconds`` is warm."""
    extra: float = 0.0
    """Difference between a cold and a warm duration, in seconds."""
    owner: dict[Kind, Actor] = field(default_factory=dict)
    """Actor that last evaluated a shard of the kind."""
    times: dict[tuple[Actor, Kind], int] = field(default_factory=dict)
    """Number of evaluations per actor and kind."""
    waited: dict[Actor, float] = field(default_factory=dict)
    """Per actor: sum of its values of ``refused`` in all steps since the actor last took a shard of another owner."""
    refused: dict[Actor, float] = field(default_factory=dict)
    """Per actor that declined to take a shard of the busiest owner in this step: the seconds of that owner's work."""

    def begin(self) -> None:
        """Begin a step: add the values of ``refused``, which the previous step has set, to ``waited``."""
        for actor, seconds in self.refused.items():
            self.waited[actor] = self.waited.get(actor, 0.0) + seconds
        self.refused.clear()

    def expected(self, actor: Actor, kind: Kind) -> float | None:
        """Return the seconds that an actor is expected to take for a shard; None if its kind was never measured."""
        known = self.seconds.get(kind)
        if known is None:
            return None
        return known if self.holds(actor, kind) else known + self.extra

    def holds(self, actor: Actor, kind: Kind) -> bool:
        """Return whether an actor has the kernels of a shard kind."""
        return self.times.get((actor, kind), 0) >= WARM

    def measured(self, actor: Actor, kind: Kind, seconds: float) -> None:
        """Record the duration of an evaluation."""
        times = self.times.get((actor, kind), 0)
        self.times[actor, kind], self.owner[kind] = times + 1, actor
        known = self.seconds.get(kind)
        if known is None:
            self.seconds[kind] = seconds
        elif times < WARM:
            if kind in self.warm:
                self._learn(seconds - known)
        elif kind in self.warm:
            seconds = min(seconds, LATE * known)  # limit outliers, which would delay the detection of late shards
            self.seconds[kind] = SMOOTHING * known + (1 - SMOOTHING) * seconds
        else:
            self._learn(known - seconds)
            self.seconds[kind] = seconds
            self.warm.add(kind)

    def _learn(self, extra: float) -> None:
        self.extra = SMOOTHING * self.extra + (1 - SMOOTHING) * max(0.0, extra)

    def forget(self, actor: Actor) -> None:
        """Drop the measurements of an actor that was lost with its kernels."""
        self.times = {key: n for key, n in self.times.items() if key[0] != actor}
        self.owner = {kind: other for kind, other in self.owner.items() if other != actor}
        self.waited.pop(actor, None)


@dataclass
class Request:
    """A running request: shards, by index, that an actor evaluates and answers together."""

    shards: list[int]
    since: float
    """Start time."""
    more: float = 0.0
    """Expected seconds of all shards except the first."""


class Step:
    """The shards of one step: each is waiting, running or done. Operations are cheap for any number of shards."""

    def __init__(self, scheduler: Scheduler, shards: Sequence[Shard]) -> None:
        self.scheduler = scheduler
        scheduler.begin()
        self.kinds = [kind_of(shard) for shard in shards]
        self.waiting: dict[Actor | None, list[int]] = {}
        """Indices of waiting shards by owner (None: no owner), sorted by ascending duration, then descending index."""
        self.left: dict[Actor | None, float] = {}
        """Expected seconds of all waiting shards of an owner: the sum of their ``cost``."""
        self.cost: dict[int, float] = {}
        """Expected seconds of a shard that is or was waiting, by index."""
        self.running: dict[Actor, Request] = {}
        self.done: set[int] = set()
        self.again: set[int] = set()
        """Late shards that a second actor has started."""
        self._wait(range(len(shards)))
        self.all = sum(self.left.values())
        """Expected seconds of all shards; unknown durations count as zero."""

    def in_turn(self, idle: Iterable[Actor]) -> list[Actor]:
        """Sort idle actors by priority: owners of waiting shards first, then by descending ``Scheduler.waited``."""
        return sorted(idle, key=lambda actor: (not self.waiting.get(actor), -self.scheduler.waited.get(actor, 0.0)))

    def next(self, actor: Actor, now: float, idle: Collection[Actor]) -> int | None:
        """Choose the next shard of an idle actor, mark it as running, and return its index.

        Returns None if the actor should not start a shard now.

        Args:
            actor: the idle actor.
            now: the current time.
            idle: all idle actors.
        """
        for owner in (actor, None):
            if self.waiting.get(owner):
                return self._begin(actor, owner, -1, now)
        for other, indices in self.waiting.items():
            if indices and other is not None and not self._goes_on(other, idle):
                return self._begin(actor, other, -1, now)
        most = self._busiest(now)
        if most is not None:
            other, left = most
            # The owner keeps a shard if the owner would finish all its work before this actor finished the shard.
            # However, the owner's work counts as longer if this actor has declined shards in earlier steps.
            # Otherwise, an actor that joins late would never compile any kernels.
            worth = left + self.scheduler.waited.get(actor, 0.0)
            for place in reversed(range(len(self.waiting[other]))):
                if (self.scheduler.expected(actor, self.kinds[self.waiting[other][place]]) or 0.0) < worth:
                    self.scheduler.waited.pop(actor, None)
                    return self._begin(actor, other, place, now)
            self.scheduler.refused.setdefault(actor, left)
        late = self._latest()
        if late is None or late[0] > now:
            return None
        self.again.add(late[1])
        self.running[actor] = Request([late[1]], now)
        return late[1]

    def along(self, actor: Actor, size: int, actors: int) -> list[int]:
        """Add short shards from the actor's own queue to the request that `next` has started; return their indices.

        The time of a request is limited to a fraction of the actor's remaining work, and to the work of the whole step
        divided by the number of ``actors``. Requests therefore become shorter towards the end of a step, and all actors
        finish at about the same time. `TOGETHER` limits the size of the gradients of a request. Each shard has
        gradients of ``size`` bytes.
        """
        waiting, request = self.waiting.get(actor, []), self.running[actor]
        if not self.scheduler.holds(actor, self.kinds[request.shards[0]]):
            return []
        room, first = TOGETHER // max(1, size), self._seconds(actor, request.shards[0])
        even = self.all / actors * (1 + 1e-6)  # tolerance: rounding must not exclude the last of several equal shards
        limit = min(LONGEST_S, even, max(SHORTEST_S, AHEAD * (first + self.left.get(actor, 0.0))))
        while waiting and len(request.shards) < room and self.scheduler.holds(actor, self.kinds[waiting[-1]]):
            more = request.more + self.cost[waiting[-1]]
            if first + more > limit:
                break
            request.shards.append(self._take(actor, -1))
            request.more = more
        return request.shards[1:]

    def _goes_on(self, actor: Actor, idle: Collection[Actor]) -> bool:
        """Return whether an actor will start its waiting shards: it is not lost, late, or busy with an earlier step."""
        return self.again.isdisjoint(self.running[actor].shards) if actor in self.running else actor in idle

    def heard(self, index: int, actor: Actor) -> None:
        """Mark the actor's request that contains the shard as answered, so that the actor may start another request."""
        if actor in self.running and index in self.running[actor].shards:
            del self.running[actor]

    def finished(self, index: int, actor: Actor, seconds: float) -> bool:
        """Record a result, and return whether it is the first of this shard.

        The actor may already be evaluating its next request.
        """
        self.heard(index, actor)
        self.scheduler.measured(actor, self.kinds[index], seconds)
        first = index not in self.done
        self.done.add(index)
        return first

    def lost(self, index: int, actor: Actor) -> None:
        """Mark a shard as waiting because its actor was lost, unless it is done or another actor is evaluating it.

        The waiting shards of the lost actor are reassigned to the owners of their kinds. Usually, these kinds no longer
        have an owner: the lost actor owned them, and `Scheduler.forget` has removed it.
        """
        self.heard(index, actor)
        self.left.pop(actor, None)
        theirs = self.waiting.pop(actor, [])
        if index not in self.done:
            self.again.discard(index)
            if all(index not in other.shards for other in self.running.values()):
                theirs.append(index)
        self._wait(theirs)

    def patience(self) -> float | None:
        """Return the time at which the next running shard becomes late; None if no shard can become late."""
        late = self._latest()
        return None if late is None else late[0]

    def _wait(self, indices: Iterable[int]) -> None:
        seconds, touched = self.scheduler.seconds, set()
        for i in indices:
            owner = self.scheduler.owner.get(self.kinds[i])
            touched.add(owner)
            self.waiting.setdefault(owner, []).append(i)
            self.cost[i] = self._seconds(owner, i)
            self.left[owner] = self.left.get(owner, 0.0) + self.cost[i]
        for owner in touched:
            self.waiting[owner].sort(key=lambda i: (seconds.get(self.kinds[i], 0.0), -i))

    def _begin(self, actor: Actor, owner: Actor | None, place: int, now: float) -> int:
        index = self._take(owner, place)
        self.running[actor] = Request([index], now)
        return index

    def _take(self, owner: Actor | None, place: int) -> int:
        index = self.waiting[owner].pop(place)
        self.left[owner] -= self.cost[index]
        return index

    def _seconds(self, owner: Actor | None, index: int) -> float:
        return 0.0 if owner is None else self.scheduler.expected(owner, self.kinds[index]) or 0.0

    def _busiest(self, now: float) -> tuple[Actor, float] | None:
        """Among the owners of waiting shards, return the one with the most remaining work, and this work in seconds."""
        busiest: tuple[Actor, float] | None = None
        for owner, indices in self.waiting.items():
            if owner is None or not indices:
                continue
            left = self.left[owner]
            if owner in self.running:
                request = self.running[owner]
                left += max(0.0, self._seconds(owner, request.shards[0]) + request.more - (now - request.since))
            if busiest is None or (left, -owner) > (busiest[1], -busiest[0]):
                busiest = owner, left
        return busiest

    def _latest(self) -> tuple[float, int] | None:
        """Return the time at which the next running shard becomes late, and the index of this shard.

        Shards that a second actor is also evaluating are excluded. Returns None if no shard can become late.
        """
        late, seconds, extra = [], self.scheduler.seconds, self.scheduler.extra
        for request in self.running.values():
            known = seconds.get(self.kinds[request.shards[0]])
            if known is None:
                continue
            for index in request.shards:
                if index not in self.again and index not in self.done:
                    late.append((request.since + LATE * (known + request.more + extra), index))
                    break
        return min(late, default=None)
