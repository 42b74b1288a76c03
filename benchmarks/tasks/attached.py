"""Task `attached`: time of gradients of moving objects relative to `prb`, and memory against depth and paths."""

from __future__ import annotations

from ..measures.job import Job, Record
from ..tables import groups, markdown, method_cell, time_cells
from .depth import memory_or_error

TITLE = "attached"
TAKES = (12, 75)
SCENE = "glass-and-diffuse"  # in which it is timed
TEXTURE = "back.bsdf.reflectance.data"
BALL = "ball.to_world"
BOX = "small-box.vertex_positions"


def jobs(quick: bool) -> list[Job]:
    """List the timings for each moving object and depth, then the memory measurements, each in its own process."""
    timed = [
        Job(
            scene=SCENE,
            parameters=parameters,
            methods=("prb", "sweep"),
            max_depth=depth,
            rr_depth=5,
            resolution=64 if quick else 128,
            spp=16,
            rounds=4 if quick else 10,
        )
        for parameters in (((BALL,),) if quick else ((BALL,), (BOX,), (BALL, TEXTURE)))
        for depth in ((6,) if quick else (6, 16))
    ]
    by_depth = [(depth, 4) for depth in ((8, 128) if quick else (8, 64, 512, 2048))]
    by_paths = [] if quick else [(64, 64), (64, 1024)]
    alone = [
        Job(
            scene="closed-box",
            parameters=(BALL,),
            methods=(method,),
            max_depth=depth,
            rr_depth=depth + 1,
            resolution=16,
            spp=spp,
            rounds=1,
            warmup=1,
            threads=1,
        )
        for depth, spp in by_depth + by_paths
        for method in ("prb", "sweep")
    ]
    return timed + alone


def table(record: Record) -> str:
    """Format times relative to `prb`, which leaves out most of these gradients, then peak memory."""
    timed = [point for point in record.points if point.scene == SCENE]
    rows = [
        [", ".join(p.parameters), str(p.max_depth), method_cell(p), *time_cells(p, methods.get("prb"))]
        for methods in groups(timed).values()
        for p in methods.values()
    ]
    times = markdown(["gradient of", "depth", "method", "seconds (median)", "time / prb"], rows)
    memory = [
        [str(depth), str(paths), *(memory_or_error(methods.get(m)) for m in ("prb", "sweep"))]
        for (_, _, depth, paths), methods in groups(p for p in record.points if p.scene == "closed-box").items()
    ]
    return times + "\n\n" + markdown(["depth", "paths", "prb, MiB", "sweep, MiB"], memory)
