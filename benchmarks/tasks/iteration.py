"""Task `iteration`: a complete optimisation step, in the loop of Mitsuba's tutorials and in our loop."""

from __future__ import annotations

from ..measures.job import Job, Record
from ..measures.methods import OWN, USUAL
from ..scenes.media import DENSITY
from ..tables import comparison, groups, markdown, method_cell
from .surface import BACK_WALL, FLOOR

TITLE = "iteration"
TAKES = (12, 165)

SURFACE = (f"prb, {USUAL}", f"prb, {OWN}", f"sweep, {USUAL}", f"sweep, {OWN}", f"sobol, {OWN}")
MEDIA = (f"prbvolpath, {USUAL}", f"score, {USUAL}", f"score, {OWN}", f"sobol, {OWN}")

#: Scene, parameter, methods, depth, largest resolution, rounds (more where the gradient has heavy tails).
ROWS = (
    ("cornell-box, box filter", BACK_WALL, SURFACE, 8, 128, 25),
    ("glossy-environment", FLOOR, SURFACE, 8, 128, 25),
    ("glass-and-diffuse, box filter", BACK_WALL, SURFACE, 8, 128, 75),
    ("cornell-box", BACK_WALL, SURFACE, 8, 128, 15),
    ("cloud", (DENSITY,), MEDIA, 64, 32, 25),
)


def jobs(quick: bool) -> list[Job]:
    """List one job for each scene. Every step starts from the same values, so that gradients of a method compare."""
    return [
        Job(
            scene=scene,
            parameters=parameters,
            methods=methods,
            max_depth=depth,
            rr_depth=5,
            resolution=min(resolution, 64) if quick else resolution,
            spp=16,
            rounds=4 if quick else rounds,
            warmup=2,
            measure="step",
        )
        for scene, parameters, methods, depth, resolution, rounds in (ROWS[:1] if quick else ROWS)
    ]


def table(record: Record) -> str:
    """Format each method relative to the tutorials' loop with Mitsuba's integrator, with 95 % intervals."""
    rows = [
        [point.scene, method_cell(point), *comparison(point, found.get(SURFACE[0]) or found.get(MEDIA[0]))]
        for found in groups(record.points).values()
        for point in found.values()
    ]
    header = ["scene", "method", "seconds (median)", "time ratio", "variance ratio", "time x variance"]
    return markdown(header, rows)
