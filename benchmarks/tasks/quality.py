"""Task `quality`: processor seconds and iterations until the held-out error of inverse problems falls below marks."""

from __future__ import annotations

import math
import statistics as st
from collections.abc import Mapping

from ..inverse.loops import entries_of
from ..inverse.problems import PROBLEMS
from ..inverse.search import MARKS, MIDDLE, best, reached
from ..measures.job import Curve, Job, Point, Record
from ..measures.methods import STOCK, parts
from ..tables import groups, markdown

TITLE = "quality"
TAKES = (90, 5000)
QUICK = "texture under a sky", "room: two lamps, four materials", "cloud"
RATES, SAMPLES = (0.001, 0.003, 0.01, 0.03), (4, 32)
QUICK_RATES, QUICK_SAMPLES = (0.01, 0.03), (8,)
SECONDS, QUICK_SECONDS = 8.0, 1.0
LONG = {"camera: pose and focal length": 24.0, "object: albedo and roughness, unknown sky": 24.0}
"""Seconds for problems in which a plain loop needs longer to reach the middle mark."""


def jobs(quick: bool) -> list[Job]:
    """One job for each problem, whose loops take turns, with one thread."""
    return [
        Job(
            scene=name,
            parameters=(),
            methods=entries_of(name),
            max_depth=0,  # see the problem
            rr_depth=0,
            resolution=18 if quick else PROBLEMS[name].pixels,
            spp=1,
            rounds=1 if quick else 3,
            warmup=1,
            threads=1,
            measure="quality",
            budget=QUICK_SECONDS if quick else LONG.get(name, SECONDS),
            rates=QUICK_RATES if quick else RATES,
            samples=QUICK_SAMPLES if quick else SAMPLES,
        )
        for name in (QUICK if quick else PROBLEMS)
    ]


def is_stock(point: Point) -> bool:
    """Whether it is a loop with one of Mitsuba's integrators."""
    return parts(point.method)[0] in STOCK


def choice(point: Point, mark: float = MIDDLE) -> Curve:
    """The point of the grid that the search has chosen for a mark."""
    return best(point.curves, mark)


def runs(point: Point, mark: float = MIDDLE) -> list[Curve]:
    """The optimisations with the rate and the samples that were chosen for a mark, one for each seed."""
    if not point.curves:  # the loop has raised an error
        return []
    chosen = choice(point, mark)
    return [
        curve for curve in point.curves if not curve.searched and (curve.rate, curve.spp) == (chosen.rate, chosen.spp)
    ]


def table(record: Record) -> str:
    """A row for each loop: chosen rates and samples, medians over seeds, and the ratio to the best plain loop."""
    header = ["problem", "loop", *(cell for mark in MARKS for cell in _headings(mark)), "1/10, iterations"]
    header += ["time / best plain loop", "last error / first", "first iterations, s"]
    return markdown(header, [row for points in groups(record.points).values() for row in _rows(points)])


def _headings(mark: float) -> list[str]:
    """Column headings of a mark. Marks below the middle one have no choice of their own."""
    name = f"1/{1 / mark:.0f}"
    return [f"{name}: rate, spp", f"{name}, s"] if mark >= MIDDLE else [f"{name}, s"]


def _cells(point: Point, mark: float) -> list[str]:
    chosen, seconds = choice(point, mark), _cell(_median(point, mark)[0], ".2f")
    return [f"{chosen.rate:g}, {chosen.spp}", seconds] if mark >= MIDDLE else [seconds]


def _rows(points: Mapping[str, Point]) -> list[list[str]]:
    rows = []
    for point in points.values():
        if point.error or not point.curves:
            rows.append([point.scene, point.method, f"raises: {_short(point.error or '')}", *[""] * 8])
            continue
        errors = st.median(curve.errors[-1] / curve.errors[0] for curve in runs(point))
        rows.append(
            [
                point.scene,
                point.method,
                *(cell for mark in MARKS for cell in _cells(point, mark)),
                _cell(_median(point, MIDDLE)[1], ".0f"),
                _ratio(point, points),
                f"{errors:.3f}",
                f"{max(curve.warm_up for curve in point.curves):.1f}",
            ]
        )
    return rows


def _short(error: str) -> str:
    return error if len(error) < 100 else error[:97] + "..."


def _median(point: Point, mark: float) -> tuple[float, float]:
    """Seconds and iterations until the mark, medians over seeds; infinite if most seeds never reach it."""
    return tuple(
        st.median(values) for values in zip(*(reached(curve, mark) for curve in runs(point, mark)), strict=True)
    )


def _cell(value: float, form: str) -> str:
    return f"{value:{form}}" if math.isfinite(value) else "not reached"


def _ratio(point: Point, points: Mapping[str, Point]) -> str:
    """Time relative to the fastest plain loop, at the smallest mark that both reach, and bounds at smaller marks.

    A plain loop that has not reached a mark needs more than all its seconds.
    """
    plain = [other for other in points.values() if is_stock(other) and other.curves]
    cells: list[str] = []
    for mark in MARKS:
        own, name = _median(point, mark)[0], f"at 1/{1 / mark:.0f}"
        if not plain or not math.isfinite(own):
            break
        times = [_median(other, mark)[0] for other in plain]
        if math.isfinite(min(times)):
            cells = [f"{own / min(times):.2f} {name}"]
        else:
            spent = min(curve.seconds[-1] for other in plain for curve in runs(other, mark))
            cells += [f"< {own / spent:.2f} {name}"] if own < spent else []
    return "; ".join(cells)
