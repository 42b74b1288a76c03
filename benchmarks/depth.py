"""Task `depth`: time and peak memory of a gradient pass against the length of the paths."""

from __future__ import annotations

from .estimates import growth
from .job import Job, Point, Record
from .tables import markdown

TITLE = "depth"
WALLS = ("box.bsdf.reflectance.data",)
DEEPEST = {"prb": 4096, "sweep": 1024, "replay": 4096}
SHALLOWEST = 8


def jobs(quick: bool) -> list[Job]:
    """A process of its own for each method and depth, all with one thread: time is then proportional to work.

    Russian roulette starts beyond the last vertex, so that every path in the closed box has ``max_depth`` of them.
    """
    deepest = {method: min(depth, 512) if quick else depth for method, depth in DEEPEST.items()}
    depths = [SHALLOWEST * 2**k for k in range(max(deepest.values()).bit_length() - SHALLOWEST.bit_length() + 1)]
    return [
        Job(
            scene="closed-box",
            parameters=WALLS,
            methods=(method,),
            max_depth=depth,
            rr_depth=depth + 1,
            resolution=16,
            spp=4,
            rounds=3 if quick else 7,
            warm_up=1,
            threads=1,
        )
        for depth in depths
        for method in deepest
        if depth <= deepest[method]
    ]


def table(record: Record) -> str:
    """Seconds (of the fastest round) and MiB by depth and method; then the exponent of time and growth of memory."""
    methods = list(dict.fromkeys(point.method for point in record.points))
    depths = sorted({point.max_depth for point in record.points})
    cells = {(point.max_depth, point.method): point for point in record.points}
    header = ["depth", *(f"{m}, s" for m in methods), *(f"{m}, MiB" for m in methods)]
    rows = []
    for depth in depths:
        row = [cells.get((depth, method)) for method in methods]
        rows.append([str(depth), *map(seconds_cell, row), *map(memory_cell, row)])
    rows.append(["exponent of time", *(_exponent(record, m) for m in methods), *[""] * len(methods)])
    rows.append(["last / first", *[""] * len(methods), *(memory_growth(record, m) for m in methods)])
    return markdown(header, rows)


def fastest(point: Point) -> float:
    """Seconds of the fastest round: the work is the same in all, and what else the machine does can only add."""
    return min(point.seconds)


def seconds_cell(point: Point | None) -> str:
    """Seconds of the fastest round, or why there are none."""
    if point is None:
        return ""
    return point.error or f"{fastest(point):.4f}"


def memory_cell(point: Point | None) -> str:
    """Peak MiB of the process."""
    return "" if point is None or point.peak_mib is None else f"{point.peak_mib:.0f}"


def alive(record: Record, method: str) -> list[Point]:
    """Points of the method, by increasing depth, that came to an end."""
    return [point for point in record.points if point.method == method and not point.error]


def _exponent(record: Record, method: str) -> str:
    points = alive(record, method)
    if len(points) < 5:
        return "too few depths"
    return str(growth([point.max_depth for point in points], [fastest(point) for point in points]))


def memory_growth(record: Record, method: str) -> str:
    """Peak memory at the largest depth over that at the smallest."""
    peaks = [point.peak_mib for point in alive(record, method) if point.peak_mib is not None]
    return f"{peaks[-1] / peaks[0]:.3f}" if peaks else ""
