"""Who computes which shard: actors keep their views, take from each other, and do again what is late or lost."""

from __future__ import annotations

import heapq

import numpy as np
import pytest

from pathreplay.distributed.scheduler import LATE, TOGETHER, Scheduler, Step, kind_of
from pathreplay.inverse.objective.evaluate import Shard

BOTH = (0, 1)


def shards_of(count: int) -> list[Shard]:
    return [Shard((view,), 4, (view,)) for view in range(count)]


def played(
    scheduler: Scheduler, shards: list[Shard], speeds: dict[int, float], costs: list[float]
) -> tuple[float, dict]:
    """A step in which actors take cost/speed seconds: when it ended, and who began what."""
    step, begun = Step(scheduler, shards), {actor: [] for actor in speeds}
    events: list[tuple[float, int, list[int]]] = []
    idle, now = sorted(speeds), 0.0
    while len(step.done) < len(shards):
        waiting = []
        for actor in step.in_turn(idle):
            index = step.next(actor, now, idle)
            if index is None:
                waiting.append(actor)
            else:
                indices = [index, *step.along(actor, 4, len(speeds))]
                begun[actor] += indices
                heapq.heappush(events, (now + sum(costs[i] for i in indices) / speeds[actor], actor, indices))
        late = step.patience()
        if waiting and late is not None and (not events or late < events[0][0]):
            now, idle = max(now, late), waiting
            continue
        now, actor, indices = heapq.heappop(events)
        for index in indices:
            step.finished(index, actor, costs[index] / speeds[actor])
        idle = [*waiting, actor]
    return now, begun


def test_every_shard_is_done_once_by_actors_that_are_alike() -> None:
    scheduler, shards = Scheduler(), shards_of(10)
    for _ in range(6):
        _, begun = played(scheduler, shards, {0: 1, 1: 1}, [1.0] * 10)
        assert sorted(begun[0] + begun[1]) == list(range(10))
        assert len(begun[0]) == 5


def test_actors_keep_their_views() -> None:
    """From the second step on, whoever had a view has it again: its kernels are there."""
    scheduler, shards = Scheduler(), shards_of(8)
    costs = [1.0, 1.1, 0.9, 1.0, 1.2, 0.8, 1.0, 1.0]
    first, *later = (played(scheduler, shards, {0: 1, 1: 1}, costs)[1] for _ in range(4))
    for begun in later:
        assert {actor: sorted(indices) for actor, indices in begun.items()} == {
            actor: sorted(indices) for actor, indices in first.items()
        }


@pytest.mark.parametrize("seconds", [1.0, 0.02])
@pytest.mark.parametrize("speeds", [{0: 1.0, 1: 1.0}, {0: 1.0, 1: 3.0}, {0: 1.0, 1: 1.0, 2: 0.5, 3: 2.0}])
def test_all_end_together(speeds: dict[int, float], seconds: float) -> None:
    """Views of unequal costs, actors of unequal speeds: within the longest shard of the best that can be."""
    costs = list(seconds * np.random.default_rng(3).uniform(0.5, 2.0, 40))
    scheduler = Scheduler()
    for _ in range(8):
        end, _ = played(scheduler, shards_of(40), speeds, costs)
    best = sum(costs) / sum(speeds.values())
    print(f"{end:.2f} s, at best {best:.2f} s")
    assert best <= end <= best + max(costs) / min(speeds.values())


def test_what_is_late_is_given_to_an_idle_actor_as_well() -> None:
    scheduler, shards = Scheduler(), shards_of(2)
    for _ in range(4):
        played(scheduler, shards, {0: 1, 1: 1}, [1.0, 1.0])
    step = Step(scheduler, shards)
    first, second = step.next(0, 0.0, BOTH), step.next(1, 0.0, BOTH)
    assert {first, second} == {0, 1}
    assert step.finished(first, 0, 1.0)
    assert step.next(0, 1.0, BOTH) is None
    assert step.patience() == pytest.approx(LATE)
    assert step.next(0, LATE, BOTH) == second
    assert step.patience() is None and step.next(2, 10 * LATE, BOTH) is None, "a third one is not asked"
    assert step.finished(second, 0, 1.0) and not step.finished(second, 1, 3.0), "the first result counts"


def test_what_was_never_done_is_not_late() -> None:
    step = Step(Scheduler(), shards_of(1))
    assert step.next(0, 0.0, BOTH) == 0
    assert step.patience() is None and step.next(1, 100.0, BOTH) is None


def test_what_is_lost_waits_again() -> None:
    scheduler, shards = Scheduler(), shards_of(3)
    step = Step(scheduler, shards)
    index = step.next(0, 0.0, BOTH)
    assert index is not None
    scheduler.forget(0)
    step.lost(index, 0)
    assert index in step.waiting[None]
    assert sorted(step.next(1, now, BOTH) for now in (1.0, 2.0, 3.0)) == [0, 1, 2]  # type: ignore[type-var]


def test_a_loss_after_another_has_taken_over_is_none() -> None:
    scheduler, shards = Scheduler(), shards_of(1)
    played(scheduler, shards, {0: 1}, [1.0])
    step = Step(scheduler, shards)
    assert step.next(0, 0.0, BOTH) == 0 and step.next(1, 10.0, BOTH) == 0
    step.lost(0, 0)
    assert not any(step.waiting.values())
    step.finished(0, 1, 1.0)
    step.lost(0, 0)
    assert not any(step.waiting.values())


def test_the_views_of_a_lost_actor_are_nobodys() -> None:
    scheduler, shards = Scheduler(), shards_of(4)
    for _ in range(3):
        played(scheduler, shards, {0: 1, 1: 1}, [1.0] * 4)
    scheduler.forget(0)
    assert set(scheduler.owner.values()) == {1}
    kind = kind_of(shards[0])
    assert scheduler.expected(0, kind) == scheduler.seconds[kind] + scheduler.extra


def known(views: int, seconds: float = 1.0) -> Scheduler:
    """Actor 0 has done all views, a second each; one that has not would take ten more."""
    kinds = [kind_of(shard) for shard in shards_of(views)]
    times = {(0, kind): 3 for kind in kinds}
    return Scheduler(dict.fromkeys(kinds, seconds), set(kinds), 10 * seconds, dict.fromkeys(kinds, 0), times)


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
    scheduler, taken = known(8), []
    for _ in range(3):
        step = Step(scheduler, shards_of(8))
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
    scheduler, (shard,) = Scheduler(), shards_of(1)
    kind = kind_of(shard)
    for seconds in (3.0, 5.0):
        scheduler.measured(0, kind, seconds)
    assert scheduler.extra == 0.0
    scheduler.measured(0, kind, 1.0)
    assert scheduler.seconds[kind] == 1.0 and scheduler.extra == pytest.approx(1.0)
    scheduler.measured(1, kind, 4.0)
    assert scheduler.extra == pytest.approx(2.0) and scheduler.expected(1, kind) == pytest.approx(3.0)


def test_an_actor_that_was_asked_again_is_at_its_next_shard() -> None:
    """It is asked before its answer is heard, so that it need not wait: it can be late there, too."""
    step = Step(known(2), shards_of(2))
    first, second = step.next(0, 0.0, BOTH), step.next(0, 1.0, BOTH)
    assert first is not None and second is not None and step.finished(first, 0, 1.0)
    late = 1.0 + LATE * (1.0 + 10.0)
    assert step.patience() == late and step.next(1, late, BOTH) == second


def asked(step: Step, actor: int, size: int = 4, actors: int = 1) -> list[int]:
    """The shards of the actor's next question."""
    first = step.next(actor, 0.0, BOTH)
    return [] if first is None else [first, *step.along(actor, size, actors)]


def questions(views: int, seconds: float, size: int = 4) -> list[list[int]]:
    """What actor 0 is asked one after the other, if nobody takes anything from it."""
    step, found = Step(known(views, seconds), shards_of(views)), []
    while indices := asked(step, 0, size):
        found.append(indices)
        for index in indices:
            assert step.finished(index, 0, seconds)
    return found


def test_short_shards_go_with_one_question() -> None:
    """Seven tenths of what is left, or a tenth of a second, or a hundredth: each shard once, in their order."""
    assert [len(indices) for indices in questions(16, 0.005)] == [11, 3, 2]
    assert [len(indices) for indices in questions(16, 0.02)] == [5, 5, 4, 1, 1]
    assert [len(indices) for indices in questions(4, 1.0)] == [1, 1, 1, 1]
    assert [index for indices in questions(16, 0.005) for index in indices] == list(range(16))


def test_large_gradients_come_by_themselves() -> None:
    assert [len(indices) for indices in questions(16, 0.005, TOGETHER // 4)] == [4, 4, 4, 2, 2]
    assert [len(indices) for indices in questions(3, 0.005, 2 * TOGETHER)] == [1, 1, 1]


def test_shards_without_kernels_come_by_themselves() -> None:
    """Actor 1 takes from 0, and does first and second evaluations, which may take long."""
    scheduler = known(40, 0.02)
    step = Step(scheduler, shards_of(40))
    assert len(asked(step, 0)) == 5 and len(asked(step, 1)) == 1
    scheduler.owner.clear()
    assert len(asked(Step(scheduler, shards_of(40)), 0)) == 1, "nobody's"


def test_a_question_that_is_lost_waits_again_but_for_what_another_has_done() -> None:
    scheduler = known(16, 0.005)
    step = Step(scheduler, shards_of(16))
    indices = asked(step, 0)
    late = step.patience()
    assert late is not None and step.next(1, late, []) == 0 and step.finished(0, 1, 0.05)
    scheduler.forget(0)
    for index in indices:
        step.lost(index, 0)
    assert sorted(step.waiting[None]) == list(range(1, 16))


def test_a_question_is_late_when_all_of_it_might_be_done() -> None:
    """Its shards are answered together. Then others do them one after the other, until that answer comes."""
    step = Step(known(2, 0.005), shards_of(2))
    assert asked(step, 0) == [0, 1]
    late = step.patience()
    assert late == pytest.approx(LATE * (0.01 + 0.05)) and step.next(1, late - 0.001, [1]) is None
    assert step.next(1, late, [1]) == 0 and step.finished(0, 1, 0.055)
    assert step.patience() == late and step.next(1, late + 0.055, [1]) == 1
    assert step.finished(1, 1, 0.055) and not step.finished(0, 0, 1.0)


def test_a_question_has_no_more_than_an_even_share() -> None:
    """Parts of a view are of one kind, and wait for whoever had one of them last: the others are idle."""
    scheduler, shards = known(1, 0.005), [Shard((0,), 4, (part,)) for part in range(16)]
    step = Step(scheduler, shards)
    assert len(asked(step, 0, actors=16)) == 1 and len(asked(Step(scheduler, shards), 0, actors=8)) == 2
    for actor in range(8):
        scheduler.times[actor, kind_of(shards[0])] = 3
    for _ in range(3):
        end, begun = played(scheduler, shards, dict.fromkeys(range(8), 1.0), [0.005] * 16)
        assert end == pytest.approx(0.01) and all(len(indices) == 2 for indices in begun.values())


@pytest.mark.parametrize("lost", [0, 1])
def test_what_one_of_two_has_lost_can_be_late_again(lost: int) -> None:
    """The other one may be stuck."""
    step = Step(known(1), shards_of(1))
    late = LATE * (1.0 + 10.0)
    assert step.next(0, 0.0, BOTH) == 0 and step.next(1, late, [1]) == 0 and step.patience() is None
    step.lost(0, lost)
    again = step.patience()
    assert again == (late + late if lost == 0 else late)
    assert step.next(2, again, [2]) == 0 and step.patience() is None
