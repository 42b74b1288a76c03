"""Task `gridmedium`: time of flights with and without cells of the medium, and noise and time of its transmittance.

All methods of a job run in alternation. Times are means instead of medians, because the clocks of some systems tick
only every few milliseconds. The cost of an estimate is its mean squared error times CPU time, relative to ratio
tracking with one majorant.
"""

from __future__ import annotations

import statistics as st

from ..measures.estimates import Versus, mean_ratio
from ..measures.grids import CANDIDATES, MAJORANTS
from ..measures.job import Job, Kind, Point, Record
from ..scenes.grids import GRIDS
from ..tables import groups, markdown

TITLE = "gridmedium"
TAKES = (20, 300)
ONE, AUTO, CELLS = MAJORANTS
RATIO = next(iter(CANDIDATES))
#: Scales of the density, quick and full.
SCALES: dict[Kind, tuple[tuple[int, ...], tuple[int, ...]]] = {
    "flight": ((40,), (1, 4, 10, 40, 100)),
    "transmittance": ((10,), (4, 20, 100)),
}


def jobs(quick: bool) -> list[Job]:
    """List the jobs: flights, then shadow rays, in each grid at each scale."""
    return [
        Job(
            scene=f"{grid} x {scale}",
            parameters=(),
            methods=tuple(MAJORANTS if measure == "flight" else CANDIDATES),
            max_depth=0,
            rr_depth=0,
            resolution=128 if quick else 256,  # rays: its square times spp
            spp=1 if quick else 2,
            rounds=3 if quick else 16,
            warmup=1,
            measure=measure,
        )
        for measure, scales in SCALES.items()
        for grid in GRIDS
        for scale in scales[0 if quick else 1]
    ]


def table(record: Record) -> str:
    """Format collisions and speed-up of flights; time, squared error, cost and z-score of transmittances."""
    flights = groups(point for point in record.points if point.measure == "flight")
    speed = [
        [scene, *(_count(found.get(name)) for name in (ONE, AUTO)), *(_gain(found, n) for n in (AUTO, CELLS))]
        for (scene, *_), found in flights.items()
    ]
    estimates = groups(point for point in record.points if point.measure == "transmittance")
    costs = [
        [point.scene, point.method, *_cost(point, found.get(RATIO))]
        for found in estimates.values()
        for point in found.values()
    ]
    header = ["grid x scale", "collisions, one majorant", "collisions, auto", "speed-up, auto", "speed-up, cells"]
    columns = ["grid x scale", "transmittance", "CPU seconds", "squared error", "cost", "z"]
    return markdown(header, speed) + "\n\n" + markdown(columns, costs)


def _count(point: Point | None) -> str:
    return "" if point is None or point.mean is None else f"{point.mean:.2f}"


def _gain(found: dict[str, Point], name: str) -> str:
    one, other = found.get(ONE), found.get(name)
    if one is None or other is None or one.error or other.error:
        return "" if other is None else other.error or ""
    return str(mean_ratio(one.seconds, other.seconds))


def _cost(point: Point, baseline: Point | None) -> list[str]:
    if point.error or baseline is None or baseline.error or point.z is None:
        return [point.error or "", "", "", ""]
    errors, cost = f"{st.fmean(point.squared_errors):.2e}", Versus(baseline, point).efficiency()
    return [f"{st.fmean(point.seconds):.4f}", errors, str(cost), f"{point.z:.1f}"]
