"""Task `quality`: processor seconds and iterations until the held-out error of inverse problems falls below marks."""

from __future__ import annotations

import math
import statistics as st
from collections.abc import Mapping

from ..inverse.loops import entries_of
from ..inverse.problems import PROBLEMS
from ..inverse.search import MARKS, best, reached
from ..measures.job import Curve, Job, Point, Record
from ..measures.methods import STOCK, parts
from ..tables import groups, markdown

TITLE = "quality"
TAKES = (90, 1200)
QUICK = "texture under a sky", "room: two lamps, four materials", "cloud"
RATES, SAMPLES = (0.001, 0.003, 0.01, 0.03), (4, 32)
QUICK_RATES, QUICK_SAMPLES = (0.01, 0.03), (8,)
SECONDS, HEAVY_SECONDS, QUICK_SECONDS = 4.0, 8.0, 1.0


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
            budget=QUICK_SECONDS if quick else HEAVY_SECONDS if PROBLEMS[name].heavy else SECONDS,
            rates=QUICK_RATES if quick else RATES,
            samples=QUICK_SAMPLES if quick else SAMPLES,
        )
        for name in (QUICK if quick else PROBLEMS)
    ]


def is_stock(point: Point) -> bool:
    """Whether it is a loop with one of Mitsuba's integrators."""
    return parts(point.method)[0] in STOCK


def runs(point: Point) -> list[Curve]:
    """The optimisations with the chosen rate and samples, one for each seed."""
    return [curve for curve in point.curves if not curve.searched]


def table(record: Record) -> str:
    """A row for each loop: chosen rate and samples, medians over seeds, and the ratio to the best plain loop."""
    header = ["problem", "loop", "rate", "spp", *(f"1/{1 / mark:.0f}, s" for mark in MARKS)]
    header += ["1/10, iterations", "time / best plain loop", "last error / first", "first iterations, s"]
    return markdown(header, [row for points in groups(record.points).values() for row in _rows(points)])


def _rows(points: Mapping[str, Point]) -> list[list[str]]:
    rows = []
    for point in points.values():
        if point.error or not runs(point):
            rows.append([point.scene, point.method, f"raises: {_short(point.error or '')}", *[""] * 8])
            continue
        choice = best([curve for curve in point.curves if curve.searched])
        errors = st.median(curve.errors[-1] / curve.errors[0] for curve in runs(point))
        cells = [_cell(_median(point, mark)[0], ".2f") for mark in MARKS]
        rows.append(
            [
                point.scene,
                point.method,
                f"{choice.rate:g}",
                str(choice.spp),
                *cells,
                _cell(_median(point, MARKS[1])[1], ".0f"),
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
    return tuple(st.median(values) for values in zip(*(reached(curve, mark) for curve in runs(point)), strict=True))


def _cell(value: float, form: str) -> str:
    return f"{value:{form}}" if math.isfinite(value) else "not reached"


def _ratio(point: Point, points: Mapping[str, Point]) -> str:
    """Time relative to the fastest plain loop, at the smallest mark that both reach."""
    plain = [other for other in points.values() if is_stock(other) and runs(other)]
    for mark in reversed(MARKS):
        times = [_median(other, mark)[0] for other in plain]
        own = _median(point, mark)[0]
        if times and math.isfinite(own) and math.isfinite(min(times)):
            return f"{own / min(times):.2f} at 1/{1 / mark:.0f}"
    return ""
