"""Who computes which shard: actors keep their views, take from each other, and do again what is late or lost."""

from __future__ import annotations

import heapq

import numpy as np
import pytest

from pathreplay.inverse.evaluate import Shard
from pathreplay.inverse.sharing import LATE, Sharing, Step, kind_of

BOTH = (0, 1)


def shards_of(count: int) -> list[Shard]:
    return [Shard((view,), 4, (view,)) for view in range(count)]


def played(sharing: Sharing, shards: list[Shard], speeds: dict[int, float], costs: list[float]) -> tuple[float, dict]:
    """A step in which actors take cost/speed seconds: when it ended, and who began what."""
    step, begun = Step(sharing, shards), {actor: [] for actor in speeds}
    events: list[tuple[float, int, int, float]] = []
    idle, now = sorted(speeds), 0.0
    while len(step.done) < len(shards):
        waiting = []
        for actor in step.in_turn(idle):
            index = step.next(actor, now, idle)
            if index is None:
                waiting.append(actor)
            else:
                begun[actor].append(index)
                seconds = costs[index] / speeds[actor]
                heapq.heappush(events, (now + seconds, actor, index, seconds))
        late = step.patience()
        if waiting and late is not None and (not events or late < events[0][0]):
            now, idle = max(now, late), waiting
            continue
        now, actor, index, seconds = heapq.heappop(events)
        step.finished(index, actor, seconds)
        idle = [*waiting, actor]
    return now, begun


def test_every_shard_is_done_once_by_actors_that_are_alike() -> None:
    sharing, shards = Sharing(), shards_of(10)
    for _ in range(6):
        _, begun = played(sharing, shards, {0: 1, 1: 1}, [1.0] * 10)
        assert sorted(begun[0] + begun[1]) == list(range(10))
        assert len(begun[0]) == 5


def test_actors_keep_their_views() -> None:
    """From the second step on, whoever had a view has it again: its kernels are there."""
    sharing, shards = Sharing(), shards_of(8)
    costs = [1.0, 1.1, 0.9, 1.0, 1.2, 0.8, 1.0, 1.0]
    first, *later = (played(sharing, shards, {0: 1, 1: 1}, costs)[1] for _ in range(4))
    for begun in later:
        assert {actor: sorted(indices) for actor, indices in begun.items()} == {
            actor: sorted(indices) for actor, indices in first.items()
        }


@pytest.mark.parametrize("speeds", [{0: 1.0, 1: 1.0}, {0: 1.0, 1: 3.0}, {0: 1.0, 1: 1.0, 2: 0.5, 3: 2.0}])
def test_all_end_together(speeds: dict[int, float]) -> None:
    """Views of unequal costs, actors of unequal speeds: within the longest shard of the best that can be."""
    costs = list(np.random.default_rng(3).uniform(0.5, 2.0, 40))
    sharing = Sharing()
    for _ in range(8):
        end, _ = played(sharing, shards_of(40), speeds, costs)
    best = sum(costs) / sum(speeds.values())
    print(f"{end:.2f} s, at best {best:.2f} s")
    assert best <= end <= best + max(costs) / min(speeds.values())


def test_what_is_late_is_given_to_an_idle_actor_as_well() -> None:
    sharing, shards = Sharing(), shards_of(2)
    for _ in range(4):
        played(sharing, shards, {0: 1, 1: 1}, [1.0, 1.0])
    step = Step(sharing, shards)
    first, second = step.next(0, 0.0, BOTH), step.next(1, 0.0, BOTH)
    assert {first, second} == {0, 1}
    assert step.finished(first, 0, 1.0)
    assert step.next(0, 1.0, BOTH) is None
    assert step.patience() == pytest.approx(LATE)
    assert step.next(0, LATE, BOTH) == second
    assert step.patience() is None and step.next(2, 10 * LATE, BOTH) is None, "a third one is not asked"
    assert step.finished(second, 0, 1.0) and not step.finished(second, 1, 3.0), "the first result counts"


def test_what_was_never_done_is_not_late() -> None:
    step = Step(Sharing(), shards_of(1))
    assert step.next(0, 0.0, BOTH) == 0
    assert step.patience() is None and step.next(1, 100.0, BOTH) is None


def test_what_is_lost_waits_again() -> None:
    sharing, shards = Sharing(), shards_of(3)
    step = Step(sharing, shards)
    index = step.next(0, 0.0, BOTH)
    assert index is not None
    sharing.forget(0)
    step.lost(index, 0)
    assert index in step.waiting[None]
    assert sorted(step.next(1, now, BOTH) for now in (1.0, 2.0, 3.0)) == [0, 1, 2]  # type: ignore[type-var]


def test_a_loss_after_another_has_taken_over_is_none() -> None:
    sharing, shards = Sharing(), shards_of(1)
    played(sharing, shards, {0: 1}, [1.0])
    step = Step(sharing, shards)
    assert step.next(0, 0.0, BOTH) == 0 and step.next(1, 10.0, BOTH) == 0
    step.lost(0, 0)
    assert not any(step.waiting.values())
    step.finished(0, 1, 1.0)
    step.lost(0, 0)
    assert not any(step.waiting.values())


def test_the_views_of_a_lost_actor_are_nobodys() -> None:
    sharing, shards = Sharing(), shards_of(4)
    for _ in range(3):
        played(sharing, shards, {0: 1, 1: 1}, [1.0] * 4)
    sharing.forget(0)
    assert set(sharing.owner.values()) == {1}
    kind = kind_of(shards[0])
    assert sharing.expected(0, kind) == sharing.seconds[kind] + sharing.extra


def known(views: int) -> Sharing:
    """Actor 0 has done all views, a second each; one that has not would take ten more."""
    kinds = [kind_of(shard) for shard in shards_of(views)]
    times = {(0, kind): 3 for kind in kinds}
    return Sharing(dict.fromkeys(kinds, 1.0), set(kinds), 10.0, dict.fromkeys(kinds, 0), times)


def test_what_would_take_longer_is_not_taken_from_one_that_is_about_to_go_on() -> None:
    """Both are idle: actor 0 is asked first, and actor 1 has nothing to do for six seconds that takes it eleven."""
    step = Step(known(6), shards_of(6))
    assert step.in_turn([1, 0]) == [0, 1]
    assert step.next(1, 0.0, BOTH) is None
    assert step.next(0, 0.0, BOTH) == 0 and step.next(1, 0.0, [1]) is None


def test_what_takes_less_than_waiting_is_taken() -> None:
    step = Step(known(20), shards_of(20))
    assert step.next(0, 0.0, BOTH) == 0 and step.next(1, 0.0, BOTH) is not None


def test_the_shards_of_one_that_is_gone_are_taken_at_any_price() -> None:
    """It is lost, or still at a shard of the step before."""
    step = Step(known(2), shards_of(2))
    assert step.next(1, 0.0, [1]) == 0


def test_the_shards_of_one_that_is_stuck_are_taken_at_any_price() -> None:
    step = Step(known(3), shards_of(3))
    late = LATE * (1.0 + 10.0)
    assert step.next(0, 0.0, BOTH) == 0 and step.next(1, 1.0, [1]) is None
    assert step.patience() == late and step.next(1, late, [1]) == 0
    assert step.finished(0, 1, 11.0)
    assert step.next(1, 2 * late, [1]) == 1, "who is at the first one may never go on"


def test_an_actor_that_comes_late_has_its_share_after_a_while() -> None:
    """Each step is shorter than it takes to make kernels, a run of them is not."""
    sharing, taken = known(8), []
    for _ in range(3):
        step = Step(sharing, shards_of(8))
        assert step.next(0, 0.0, BOTH) == 0
        taken.append(step.next(1, 0.0, [1]))
    assert taken[0] is None and taken[1] is not None
    assert taken[2] is None, "it has had its turn"


def test_a_shard_that_was_answered_late_is_not_done_again() -> None:
    step = Step(known(1), shards_of(1))
    assert step.next(0, 0.0, BOTH) == 0
    step.heard(0, 0)
    assert step.next(0, 100.0, BOTH) is None and step.patience() is None
    assert step.finished(0, 0, 100.0)


def test_kernels_cost_what_warm_evaluations_do_not() -> None:
    """A first evaluation, and one that records, are both slow: their difference is no price."""
    sharing, (shard,) = Sharing(), shards_of(1)
    kind = kind_of(shard)
    for seconds in (3.0, 5.0):
        sharing.measured(0, kind, seconds)
    assert sharing.extra == 0.0
    sharing.measured(0, kind, 1.0)
    assert sharing.seconds[kind] == 1.0 and sharing.extra == pytest.approx(1.0)
    sharing.measured(1, kind, 4.0)
    assert sharing.extra == pytest.approx(2.0) and sharing.expected(1, kind) == pytest.approx(3.0)


def test_an_actor_that_was_asked_again_is_at_its_next_shard() -> None:
    """It is asked before its answer is heard, so that it need not wait: it can be late there, too."""
    step = Step(known(2), shards_of(2))
    first, second = step.next(0, 0.0, BOTH), step.next(0, 1.0, BOTH)
    assert first is not None and second is not None and step.finished(first, 0, 1.0)
    late = 1.0 + LATE * (1.0 + 10.0)
    assert step.patience() == late and step.next(1, late, BOTH) == second
