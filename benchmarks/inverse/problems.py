"""The inverse problems by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from .media import cloud
from .outdoors import camera, metal, object_under_sky, texture
from .problem import Problem
from .rooms import glass, mesh, room


@dataclass(frozen=True)
class Kind:
    """A problem for a number of pixels along an image's edge, and the integrators of its plain loops."""

    make: Callable[[int, int], Problem]  # pixels of an edge of images, cells of an edge of textures and grids
    integrators: tuple[str, ...] = ("prb",)
    has_grid: bool = False  # textures or volumes among the unknowns
    few: bool = False  # no more unknown numbers than Levenberg-Marquardt takes
    pixels: int = 24  # of an edge in a full run

    def build(self, pixels: int) -> Problem:
        """Textures and grids have a third more cells along an edge than images have pixels."""
        return self.make(pixels, pixels * 4 // 3)


PROJECTIVE = ("prb_projective",)
"""Where something moves, so that visibility has to be differentiated."""
NO_GRADIENT = ("path",)
"""Central differences, for few numbers."""

PROBLEMS: dict[str, Kind] = {
    "texture under a sky": Kind(texture, has_grid=True, pixels=48),
    "camera: pose and focal length": Kind(camera, PROJECTIVE + NO_GRADIENT, few=True),
    "room: two lamps, four materials": Kind(room, few=True),
    "cloud": Kind(cloud, ("prbvolpath",), has_grid=True),
    "object: albedo and roughness, unknown sky": Kind(object_under_sky, has_grid=True, pixels=48),
    "glass pane: index and normals": Kind(glass, has_grid=True),
    "mesh by shadows": Kind(mesh, PROJECTIVE),
    "metal fitted by principled": Kind(metal, few=True),
}
