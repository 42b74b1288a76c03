"""A look into Mitsuba's serialized meshes before Mitsuba reads them, which trusts their numbers."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pathreplay.errors import PathreplayError

_MAGIC = 0x041C
_NORMALS, _COORDINATES, _COLOURS, _DOUBLE = 0x0001, 0x0002, 0x0008, 0x2000
_HIGHEST_RATIO = 1032
"""zlib packs no more than this."""


def require_sound_serialized(path: Path, index: Any) -> None:
    """Raise PathreplayError unless the table of shapes fits into the file, and shape ``index`` has its faces' vertices.

    That shape is unpacked, as Mitsuba does it once more. Damage of other kinds is left to Mitsuba, which sees it.
    """
    with path.open("rb") as file:
        head = file.read(4)
        if len(head) < 4 or struct.unpack("<HH", head) not in ((_MAGIC, 3), (_MAGIC, 4)):
            return
        version, size = struct.unpack("<HH", head)[1], path.stat().st_size
        offset = struct.Struct("<Q" if version == 4 else "<I")
        file.seek(max(size - 4, 4))
        if len(last := file.read(4)) < 4:
            return
        (count,) = struct.unpack("<I", last)
        table = size - 4 - offset.size * count
        if count < 1 or table < 4:
            raise PathreplayError(
                f"Mesh {path} of {size} bytes should hold {count} shapes; it is damaged, write it anew"
            )
        if not isinstance(index, int) or not 0 <= index < count:
            return
        file.seek(table + offset.size * index)
        (begin,) = offset.unpack(file.read(offset.size))
        file.seek(min(begin, size) + 4)
        packed = file.read(max(table - begin, 0))
    try:
        _require_sound_faces(path, packed, version)
    except (zlib.error, struct.error, ValueError):
        return


def _require_sound_faces(path: Path, packed: bytes, version: int) -> None:
    head = zlib.decompressobj().decompress(packed, 2**16)
    (flags,) = struct.unpack_from("<I", head)
    at = 4 if version == 3 else head.index(b"\0", 4) + 1
    vertices, faces = struct.unpack_from("<QQ", head, at)
    numbers = 3 + 3 * bool(flags & _NORMALS) + 2 * bool(flags & _COORDINATES) + 3 * bool(flags & _COLOURS)
    begin = at + 16 + vertices * numbers * (8 if flags & _DOUBLE else 4)
    end = begin + 12 * faces
    if not vertices or not faces or vertices >= 2**32 or end > _HIGHEST_RATIO * len(packed):
        return
    content = zlib.decompressobj().decompress(packed, end)
    require_vertices(path, np.frombuffer(content, "<u4", 3 * faces, begin), vertices)


def require_vertices(path: Path, indices: NDArray[Any], vertices: int) -> None:
    """Raise PathreplayError if the faces of a mesh name a vertex that it does not have."""
    low, high = int(indices.min()), int(indices.max())
    if low < 0 or high >= vertices:
        raise PathreplayError(
            f"Mesh {path} has a face with vertex {low if low < 0 else high}, but its {vertices} vertices count from 0 "
            f"to {vertices - 1}; it is damaged, write it anew"
        )
