"""Validate the headers of a NanoVDB file, because the library that reads the file crashes on damaged headers.

A file is a sequence of segments. A segment consists of a header of 16 bytes (magic, version, number of grids,
compression), a description of every grid (176 bytes and a name), and the grids. A grid begins with a header of 672
bytes, which is followed by the positions of its tree nodes.
"""

from __future__ import annotations

import struct
import zlib
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import NamedTuple

from pathreplay.errors import PathreplayError

MAGICS = (b"NanoVDB0", b"NanoVDB2")
MAJOR = 32
"""Major version of the format, the upper 11 bits of the version number in the file."""
NONE, ZIP = 0, 1

# Largest compression ratio of zip.
_MOST_PACKED = 1032

_SEGMENT = struct.Struct("<8sIHH")
# The description of a grid: size in memory, size in the file, hash of the name, number of voxels, type of the values,
# class of the grid, and length of the name. Two boxes and the voxel size precede the length of the name. They are
# skipped.
_GRID = struct.Struct("<4Q2I96xI36x")
_GRID_HEADER = 672
# The positions of the tree nodes: four offsets (leaves, lower nodes, upper nodes, root) relative to the start of this
# structure, then three counts (leaves, lower nodes, upper nodes).
_TREE = struct.Struct("<4Q3I")
_FLOAT, _FLOAT_SIZES = 1, (2144, 33856, 270400)


class _Place(NamedTuple):
    grid_size: int
    file_size: int
    kind: int
    begin: int
    codec: int


def require_whole_nanovdb(path: Path) -> bool:
    """Check headers, sizes and tree positions of a NanoVDB file; return whether its first grid is compressed.

    Zip-compressed grids are decompressed, which verifies their checksum. Values are not checked. Links between the
    nodes of an uncompressed tree are not checked either.

    Raises PathreplayError if the file is not NanoVDB, has an unknown version, or is damaged.
    """
    if path.stat().st_size < _SEGMENT.size:
        raise _damaged(path, "its header is truncated")
    try:
        with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as content:
            places = _places(path, content)
            for place in places:
                _require_grid(path, content, place)
            return places[0].codec != NONE
    except (struct.error, UnicodeDecodeError):
        raise _damaged(path, "a header is truncated or contains an invalid name") from None


def _places(path: Path, content: mmap) -> list[_Place]:
    places: list[_Place] = []
    at = 0
    while at < len(content) or not places:
        magic, version, grids, codec = _SEGMENT.unpack_from(content, at)
        if magic not in MAGICS:
            raise PathreplayError(f"Volume {path} is not a NanoVDB file (no 'NanoVDB' at byte {at}); save it as one")
        if version >> 21 != MAJOR:
            raise PathreplayError(f"Volume {path} has NanoVDB version {version >> 21}; save it as version {MAJOR}")
        if not grids:
            raise _damaged(path, "it contains no grid")
        at += _SEGMENT.size
        sizes = []
        for _ in range(grids):
            grid_size, file_size, _, _, kind, _, name = _GRID.unpack_from(content, at)
            content[at + _GRID.size : at + _GRID.size + name].rstrip(b"\0").decode()
            at += _GRID.size + name
            sizes.append((grid_size, file_size, kind))
        for grid_size, file_size, kind in sizes:
            places.append(_Place(grid_size, file_size, kind, at, codec))
            at += file_size
        if at > len(content):
            raise _damaged(path, f"its header describes {at} bytes, and it has {len(content)}")
    return places


def _require_grid(path: Path, content: mmap, place: _Place) -> None:
    data = content[place.begin : place.begin + place.file_size]
    if place.grid_size > _MOST_PACKED * place.file_size:
        raise _damaged(path, f"{place.file_size} bytes cannot decompress to {place.grid_size}")
    if place.codec == ZIP:
        unpacker = zlib.decompressobj()
        try:
            data = unpacker.decompress(data[8:], place.grid_size + 1)
        except zlib.error as error:
            raise _damaged(path, str(error)) from None
    elif place.codec != NONE:
        return  # the reader itself rejects other codecs
    if len(data) != place.grid_size or len(data) < _GRID_HEADER + _TREE.size or data[:7] != b"NanoVDB":
        raise _damaged(path, f"a grid of {place.grid_size} bytes is incomplete")
    *begins, root, leaves, lowers, uppers = _TREE.unpack_from(data, _GRID_HEADER)
    room = len(data) - _GRID_HEADER
    ends = [root + 96]
    if place.kind == _FLOAT:
        counts = (leaves, lowers, uppers)
        ends += [b + n * size for b, n, size in zip(begins, counts, _FLOAT_SIZES, strict=True) if n]
    if max(ends) > room or any(value < _TREE.size for value in (root, *(b for b in begins if b))):
        raise _damaged(path, "its tree extends beyond its end")


def _damaged(path: Path, why: str) -> PathreplayError:
    return PathreplayError(f"Volume {path} cannot be read: it is damaged ({why}); replace it")
