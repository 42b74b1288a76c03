"""Short tables for pages that tell the story and not the details: marked `<!-- begin TASK-summary -->` there."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping

from .measures.estimates import cost_ratio, efficiency, mean_ratio, time_ratio
from .measures.job import Point, Record
from .tables import groups, markdown
from .tasks import attached, depth, iteration, media, surface, truth


def _surface(record: Record) -> str:
    """The sweep next to `prb`."""
    rows = []
    for (scene, *_), found in groups(record.points).items():
        if pair := _pair(found, "sweep", "prb"):
            ours, rival = pair
            times = time_ratio(ours.seconds, rival.seconds)
            rows.append([str(scene), str(times), str(mean_ratio(ours.squared_errors, rival.squared_errors))])
    return markdown(["gradient of a texture, sweep / prb", "time", "variance"], rows)


def _attached(record: Record) -> str:
    """The sweep next to `prb`, which leaves out most of these gradients."""
    rows = []
    for (scene, parameters, max_depth, *_), found in groups(record.points).items():
        if scene == attached.SCENE and (pair := _pair(found, "sweep", "prb")):
            times = time_ratio(*(point.seconds for point in pair))
            rows.append([", ".join(parameters), str(max_depth), str(times)])  # type: ignore[arg-type]
    return markdown(["gradient of what moves, sweep / prb", "depth", "time"], rows)


def _iteration(record: Record) -> str:
    """Our own loop next to the usual one with Mitsuba's integrator."""
    rows = []
    for (scene, *_), found in groups(record.points).items():
        for theirs, *_, own in (iteration.SURFACE, iteration.MEDIA):
            if pair := _pair(found, own, theirs):
                ours, rival = pair
                times, errors = (ours.seconds, rival.seconds), (ours.squared_errors, rival.squared_errors)
                rows.append([str(scene), str(time_ratio(*times)), str(cost_ratio(times, errors))])
    return markdown(["optimisation step, relative to Mitsuba's", "time", "time at equal variance"], rows)


def _media(record: Record) -> str:
    """How many times less (time x variance) the default needs than `prbvolpath`."""
    rows = []
    for (scene, parameters, *_), found in groups(record.points).items():
        if pair := _pair(found, "score", media.RIVAL):
            ours, rival = pair
            gain = efficiency((ours.seconds, rival.seconds), (ours.squared_errors, rival.squared_errors))
            what = media.WHAT[parameters[0]]  # type: ignore[index]
            rows.append([f"{what}: {scene}", str(gain)])
    return markdown(["gradient of media", "time x variance, prbvolpath / pathreplay"], rows)


def _depth(record: Record) -> str:
    """Exponent of time and growth of memory from the smallest depth to the largest, by scene and method."""
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
    """How many cells each method gets right."""
    counts: dict[str, Counter[str]] = {}
    for point in record.points:
        if point.method not in truth.STEPS:
            verdict = "raises" if point.error else point.verdict or "not finite"
            counts.setdefault(point.method, Counter())[{"zero": "pass"}.get(verdict, verdict)] += 1
    verdicts = ["pass", "fail", "inconclusive", "raises"]
    rows = [[method, str(sum(c.values())), *(str(c[v]) for v in verdicts)] for method, c in counts.items()]
    return markdown(["gradient against finite differences", "cells", *verdicts], rows)


def _wrong(record: Record) -> str:
    """Gradients of media that `prbvolpath` has wrong, next to ours."""
    rows = []
    for (scene, *_), found in groups(record.points).items():
        theirs = found.get(media.RIVAL)
        if theirs is not None and theirs.verdict == "fail":
            rows.append([str(scene), *(truth.told(found.get(name)) for name in (truth.STEPS[1], "score", media.RIVAL))])
    return markdown(["gradient by", "finite differences of `volpath`", "`pathreplay`", "`prbvolpath`"], rows)


def _pair(found: Mapping[str, Point], ours: str, theirs: str) -> tuple[Point, Point] | None:
    """Both methods, if both have come to an end with finite gradients."""
    a, b = found.get(ours), found.get(theirs)
    if a is None or b is None or not (a.squared_errors and b.squared_errors):
        return None
    return a, b


#: By the name of its marker: the task, and its summary.
SUMMARIES: dict[str, tuple[str, Callable[[Record], str]]] = {
    f"{task}-summary": (task, summary)
    for task, summary in (
        (attached.TITLE, _attached),
        (surface.TITLE, _surface),
        (iteration.TITLE, _iteration),
        (media.TITLE, _media),
        (depth.TITLE, _depth),
        (truth.TITLE, _truth),
    )
} | {"wrong-summary": (truth.TITLE, _wrong)}
