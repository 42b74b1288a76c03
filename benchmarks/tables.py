"""Markdown tables from the points of a record."""

from __future__ import annotations

import statistics as st
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

from .measures.estimates import Versus
from .measures.job import Point, Record


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Format a Markdown table whose first column is left-aligned, and the others right-aligned."""
    lines = [header, ["---", *["---:"] * (len(header) - 1)], *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def median_seconds(point: Point) -> str:
    return f"{st.median(point.seconds):.3f}"


def method_cell(point: Point) -> str:
    """Name of the method, and its number of non-finite gradients."""
    broken = len(point.not_finite)
    return point.method + (f" ({broken} of {len(point.seeds)} not finite)" if broken else "")


class Turns(NamedTuple):
    """Key of points that were measured alternately."""

    scene: str
    parameters: tuple[str, ...]
    max_depth: int
    paths: int


def groups(points: Iterable[Point]) -> dict[Turns, dict[str, Point]]:
    """Group points that were measured alternately, by method."""
    by_turns: dict[Turns, dict[str, Point]] = {}
    for point in points:
        by_turns.setdefault(Turns(point.scene, point.parameters, point.max_depth, point.paths), {})[point.method] = (
            point
        )
    return by_turns


def pooled(points: Iterable[Point]) -> list[Point]:
    """Merge the points of repeated jobs by joining their seconds. Gradient errors are equal, as the seeds are."""
    merged: dict[tuple[object, ...], Point] = {}
    for point in points:
        key = (point.scene, point.parameters, point.method, point.max_depth, point.paths, point.measure)
        before = merged.get(key)
        if before is not None:
            error = before.error or point.error
            point = replace(before, seconds=before.seconds + point.seconds, error=error)
        merged[key] = point
    return list(merged.values())


def time_cells(point: Point, baseline: Point | None) -> list[str]:
    """Cells: median seconds, then time relative to a baseline."""
    if point.error:
        return [point.error, ""]
    if baseline is None or baseline.error or baseline is point:
        return [median_seconds(point), "1" if baseline is point else ""]
    return [median_seconds(point), str(Versus(point, baseline).time())]


def comparison(point: Point, baseline: Point | None) -> list[str]:
    """Cells: the cells of `time_cells`, then variance and time x variance relative to a baseline."""
    times = time_cells(point, baseline)
    # Either both have squared errors, or, after a single round, neither.
    if point.error or baseline is None or baseline is point or not (point.squared_errors and baseline.squared_errors):
        return [*times, *["1" if baseline is point and not point.error else ""] * 2]
    versus = Versus(point, baseline)
    return [*times, str(versus.variance()), str(versus.cost())]


def brief_footnote(record: Record) -> str:
    """Command and date of the measurement, for summaries. Pages with full tables use `footnote`."""
    return f"`{record.command}`, {record.date[:10]}."


def footnote(record: Record) -> str:
    """Circumstances of the measurement: command, date, commit, machine, versions and load."""
    machine = record.machines[0]
    counts = sorted({len(point.seconds) for point in record.points if not point.error}) or [0]
    rounds = str(counts[0]) if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    threads = " and ".join(str(m.threads) for m in record.machines)
    sittings = f"; in {record.sittings} sittings" if record.sittings > 1 else ""
    return (
        f"`{record.command}`, {record.date[:10]}, commit {record.commit}: {machine.processor}, "
        f"{machine.processors} processors, {threads} threads, {machine.variant}, Mitsuba {machine.mitsuba}, "
        f"Dr.Jit {machine.drjit}, libLLVM {machine.libllvm}, Python {machine.python}; {rounds} rounds; "
        f"load average {record.load[0]:.1f} before, {record.load[1]:.1f} after{sittings}."
    )
