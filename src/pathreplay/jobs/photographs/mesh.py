"""Reads the mesh that the user gives as the geometry of a photographed scene, and writes it for a job."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError, shown
from pathreplay.platform import compat
from pathreplay.platform.files import file_problem
from pathreplay.scenes.descriptions import errors_as

GREY = 0.5
"""Initial reflectance."""
COLOUR = "vertex_color"
"""Attribute with the reflectance of the vertices. Mitsuba gives this name to the colours in a PLY file."""
KINDS = (".ply", ".obj")


@dataclass(frozen=True)
class Proxy:
    """A mesh file, and how its reflectance is stored."""

    path: Path
    textured: bool
    """Whether the mesh has texture coordinates; without them, each vertex has a colour."""

    @property
    def kind(self) -> str:
        """The Mitsuba plugin that reads the stored mesh file."""
        return self.path.suffix.lower()[1:] if self.textured else "ply"

    @property
    def stored(self) -> str:
        """Path of the mesh file, relative to the folder of the job."""
        return f"start/mesh.{self.kind}"

    @property
    def key(self) -> str:
        """Key of the reflectance."""
        return "mesh.bsdf.brdf_0.reflectance.data" if self.textured else f"mesh.{COLOUR}"

    def write(self, folder: Path) -> None:
        """Write the file into a folder; a mesh without texture coordinates gets a colour per vertex."""
        target = folder / f"mesh.{self.kind}"
        if self.textured:
            shutil.copyfile(self.path, target)
            return
        mesh = _loaded(self.path)
        if COLOUR in mi.traverse(mesh):  # the mesh has colours of its own, with 3 or 4 channels
            mesh.remove_attribute(COLOUR)
        mesh.add_attribute(COLOUR, 3, np.full(3 * mesh.vertex_count(), GREY, np.float32))
        mesh.write_ply(str(target))


def read_proxy(path: Path) -> Proxy:
    """Read a PLY or OBJ file. Raises PathreplayError if it cannot be read."""
    if path.suffix.lower() not in KINDS:
        raise PathreplayError(f"mesh {shown(str(path))} is not a PLY or OBJ file; convert it to one of them")
    if problem := file_problem(path):
        raise PathreplayError(f"mesh {path} {problem}; give a PLY or OBJ file")
    data = compat.mesh_arrays(mi.traverse(_loaded(path)))
    assert data is not None
    return Proxy(path, len(data.texcoords) > 0 and bool(np.ptp(data.texcoords, axis=0).min() > 0))


def _loaded(path: Path) -> mi.Mesh:
    with errors_as(f"mesh {path} cannot be read"):
        return mi.load_dict({"type": path.suffix.lower()[1:], "filename": str(path)})
