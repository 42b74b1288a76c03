"""Who computes which shard of a step: decided by measured seconds while results come in, and without effect on them.

Every actor goes on with the views that it had before, whose kernels it holds. One that has nothing left takes from
whoever has most left; so the shares of the actors become such that all end together. When nothing is left to begin,
a shard that takes much longer than expected is computed by an idle actor as well, and the first result counts.
Short shards go together in one question, since asking has a price.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field

from pathreplay.inverse.objective.evaluate import Shard

Actor = int
"""The number of an actor; one that was started again keeps it."""

LATE = 2.0
"""A question is late when it has taken so many times what it would take one who has never done its first shard.

Noise of a shared machine is less, and whoever begins it as well can then be the first.
"""

WARM = 2
"""Evaluations of a view by an actor after which its kernels are there: one is traced, the next one is recorded."""

SHORTEST_S, LONGEST_S = 0.01, 0.1
"""Short shards go with one question, as many as take so long: a call has a price (`benchmarks.schedule --measure`)."""

AHEAD = 0.7
"""Of what an actor has left, how much goes with one question at most: the rest can still be taken by others."""

TOGETHER = 2**26
"""Bytes of gradients that an actor has for one question at most, unless one shard has more."""

SMOOTHING = 0.5
"""How much of what was known of a view's seconds stays when they are measured again."""

Kind = tuple[tuple[int, ...], int, int]
"""What shards that take the same time have in common: views, samples, stage."""


def kind_of(shard: Shard) -> Kind:
    """What decides how long a shard takes: its views, samples and stage."""
    return shard.views, shard.samples, shard.stage


@dataclass
class Scheduler:
    """What is known of shards and actors from step to step."""

    seconds: dict[Kind, float] = field(default_factory=dict)
    """Of an evaluation by an actor that has done it before; of any, until one is ``warm``."""
    warm: set[Kind] = field(default_factory=set)
    """Those whose seconds are of an actor that had their kernels."""
    extra: float = 0.0
    """More seconds of one that has not."""
    owner: dict[Kind, Actor] = field(default_factory=dict)
    """Who did it last."""
    times: dict[tuple[Actor, Kind], int] = field(default_factory=dict)
    """How often an actor has done it."""
    waited: dict[Actor, float] = field(default_factory=dict)
    """Seconds that an actor went without work in steps before, since what was left would have taken it longer."""
    refused: dict[Actor, float] = field(default_factory=dict)
    """The same of this step."""

    def begin(self) -> None:
        """A step begins."""
        for actor, seconds in self.refused.items():
            self.waited[actor] = self.waited.get(actor, 0.0) + seconds
        self.refused.clear()

    def expected(self, actor: Actor, kind: Kind) -> float | None:
        """Seconds that the actor will take; None where such a shard has never been done."""
        known = self.seconds.get(kind)
        if known is None:
            return None
        return known if self.holds(actor, kind) else known + self.extra

    def holds(self, actor: Actor, kind: Kind) -> bool:
        """Whether the actor has the kernels of such a shard."""
        return self.times.get((actor, kind), 0) >= WARM

    def measured(self, actor: Actor, kind: Kind, seconds: float) -> None:
        """An actor has taken so many seconds."""
        times = self.times.get((actor, kind), 0)
        self.times[actor, kind], self.owner[kind] = times + 1, actor
        known = self.seconds.get(kind)
        if known is None:
            self.seconds[kind] = seconds
        elif times < WARM:
            if kind in self.warm:
                self._learn(seconds - known)
        elif kind in self.warm:
            seconds = min(seconds, LATE * known)  # an accident shall not make the next one seem early
            self.seconds[kind] = SMOOTHING * known + (1 - SMOOTHING) * seconds
        else:
            self._learn(known - seconds)
            self.seconds[kind] = seconds
            self.warm.add(kind)

    def _learn(self, extra: float) -> None:
        self.extra = SMOOTHING * self.extra + (1 - SMOOTHING) * max(0.0, extra)

    def forget(self, actor: Actor) -> None:
        """The actor was lost with all that it held."""
        self.times = {key: n for key, n in self.times.items() if key[0] != actor}
        self.owner = {kind: other for kind, other in self.owner.items() if other != actor}
        self.waited.pop(actor, None)


@dataclass
class Question:
    """What an actor is at: shards that are answered together."""

    shards: list[int]
    since: float
    more: float = 0.0
    """Seconds of those that went along with the first one."""


class Step:
    """The shards of one step: which wait, who is at which, which are done. Costs little for each, however many."""

    def __init__(self, scheduler: Scheduler, shards: Sequence[Shard]) -> None:
        self.scheduler = scheduler
        scheduler.begin()
        self.kinds = [kind_of(shard) for shard in shards]
        self.waiting: dict[Actor | None, list[int]] = {}
        """By who had them last, if that is known: the longest comes last, of some that are alike the first."""
        self.left: dict[Actor | None, float] = {}
        """Seconds that each will take for those, which are the ``cost`` of all of them."""
        self.cost: dict[int, float] = {}
        self.running: dict[Actor, Question] = {}
        self.done: set[int] = set()
        self.again: set[int] = set()
        """Begun by a second actor, since they were late."""
        self._wait(range(len(shards)))
        self.all = sum(self.left.values())
        """Seconds of all of them, as far as that is known."""

    def in_turn(self, idle: Iterable[Actor]) -> list[Actor]:
        """Idle actors in the order in which they are asked: those that go on by themselves, who has waited longest."""
        return sorted(idle, key=lambda actor: (not self.waiting.get(actor), -self.scheduler.waited.get(actor, 0.0)))

    def next(self, actor: Actor, now: float, idle: Collection[Actor]) -> int | None:
        """The shard that an idle actor begins; None if it has nothing to do for now. ``idle`` are all that are so."""
        for owner in (actor, None):
            if self.waiting.get(owner):
                return self._begin(actor, owner, -1, now)
        for other, indices in self.waiting.items():
            if indices and other is not None and not self._goes_on(other, idle):
                return self._begin(actor, other, -1, now)
        most = self._busiest(now)
        if most is not None:
            other, left = most
            # It goes without help where it would be ready sooner by itself. But who has waited longer for others than
            # it takes to make kernels may do so, or one that comes late would never have any.
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
        self.running[actor] = Question([late[1]], now)
        return late[1]

    def along(self, actor: Actor, size: int, actors: int) -> list[int]:
        """Shards that an actor begins with the one that was its `next`: of its own, if they are short.

        They are a share of what it has left, and no more than each of so many ``actors`` would have, so that questions
        become shorter and actors still end together. A gradient has ``size`` bytes.
        """
        waiting, question = self.waiting.get(actor, []), self.running[actor]
        if not self.scheduler.holds(actor, self.kinds[question.shards[0]]):
            return []
        room, first = TOGETHER // max(1, size), self._seconds(actor, question.shards[0])
        even = self.all / actors * (1 + 1e-6)  # of shards that are alike all have as many, in spite of rounding
        limit = min(LONGEST_S, even, max(SHORTEST_S, AHEAD * (first + self.left.get(actor, 0.0))))
        while waiting and len(question.shards) < room and self.scheduler.holds(actor, self.kinds[waiting[-1]]):
            more = question.more + self.cost[waiting[-1]]
            if first + more > limit:
                break
            question.shards.append(self._take(actor, -1))
            question.more = more
        return question.shards[1:]

    def _goes_on(self, actor: Actor, idle: Collection[Actor]) -> bool:
        """Whether it is known when: not of one that is lost, or still busy with a step before, or stuck."""
        return self.again.isdisjoint(self.running[actor].shards) if actor in self.running else actor in idle

    def heard(self, index: int, actor: Actor) -> None:
        """An actor is not at a shard any more, nor at those of the same question; it may begin others."""
        if actor in self.running and index in self.running[actor].shards:
            del self.running[actor]

    def finished(self, index: int, actor: Actor, seconds: float) -> bool:
        """A result is there; whether it is the first of its shard. The actor may be at its next one already."""
        self.heard(index, actor)
        self.scheduler.measured(actor, self.kinds[index], seconds)
        first = index not in self.done
        self.done.add(index)
        return first

    def lost(self, index: int, actor: Actor) -> None:
        """An actor has gone without a result; if no other is at the shard, it waits again. Its others are nobody's."""
        self.heard(index, actor)
        self.left.pop(actor, None)
        theirs = self.waiting.pop(actor, [])
        if index not in self.done:
            self.again.discard(index)
            if all(index not in other.shards for other in self.running.values()):
                theirs.append(index)
        self._wait(theirs)

    def patience(self) -> float | None:
        """When the next shard is late, for whoever waits; None if none will be."""
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
        self.running[actor] = Question([index], now)
        return index

    def _take(self, owner: Actor | None, place: int) -> int:
        index = self.waiting[owner].pop(place)
        self.left[owner] -= self.cost[index]
        return index

    def _seconds(self, owner: Actor | None, index: int) -> float:
        return 0.0 if owner is None else self.scheduler.expected(owner, self.kinds[index]) or 0.0

    def _busiest(self, now: float) -> tuple[Actor, float] | None:
        """Who has most left to do, of those for whom shards wait, and how many seconds."""
        found: tuple[Actor, float] | None = None
        for owner, indices in self.waiting.items():
            if owner is None or not indices:
                continue
            left = self.left[owner]
            if owner in self.running:
                at = self.running[owner]
                left += max(0.0, self._seconds(owner, at.shards[0]) + at.more - (now - at.since))
            if found is None or (left, -owner) > (found[1], -found[0]):
                found = owner, left
        return found

    def _latest(self) -> tuple[float, int] | None:
        """When the first of the shards that are at one actor alone is late, and which that is."""
        late, seconds, extra = [], self.scheduler.seconds, self.scheduler.extra
        for question in self.running.values():
            known = seconds.get(self.kinds[question.shards[0]])
            if known is None:
                continue
            for index in question.shards:
                if index not in self.again and index not in self.done:
                    late.append((question.since + LATE * (known + question.more + extra), index))
                    break
        return min(late, default=None)
