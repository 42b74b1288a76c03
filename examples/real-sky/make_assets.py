"""Write the mesh and texture of a bottle and a sky into examples/real-sky/assets, from checkouts of two repositories.

    python make_assets.py OPENEXR_IMAGES PYRENDER

The sky is ``MultiResolution/KernerEnvLatLong.exr`` of github.com/AcademySoftwareFoundation/openexr-images, and the
bottle is ``examples/models/fuze.obj`` with ``fuze_uv.jpg`` of github.com/mmatl/pyrender.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.platform.backend import set_variant

if TYPE_CHECKING:
    import mitsuba as mi

ASSETS = Path(__file__).parent / "assets"
SKY = "MultiResolution/KernerEnvLatLong.exr"
MESH, TEXTURE = "examples/models/fuze.obj", "examples/models/fuze_uv.jpg"
HEIGHT = 2.0
"""Height of the bottle in scene units."""


def file_of(checkout: Path, name: str, repository: str) -> Path:
    """Return the path of a file of a checkout. Raises PathreplayError if there is no such file."""
    if not (path := checkout / name).is_file():
        raise PathreplayError(f"{path} is no file; give the folder of a checkout of github.com/{repository}")
    return path


def averaged(path: Path, height: int, width: int) -> np.ndarray:
    """Read an image and reduce it to height x width by averages of blocks, which keep the energy of the sun."""
    from pathreplay.inverse.images.io import read_image

    image = read_image(path)[:, :, :3]
    rows, columns, channels = image.shape
    if rows % height or columns % width or channels != 3:
        raise PathreplayError(
            f"{path} is {columns} x {rows} with {channels} channels; use an RGB image whose width is a multiple of "
            f"{width} and whose height is a multiple of {height}"
        )
    return image.reshape(height, rows // height, width, columns // width, 3).mean((1, 3))


def upright(path: Path) -> mi.Mesh:
    """Load a mesh whose axis is z. Return it with a height of `HEIGHT`, its base at y = 0 and y as its axis."""
    import mitsuba as mi

    from pathreplay.scenes.descriptions import errors_as

    def loaded(to_world: mi.ScalarTransform4f) -> mi.Mesh:
        with errors_as(f"Mesh {path} cannot be read"):
            return mi.load_dict({"type": "obj", "filename": str(path), "to_world": to_world})

    move = mi.ScalarTransform4f
    mesh = loaded(move())
    low, high = np.array(mesh.bbox().min), np.array(mesh.bbox().max)
    if not (mesh.has_vertex_texcoords() and high[2] > low[2]):
        raise PathreplayError(f"Mesh {path} has no texture coordinates or no extent along z; use a textured bottle")
    middle = np.array([*(low[:2] + high[:2]) / 2, low[2]])
    scale = float(HEIGHT / (high[2] - low[2]))
    return loaded(move().scale(scale).rotate([1, 0, 0], -90).translate((-middle).tolist()))


def main(openexr_images: Path, pyrender: Path, into: Path = ASSETS) -> None:
    """Write all files, replacing existing ones. Raises PathreplayError if a file of a checkout cannot be used."""
    set_variant()
    from pathreplay.inverse.images.io import exr_bytes

    sky = averaged(file_of(openexr_images, SKY, "AcademySoftwareFoundation/openexr-images"), 64, 128)
    label = averaged(file_of(pyrender, TEXTURE, "mmatl/pyrender"), 256, 256)
    bottle = upright(file_of(pyrender, MESH, "mmatl/pyrender"))
    into.mkdir(parents=True, exist_ok=True)
    (into / "sky.exr").write_bytes(exr_bytes(sky))
    (into / "label.exr").write_bytes(exr_bytes(label))
    bottle.write_ply(str(into / "bottle.ply"))
    print(f"bottle.ply, label.exr and sky.exr in {into}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("openexr_images", type=Path, metavar="OPENEXR_IMAGES", help="checkout of openexr-images")
    parser.add_argument("pyrender", type=Path, metavar="PYRENDER", help="checkout of pyrender")
    given = parser.parse_args()
    try:
        main(given.openexr_images, given.pyrender)
    except PathreplayError as error:
        sys.exit(f"make_assets.py: error: {error}")
