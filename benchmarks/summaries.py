"""Short tables for overview pages, in which `<!-- begin TASK-summary -->` marks the place of a table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator

from .measures.estimates import Versus
from .measures.job import Record
from .tables import Turns, groups, markdown
from .tasks import attached, depth, edges, iteration, media, surface, truth


def _surface(record: Record) -> str:
    """Compare with `prb`: the sweep, the automatic choice if only emitters are optimized, and Sobol sampling."""
    rows = [
        [f"{key.scene}, {surface.what(key.parameters)}", sampling, str(v.time()), str(v.variance())]
        for sampling, ours in (("scene", "sweep"), ("scene", "auto"), ("sobol", "sobol"))
        for key, v in _pairs(record, ours, "prb")
    ]
    return markdown(["gradient, pathreplay / prb", "`sampling`", "time", "variance"], rows)


def _attached(record: Record) -> str:
    """Compare the time of the sweep with `prb`, which omits most of these gradients."""
    rows = [
        [", ".join(key.parameters), str(key.max_depth), str(versus.time())]
        for key, versus in _pairs(record, "sweep", "prb")
        if key.scene == attached.SCENE
    ]
    return markdown(["moving parameter, sweep / prb", "depth", "time"], rows)


def _iteration(record: Record) -> str:
    """Compare our optimization loop, with the scene's sampler and with Sobol sampling, with a loop over Mitsuba's."""
    rows = [
        [key.scene, sampling, str(versus.time()), str(versus.cost())]
        for (theirs, *_, own, sobol) in (iteration.SURFACE, iteration.MEDIA)
        for sampling, method in (("scene", own), ("sobol", sobol))
        for key, versus in _pairs(record, method, theirs)
    ]
    header = ["optimisation step, relative to Mitsuba's loop", "`sampling`", "time", "time at equal variance"]
    return markdown(header, rows)


def _media(record: Record) -> str:
    """Efficiency gain (time x variance) of the default over `prbvolpath`."""
    rows = [
        [f"{media.WHAT[key.parameters[0]]}: {key.scene}", str(versus.efficiency())]
        for key, versus in _pairs(record, "score", media.RIVAL)
    ]
    return markdown(["gradient of media", "time x variance, prbvolpath / pathreplay"], rows)


def _edges(record: Record) -> str:
    """Cost of boundary terms by scene."""
    return edges.costs(edges.by_job([point for point in edges.timed(record) if ", " not in point.method]))


def _depth(record: Record) -> str:
    """Exponent of time, and growth of memory from the smallest depth to the largest, by scene and method."""
    rows = []
    for scene in dict.fromkeys(point.scene for point in record.points):
        part = depth.of_scene(record, scene)
        for method in dict.fromkeys(point.method for point in part.points):
            depths = [point.max_depth for point in depth.alive(part, method)]
            if depths:
                reach = f"{depths[0]} to {depths[-1]}"
                rows.append([scene, method, reach, depth.exponent(part, method), depth.memory_growth(part, method)])
    return markdown(["scene", "method", "depth", "exponent of time", "peak memory, last / first"], rows)


def _truth(record: Record) -> str:
    """Number of gradients that each method has right."""
    counts: dict[str, Counter[str]] = {}
    for point in record.points:
        if point.method not in truth.STEPS:
            verdict = "raises" if point.error else point.verdict or "not finite"
            counts.setdefault(point.method, Counter())[{"zero": "pass"}.get(verdict, verdict)] += 1
    verdicts = ["pass", "fail", "inconclusive", "raises"]
    rows = [[method, str(sum(c.values())), *(str(c[v]) for v in verdicts)] for method, c in counts.items()]
    return markdown(["gradient against finite differences", "cells", *verdicts], rows)


def _wrong(record: Record) -> str:
    """Gradients of media that are wrong in `prbvolpath`, beside ours."""
    rows = []
    for (scene, *_), points in groups(record.points).items():
        baseline = points.get(media.RIVAL)
        if baseline is not None and baseline.verdict == "fail":
            rows.append([scene, *(truth.told(points.get(name)) for name in (truth.STEPS[1], "score", media.RIVAL))])
    return markdown(["parameter", "finite differences of `volpath`", "`pathreplay`", "`prbvolpath`"], rows)


def _pairs(record: Record, ours: str, theirs: str) -> Iterator[tuple[Turns, Versus]]:
    """Comparisons of two methods, for jobs in which both have finite gradients."""
    for key, points in groups(record.points).items():
        a, b = points.get(ours), points.get(theirs)
        if a is not None and b is not None and a.squared_errors and b.squared_errors:
            yield key, Versus(a, b)


#: Task and summary by the name of the marker.
SUMMARIES: dict[str, tuple[str, Callable[[Record], str]]] = {
    f"{task}-summary": (task, summary)
    for task, summary in (
        (attached.TITLE, _attached),
        (surface.TITLE, _surface),
        (iteration.TITLE, _iteration),
        (media.TITLE, _media),
        (depth.TITLE, _depth),
        (truth.TITLE, _truth),
        (edges.TITLE, _edges),
    )
} | {"wrong-summary": (truth.TITLE, _wrong), "worth-summary": (edges.TITLE, edges.worth)}
