"""The search for a learning rate and a number of samples, the same for every loop: the error is followed in time."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import product

from ..measures.job import Curve
from .loops import Loop
from .problem import Values

MARKS = (1 / 3, 1 / 10, 1 / 30)
"""Fractions of the initial held-out error."""
MIDDLE = MARKS[1]
GROWTH = 2**0.5
"""Ratio of the iterations after which the error is measured by default."""
LOST = 1e30
"""Error of values that are not finite; records hold finite numbers only."""


Clock = Callable[[], float]


def followed(
    loop: Loop,
    error: Callable[[Values], float],
    goal: float,
    budget: float,
    clock: Clock = time.process_time,
    growth: float = GROWTH,
) -> Curve:
    """Run a loop until its error is ``goal`` times the initial one or its iterations have taken ``budget`` seconds.

    Seconds are processor time, so that other processes disturb less. The clock stands while the error is measured. A
    value that is not finite ends the run. ``growth`` is the ratio of the iterations after which the error is measured.
    """
    errors, steps, seconds = [error(loop.values())], [0], [0.0]
    while seconds[-1] < budget and errors[-1] > goal * errors[0]:
        target = max(steps[-1] + 1, round(steps[-1] * growth))
        done, start = steps[-1], clock()
        while done < target and seconds[-1] + clock() - start < budget:
            loop.step()
            done += 1
        values = loop.values()
        seconds.append(seconds[-1] + clock() - start)
        steps.append(done)
        errors.append(error(values))
        if not math.isfinite(errors[-1]):
            errors[-1] = LOST
            break
    return Curve(0.0, 0, 0, tuple(steps), tuple(seconds), tuple(errors))


def warmed(loop: Loop, iterations: int, clock: Clock = time.process_time) -> float:
    """Take iterations and return to the initial values; returns the seconds that this took."""
    start = clock()
    for _ in range(iterations):
        loop.step()
    loop.values()
    loop.reset()
    return clock() - start


Try = Callable[[float, int, float], Curve]
"""Learning rate, samples per pixel and seconds -> a run."""


def searched(rates: Sequence[float], samples: Sequence[int], run: Try, budget: float) -> Iterator[Curve]:
    """Run every point of the grid; one that can no longer reach the middle mark first is stopped."""
    for spp, rate in product(samples, rates):
        curve = run(rate, spp, budget)
        budget = min(budget, reached(curve, MIDDLE)[0])
        yield replace(curve, rate=rate, spp=spp, searched=True)


def best(curves: Sequence[Curve], mark: float) -> Curve:
    """The curve of the search that reaches a mark first; if none does, the one with the smallest final error.

    The search ends at the middle mark, so the choice for a smaller mark is that for the middle mark.
    """
    goal, found = max(mark, MIDDLE), [curve for curve in curves if curve.searched]
    return min(found, key=lambda curve: (reached(curve, goal)[0], curve.errors[-1] / curve.errors[0]))


def reached(curve: Curve, mark: float) -> tuple[float, float]:
    """Seconds and iterations until the error is ``mark`` times the initial one; infinite if it never is.

    Between two measurements the logarithm of the error is interpolated linearly.
    """
    goal = mark * curve.errors[0]
    for k in range(1, len(curve.errors)):
        if curve.errors[k] <= goal:
            before, after = (math.log(max(error, 1e-30)) for error in curve.errors[k - 1 : k + 1])
            t = (before - math.log(goal)) / (before - after)
            return tuple(a[k - 1] + t * (a[k] - a[k - 1]) for a in (curve.seconds, curve.steps))
    return math.inf, math.inf
