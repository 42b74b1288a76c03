"""Read and write volume files: Mitsuba's `.vol`, and OpenVDB and NanoVDB through the package tinyvdb (extra `vdb`).

The values of a grid are samples at the centres of its voxels, as in Mitsuba's `gridvolume`. A sparse grid is converted
to a dense grid over the bounding box of its active voxels. Inactive voxels in this box have the background value.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

from pathreplay.errors import PathreplayError
from pathreplay.platform.files import file_problem
from pathreplay.scenes.nanovdb_header import require_whole_nanovdb
from pathreplay.types import SceneDict

Bounds = tuple[tuple[float, float, float], tuple[float, float, float]]

UNIT_CUBE: Bounds = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))

# 'VOL' and version 3, encoding (1: float32), size in x, y, z, number of channels, and bounding box.
_VOL_MAGIC = b"VOL\x03"
_VOL_HEADER = struct.Struct("<4s5i6f")
_FLOAT32 = 1

# Largest number of voxels of a grid: 4 GiB of float32. The bounding box of a larger grid is probably wrong.
_MOST_VOXELS = 2**30
# Largest number of voxels of a NanoVDB grid. Reading them one by one takes half a minute, at a million per second.
_MOST_ASKED_FOR = 2**25

# Largest absolute value of a voxel. At higher extinctions, free paths are far shorter than the resolution of single
# precision.
_LARGEST = 1e12


@dataclass(frozen=True)
class Volume:
    """A dense grid: ``data`` of shape (z, y, x, channels), float32, and its position."""

    data: NDArray[np.float32]
    to_world: NDArray[np.float64]
    """4 x 4 matrix that maps the unit cube, which ``data`` fills, to the world space of the file."""
    name: str
    """Name of the grid in the file; empty for `.vol`."""

    def bounds(self) -> Bounds:
        """Return the minimum and maximum corner of the volume's bounding box in world space."""
        corners = np.array([[x, y, z, 1] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) @ self.to_world.T
        (x, y, z), (X, Y, Z) = corners[:, :3].min(axis=0).tolist(), corners[:, :3].max(axis=0).tolist()
        return (x, y, z), (X, Y, Z)


def load_volume(path: str | Path, grid: str | None = None) -> Volume:
    """Read a volume from a `.vol`, `.vdb` or `.nvdb` file.

    ``grid`` names one of several grids in a VDB file; without it the file must contain exactly one.

    Raises PathreplayError if the file or grid does not exist, the format is unknown or damaged, values are not float,
    the extra `vdb` is missing, or the reader would return wrong values (see docs/volumes.md).
    """
    path = Path(path)
    read = {".vol": _read_vol, ".vdb": _read_vdb, ".nvdb": _read_nvdb}.get(path.suffix.lower())
    if read is None:
        raise PathreplayError(
            f"Volume {path} has the unknown extension '{path.suffix}'; give a .vol, .vdb or .nvdb file"
        )
    if problem := file_problem(path):
        raise PathreplayError(f"No volume file {path}: it {problem}; correct the path")
    volume = read(path, grid)
    if not np.isfinite(volume.data).all():
        raise PathreplayError(f"Volume {path} holds NaN or infinite values; repair it first")
    _require_small(path, volume.data)
    return volume


def _require_small(path: Path, data: NDArray[np.float32]) -> None:
    if (extreme := float(max(data.max(), -data.min()))) > _LARGEST:
        raise PathreplayError(
            f"Volume {path} holds values up to {extreme:g}, in which paths would never end; scale it below {_LARGEST:g}"
        )


def save_vol(path: str | Path, data: np.ndarray, bounds: Bounds = UNIT_CUBE) -> None:
    """Write a grid of shape (z, y, x) or (z, y, x, channels) as a Mitsuba `.vol` file (version 3, float32)."""
    Path(path).write_bytes(vol_bytes(data, bounds))


def vol_bytes(data: np.ndarray, bounds: Bounds = UNIT_CUBE) -> bytes:
    """Encode a grid as a `.vol` file; ``bounds`` is the box of the grid, which Mitsuba uses if `use_grid_bbox` is set.

    Raises PathreplayError for data that have neither three nor four dimensions, or no voxels.
    """
    grid = data[..., None] if data.ndim == 3 else data
    if grid.ndim != 4 or not grid.size:
        raise PathreplayError(
            f"Volume of shape {data.shape}; give the shape (z, y, x) or (z, y, x, channels) without zeros"
        )
    z, y, x, channels = grid.shape
    header = _VOL_HEADER.pack(_VOL_MAGIC, _FLOAT32, x, y, z, channels, *bounds[0], *bounds[1])
    return header + np.ascontiguousarray(grid, "<f4").tobytes()


def vol_bounds(vol: bytes) -> Bounds:
    """Return the box in the header of a `.vol` file, which Mitsuba uses if `use_grid_bbox` is set."""
    x, y, z, X, Y, Z = _VOL_HEADER.unpack_from(vol)[6:]
    return (x, y, z), (X, Y, Z)


def grid_volume(path: str | Path, grid: str | None = None, **options: object) -> SceneDict:
    """Describe a volume file as a `gridvolume` for a scene dictionary, positioned in the world space of the file.

    ``options`` are properties of the plugin, such as ``filter_type``, ``wrap_mode`` and ``raw``. The option
    ``to_world`` replaces the transform in the file. The values are differentiable, with the key ``….data``. The
    position is not differentiable. A Mitsuba variant must be active.
    """
    volume = load_volume(path, grid)
    return {
        "type": "gridvolume",
        "grid": mi.VolumeGrid(np.ascontiguousarray(volume.data)),
        "to_world": mi.ScalarTransform4f(volume.to_world),
        **options,
    }


def require_whole_vol(path: Path) -> None:
    """Raise PathreplayError if a `.vol` file is empty or truncated, or if its channels or values are not supported.

    Mitsuba reports other damage.
    """
    if (header := _vol_header(path)) is None:
        return
    encoding, *shape = header[:5]
    if encoding == _FLOAT32 and (min(shape) < 1 or path.stat().st_size < _VOL_HEADER.size + 4 * math.prod(shape)):
        raise _wrong_length(path, shape)
    if shape[3] not in _CHANNELS:
        raise PathreplayError(f"Volume {path} has {shape[3]} channels, and scenes need 1, 3 or 6; convert it")
    if encoding == _FLOAT32:
        _require_small(path, np.memmap(path, "<f4", "r", _VOL_HEADER.size, math.prod(shape)))


_CHANNELS = (1, 3, 6)
"""Numbers of channels of scalars, colours, and the parameters of SGGX phase functions."""


def _vol_header(path: Path) -> tuple[Any, ...] | None:
    """Read encoding, size and box of a `.vol` file; return None for another format or a truncated header."""
    with path.open("rb") as file:
        header = file.read(_VOL_HEADER.size)
    whole = len(header) == _VOL_HEADER.size and header.startswith(_VOL_MAGIC)
    return _VOL_HEADER.unpack(header)[1:] if whole else None


def _wrong_length(path: Path, shape: list[int]) -> PathreplayError:
    numbers, size = " x ".join(map(str, shape)), path.stat().st_size
    return PathreplayError(
        f"Volume {path} should contain {numbers} numbers and has {size} bytes; it is damaged, replace it"
    )


def _read_vol(path: Path, grid: str | None) -> Volume:
    if grid is not None:
        raise PathreplayError(f"Volume {path} has no grid '{grid}': the grid of a .vol file has no name; omit the name")
    if (header := _vol_header(path)) is None:
        raise PathreplayError(f"Volume {path} is not a Mitsuba volume of version 3; write it with mi.VolumeGrid.write")
    encoding, x, y, z, channels, *box = header
    if encoding != _FLOAT32:
        raise PathreplayError(f"Volume {path} has encoding {encoding}; write it as float32 (encoding 1)")
    if min(x, y, z, channels) < 1 or path.stat().st_size != _VOL_HEADER.size + 4 * x * y * z * channels:
        raise _wrong_length(path, [x, y, z, channels])
    values = np.fromfile(path, "<f4", offset=_VOL_HEADER.size).astype(np.float32)
    return Volume(values.reshape(z, y, x, channels), _scaled(np.subtract(box[3:], box[:3]), box[:3]), "")


def _scaled(scale: Iterable[float], translation: ArrayLike) -> NDArray[np.float64]:
    """Return the 4 x 4 matrix (for column vectors) that scales along the axes, then translates."""
    matrix = np.diag([*map(float, scale), 1.0])
    matrix[:3, 3] = translation
    return matrix


def _read_vdb(path: Path, grid: str | None) -> Volume:
    with _vdb_reader(path) as tinyvdb, tinyvdb.open(str(path)) as file:
        index = _chosen(path, grid, [file.grid_name(i) for i in range(file.grid_count)])
        file.read_grids()
        source = file.grid(index)
        where = f"Grid '{source.name}' of {path}"
        if source.type_name.split("_")[1:2] != ["float"]:
            raise PathreplayError(f"{where} is of type {source.type_name}; only grids of float can be read")
        sparse = source.to_sparse()
        at = np.frombuffer(sparse["coords"], np.int32).reshape(-1, 3)
        _require_all_voxels(where, source, len(at))
        if not len(at):
            raise PathreplayError(f"{where} has no active voxel; choose another grid")
        low, high = at.min(axis=0), at.max(axis=0)
        data = np.full(_size(where, low, high), source.float_background(), np.float32)
        data[tuple((at - low).T)] = np.frombuffer(sparse["values"], np.float32)
        return _placed(data, _index_to_world(source.transform), low, source.name)


def _require_all_voxels(where: str, source: Any, read: int) -> None:
    """Raise PathreplayError for active tiles, which tinyvdb 0.9 does not read and which would become background."""
    nodes = (source.tree.node(i) for i in range(source.tree.num_nodes))
    tiles = sum(node.active_voxel_count for node in nodes if node.type == "internal")
    active = source.metadata.get("file_voxel_count", read)
    if tiles or active != read:
        raise PathreplayError(
            f"{where} stores constant regions as tiles, which the reader skips ({read} of {active} voxels read); "
            "voxelise the active tiles, or save it as .nvdb"
        )


def _index_to_world(transform: SceneDict) -> NDArray[np.float64]:
    """Return the index-to-world map as a matrix for column vectors."""
    if "affine" in transform["type"]:
        return np.array(transform["matrix"]).T  # OpenVDB uses row vectors
    return _scaled(transform["scale"], transform["translation"])


def _read_nvdb(path: Path, grid: str | None) -> Volume:
    with _vdb_reader(path):
        from tinyvdb._tinyvdb_nanovdb import NanoVDBFile

        packed = require_whole_nanovdb(path)
        file = NanoVDBFile(str(path))
        index = _chosen(path, grid, [file.grid_name(i) for i in range(file.grid_count())])
        where = f"Grid '{file.grid_name(index)}' of {path}"
        if file.grid_type(index) != "Float":
            raise PathreplayError(f"{where} is of type {file.grid_type(index)}; only grids of Float can be read")
        # In uncompressed files, tinyvdb 0.9 returns wrong values for all grids except the first.
        if index > 0 and not packed:
            raise PathreplayError(
                f"{where} is uncompressed and not the first of its file, which cannot be read; save it with zip"
            )
        low, high = (np.array(corner, np.int64) for corner in file.bbox(index))
        shape = _size(where, low, high, _MOST_ASKED_FOR)
        voxel = np.array([file.voxel_size(index, axis) for axis in range(3)])
        first, last = (np.array(corner) for corner in file.world_bbox(index))
        # tinyvdb does not expose the index-to-world matrix. If this matrix does not rotate or shear, the extent of the
        # world box is the number of voxels along each axis times the voxel size.
        if not np.allclose(last - first, voxel * shape, rtol=1e-4):
            raise PathreplayError(f"{where} is rotated or sheared in its world, which cannot be read; save it as .vdb")
        x, y, z = (range(a, b + 1) for a, b in zip(low.tolist(), high.tolist(), strict=True))
        values = (file.get(index, i, j, k) for i in x for j in y for k in z)
        data = np.fromiter(values, np.float32, int(np.prod(shape))).reshape(shape)
        # The world box extends from the lower corner of the first voxel to the upper corner of the last.
        return _placed(data, _scaled(voxel, first - low * voxel), low, file.grid_name(index))


@contextmanager
def _vdb_reader(path: Path) -> Iterator[ModuleType]:
    try:
        import tinyvdb
    except ImportError:
        raise PathreplayError(
            f"Volume {path} needs a VDB reader: pip install 'pathreplay[vdb]' (Python 3.11 or newer), "
            "or convert it to .vol"
        ) from None
    try:
        yield tinyvdb
    except (tinyvdb.VDBError, OSError, UnicodeDecodeError) as error:
        raise PathreplayError(f"Volume {path} cannot be read: {error}; replace it, or save it with zip") from None


def _chosen(path: Path, grid: str | None, names: list[str]) -> int:
    if grid is None and len(names) == 1:
        return 0
    if grid not in names:
        asked = "needs the name of a grid" if grid is None else f"has no grid '{grid}'"
        raise PathreplayError(f"Volume {path} {asked}; choose one of: {', '.join(names)}")
    return names.index(grid)


def _size(where: str, low: np.ndarray, high: np.ndarray, most: int = _MOST_VOXELS) -> tuple[int, ...]:
    """Return the number of voxels along x, y, z of an index box, given its first and last voxel."""
    shape = tuple(int(n) for n in np.asarray(high, np.int64) - low + 1)
    if min(shape) < 1 or np.prod(shape, dtype=np.float64) > most:
        spans = " x ".join(map(str, shape))
        raise PathreplayError(f"{where} spans {spans} voxels; crop it to at least 1 and at most {most} voxels")
    return shape


def _placed(data: NDArray[np.float32], index_to_world: NDArray[np.float64], low: np.ndarray, name: str) -> Volume:
    """Create the volume of ``data``, an array with axes x, y, z whose first voxel has the index ``low``.

    An index (i, j, k) denotes the centre of a voxel.
    """
    box = _scaled(data.shape, low - 0.5)
    return Volume(np.ascontiguousarray(data.transpose(2, 1, 0)[..., None]), index_to_world @ box, name)
