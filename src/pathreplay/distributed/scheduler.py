"""Assigns the shards of a step to actors by measured durations, while results come in and without effect on them.

Every actor keeps the views that it had before, because it holds their kernels. An actor with nothing left takes a shard
from the actor with the most remaining work, so that all actors end at about the same time. When no shard is left to
start, an idle actor also computes a shard that takes much longer than expected, and the first result counts. Short
shards share one request, because each request has a fixed cost.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field

from pathreplay.inverse.objective.evaluate import Shard

Actor = int
"""Number of an actor; a restarted actor keeps it."""

LATE = 2.0
"""A request is a straggler after LATE times the expected cold-start duration of its first shard.

This exceeds the timing noise of a shared machine, and a second actor that starts the shard can still be first.
"""

WARM = 2
"""Evaluations of a view after which an actor holds its kernels: the first is traced, the second is recorded."""

SHORTEST_S, LONGEST_S = 0.01, 0.1
"""Range of the duration of a request of several short shards (`benchmarks.schedule --measure` gives a call's cost)."""

AHEAD = 0.7
"""Maximum fraction of an actor's remaining work in one request; other actors can still take the rest."""

TOGETHER = 2**26
"""Maximum bytes of gradients per request of several shards."""

SMOOTHING = 0.5
"""Weight of the previous estimate when the duration of a view is measured again."""

Kind = tuple[tuple[int, ...], int, int]
"""Key of shards of equal duration: views, samples, stage."""


def kind_of(shard: Shard) -> Kind:
    """Key of all that determines the duration of a shard: its views, samples and stage."""
    return shard.views, shard.samples, shard.stage


@dataclass
class Scheduler:
    """Measurements of shards and actors that are kept from step to step."""

    seconds: dict[Kind, float] = field(default_factory=dict)
    """Warm duration per shard kind (cold duration until one is known)."""
    warm: set[Kind] = field(default_factory=set)
    """Kinds whose ``seconds`` are a warm duration."""
    extra: float = 0.0
    """Additional seconds of a cold evaluation."""
    owner: dict[Kind, Actor] = field(default_factory=dict)
    """Actor that evaluated the kind last."""
    times: dict[tuple[Actor, Kind], int] = field(default_factory=dict)
    """Number of evaluations per actor and kind."""
    waited: dict[Actor, float] = field(default_factory=dict)
    """Seconds that an actor was idle in earlier steps, because it would have finished later than the owner."""
    refused: dict[Actor, float] = field(default_factory=dict)
    """The same for the current step."""

    def begin(self) -> None:
        """Begin a step."""
        for actor, seconds in self.refused.items():
            self.waited[actor] = self.waited.get(actor, 0.0) + seconds
        self.refused.clear()

    def expected(self, actor: Actor, kind: Kind) -> float | None:
        """Seconds that the actor is expected to take; None if no shard of this kind was measured."""
        known = self.seconds.get(kind)
        if known is None:
            return None
        return known if self.holds(actor, kind) else known + self.extra

    def holds(self, actor: Actor, kind: Kind) -> bool:
        """Whether the actor holds the kernels of such a shard."""
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
            seconds = min(seconds, LATE * known)  # an outlier must not delay the detection of the next straggler
            self.seconds[kind] = SMOOTHING * known + (1 - SMOOTHING) * seconds
        else:
            self._learn(known - seconds)
            self.seconds[kind] = seconds
            self.warm.add(kind)

    def _learn(self, extra: float) -> None:
        self.extra = SMOOTHING * self.extra + (1 - SMOOTHING) * max(0.0, extra)

    def forget(self, actor: Actor) -> None:
        """Drop what is known of an actor that was lost with its kernels."""
        self.times = {key: n for key, n in self.times.items() if key[0] != actor}
        self.owner = {kind: other for kind, other in self.owner.items() if other != actor}
        self.waited.pop(actor, None)


@dataclass
class Request:
    """Shards that an actor is evaluating and answers together."""

    shards: list[int]
    since: float
    more: float = 0.0
    """Expected seconds of all shards but the first."""


class Step:
    """State of the shards of one step: waiting, running or done. Each operation is cheap for any number of shards."""

    def __init__(self, scheduler: Scheduler, shards: Sequence[Shard]) -> None:
        self.scheduler = scheduler
        scheduler.begin()
        self.kinds = [kind_of(shard) for shard in shards]
        self.waiting: dict[Actor | None, list[int]] = {}
        """Waiting shards by owner, or None if unknown, in ascending order of duration; equals in descending order."""
        self.left: dict[Actor | None, float] = {}
        """Expected seconds of an owner's waiting shards: the sum of their ``cost``."""
        self.cost: dict[int, float] = {}
        self.running: dict[Actor, Request] = {}
        self.done: set[int] = set()
        self.again: set[int] = set()
        """Late shards that a second actor has started."""
        self._wait(range(len(shards)))
        self.all = sum(self.left.values())
        """Expected seconds of all shards, as far as known."""

    def in_turn(self, idle: Iterable[Actor]) -> list[Actor]:
        """Sort idle actors by priority: owners of waiting shards first, then those that have waited longest."""
        return sorted(idle, key=lambda actor: (not self.waiting.get(actor), -self.scheduler.waited.get(actor, 0.0)))

    def next(self, actor: Actor, now: float, idle: Collection[Actor]) -> int | None:
        """Start a shard on an idle actor and return its index; None if there is nothing to do for now.

        ``idle`` are all idle actors.
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
            # Leave the shard to its owner if that is faster. Time that the actor has waited in earlier steps counts in
            # its favour: an actor that joins late would never build any kernels otherwise.
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
        """Add short shards from the actor's own queue to the request that `next` has started; returns their indices.

        Their time is limited to a fraction of the actor's remaining work, and to an even share among ``actors``. So
        requests become shorter towards the end, and all actors end at about the same time. The bytes of a gradient,
        ``size``, limit their number.
        """
        waiting, request = self.waiting.get(actor, []), self.running[actor]
        if not self.scheduler.holds(actor, self.kinds[request.shards[0]]):
            return []
        room, first = TOGETHER // max(1, size), self._seconds(actor, request.shards[0])
        even = self.all / actors * (1 + 1e-6)  # rounding must not cut off the last of equally long shards
        limit = min(LONGEST_S, even, max(SHORTEST_S, AHEAD * (first + self.left.get(actor, 0.0))))
        while waiting and len(request.shards) < room and self.scheduler.holds(actor, self.kinds[waiting[-1]]):
            more = request.more + self.cost[waiting[-1]]
            if first + more > limit:
                break
            request.shards.append(self._take(actor, -1))
            request.more = more
        return request.shards[1:]

    def _goes_on(self, actor: Actor, idle: Collection[Actor]) -> bool:
        """Whether the actor will reach its waiting shards: it is not lost, stuck, or busy with an earlier step."""
        return self.again.isdisjoint(self.running[actor].shards) if actor in self.running else actor in idle

    def heard(self, index: int, actor: Actor) -> None:
        """End the actor's request that contains the shard; the actor may then start another."""
        if actor in self.running and index in self.running[actor].shards:
            del self.running[actor]

    def finished(self, index: int, actor: Actor, seconds: float) -> bool:
        """Record a result; returns whether it is the first of the shard. The actor may run its next request already."""
        self.heard(index, actor)
        self.scheduler.measured(actor, self.kinds[index], seconds)
        first = index not in self.done
        self.done.add(index)
        return first

    def lost(self, index: int, actor: Actor) -> None:
        """Put the shard of a lost actor back, unless another actor runs it. Its waiting shards become unowned."""
        self.heard(index, actor)
        self.left.pop(actor, None)
        theirs = self.waiting.pop(actor, [])
        if index not in self.done:
            self.again.discard(index)
            if all(index not in other.shards for other in self.running.values()):
                theirs.append(index)
        self._wait(theirs)

    def patience(self) -> float | None:
        """Time at which the next running shard becomes late; None if none will."""
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
        """Actor with waiting shards that has the most remaining work, and its seconds."""
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
        """Time at which the first shard that only one actor runs becomes late, and its index."""
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
