"""The inverse problems by name. Textures and grids have as many cells along an axis as images have pixels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from .media import cloud
from .outdoors import camera, metal, object_under_sky, texture
from .problem import Problem
from .rooms import glass, mesh, room


@dataclass(frozen=True)
class Kind:
    """A problem for a number of pixels along an image's edge, and Mitsuba's integrators that can differentiate it."""

    build: Callable[[int], Problem]
    integrators: tuple[str, ...] = ("prb",)
    has_grid: bool = False  # textures or volumes among the unknowns


PROJECTIVE = ("prb_projective",)
"""Where something moves, so that visibility has to be differentiated."""

PROBLEMS: dict[str, Kind] = {
    "texture under a sky": Kind(texture, has_grid=True),
    "camera: pose and focal length": Kind(camera, PROJECTIVE),
    "room: two lamps, four materials": Kind(room),
    "cloud": Kind(cloud, ("prbvolpath",), has_grid=True),
    "object: albedo and roughness, unknown sky": Kind(object_under_sky, has_grid=True),
    "glass pane: index and normals": Kind(glass, has_grid=True),
    "mesh by shadows": Kind(mesh, PROJECTIVE),
    "metal fitted by principled": Kind(metal),
}
