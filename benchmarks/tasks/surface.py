"""Task `surface`: time and variance of gradients by a texture, and by lights alone, in turn with `prb`."""

from __future__ import annotations

from ..measures.job import Job, Record
from ..tables import comparison, groups, markdown, method_cell

TITLE = "surface"
TAKES = (18, 55)  # seconds on two quiet cores: quick, full
BACK_WALL = ("back.bsdf.reflectance.data",)
FLOOR = ("floor.bsdf.base_color.data",)
METHODS = ("prb", "sweep", "replay", "sobol")
SKY = ("environment.data",)
LAMP = ("light.emitter.radiance.value",)
LIGHTS = ("prb", "auto", "sobol")  # no driver is chosen: where only lights have gradients, one of their own is


def jobs(quick: bool) -> list[Job]:
    """One job for each row; the Cornell box has the size that the claim is made for."""

    def job(scene: str, parameters: tuple[str, ...], methods: tuple[str, ...] = METHODS) -> Job:
        return Job(
            scene=scene,
            parameters=parameters,
            methods=methods,
            max_depth=8,
            rr_depth=5,
            resolution=64 if quick else 128,
            spp=16,
            rounds=4 if quick else 25,
        )

    return [
        job("cornell-box", BACK_WALL),
        job("glossy-environment", FLOOR),
        job("glass-and-diffuse", BACK_WALL),
        job("glossy-environment", SKY, LIGHTS),
        job("cornell-box", LAMP, LIGHTS),
    ]


def what(parameters: tuple[str, ...]) -> str:
    """What is differentiated, in a word."""
    return {SKY: "sky", LAMP: "light"}.get(parameters, "texture")


def table(record: Record) -> str:
    """Each method next to `prb`, with 95 % intervals."""
    rows = [
        [point.scene, what(point.parameters), method_cell(point), *comparison(point, methods.get("prb"))]
        for methods in groups(record.points).values()
        for point in methods.values()
    ]
    return markdown(
        ["scene", "parameter", "method", "seconds (median)", "time / prb", "variance / prb", "time x variance"], rows
    )
