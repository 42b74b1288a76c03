"""Task `startup`: seconds until a new process has computed its first and its second gradient."""

from __future__ import annotations

import statistics as st

from ..measures.job import Job, Record
from ..measures.methods import STAGES
from ..tables import groups, markdown

TITLE = "startup"
TAKES = (15, 20)
METHODS = ("prb", "sweep")


def jobs(quick: bool) -> list[Job]:
    """List the jobs with an empty and a filled kernel cache; each method has its own process in each round."""
    return [
        Job(
            scene="cornell-box",
            parameters=("back.bsdf.reflectance.data",),
            methods=tuple(f"{method}, {stage}" for stage in STAGES for method in METHODS),
            max_depth=8,
            rr_depth=5,
            resolution=64,
            spp=16,
            rounds=1 if quick else 5,
            warmup=1,
            measure=measure,
        )
        for measure in ("cold start", "warm start")
    ]


def table(record: Record) -> str:
    """Format seconds by kernel cache and stage, with the fastest and the slowest process in brackets."""
    rows = []
    for measure in dict.fromkeys(point.measure for point in record.points):
        found = next(iter(groups(point for point in record.points if point.measure == measure).values()))
        for stage in STAGES:
            points = [found.get(f"{method}, {stage}") for method in METHODS]
            rows.append([measure, stage, *("" if p is None else p.error or _seconds(p.seconds) for p in points)])
    return markdown(["kernel cache", "stage", *(f"{method}, s" for method in METHODS)], rows)


def _seconds(seconds: tuple[float, ...]) -> str:
    return f"{st.median(seconds):.2f} [{min(seconds):.2f}, {max(seconds):.2f}]"
