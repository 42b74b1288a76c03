"""Task `supergrid`: time that coarse local majorants save on a sparse 64³ grid, and cost on a uniform grid."""

from __future__ import annotations

import numpy as np

from ..measures.estimates import unpaired_ratio
from ..measures.job import Job, Kind, Point, Record
from ..scenes.media import DENSITY
from ..tables import markdown, median_seconds, pooled

TITLE = "supergrid"
TAKES = (20, 165)
WITHOUT = "one majorant"
GRIDS = {"sparse": ("supergrid", "auto"), "thin sparse": ("auto",), "uniform": ("supergrid", "auto")}
PASSES: tuple[Kind, ...] = ("gradient", "image")
# A process has one medium only, since a virtual call traces every medium that there is: so the processes take turns.
TURNS = 2


def jobs(quick: bool) -> list[Job]:
    """List image and gradient jobs for each grid and choice of majorants, each repeated TURNS times in alternation."""
    return [
        Job(
            scene=f"{grid}, {choice}",
            parameters=(DENSITY,),
            methods=("score",),
            max_depth=32,
            rr_depth=5,
            resolution=32 if quick else 64,
            spp=16 if quick else 64,  # enough that tracing the kernels does not count
            rounds=4 if quick else 5,
            warmup=3,
            measure=measure,
            weights="wave",
            update=True,
        )
        for grid, choices in GRIDS.items()
        for measure in (PASSES[:1] if quick else PASSES)
        for _ in range(1 if quick else TURNS)
        for choice in ((WITHOUT, "auto") if quick else (WITHOUT, *choices))
    ]


def table(record: Record) -> str:
    """Format speed and variance relative to one majorant for the whole grid."""
    found = {(point.scene, point.measure): point for point in pooled(record.points)}
    rows = []
    for (scene, measure), point in found.items():
        grid, choice = scene.split(", ")
        rows.append([grid, measure, choice, *_cells(point, found.get((f"{grid}, {WITHOUT}", measure)))])
    return markdown(["grid", "pass", "majorants", "seconds (median)", "speed-up", "variance ratio"], rows)


def _cells(point: Point, baseline: Point | None) -> list[str]:
    if point.error:
        return [point.error, "", ""]
    if baseline is None or baseline.error:
        return [median_seconds(point), "", ""]
    if baseline is point:
        return [median_seconds(point), "1", "1"]
    variance = unpaired_ratio(point.squared_errors, baseline.squared_errors, np.mean)
    return [median_seconds(point), str(unpaired_ratio(baseline.seconds, point.seconds, np.median)), str(variance)]
