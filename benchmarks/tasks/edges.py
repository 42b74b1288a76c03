"""Task `edges`: what edges cost, by kind, beside `prb` and beside Mitsuba's projective sampling.

Seconds are those of kernels. The parts of ours, and those of `prb_projective`, are gradients of one thing: of what the
camera sees, or of what surfaces see. Lists of edges are right where a mesh that is black moves before a glow: elsewhere
they leave creases out, and shade the wrong faces (see docs/edges_peers.md).
"""

from __future__ import annotations

import statistics as st

from ..measures.job import Job, Point, Record
from ..measures.methods import RECORDED, TRACED
from ..tables import comparison, groups, markdown, method_cell

TITLE = "edges"
TAKES = (60, 600)
KEY = ("object.vertex_positions",)
INNER, FILM = ("shadow", "silhouette", "ears"), ("black silhouette", "black ears")
VERSUS = (
    ("film edges alone", "edge list"),
    ("inner edges alone", "unguided inner"),
    ("inner edges alone", "projective inner"),
)
"""What is compared with what that finds the same."""
STEPS = tuple(f"{name}, {way}" for name in ("prb", "all edges") for way in (TRACED, RECORDED))
GUIDED = 120
"""Seconds after which `prb_projective` sits out, whose guiding takes most of them."""


def jobs(quick: bool) -> list[Job]:
    """Inner edges, edges on the film, and steps that are recorded; the guided rival in jobs of its own."""
    inner = ("prb", "inner edges alone", "film edges alone", "edges alone", "unguided inner")
    film = ("prb", "film edges alone", "edge list")
    wanted = [(scene, inner, 0.0) for scene in INNER] + [(scene, film, 0.0) for scene in FILM]
    wanted += [(scene, ("prb", "projective inner"), GUIDED) for scene in INNER]
    wanted += [("ears", STEPS, 0.0)]
    return [
        Job(
            scene=scene,
            parameters=KEY,
            methods=methods,
            max_depth=2,
            rr_depth=100,
            resolution=32,
            spp=16 if quick else 64,
            rounds=4 if quick else 6 if patience else 16,
            warm_up=0 if patience else 2,
            patience=patience,
            measure="edges",
        )
        for scene, methods, patience in wanted
    ]


def table(record: Record) -> str:
    """Time next to `prb`, and time x variance next to the rivals; then recorded steps next to their kernels."""
    parts = [point for point in record.points if ", " not in point.method]
    rows = [
        [
            p.scene,
            method_cell(p),
            *comparison(p, methods.get("prb"))[:2],
            *(comparison(p, methods.get(rival))[3] if p.method == ours else "" for ours, rival in VERSUS),
        ]
        for methods in groups(parts).values()
        for p in methods.values()
    ]
    columns_told = [f"time x variance / {rival}" for _, rival in VERSUS]
    header = ["scene", "method", "seconds of kernels (median)", "time / prb", *columns_told]
    steps = {point.method: point for point in record.points if ", " in point.method}
    return markdown(header, rows) + "\n\n" + _steps(steps)


def _steps(steps: dict[str, Point]) -> str:
    """A step by the clock where it was recorded, and its kernels where it was traced."""
    rows = []
    for name in ("prb", "all edges"):
        found = [steps.get(f"{name}, {way}") for way in (RECORDED, TRACED)]
        if all(point is not None and not point.error for point in found):
            clock, kernels = (st.median(point.seconds) for point in found if point is not None)
            rows.append([name, f"{kernels:.3f}", f"{clock:.3f}", f"{clock / kernels:.2f}"])
        else:
            rows.append([name, *(point.error or "" if point else "" for point in found), ""])
    return markdown(["recorded step", "seconds of kernels", "seconds by the clock", "ratio"], rows)
