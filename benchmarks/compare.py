"""The regression check: finds what became slower, noisier, larger or wrong between two records of a task.

Absolute times differ between days and machines. The check therefore compares ratios to Mitsuba's method in the same job
of the same run, if both records contain this method. A change counts if its 95 % bootstrap interval lies outside a
margin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from .measures.estimates import Estimate, interval, unpaired_ratio
from .measures.job import Machine, Point, Record
from .measures.methods import STOCK, parts
from .tables import markdown, pooled

# Two runs of the same code differ by more than their intervals: memory layouts and machine loads differ. Ratios to an
# interleaved baseline vary by a few per cent; absolute seconds also drift with the machine's clock frequency.
MARGIN = 0.05
ALONE_MARGIN = 0.15

Outcome = Literal["worse", "better", "same", "missing", "new", "not comparable"]
Key = tuple[object, ...]


@dataclass(frozen=True)
class Row:
    """Comparison of one quantity of one method in one job."""

    scene: str
    method: str
    depth: int
    quantity: str
    outcome: Outcome
    told: str  # new / old with its interval, or the reason for the outcome


@dataclass(frozen=True)
class Comparison:
    """All rows of two records of a task."""

    rows: tuple[Row, ...]

    @property
    def worse(self) -> tuple[Row, ...]:
        """Rows that became slower, noisier, larger or wrong."""
        return tuple(row for row in self.rows if row.outcome == "worse")

    def table(self) -> str:
        """Changes as a Markdown table, the worst outcomes first, followed by a summary."""
        order: tuple[Outcome, ...] = ("worse", "missing", "not comparable", "new", "better")
        told = [row for outcome in order for row in self.rows if row.outcome == outcome]
        same = len(self.rows) - len(told)
        summary = f"{same} of {len(self.rows)} quantities are the same within their spread, {len(self.worse)} worse."
        if not told:
            return summary
        cells = [[r.scene, r.method, str(r.depth), r.quantity, r.outcome, r.told] for r in told]
        return markdown(["scene", "method", "depth", "quantity", "is", "new / old"], cells) + "\n\n" + summary


def compare(old: Record, new: Record) -> Comparison:
    """Compare two records of a task. Mitsuba's own methods serve as the reference and are not judged."""
    before, now = ({_key(point): point for point in pooled(record.points)} for record in (old, new))
    same_machine = _place(old.machines) == _place(new.machines)
    rows: list[Row] = []
    for key in dict.fromkeys([*before, *now]):
        a, b = before.get(key), now.get(key)
        if a is None or b is None:
            point = a or b
            assert point is not None
            outcome: Outcome = "missing" if b is None else "new"
            rows.append(_row(point, "all", outcome, f"not in the {'new' if b is None else 'old'} record"))
        elif not _is_stock(a.method):
            rows += _rows(a, b, _yardstick(key, before, now), same_machine)
    return Comparison(tuple(rows))


def _key(point: Point) -> Key:
    return point.scene, point.parameters, point.max_depth, point.paths, point.measure, point.method


def _row(point: Point, quantity: str, outcome: Outcome, told: str) -> Row:
    return Row(point.scene, point.method, point.max_depth, quantity, outcome, told)


def _is_stock(method: str) -> bool:
    return parts(method)[0] in STOCK


def _place(machines: Sequence[Machine]) -> set[tuple[str, int, int]]:
    return {(machine.processor, machine.processors, machine.threads) for machine in machines}


def _yardstick(key: Key, before: dict[Key, Point], now: dict[Key, Point]) -> tuple[Point, Point] | None:
    """Return the points of Mitsuba's method for the same job and stage (as in 'prb, import') in both records."""
    baselines = [
        other
        for other in before
        if other[:-1] == key[:-1] and _is_stock(str(other[-1])) and _timed(before[other]) and _timed(now.get(other))
    ]
    stage = parts(str(key[-1]))[1]
    baselines.sort(key=lambda other: parts(str(other[-1]))[1] != stage)
    return (before[baselines[0]], now[baselines[0]]) if baselines else None


def _timed(point: Point | None) -> bool:
    return point is not None and point.error is None and len(point.seconds) > 1


def _rows(a: Point, b: Point, baselines: tuple[Point, Point] | None, same_machine: bool) -> list[Row]:
    if a.error or b.error:
        if a.error and b.error:
            return [_row(b, "all", "same", b.error)]
        return [_row(b, "all", "worse" if b.error else "better", b.error or f"was: {a.error}")]
    rows: list[Row] = []
    if a.verdict is not None and b.verdict is not None:
        good = [verdict in ("pass", "zero") for verdict in (a.verdict, b.verdict)]
        outcome: Outcome = "same" if good[0] == good[1] else "better" if good[1] else "worse"
        return [_row(b, "truth", outcome, f"{b.verdict}, was {a.verdict}")]
    lost = len(b.not_finite) > len(a.not_finite)
    if lost:
        rows.append(_row(b, "finite", "worse", f"{len(b.not_finite)} gradients are not, were {len(a.not_finite)}"))
    rows.append(_time(a, b, baselines, same_machine))
    if len(a.squared_errors) > 1 and len(b.squared_errors) > 1:
        noise = unpaired_ratio(b.squared_errors, a.squared_errors, np.mean)
        rows.append(_judged(b, "variance", noise, MARGIN))
    if len(a.values) > 1 and len(b.values) > 1:
        rows.append(_judged(b, "error", unpaired_ratio(b.values, a.values, np.mean), MARGIN))
    if same_machine and a.peak_mib and b.peak_mib:
        ratio = b.peak_mib / a.peak_mib
        rows.append(_judged(b, "memory", Estimate(ratio, ratio, ratio), MARGIN))
    return rows


def _time(a: Point, b: Point, baselines: tuple[Point, Point] | None, same_machine: bool) -> Row:
    if baselines is not None and _timed(a) and _timed(b):
        return _judged(b, f"time / {baselines[0].method}", _relative_time(a, b, *baselines), MARGIN)
    if not (same_machine and _timed(a) and _timed(b)):
        return _row(b, "time", "not comparable", "another machine and no baseline in both, or a single round")
    return _judged(b, "time", unpaired_ratio(b.seconds, a.seconds, np.median), ALONE_MARGIN)


def _judged(point: Point, quantity: str, change: Estimate, margin: float) -> Row:
    if change.low > 1 + margin:
        return _row(point, quantity, "worse", str(change))
    return _row(point, quantity, "better" if change.high < 1 - margin else "same", str(change))


def _relative_time(a: Point, b: Point, baseline_of_a: Point, baseline_of_b: Point) -> Estimate:
    """Change of the time relative to a baseline, round by round if both have the same number of rounds."""
    pairs = (b, baseline_of_b), (a, baseline_of_a)
    if all(len(ours.seconds) == len(theirs.seconds) for ours, theirs in pairs):
        return unpaired_ratio(*(np.divide(ours.seconds, theirs.seconds) for ours, theirs in pairs), np.median)

    def change(*seconds: np.ndarray, axis: int) -> np.ndarray:
        ours, theirs, our_old, their_old = (np.median(times, axis) for times in seconds)
        return ours / theirs / (our_old / their_old)

    return interval(change, *(point.seconds for pair in pairs for point in pair), paired=False)
