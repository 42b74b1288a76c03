"""Files as other programs write them: meshes with and without texture coordinates and normals, pictures, grids."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
from PIL import Image

from pathreplay.inverse.images.io import exr_bytes


@dataclass(frozen=True)
class Patch:
    """A bumpy square over [-1, 1]²: n x n vertices, two triangles for each of the squares between them."""

    positions: np.ndarray
    normals: np.ndarray
    coordinates: np.ndarray
    faces: np.ndarray


def patch(n: int = 5) -> Patch:
    """z = 0.2 cos 2x cos 2y, with its normals, and texture coordinates from 0 to 1."""
    y, x = (axis.ravel() for axis in np.meshgrid(*2 * [np.linspace(-1, 1, n)], indexing="ij"))
    z = 0.2 * np.cos(2 * x) * np.cos(2 * y)
    slopes = 0.4 * np.sin(2 * x) * np.cos(2 * y), 0.4 * np.cos(2 * x) * np.sin(2 * y)
    normals = np.stack([*slopes, np.ones_like(x)], axis=1)
    at = np.arange(n * n).reshape(n, n)
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
    return Patch(
        np.stack([x, y, z], axis=1),
        normals / np.linalg.norm(normals, axis=1, keepdims=True),
        np.stack([(x + 1) / 2, (y + 1) / 2], axis=1),
        np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]),
    )


def write_ply(path: Path, mesh: Patch, *, normals: bool = False, coordinates: bool = False, text: bool = False) -> None:
    """A PLY file, binary (little endian) or as text."""
    columns, names = [mesh.positions], ["x", "y", "z"]
    if normals:
        columns, names = [*columns, mesh.normals], [*names, "nx", "ny", "nz"]
    if coordinates:
        columns, names = [*columns, mesh.coordinates], [*names, "s", "t"]
    rows = np.concatenate(columns, axis=1).astype("<f4")
    head = ["ply", f"format {'ascii' if text else 'binary_little_endian'} 1.0", "comment made by hand"]
    head += [f"element vertex {len(rows)}", *(f"property float {name}" for name in names)]
    head += [f"element face {len(mesh.faces)}", "property list uchar uint vertex_indices", "end_header\n"]
    if text:
        lines = [" ".join(f"{x:.6f}" for x in row) for row in rows] + [f"3 {a} {b} {c}" for a, b, c in mesh.faces]
        path.write_text("\n".join(head) + "\n".join(lines) + "\n")
    else:
        body = b"".join(struct.pack("<B3I", 3, *face) for face in mesh.faces.tolist())
        path.write_bytes("\n".join(head).encode() + rows.tobytes() + body)


def write_obj(path: Path, mesh: Patch, *, normals: bool = False, coordinates: bool = False) -> None:
    """An OBJ file with a material library that does not come along, as is usual."""
    lines = ["# made by hand", "mtllib nowhere.mtl", "o Patch.001"]
    lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in mesh.positions]
    if coordinates:
        lines += [f"vt {u:.6f} {v:.6f}" for u, v in mesh.coordinates]
    if normals:
        lines += [f"vn {x:.6f} {y:.6f} {z:.6f}" for x, y, z in mesh.normals]
    corner = {(False, False): "{0}", (True, False): "{0}/{0}", (False, True): "{0}//{0}", (True, True): "{0}/{0}/{0}"}
    form = corner[coordinates, normals]
    lines += ["s off", *("f " + " ".join(form.format(i + 1) for i in face) for face in mesh.faces)]
    path.write_text("\n".join(lines) + "\n")


def write_serialized(path: Path, mesh: Patch) -> None:
    """Mitsuba's own format, version 4: one compressed mesh in single precision, then where it begins."""
    body = struct.pack("<I", 0x1000) + b"patch\0" + struct.pack("<QQ", len(mesh.positions), len(mesh.faces))
    body += mesh.positions.astype("<f4").tobytes() + mesh.faces.astype("<u4").tobytes()
    path.write_bytes(struct.pack("<HH", 0x041C, 4) + zlib.compress(body) + struct.pack("<QI", 0, 1))


def write_by_mitsuba(path: Path) -> None:
    """A PLY file by Mitsuba's own writer, of a cube with normals and texture coordinates."""
    mesh = mi.load_dict({"type": "cube"})
    mesh.write_ply(str(path))


def waves(height: int, width: int) -> np.ndarray:
    """A smooth colour picture between 0.2 and 0.8, (height, width, 3)."""
    y, x = np.meshgrid(np.arange(height) / height, np.arange(width) / width, indexing="ij")
    return 0.5 + 0.3 * np.stack([np.sin(6 * x), np.cos(5 * y), np.sin(4 * (x + y))], axis=-1)


def write_png(path: Path, picture: np.ndarray, *, bits: int = 8) -> None:
    """An 8-bit colour PNG, or a 16-bit grey one (Pillow writes no 16-bit colour)."""
    if bits == 8:
        Image.fromarray(np.round(picture * 255).astype(np.uint8)).save(path)
    else:
        Image.fromarray(np.round(picture.mean(axis=2) * 65535).astype(np.uint16)).save(path)


def write_environment(path: Path, height: int = 8, width: int = 16) -> None:
    """A sky in OpenEXR, brighter above."""
    path.write_bytes(exr_bytes((0.2 + waves(height, width)).astype(np.float32)))
