"""Task `depth`: time and peak memory of a gradient pass as functions of path length."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from ..measures.estimates import growth
from ..measures.job import Job, Point, Record
from ..scenes.media import DENSITY
from ..tables import markdown

TITLE = "depth"
TAKES = (25, 220)
WALLS = ("box.bsdf.reflectance.data",)

#: Scene, parameter, and for each method its greatest depth and the factor from one depth to the next. Where a claim
#: rests on the exponent there are more depths; radiative backpropagation ends where one pass takes some ten seconds.
SURFACES, MEDIA = "closed-box", "sealed-fog"
ROWS: dict[str, tuple[tuple[str, ...], dict[str, tuple[int, int]]]] = {
    SURFACES: (
        WALLS,
        {
            "sweep": (1024, 2),
            "replay": (4096, 4),
            "prb": (1024, 2),
            "prb_basic": (1024, 4),
            "naive AD": (512, 2),
            "RB": (256, 2),
            "linear RB": (1024, 4),
        },
    ),
    MEDIA: (
        (DENSITY,),
        {
            "score": (1024, 4),
            "prbvolpath": (1024, 4),
            "naive AD": (128, 2),
            "RB": (64, 2),
            "linear RB": (1024, 4),
        },
    ),
}
QUICK = {"sweep": (256, 64), "prb": (256, 64), "naive AD": (32, 8), "RB": (32, 8)}
SHALLOWEST = 4
# One pass beyond it is enough to know how slow a method is.
PATIENCE_S = 10


def jobs(quick: bool) -> list[Job]:
    """List one job for each method and depth. Each process has one thread, so that time is proportional to work.

    Russian roulette starts beyond the last vertex, so that every path in the closed box has ``max_depth`` vertices.
    """
    rows = {SURFACES: (WALLS, QUICK)} if quick else ROWS
    return [
        Job(
            scene=scene,
            parameters=parameters,
            methods=(method,),
            max_depth=depth,
            rr_depth=depth + 1,
            resolution=16,
            spp=4,
            rounds=3 if quick else 5,
            warmup=2 if scene == MEDIA else 1,  # a method that learns may have another kernel for when it knows nothing
            threads=1,
            patience=PATIENCE_S,
        )
        for scene, (parameters, methods) in rows.items()
        for depth in _ladder(max(deepest for deepest, _ in methods.values()), 2)
        for method, (deepest, factor) in methods.items()
        if depth in _ladder(deepest, factor)
    ]


def _ladder(deepest: int, factor: int) -> list[int]:
    """Return SHALLOWEST and its multiples by powers of ``factor``, up to ``deepest``."""
    depths = [SHALLOWEST]
    while depths[-1] * factor <= deepest:
        depths.append(depths[-1] * factor)
    return depths


def table(record: Record) -> str:
    """Format tables of time and memory, for surfaces and for media."""
    scenes = dict.fromkeys(point.scene for point in record.points)
    return "\n\n".join(part for scene in scenes for part in _tables(of_scene(record, scene)))


def of_scene(record: Record, scene: str) -> Record:
    """Return the record with only the points of one scene."""
    return replace(record, points=tuple(point for point in record.points if point.scene == scene))


def _tables(record: Record) -> list[str]:
    """Format two tables by depth and method: seconds with their exponent, and MiB with their growth."""
    methods = list(dict.fromkeys(point.method for point in record.points))
    depths = sorted({point.max_depth for point in record.points})
    cells = {(point.max_depth, point.method): point for point in record.points}
    scene = record.points[0].scene

    def rows(cell: Callable[[Point | None], str]) -> list[list[str]]:
        return [[str(depth), *(cell(cells.get((depth, method))) for method in methods)] for depth in depths]

    exponents = ["exponent", *(exponent(record, method) for method in methods)]
    growths = ["last / first", *(memory_growth(record, method) for method in methods)]
    return [
        markdown([f"{scene}: seconds at depth", *methods], [*rows(seconds_cell), exponents]),
        markdown([f"{scene}: MiB at depth", *methods], [*rows(memory_cell), growths]),
    ]


def fastest(point: Point) -> float:
    """Return the seconds of the fastest round. All rounds do the same work; other load only adds time."""
    return min(point.seconds)


def seconds_cell(point: Point | None) -> str:
    """Return the seconds of the fastest round, or the error message."""
    if point is None:
        return ""
    return point.error or f"{fastest(point):.4f}"


def memory_cell(point: Point | None) -> str:
    """Return the peak memory of the process in MiB."""
    return "" if point is None or point.peak_mib is None else f"{point.peak_mib:.0f}"


def memory_or_error(point: Point | None) -> str:
    """Return the error message of a method that raised, otherwise the peak memory of the process in MiB."""
    return point.error if point is not None and point.error else memory_cell(point)


def alive(record: Record, method: str) -> list[Point]:
    """Return the points of a method without error, by increasing depth."""
    return [point for point in record.points if point.method == method and not point.error]


def exponent(record: Record, method: str) -> str:
    """Return the exponent of time with its interval."""
    points = alive(record, method)
    if len(points) < 5:
        return "too few depths"
    return str(growth([point.max_depth for point in points], [fastest(point) for point in points]))


def memory_growth(record: Record, method: str) -> str:
    """Return the ratio of peak memory at the largest and at the smallest depth."""
    peaks = [point.peak_mib for point in alive(record, method) if point.peak_mib is not None]
    return f"{peaks[-1] / peaks[0]:.2f}" if peaks else ""
