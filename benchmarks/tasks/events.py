"""Task `events`: time and peak memory of a density gradient against the number of events of a path in a medium."""

from __future__ import annotations

from ..measures.estimates import growth
from ..measures.job import Job, Record
from ..scenes.media import DENSITY
from ..tables import markdown
from .depth import PATIENCE_S, alive, fastest, memory_cell, memory_growth, seconds_cell

TITLE = "events"
TAKES = (12, 140)
METHODS = ("prbvolpath", "score", "listing")
COUNTED = "sealed-fog, counted"


def jobs(quick: bool) -> list[Job]:
    """List one job for each method and depth. Each process has one thread, so that time is proportional to work.

    Russian roulette starts beyond the last vertex, so that nearly all paths have ``max_depth`` vertices. At each depth,
    a separate job counts the vertices that are events in the medium.
    """
    depths = (4, 64) if quick else (4, 16, 64, 256, 1024, 2048)

    def job(method: str, depth: int) -> Job:
        counted = method == "volpath"
        return Job(
            scene=COUNTED if counted else "sealed-fog",
            parameters=(DENSITY,),
            methods=(method,),
            max_depth=depth,
            rr_depth=depth + 1,
            resolution=16,
            spp=4,
            rounds=2 if counted else 3 if quick else 7,
            patience=0 if counted else PATIENCE_S,
            warmup=0 if counted else 2,  # a method that learns may have another kernel for when it knows nothing
            threads=1,
            measure="events" if counted else "gradient",
        )

    return [job(method, depth) for depth in depths for method in ("volpath", *METHODS)]


def table(record: Record) -> str:
    """Format seconds of the fastest round and MiB by events and method, with the exponent of time and memory growth."""
    events = {point.max_depth: point.mean for point in record.points if point.scene == COUNTED and point.mean}
    methods = list(dict.fromkeys(point.method for point in record.points if point.scene != COUNTED))
    cells = {(point.max_depth, point.method): point for point in record.points}
    header = ["depth", "events per path", *(f"{m}, s" for m in methods), *(f"{m}, MiB" for m in methods)]
    rows = []
    for depth, count in events.items():
        row = [cells.get((depth, method)) for method in methods]
        rows.append([str(depth), f"{count:.1f}", *map(seconds_cell, row), *map(memory_cell, row)])
    rows.append(["exponent of time", "", *(_exponent(record, m, events) for m in methods), *[""] * len(methods)])
    rows.append(["last / first", *[""] * (len(methods) + 1), *(memory_growth(record, m) for m in methods)])
    return markdown(header, rows)


def _exponent(record: Record, method: str, events: dict[int, float]) -> str:
    points = [point for point in alive(record, method) if point.max_depth in events]
    if len(points) < 5:
        return "too few depths"
    return str(growth([events[point.max_depth] for point in points], [fastest(point) for point in points]))
