"""Task `startup`: seconds until a new process has computed its first gradients, of a texture and of a mesh."""

from __future__ import annotations

import statistics as st

from ..measures.job import Job, Record
from ..measures.methods import STAGES
from ..tables import markdown

TITLE = "startup"
TAKES = (60, 240)
PARAMETERS = {
    "back.bsdf.reflectance.data": ("prb", "sweep"),
    "small-box.vertex_positions": ("unguided prb_projective", "boundary and interior"),
}
"""Methods by parameter. The edges of the mesh move with its vertices. By default, `prb_projective` guides its samples,
which takes minutes here."""
MEASURES = ("cold start", "warm start")
"""With an empty and with a filled kernel cache."""


def jobs(quick: bool) -> list[Job]:
    """List the jobs with an empty and a filled kernel cache; each method has its own process in each round."""
    return [
        Job(
            scene="cornell-box",
            parameters=(parameter,),
            methods=tuple(f"{method}, {stage}" for stage in STAGES for method in methods),
            max_depth=8,
            rr_depth=5,
            resolution=64,
            spp=16,
            rounds=1 if quick else 5,
            warmup=1,
            measure=measure,
        )
        for parameter, methods in PARAMETERS.items()
        for measure in MEASURES
    ]


def table(record: Record) -> str:
    """Format seconds by parameter, kernel cache and stage, with the fastest and the slowest process in brackets."""
    rows = []
    for parameter, methods in PARAMETERS.items():
        for measure in MEASURES:
            found = {p.method: p for p in record.points if (p.parameters, p.measure) == ((parameter,), measure)}
            for method in methods:
                points = [found.get(f"{method}, {stage}") for stage in STAGES]
                cells = ("" if p is None else p.error or _seconds(p.seconds) for p in points)
                rows.append([parameter, measure, method, *cells])
    return markdown(["parameter", "kernel cache", "method", *(f"{stage}, s" for stage in STAGES)], rows)


def _seconds(seconds: tuple[float, ...]) -> str:
    return f"{st.median(seconds):.2f} [{min(seconds):.2f}, {max(seconds):.2f}]"
