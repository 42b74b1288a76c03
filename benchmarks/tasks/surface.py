"""Task `surface`: time and variance of a texture's gradient, in turn with `prb`, on three scenes."""

from __future__ import annotations

from ..measures.job import Job, Record
from ..tables import comparison, groups, markdown, method_cell

TITLE = "surface"
TAKES = (12, 40)  # seconds on two quiet cores: quick, full
BACK_WALL = ("back.bsdf.reflectance.data",)
FLOOR = ("floor.bsdf.base_color.data",)
METHODS = ("prb", "sweep", "replay")


def jobs(quick: bool) -> list[Job]:
    """One job for each scene; the Cornell box has the size that the claim is made for."""

    def job(scene: str, parameters: tuple[str, ...]) -> Job:
        return Job(
            scene=scene,
            parameters=parameters,
            methods=METHODS,
            max_depth=8,
            rr_depth=5,
            resolution=64 if quick else 128,
            spp=16,
            rounds=4 if quick else 25,
        )

    return [job("cornell-box", BACK_WALL), job("glossy-environment", FLOOR), job("glass-and-diffuse", BACK_WALL)]


def table(record: Record) -> str:
    """Each method next to `prb`, with 95 % intervals."""
    rows = [
        [point.scene, method_cell(point), *comparison(point, methods.get("prb"))]
        for methods in groups(record.points).values()
        for point in methods.values()
    ]
    return markdown(["scene", "method", "seconds (median)", "time / prb", "variance / prb", "time x variance"], rows)
