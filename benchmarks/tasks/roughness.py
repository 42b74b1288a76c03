"""Task `roughness`: time and variance of gradients with respect to the roughness of a metal ball, relative to `prb`."""

from __future__ import annotations

from ..measures.job import Job, Record
from ..scenes.surfaces import METAL_SCENES
from ..tables import comparison, groups, markdown

TITLE = "roughness"
TAKES = (8, 126)  # seconds on two quiet cores: quick, full
KEY = "ball.bsdf.alpha.value"
METHODS = ("prb", "sweep", "sobol")


def jobs(quick: bool) -> list[Job]:
    """List one job for each kind of light and roughness."""
    return [
        Job(
            scene=scene,
            parameters=(KEY,),
            methods=METHODS,
            max_depth=6,
            rr_depth=5,
            resolution=16 if quick else 64,
            spp=16,
            rounds=4 if quick else 64,
        )
        for scene in (list(METAL_SCENES)[:1] if quick else METAL_SCENES)
    ]


def table(record: Record) -> str:
    """Format our methods relative to `prb`, with 95 % intervals."""
    rows = [
        [*key.scene.split(", "), name, *comparison(methods[name], methods.get("prb"))[1:]]
        for key, methods in groups(record.points).items()
        for name in METHODS[1:]
        if name in methods
    ]
    return markdown(["light", "roughness", "method", "time / prb", "variance / prb", "time x variance"], rows)
