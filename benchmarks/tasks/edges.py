"""Task `edges`: what the boundary costs beside the interior, and beside Mitsuba's projective sampling.

Time is that of a whole gradient pass. The gradients are not those of the same thing: `prb` and `sweep` leave out edges,
and `prb_projective` a part of them (see docs/edges.md).
"""

from __future__ import annotations

from ..measures.job import Job, Record
from ..tables import comparison, groups, markdown, method_cell

TITLE = "edges"
TAKES = (40, 240)
METHODS = ("prb", "sweep", "film edges", "all edges", "prb_projective")
MOVES = {"glass-and-diffuse": "ball.to_world", "cornell-box": "small-box.vertex_positions"}


def jobs(quick: bool) -> list[Job]:
    """What moves x depth, all methods in turn."""
    return [
        Job(
            scene=scene,
            parameters=(key,),
            methods=METHODS,
            max_depth=depth,
            rr_depth=5,
            resolution=64 if quick else 128,
            spp=16,
            rounds=3 if quick else 10,
        )
        for scene, key in MOVES.items()
        for depth in ((4,) if quick else (2, 6))
    ]


def table(record: Record) -> str:
    """Time next to `prb`."""
    rows = [
        [p.scene, ", ".join(p.parameters), str(p.max_depth), method_cell(p), *comparison(p, methods.get("prb"))[:2]]
        for methods in groups(record.points).values()
        for p in methods.values()
    ]
    return markdown(["scene", "gradient of", "depth", "method", "seconds (median)", "time / prb"], rows)
