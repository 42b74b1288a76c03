"""Task `truth`: compares our derivatives and Mitsuba's with finite differences of Mitsuba's path tracers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..measures.job import Job, Point, Record
from ..tables import groups, markdown

TITLE = "truth"
TAKES = (18, 290)

STEPS = ("finite differences", "half steps")
SURFACE = ("sweep", "replay", "forward", "prb", "prb_basic")
MEDIA = ("score", "listing", "forward", "prbvolpath")

Where = Literal["everywhere", "full", "empty"]


@dataclass(frozen=True)
class Cell:
    """One derivative of a weighted image, with respect to one parameter along one direction."""

    name: str
    scene: str  # in truth_scenes.py
    key: str
    room: Literal["surfaces", "media"] = "surfaces"
    depth: int = 5
    step: float | None = None  # of the differences; None: a hundredth of the parameter
    where: Where = "everywhere"  # entries that move: those that are not zero, or those that are
    spp: int = 128
    reference_spp: int = 512


OBJECT, MEDIUM = "object.bsdf.", "object.interior_medium."
DENSITY, ALBEDO = MEDIUM + "sigma_t.data", MEDIUM + "albedo.data"


def _medium(name: str, scene: str, key: str, step: float, where: Where = "everywhere", spp: int = 64) -> Cell:
    """Create a cell of a scene with media.

    Delta tracking makes new random decisions at every step size h, so that its noise does not decrease with h. Steps
    are therefore large.
    """
    return Cell(name, scene, key, "media", 4, step, where, spp, reference_spp=256)


CELLS = {
    cell.name: cell
    for cell in (
        Cell("texture", "textured room", OBJECT + "reflectance.data"),
        Cell("black texture", "black room", OBJECT + "reflectance.data"),
        Cell("area light", "textured room", "light.emitter.radiance.value"),
        Cell("environment", "plastic ball", "sky.data"),
        Cell("plastic, diffuse part", "plastic ball", OBJECT + "diffuse_reflectance.value"),
        Cell("rough plastic, diffuse part", "rough plastic ball", OBJECT + "diffuse_reflectance.value"),
        Cell("rough metal, roughness", "rough metal ball", OBJECT + "alpha.value", spp=512),  # rare large samples
        Cell("principled, roughness", "principled ball", OBJECT + "roughness.value"),
        Cell("glass, index", "glass ball", OBJECT + "eta"),
        Cell("rough glass, specular part", "rough glass ball", OBJECT + "specular_transmittance.value"),
        Cell("glass ball that moves", "glass ball", "object.to_world"),
        Cell("camera that moves", "waves", "camera.to_world"),
        _medium("smooth density", "smooth cloud", DENSITY, 0.1),
        _medium("constant density", "even cloud", DENSITY, 0.1),
        _medium("binary density, full voxels", "checkered cloud", DENSITY, 0.1, "full", 128),
        _medium("binary density, empty voxels", "checkered cloud", DENSITY, 0.1, "empty", 128),
        _medium("chromatic density", "coloured cloud", DENSITY, 0.1),
        _medium("albedo", "smooth cloud", ALBEDO, 0.1),
        _medium("black albedo", "black cloud", ALBEDO, 0.1),
        _medium("phase function, g", "forward cloud", MEDIUM + "phase_function.g", 0.1),
        _medium("homogeneous density", "fog", MEDIUM + "sigma_t.value.value", 0.1),
        _medium("density over a lit floor", "cloud on a floor", DENSITY, 0.1),
        _medium("density around the camera", "camera in a cloud", "fog.sigma_t.data", 0.1),
        _medium("index of glass around fog", "fog in glass", OBJECT + "eta", 0.05),
    )
}
QUICK = ("plastic, diffuse part", "constant density", "binary density, empty voxels")


def jobs(quick: bool) -> list[Job]:
    """List one job for each cell: finite differences with both step sizes and all methods, in alternation."""
    return [
        Job(
            scene=cell.name,
            parameters=(cell.key,),
            methods=STEPS + (MEDIA if cell.room == "media" else SURFACE),
            max_depth=cell.depth,
            rr_depth=3,
            resolution=16,
            spp=cell.spp,
            rounds=6 if quick else 12,
            warmup=0,
            measure="truth",
        )
        for cell in CELLS.values()
        if not quick or cell.name in QUICK
    ]


def table(record: Record) -> str:
    """Format a table for surfaces and a table for media: derivative, z-score, and the verdict unless it is a pass.

    Error messages of methods are only in the record.
    """
    parts = []
    for room, methods in (("surfaces", SURFACE), ("media", MEDIA)):
        rows = [
            [str(scene), *(told(found.get(method)) for method in (STEPS[1], *methods))]
            for (scene, *_), found in groups(record.points).items()
            if CELLS[str(scene)].room == room
        ]
        if rows:
            parts.append(markdown([room, "finite differences", *methods], rows))
    return "\n\n".join(parts)


def told(point: Point | None) -> str:
    """Format a derivative, and its verdict unless it is a pass."""
    if point is None:
        return ""
    if point.error:
        return "raises"
    values = np.asarray(point.values)
    if not np.isfinite(values).all():
        return f"**{np.count_nonzero(~np.isfinite(values))} of {values.size} not finite**"
    text = f"{values.mean():+.4f}"
    if point.z is None:
        return f"{text} ± {values.std(ddof=1) / np.sqrt(values.size):.4f}"
    text += f" (z {point.z:+.1f})"
    return text if point.verdict in ("pass", "zero") else f"{text} **{point.verdict}**"
