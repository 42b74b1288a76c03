"""Task `surface`: time and variance of gradients with respect to a texture or to emitters, relative to `prb`."""

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
    """List one job for each row. The Cornell box has the resolution for which the documentation states results."""

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
    """Return one word for the differentiated parameters."""
    return {SKY: "sky", LAMP: "light"}.get(parameters, "texture")


def table(record: Record) -> str:
    """Format each method relative to `prb`, with 95 % intervals."""
    rows = [
        [point.scene, what(point.parameters), method_cell(point), *comparison(point, methods.get("prb"))]
        for methods in groups(record.points).values()
        for point in methods.values()
    ]
    return markdown(
        ["scene", "parameter", "method", "seconds (median)", "time / prb", "variance / prb", "time x variance"], rows
    )
