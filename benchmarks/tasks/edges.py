"""Task `edges`: cost of boundary terms, by kind, relative to `prb` and to Mitsuba's projective sampling.

Times are seconds of kernels. A part of our boundary term is compared with the part of `prb_projective` for the same
edges: edges that the camera sees, or edges that surfaces see. Edge lists are correct if a black mesh moves in front of
an emissive wall. In other scenes they omit creases and shade the wrong faces (see docs/edges_peers.md).

The task also compares derivatives with respect to one number, interior and boundary terms together, with central
differences. These differences use common random numbers, and are the usual method without gradients.
"""

from __future__ import annotations

import statistics as st
from dataclasses import replace

from ..measures.estimates import mean_ratio
from ..measures.job import Job, Point, Record
from ..measures.methods import DIFFERENCE, RECORDED, TRACED
from ..tables import comparison, markdown, method_cell, time_cells

TITLE = "edges"
TAKES = (60, 900)
KEY = ("object.vertex_positions",)
INNER, FILM = ("shadow", "silhouette", "bumps"), ("black silhouette", "black bumps")
VERSUS = (
    ("primary boundary", "edge list"),
    ("secondary boundary", "unguided secondary"),
    ("projective secondary", "secondary boundary"),
)
"""Pairs of methods that estimate the same part, as (method, baseline). The last pair is reversed, because its ratio is
large."""
ROUNDS, CHEAP_ROUNDS = 60, 480
"""ROUNDS determine a ratio of variances to within a third; jobs in which all methods are fast use CHEAP_ROUNDS."""
STEPS = tuple(f"{name}, {way}" for name in ("prb", "all boundaries") for way in (TRACED, RECORDED))
GUIDED = 120
"""Seconds after which `prb_projective` skips the remaining rounds. Guiding takes most of these seconds."""
TINY, SMALL, LARGE = 16, 32, 128
"""Pixels along a side. With few pixels, kernels of boundary terms do not fill the cores; the kernel of `prb` does."""

OURS = "boundary and interior"
PLACE, LOOK_FROM = "object.to_world", "camera.to_world"
MOVING = {
    "head turns": (*KEY, 3),
    "shadow of the head": (*KEY, 3),
    "textured ball": (PLACE, 3),
    "heights": (*KEY, 3),
    "camera turns": (LOOK_FROM, 3),
    "camera around a head": (LOOK_FROM, 3),
    "orthographic camera": (LOOK_FROM, 3),
    "field of view": ("camera.x_fov", 3),
    "behind rough glass": (*KEY, 5),
    "between walls": (*KEY, 6),
    "ball lifts off": (PLACE, 3),
    "ball in fog": (PLACE, 5),
    "ball in thick fog": (PLACE, 5),
    "wall behind a lamp": (PLACE, 3),
    "ball behind a lamp": (PLACE, 3),
    "behind a pane": (PLACE, 4),
    "ball of metal": (PLACE, 4),
    "ball of glass": (PLACE, 4),
    "ball of rough metal": (PLACE, 4),
    "ball of rough plastic": (PLACE, 4),
    "ball of frosted glass": (PLACE, 4),
    "small in a room": (PLACE, 3),
}
"""Scenes for derivatives with respect to one number: the key of the moving parameter, and the depth."""


def jobs(quick: bool) -> list[Job]:
    """List the jobs: single numbers, secondary and primary edges, guided baselines, large films and recorded steps."""
    inner = ("prb", "secondary boundary", "primary boundary", "boundary alone", "unguided secondary")
    film = ("prb", "primary boundary", "edge list")
    wanted = [(scene, inner, 0.0, SMALL) for scene in INNER] + [(scene, film, 0.0, SMALL) for scene in FILM]
    wanted += [(scene, ("prb", "projective secondary"), GUIDED, SMALL) for scene in INNER]
    wanted += [(scene, ("prb", "boundary alone"), 0.0, LARGE) for scene in INNER]
    wanted += [("bumps", STEPS, 0.0, SMALL)]
    numbers = [by_number(scene, key, depth, quick) for scene, (key, depth) in MOVING.items()]
    return numbers + [
        Job(
            scene=scene,
            parameters=KEY,
            methods=methods,
            max_depth=2,
            rr_depth=100,
            resolution=side,
            spp=16 if quick else 64,
            rounds=4 if quick else CHEAP_ROUNDS if scene in FILM else ROUNDS,
            warmup=1 if patience else 2,
            patience=patience,
            measure="edges",
        )
        for scene, methods, patience, side in wanted
    ]


def by_number(scene: str, key: str, depth: int, quick: bool) -> Job:
    """Create the job that compares a derivative with respect to one number with a central difference."""
    return Job(
        scene=scene,
        parameters=(key,),
        methods=(DIFFERENCE, OURS),
        max_depth=depth,
        rr_depth=100,
        resolution=TINY,
        spp=4 if quick else 16,
        rounds=4 if quick else 32,
        warmup=0,
        measure="number",
    )


def table(record: Record) -> str:
    """Format four tables.

    The tables contain the cost of boundary terms by scene, all methods relative to `prb`, recorded steps relative to
    their kernels, and derivatives with respect to one number relative to central differences.
    """
    found = by_job([point for point in timed(record) if ", " not in point.method])
    rows = [[p.scene, method_cell(p), *_times(p, job.get("prb"))] for job in found for p in job.values()]
    header = ["scene", "method", "seconds of kernels (median)", "time / prb"]
    steps = {point.method: point for point in timed(record) if ", " in point.method}
    return "\n\n".join((costs(found), markdown(header, rows), _steps(steps), worth(record)))


def timed(record: Record) -> list[Point]:
    """Return the points with timings of boundary terms."""
    return [point for point in record.points if point.measure == "edges"]


def worth(record: Record) -> str:
    """Format variances relative to central differences, and the fraction of the variance due to the worst pass."""
    found: dict[str, dict[str, Point]] = {}
    for point in record.points:
        if point.measure == "number":
            found.setdefault(point.scene, {})[point.method] = point
    rows = []
    for scene, points in found.items():
        ours, other = points.get(OURS), points.get(DIFFERENCE)
        if ours is None or other is None or not ours.squared_errors or not other.squared_errors:
            rows.append([scene, *(next((p.error for p in points.values() if p.error), "not finite"), "", "")])
            continue
        ratio = mean_ratio(ours.squared_errors, other.squared_errors)
        typical = st.median(ours.squared_errors) / st.median(other.squared_errors)
        share = max(ours.squared_errors) / sum(ours.squared_errors)
        rows.append([scene, str(ratio), f"{typical:.2f}", f"{share:.0%}"])
    if not rows:
        return "*Not measured yet.*"
    ratios = [f"{quantity} / central difference" for quantity in ("variance", "median squared error")]
    header = ["parameter", *ratios, "fraction of variance in one pass"]
    return markdown(header, rows)


def by_job(points: list[Point]) -> list[dict[str, Point]]:
    """Group the points by job, each a dictionary by method; `prb` is the first method of each job."""
    found: list[dict[str, Point]] = []
    for point in points:
        if point.method == "prb" or not found:
            found.append({})
        found[-1][point.method] = point
    return found


def costs(found: list[dict[str, Point]]) -> str:
    """Format a row for each scene: times relative to `prb`, and time x variance relative to baselines."""
    timed = ("primary boundary", "secondary boundary", "boundary alone", "projective secondary")
    header = ["scene", *(f"{name} / prb" for name in timed), f"boundary alone / prb, {LARGE} x {LARGE}"]
    header += [f"time x variance of {a} / {b}" for a, b in VERSUS]
    rows = []
    for scene in (*INNER, *FILM):
        jobs = [job for job in found if any(point.scene == scene for point in job.values())]
        least = min((point.paths for job in jobs for point in job.values()), default=0)
        large = {name: job for job in jobs for name, point in job.items() if point.paths > least}
        at = {name: job for job in jobs for name, point in job.items() if point.paths == least}
        times = [_times(at[name][name], at[name].get("prb"))[1] if name in at else "" for name in timed]
        times.append(
            _times(large["boundary alone"]["boundary alone"], large["boundary alone"]["prb"])[1] if large else ""
        )
        rows.append(
            [scene, *times, *(_cost(at.get(ours), ours, at.get(baseline), baseline) for ours, baseline in VERSUS)]
        )
    return markdown(header, rows)


def _times(point: Point, baseline: Point | None) -> list[str]:
    """Return `time_cells` for the rounds of both points; one of the methods may have skipped the last rounds."""
    return time_cells(point, baseline) if baseline is None or baseline is point else time_cells(*_both(point, baseline))


def _both(point: Point, baseline: Point) -> tuple[Point, Point]:
    """Return the two points, restricted to the rounds that both contain."""
    n = min(len(point.seeds), len(baseline.seeds))
    point, baseline = (
        replace(p, seconds=p.seconds[:n], squared_errors=p.squared_errors[:n]) for p in (point, baseline)
    )
    return point, baseline


def _cost(job: dict[str, Point] | None, ours: str, other: dict[str, Point] | None, baseline: str) -> str:
    """Return time x variance relative to a baseline; times of `prb` correct for the load if the jobs differ."""
    if job is None or other is None or job[ours].error or other[baseline].error:
        return ""
    seconds = [st.median(x["prb"].seconds) if "prb" in x and x["prb"].seconds else 1.0 for x in (job, other)]
    scaled = tuple(s * seconds[0] / seconds[1] for s in other[baseline].seconds)
    return comparison(*_both(job[ours], replace(other[baseline], seconds=scaled)))[3]


def _steps(steps: dict[str, Point]) -> str:
    """Format wall-clock times of recorded steps, and seconds of kernels of traced steps."""
    rows = []
    for name in ("prb", "all boundaries"):
        found = [steps.get(f"{name}, {way}") for way in (RECORDED, TRACED)]
        if all(point is not None and not point.error for point in found):
            clock, kernels = (st.median(point.seconds) for point in found if point is not None)
            rows.append([name, f"{kernels:.3f}", f"{clock:.3f}", f"{clock / kernels:.2f}"])
        else:
            rows.append([name, *(point.error or "" if point else "" for point in found), ""])
    return markdown(["recorded step", "seconds of kernels", "seconds by the clock", "ratio"], rows)
