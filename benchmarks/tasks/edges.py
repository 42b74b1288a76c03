"""Task `edges`: what edges cost, by kind, beside `prb` and beside Mitsuba's projective sampling.

Seconds are those of kernels. The parts of ours, and those of `prb_projective`, are gradients of one thing: of what the
camera sees, or of what surfaces see. Lists of edges are right where a mesh that is black moves before a glow: elsewhere
they leave creases out, and shade the wrong faces (see docs/edges_peers.md).

And what a derivative by one number is worth, interior and edges, beside a central difference with common random
numbers, which is what one would do without gradients.
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
"""What is compared with what that finds the same; the last the other way round, since it is many times as much."""
ROUNDS, CHEAP_ROUNDS = 60, 480
"""The first say a ratio of variances within a third; where all takes little time there are more."""
STEPS = tuple(f"{name}, {way}" for name in ("prb", "all boundaries") for way in (TRACED, RECORDED))
GUIDED = 120
"""Seconds after which `prb_projective` sits out, whose guiding takes most of them."""
TINY, SMALL, LARGE = 16, 32, 128
"""Pixels along a side. On few the several kernels of edges do not fill the cores, as the one of `prb` does."""

OURS = "boundary and interior"
PLACE, LOOK_FROM = "object.to_world", "camera.to_world"
MOVING = {
    "head turns": (*KEY, 3),
    "shadow of the head": (*KEY, 3),
    "textured ball": (PLACE, 3),
    "heights": (*KEY, 3),
    "camera turns": (LOOK_FROM, 3),
    "orthographic camera": (LOOK_FROM, 3),
    "field of view": ("camera.x_fov", 3),
    "behind rough glass": (*KEY, 5),
    "between walls": (*KEY, 6),
    "ball lifts off": (PLACE, 3),
    "small in a room": (PLACE, 3),
}
"""Scenes of which one number is asked: what it moves, and the depth."""


def jobs(quick: bool) -> list[Job]:
    """Inner edges, edges on the film, recorded steps; guided baselines and large films have jobs of their own."""
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
    """A derivative by one number, and a central difference by the same."""
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
    """What edges cost, scene by scene; then all methods next to `prb`, and recorded steps next to their kernels.

    Last, derivatives by one number next to central differences.
    """
    found = by_job([point for point in timed(record) if ", " not in point.method])
    rows = [[p.scene, method_cell(p), *_times(p, job.get("prb"))] for job in found for p in job.values()]
    header = ["scene", "method", "seconds of kernels (median)", "time / prb"]
    steps = {point.method: point for point in timed(record) if ", " in point.method}
    return "\n\n".join((costs(found), markdown(header, rows), _steps(steps), worth(record)))


def timed(record: Record) -> list[Point]:
    """What was measured for its time."""
    return [point for point in record.points if point.measure == "edges"]


def worth(record: Record) -> str:
    """Variance of a derivative by one number over that of a central difference, and how much of it one pass has."""
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
    """By method, what was measured in turn: `prb` comes first in each job."""
    found: list[dict[str, Point]] = []
    for point in points:
        if point.method == "prb" or not found:
            found.append({})
        found[-1][point.method] = point
    return found


def costs(found: list[dict[str, Point]]) -> str:
    """A row for each scene: times next to `prb`, and time x variance next to baselines."""
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
    """As `time_cells`, of the rounds that both have: one may have sat out the last."""
    return time_cells(point, baseline) if baseline is None or baseline is point else time_cells(*_both(point, baseline))


def _both(point: Point, baseline: Point) -> tuple[Point, Point]:
    """Two points with the rounds that both have."""
    n = min(len(point.seeds), len(baseline.seeds))
    point, baseline = (
        replace(p, seconds=p.seconds[:n], squared_errors=p.squared_errors[:n]) for p in (point, baseline)
    )
    return point, baseline


def _cost(job: dict[str, Point] | None, ours: str, other: dict[str, Point] | None, baseline: str) -> str:
    """Time x variance next to a baseline. If it ran in another job, times of `prb` in both correct for the load."""
    if job is None or other is None or job[ours].error or other[baseline].error:
        return ""
    seconds = [st.median(x["prb"].seconds) if "prb" in x and x["prb"].seconds else 1.0 for x in (job, other)]
    scaled = tuple(s * seconds[0] / seconds[1] for s in other[baseline].seconds)
    return comparison(*_both(job[ours], replace(other[baseline], seconds=scaled)))[3]


def _steps(steps: dict[str, Point]) -> str:
    """A step by the clock where it was recorded, and its kernels where it was traced."""
    rows = []
    for name in ("prb", "all boundaries"):
        found = [steps.get(f"{name}, {way}") for way in (RECORDED, TRACED)]
        if all(point is not None and not point.error for point in found):
            clock, kernels = (st.median(point.seconds) for point in found if point is not None)
            rows.append([name, f"{kernels:.3f}", f"{clock:.3f}", f"{clock / kernels:.2f}"])
        else:
            rows.append([name, *(point.error or "" if point else "" for point in found), ""])
    return markdown(["recorded step", "seconds of kernels", "seconds by the clock", "ratio"], rows)
