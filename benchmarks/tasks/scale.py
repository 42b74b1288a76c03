"""Task `scale`: memory by number of views, parameters and samples, and time by number of shapes and of actors."""

from __future__ import annotations

import statistics as st
from dataclasses import replace

from ..measures import actors
from ..measures.job import Job, Point, Record
from ..measures.methods import OWN, USUAL
from ..measures.scale import name_of
from ..scenes.wide import COLOUR, SHAPES, SKY, shapes_name
from ..tables import groups, markdown, method_cell, time_cells

TITLE = "scale"
TAKES = (90, 1100)
VIEWS, TEXELS = (1, 50, 200), (100, 1000, 3162, 10000)
QUICK_VIEWS, QUICK_TEXELS = (1, 4), (100, 500)
BUDGET = "4 GiB"
SAMPLES = (20, 24, 28, 32, 33)
ACTORS = (1, 2)
BYTES = 12
"""Bytes of a parameter's value and of its state in Adam."""


def jobs(quick: bool) -> list[Job]:
    """List the jobs: whole runs in one process each, sums, shapes with `prb` and `sweep` in alternation, and actors."""
    run = Job(
        scene="",
        parameters=("wall.bsdf.reflectance.data",),
        methods=("optimize",),
        max_depth=2,
        rr_depth=5,
        resolution=32 if quick else 128,
        spp=4,
        rounds=1,
        warmup=0,
        measure="whole run",
    )
    views = [replace(run, scene=name_of(n, 100)) for n in (QUICK_VIEWS if quick else VIEWS)]
    texels = [replace(run, scene=name_of(2, n), resolution=32) for n in (QUICK_TEXELS if quick else TEXELS)]
    both = [] if quick else [replace(run, scene=name_of(200, 10000, BUDGET), resolution=128)]
    sums = [
        replace(
            run, scene="even sky", parameters=(SKY,), methods=(method,), resolution=64, spp=2 ** (n - 12), measure="sum"
        )
        for n in (SAMPLES[:2] if quick else SAMPLES)
        for method in ("prb", "sweep")
    ]
    shapes = [
        replace(
            run, scene=shapes_name(n), parameters=(COLOUR,), methods=("prb", "sweep"), max_depth=4, resolution=32,
            spp=16, rounds=2 if n == SHAPES[-1] or quick else 5, warmup=1, measure="gradient",
        )
        for n in (SHAPES[:2] if quick else SHAPES)
    ]  # fmt: skip
    ways = f"prb, {USUAL}", f"sweep, {OWN}"
    # The median is that of recorded steps: the first two are traced.
    steps = [
        replace(job, methods=ways, measure="step", warmup=0, rounds=7 if job is shapes[-1] else 15) for job in shapes
    ]
    return [*views, *texels, *both, *sums, *shapes, *steps, *_by_actors(run, quick)]


def _by_actors(run: Job, quick: bool) -> list[Job]:
    """List the jobs with actors. They need one core per actor and `pip install 'pathreplay[ray]'`.

    If Ray is missing, the rows contain an error message.
    """
    ways = actors.PROCESS, *(actors.many(n) for n in ACTORS[: 1 if quick else None])
    # In turn, since processors that others use as well are slower for minutes.
    job = replace(run, parameters=(), methods=ways, measure="iterations", threads=1, rounds=1 if quick else 3)
    views = 4 if quick else 32
    return [
        replace(job, scene=actors.name_of("surfaces", views), resolution=16 if quick else 64, spp=16),
        replace(job, scene=actors.name_of("cloud", views), resolution=8 if quick else 24, spp=8),
    ]


def table(record: Record) -> str:
    """Format tables: memory of whole runs, memory and error of sums over many samples, time by shapes and by actors."""
    runs = [p for p in record.points if p.measure == "whole run"]
    sums = [p for p in record.points if p.measure == "sum"]
    shapes = [p for p in record.points if p.measure == "gradient"]
    steps = [p for p in record.points if p.measure == "step"]
    traced, recorded = "shapes and BSDFs: traced gradient", "shapes and BSDFs: step of a job"
    tables = _runs(runs), _sums(sums), _shapes(traced, "prb", shapes), _shapes(recorded, f"prb, {USUAL}", steps)
    tables += (_actors([p for p in record.points if p.measure == "iterations"]),)
    return "\n\n".join(part for part in tables if part)


def _runs(points: list[Point]) -> str:
    if not points:
        return ""
    least = min((p.values[-1] for p in points if p.values), default=0.0)
    rows = []
    for point in points:
        if point.error or not point.values:
            rows.append([point.scene, str(point.paths), point.error or "", "", "", "", ""])
            continue
        texels = int(point.scene.split(", ")[1].split(" ")[0]) ** 2
        views = int(point.scene.split(" ")[0])
        pixels = point.paths // 4 * views
        more = (point.values[-1] - least) * 2**20
        rows.append(
            [
                point.scene,
                f"{pixels / 1e6:.2f}",
                f"{st.median(point.seconds):.0f}",
                " ".join(f"{peak:.0f}" for peak in point.values[:-1]),
                f"{point.values[-1]:.0f}",
                f"{more / pixels:.0f}" if views > 2 else "",
                f"{more / texels / BYTES:.2f}" if texels >= 10**6 else "",
            ]
        )
    head = [
        "job",
        "million pixels in all views",
        "seconds",
        "peak MiB: first, second, third step, end",
        "without cached file pages",
        "bytes per pixel",
        "multiple of values and Adam state",
    ]
    return markdown(head, rows)


def _sums(points: list[Point]) -> str:
    rows = []
    for point in points:
        samples = f"2^{point.paths.bit_length() - 1}"
        if point.error:
            rows.append([samples, point.method, point.error.split(". ")[0], "", ""])
            continue
        rows.append(
            [samples, point.method, f"{point.seconds[0]:.1f}", f"{point.peak_mib or 0:.0f}", f"{point.mean or 0:.1e}"]
        )
    head = ["samples of one gradient pass", "method", "seconds", "peak MiB", "error of the sum"]
    return markdown(head, rows) if rows else ""


def _shapes(what: str, peer: str, points: list[Point]) -> str:
    rows = [
        [point.scene, method_cell(point), *time_cells(point, methods.get(peer))]
        for methods in groups(points).values()
        for point in methods.values()
    ]
    return markdown([what, "method", "seconds (median)", "time / prb"], rows) if rows else ""


def _actors(points: list[Point]) -> str:
    one = {p.scene: st.median(p.values) for p in points if p.method == actors.many(1) and p.values}
    rows = []
    for point in points:
        if point.error or not point.values:
            rows.append([point.scene, point.method, point.error or "", ""])
            continue
        seconds = st.median(point.values)
        share = f"{seconds / one[point.scene]:.2f}" if point.scene in one else ""
        rows.append([point.scene, point.method, f"{seconds:.3f}", share])
    head = ["iteration of a job, one thread each", "computed by", "seconds (median)", "relative to one actor"]
    return markdown(head, rows) if rows else ""
