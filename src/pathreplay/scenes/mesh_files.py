"""Check the indices of PLY files and serialized meshes, because Mitsuba reads them without validation."""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.platform import compat

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: list[tuple[str, ...]]
    """Words of each property in the header: a type and a name, or 'list', two types and a name."""

    @property
    def kinds(self) -> list[str]:
        return [kinds[0] for kinds in self.properties]

    def layout(self, form: str) -> np.dtype[np.void]:
        """Return the NumPy type of one vertex or face. Lists must have three items.

        All numbers of an ASCII file have the type float64.
        """
        order = "<" if form == "binary_little_endian" else ">"
        fields: list[tuple[str, str] | tuple[str, str, int]] = []
        for i, (*kinds, _) in enumerate(self.properties):
            *count, number = ("f8" if form == "ascii" else order + _TYPES[kind] for kind in kinds if kind != "list")
            fields += [(f"count {i}", count[0]), (f"{i}", number, 3)] if count else [(f"{i}", number)]
        return np.dtype(fields)


def require_sound_ply(path: Path) -> None:
    """Raise PathreplayError for a file that is not PLY, has no vertices or faces, or has faces with invalid indices.

    Mitsuba detects other damage itself.
    """
    with path.open("rb") as file:
        if file.read(3) != b"ply":
            raise PathreplayError(f"Mesh {path} is not a PLY file: it does not begin with 'ply'; replace it")
        form, elements = _ply_header(file)
        names = [element.name for element in elements[:2]]
        if form is None or names != ["vertex", "face"] or "list" in elements[0].kinds:
            return
        vertices, faces = elements[0].count, elements[1].count
        if not vertices or not faces:
            has = f"has {vertices} vertices and {faces} faces"
            raise PathreplayError(f"Mesh {path} {has}; add some, or leave the mesh out")
        try:
            indices = _triangles(file, elements, form)
        except (KeyError, ValueError, IndexError):
            return  # Mitsuba may be able to read this file, although the function `_triangles` is not
    if indices is not None:
        _require_vertices(path, indices, vertices)


def _ply_header(file: BinaryIO) -> tuple[str | None, list[_Element]]:
    form, elements = None, []
    for _ in range(1000):
        words = file.readline(4096).decode("latin-1").split()
        if words[:1] == ["format"] and len(words) > 1:
            form = words[1]
        elif words[:1] == ["element"] and len(words) == 3 and re.fullmatch(r"\d+", words[2]):
            elements.append(_Element(words[1], int(words[2]), []))
        elif words[:1] == ["property"] and len(words) > 2 and elements:
            elements[-1].properties.append(tuple(words[1:]))
        elif words[:1] == ["end_header"]:
            return form, elements
    return None, []


def _triangles(file: BinaryIO, elements: list[_Element], form: str) -> np.ndarray | None:
    """Read the vertex indices (n, 3). Return None if data are missing or a face is not a triangle.

    Mitsuba rejects files with these defects.
    """
    vertex, face = (element.layout(form) for element in elements[:2])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # NumPy warns if text follows the numbers
        text = form == "ascii"
        data = np.fromfile(file, np.float64, sep=" ") if text else np.memmap(file, np.uint8, "r", file.tell())
    skipped, faces = vertex.itemsize * elements[0].count, elements[1].count
    if data.nbytes < skipped + face.itemsize * faces:
        return None
    entries = np.frombuffer(data, face, faces, skipped)
    at = elements[1].kinds.index("list")
    return entries[f"{at}"] if (entries[f"count {at}"] == 3).all() else None


# Maps the first bytes of a serialized mesh file (version 3 or 4) to the size in bytes of an entry of the table of
# shapes, which is at the end of the file.
_ENTRIES = {b"\x1c\x04\x03\0": 4, b"\x1c\x04\x04\0": 8}


def require_sound_serialized(path: Path, index: object) -> None:
    """Raise PathreplayError unless the table of shapes fits into the file and shape ``index`` has valid vertex indices.

    Mitsuba detects other damage itself.
    """
    with path.open("rb") as file:
        entry, size = _ENTRIES.get(file.read(4)), path.stat().st_size
        file.seek(max(size - 4, 4))
        last = file.read(4)
    if entry is None or len(last) < 4:
        return
    count = int.from_bytes(last, "little")
    if count < 1 or size - 4 - entry * count < 4:
        raise PathreplayError(
            f"Mesh {path} of {size} bytes should contain {count} shapes; it is damaged, write it again"
        )
    try:
        # With face normals, Mitsuba does not compute vertex normals. To compute them, Mitsuba would use the unchecked
        # indices.
        description = {"type": "serialized", "filename": str(path), "shape_index": index, "face_normals": True}
        mesh = mi.load_dict(description)
    except RuntimeError:
        return
    data = compat.mesh_arrays(mi.traverse(mesh))
    if data is not None and mesh.vertex_count() and mesh.face_count():
        _require_vertices(path, data.faces, mesh.vertex_count())


def _require_vertices(path: Path, indices: np.ndarray, vertices: int) -> None:
    """Raise PathreplayError if a face refers to a vertex that does not exist."""
    low, high = int(indices.min()), int(indices.max())
    if low < 0 or high >= vertices:
        raise PathreplayError(
            f"Mesh {path} has a face with vertex {low if low < 0 else high}, but its {vertices} vertices are numbered "
            f"0 to {vertices - 1}; it is damaged, write it again"
        )
