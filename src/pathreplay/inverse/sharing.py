"""Who computes which shard of a step: decided by measured seconds while results come in, and without effect on them.

Every actor goes on with the views that it had before, whose kernels it holds. One that has nothing left takes from
whoever has most left; so the shares of the actors become such that all end together. When nothing is left to begin,
a shard that takes much longer than expected is computed by an idle actor as well, and the first result counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from pathreplay.inverse.evaluate import Shard

Actor = int
"""The number of an actor; one that was started again keeps it."""

LATE = 2.0
"""A shard is late when it has taken so many times what it takes otherwise: noise of a shared machine is less."""

WARM = 2
"""Evaluations of a view by an actor after which its kernels are there: one is traced, the next one is recorded."""

SMOOTHING = 0.5
"""How much of what was known of a view's seconds stays when they are measured again."""

Kind = tuple[tuple[int, ...], int, int]
"""What shards that take the same time have in common: views, samples, stage."""


def kind_of(shard: Shard) -> Kind:
    return shard.views, shard.samples, shard.stage


@dataclass
class Sharing:
    """What is known of shards and actors from step to step."""

    seconds: dict[Kind, float] = field(default_factory=dict)
    """Of an evaluation by an actor that has done it before."""
    extra: float = 0.0
    """More seconds of one that has not."""
    owner: dict[Kind, Actor] = field(default_factory=dict)
    """Who did it last."""
    times: dict[tuple[Actor, Kind], int] = field(default_factory=dict)
    """How often an actor has done it."""

    def expected(self, actor: Actor, kind: Kind) -> float | None:
        """Seconds that the actor will take; None where such a shard has never been done."""
        known = self.seconds.get(kind)
        if known is None:
            return None
        return known if self.times.get((actor, kind), 0) >= WARM else known + self.extra

    def measured(self, actor: Actor, kind: Kind, seconds: float) -> None:
        """An actor has taken so many seconds."""
        times = self.times.get((actor, kind), 0)
        self.times[actor, kind], self.owner[kind] = times + 1, actor
        known = self.seconds.get(kind)
        if known is None:
            self.seconds[kind] = seconds
        elif times >= WARM:
            # What was measured before it was warm is not mixed in.
            warm = times > WARM or any(self.times.get((a, kind), 0) > WARM for a in self.actors() if a != actor)
            self.seconds[kind] = SMOOTHING * known + (1 - SMOOTHING) * seconds if warm else seconds
        elif seconds > known:
            self.extra = SMOOTHING * self.extra + (1 - SMOOTHING) * (seconds - known)

    def actors(self) -> set[Actor]:
        """Those that have done something."""
        return {actor for actor, _ in self.times}

    def forget(self, actor: Actor) -> None:
        """The actor was lost with all that it held."""
        self.times = {key: n for key, n in self.times.items() if key[0] != actor}
        self.owner = {kind: other for kind, other in self.owner.items() if other != actor}


class Step:
    """The shards of one step: which wait, who is at which, which are done."""

    def __init__(self, sharing: Sharing, shards: Sequence[Shard]) -> None:
        self.sharing = sharing
        self.kinds = [kind_of(shard) for shard in shards]
        self.waiting = set(range(len(shards)))
        self.begun: dict[int, dict[Actor, float]] = {i: {} for i in self.waiting}
        """Of each shard, who is at it since when."""
        self.done: set[int] = set()

    def next(self, actor: Actor, now: float) -> int | None:
        """The shard that an idle actor begins; None if it has nothing to do for now."""
        chosen = self._own(actor)
        if chosen is None:
            chosen = self._taken(actor, now)
        if chosen is None:
            chosen = self._late(actor, now)
        if chosen is not None:
            self.waiting.discard(chosen)
            self.begun[chosen][actor] = now
        return chosen

    def finished(self, index: int, actor: Actor, seconds: float) -> bool:
        """A result is there; whether it is the first of its shard."""
        self.begun[index].pop(actor, None)
        self.sharing.measured(actor, self.kinds[index], seconds)
        first = index not in self.done
        self.done.add(index)
        return first

    def lost(self, index: int, actor: Actor) -> None:
        """An actor has gone without a result; if no other is at the shard, it waits again."""
        self.begun[index].pop(actor, None)
        if index not in self.done and not self.begun[index]:
            self.waiting.add(index)

    def patience(self, now: float) -> float | None:
        """Seconds until the next shard is late; None if none will be."""
        if self.waiting:
            return None
        times = [late - now for late in self._lateness().values()]
        return max(0.0, min(times)) if times else None

    def _own(self, actor: Actor) -> int | None:
        """The longest of the actor's own shards, else of those that are nobody's."""
        owner = self.sharing.owner
        own = [i for i in self.waiting if owner.get(self.kinds[i]) == actor]
        return self._longest(own or [i for i in self.waiting if self.kinds[i] not in owner])

    def _taken(self, actor: Actor, now: float) -> int | None:
        """A shard of the actor that has most left to do, unless that would be ready sooner by itself."""
        left: dict[Actor, float] = {}
        theirs: dict[Actor, list[int]] = {}
        for i in self.waiting:
            other = self.sharing.owner[self.kinds[i]]
            left[other] = left.get(other, 0.0) + (self.sharing.expected(other, self.kinds[i]) or 0.0)
            theirs.setdefault(other, []).append(i)
        for i, actors in self.begun.items():
            for other, since in actors.items():
                if other in left and i not in self.done:
                    rest = (self.sharing.expected(other, self.kinds[i]) or 0.0) - (now - since)
                    left[other] += max(0.0, rest)
        if not left:
            return None
        most = max(sorted(left), key=left.__getitem__)
        busy = {other for actors in self.begun.values() for other in actors}
        fitting = [
            i
            for i in theirs[most]
            if most not in busy or (self.sharing.expected(actor, self.kinds[i]) or 0.0) < left[most]
        ]
        return self._longest(fitting)

    def _late(self, actor: Actor, now: float) -> int | None:
        """The shard that is most overdue, if it is not at this actor already."""
        late = {i: at for i, at in self._lateness().items() if at <= now and actor not in self.begun[i]}
        return min(sorted(late), key=late.__getitem__) if late else None

    def _lateness(self) -> dict[int, float]:
        """When each shard that is at one actor alone is late."""
        found = {}
        for i, actors in self.begun.items():
            if i in self.done or len(actors) != 1:
                continue
            ((actor, since),) = actors.items()
            expected = self.sharing.expected(actor, self.kinds[i])
            if expected is not None:
                found[i] = since + LATE * expected
        return found

    def _longest(self, indices: Sequence[int]) -> int | None:
        seconds = self.sharing.seconds
        return max(sorted(indices, reverse=True), key=lambda i: seconds.get(self.kinds[i], 0.0), default=None)
