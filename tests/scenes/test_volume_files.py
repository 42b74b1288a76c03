"""Volume files: `.vol` both ways, VDB files as OpenVDB itself wrote them, and one line for what cannot be read.

`data/vdb.zip` was written by OpenVDB 10.0.1 (its Python module, and nanovdb::io::writeGrids). The grid 'density' holds
1 + i + 10 j + 100 k at the indices i < 3, j < 4, k < 5, shifted by (-1, 2, 5), with voxels of 0.5 and the translation
(1, 2, 3); 'heat' holds twice that from index 0 on, at the same place.
"""

from __future__ import annotations

import struct
import sys
import time
import zipfile
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from pathreplay.errors import PathreplayError
from pathreplay.scenes.volume_files import grid_volume, load_volume, save_vol
from places import DATA

VALUES = np.fromfunction(lambda k, j, i: 1 + i + 10 * j + 100 * k, (5, 4, 3), dtype=np.float32)[..., None]

try:
    import tinyvdb  # noqa: F401

    HAS_VDB = True
except ImportError:
    HAS_VDB = False
needs_vdb = pytest.mark.skipif(not HAS_VDB, reason="tinyvdb is not installed (extra vdb; Python 3.11 or newer)")


@pytest.fixture
def files(tmp_path: Path) -> Path:
    with zipfile.ZipFile(DATA / "vdb.zip") as archive:
        archive.extractall(tmp_path)
    return tmp_path


def looked_up(volume: mi.Volume, point: tuple[float, float, float]) -> float:
    it = mi.Interaction3f()
    it.t, it.p = 0.0, mi.Point3f(*point)
    return float(volume.eval_1(it)[0])


def test_vol_is_what_mitsuba_writes_and_reads(tmp_path: Path) -> None:
    data = np.random.default_rng(1).random((4, 3, 2, 3), np.float32)
    mi.VolumeGrid(data).write(str(tmp_path / "mitsuba.vol"))
    assert np.array_equal(load_volume(tmp_path / "mitsuba.vol").data, data)
    save_vol(tmp_path / "ours.vol", data)
    assert np.array_equal(np.array(mi.VolumeGrid(str(tmp_path / "ours.vol"))), data)


def test_vol_keeps_its_place(tmp_path: Path) -> None:
    bounds = ((-1.0, 0.0, 2.0), (1.0, 3.0, 2.5))
    save_vol(tmp_path / "a.vol", VALUES[..., 0], bounds)
    assert load_volume(tmp_path / "a.vol").bounds() == bounds
    stock = mi.load_dict({"type": "gridvolume", "filename": str(tmp_path / "a.vol"), "use_grid_bbox": True})
    ours = mi.load_dict(grid_volume(tmp_path / "a.vol"))
    point = (0.3, 1.1, 2.2)
    assert looked_up(ours, point) == pytest.approx(looked_up(stock, point), rel=1e-5)
    assert looked_up(ours, point) > 1


@needs_vdb
@pytest.mark.parametrize("file", ["two.vdb", "two.nvdb", "raw.nvdb"])
def test_vdb_values_and_place(file: str, files: Path) -> None:
    volume = load_volume(files / file, "density")
    assert volume.name == "density"
    assert np.array_equal(volume.data, VALUES)
    # Index (-1, 2, 5) is the centre of the first voxel: half a voxel of 0.5 before it is the corner.
    assert np.allclose(volume.bounds(), [(0.25, 2.75, 5.25), (1.75, 4.75, 7.75)])


@needs_vdb
@pytest.mark.parametrize("file", ["two.vdb", "two.nvdb"])
def test_grids_are_chosen_by_name(file: str, files: Path) -> None:
    assert np.array_equal(load_volume(files / file, "heat").data, 2 * VALUES)
    with pytest.raises(PathreplayError, match="choose one of: density, heat"):
        load_volume(files / file)
    with pytest.raises(PathreplayError, match="no grid 'dens'; choose one of: density, heat"):
        load_volume(files / file, "dens")


@needs_vdb
def test_a_turned_grid_is_looked_up_where_it_lies(files: Path) -> None:
    volume = mi.load_dict(grid_volume(files / "turned.vdb", filter_type="nearest"))
    # OpenVDB: (i, j, k, 1) times the rows (0, .5, 0, 0), (-.5, 0, 0, 0), (0, 0, .25, 0), (1, 2, 3, 1).
    for i, j, k in [(0, 0, 0), (2, 1, 3), (1, 3, 4)]:
        assert looked_up(volume, (1 - 0.5 * j, 2 + 0.5 * i, 3 + 0.25 * k)) == VALUES[k, j, i, 0]


@needs_vdb
@pytest.mark.parametrize(
    ("file", "grid", "words"),
    [
        ("tile.vdb", None, ["density", "tiles", "0 of 512", ".nvdb"]),
        ("vector.vdb", None, ["velocity", "vec3s", "float"]),
        ("turned.nvdb", None, ["density", "rotated", ".vdb"]),
        ("raw.nvdb", "heat", ["heat", "uncompressed", "zip"]),
        ("damaged.vdb", None, ["damaged.vdb", "cannot be read"]),
        ("damaged.nvdb", None, ["damaged.nvdb", "cannot be read"]),
    ],
)
def test_what_the_reader_gets_wrong_is_refused(file: str, grid: str | None, words: list[str], files: Path) -> None:
    for kind in ("vdb", "nvdb"):
        (files / f"damaged.{kind}").write_bytes((files / f"two.{kind}").read_bytes()[:500])
    with pytest.raises(PathreplayError) as caught:
        load_volume(files / file, grid)
    assert all(word in str(caught.value) for word in words), caught.value
    assert "\n" not in str(caught.value)


def flipped(content: bytes, at: int) -> bytes:
    return content[:at] + bytes([content[at] ^ 0xFF]) + content[at + 1 :]


# Where in the file, from the layout in nanovdb_header: segment 0, first grid's facts 16, its name 192, grids from 381
# on; in raw.nvdb the places of the tree are 672 bytes into the first of them.
@needs_vdb
@pytest.mark.parametrize(
    ("file", "at", "words"),
    [
        ("two.nvdb", 3, "not a NanoVDB file"),
        ("two.nvdb", 11, "has NanoVDB version"),
        ("two.nvdb", 13, "damaged"),  # number of grids
        ("two.nvdb", 18, "damaged"),  # size in memory
        ("two.nvdb", 23, "damaged"),  # the same, beyond any memory
        ("two.nvdb", 25, "damaged"),  # size in the file
        ("two.nvdb", 192, "damaged"),  # not UTF-8
        ("two.nvdb", 700, "damaged"),  # values in zip
        ("two.nvdb", 2424, "damaged"),
        ("raw.nvdb", 381 + 1, "damaged"),  # magic of the grid
        ("raw.nvdb", 381 + 672 + 5, "damaged"),  # where leaves begin
        ("raw.nvdb", 381 + 672 + 34, "damaged"),  # how many there are
    ],
)
def test_damaged_nanovdb_does_not_reach_the_reader(file: str, at: int, words: str, files: Path) -> None:
    (files / "bad.nvdb").write_bytes(flipped((files / file).read_bytes(), at))
    with pytest.raises(PathreplayError, match=words) as caught:
        load_volume(files / "bad.nvdb", "density")
    assert "\n" not in str(caught.value)


@needs_vdb
@pytest.mark.parametrize("far", [399, 2**30])
def test_a_huge_box_is_not_asked_for_voxel_by_voxel(far: int, files: Path) -> None:
    """A million voxels a second: a box of 2^90 would have no end, one of 400 x 400 x 400 takes a minute."""
    content = (files / "raw.nvdb").read_bytes()
    box = struct.pack("<6i", -1, 2, 5, 1, 5, 9)
    assert content.count(box) == 2  # in the segment and in the grid
    (files / "huge.nvdb").write_bytes(content.replace(box, struct.pack("<6i", -1, 2, 5, far, far, far)))
    start = time.perf_counter()
    with pytest.raises(
        PathreplayError, match=rf"spans {far + 2} x .* voxels; crop it to at least 1 and at most \d+ voxels"
    ):
        load_volume(files / "huge.nvdb", "density")
    assert time.perf_counter() - start < 5


@needs_vdb
def test_random_damage_never_ends_the_process(files: Path) -> None:
    """Headers with a few random bytes: read or refused, in one line. (The reader alone died of one in twenty.)"""
    for seed in range(60):
        rng = np.random.default_rng(seed)
        content = bytearray((files / ("two.nvdb", "turned.nvdb", "raw.nvdb")[seed % 3]).read_bytes())
        for at in rng.integers(0, 384, rng.integers(1, 6)):
            content[at] = rng.integers(0, 256)
        (files / "bad.nvdb").write_bytes(bytes(content))
        try:
            load_volume(files / "bad.nvdb", "density")
        except PathreplayError as error:
            assert "\n" not in str(error)


def test_without_the_extra_one_line_says_how_to_get_it(files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tinyvdb", None)
    with pytest.raises(PathreplayError, match=r"two\.vdb needs a VDB reader: pip install 'pathreplay\[vdb\]'"):
        load_volume(files / "two.vdb")


def test_bad_files_get_one_line(tmp_path: Path) -> None:
    save_vol(tmp_path / "good.vol", VALUES)
    good = (tmp_path / "good.vol").read_bytes()
    (tmp_path / "short.vol").write_bytes(good[:-4])
    (tmp_path / "text.vol").write_bytes(b"no volume at all, but longer than the header of one: 48 bytes")
    (tmp_path / "half.vol").write_bytes(good[:4] + b"\x02" + good[5:])
    save_vol(tmp_path / "nan.vol", np.full((2, 2, 2), np.nan))
    (tmp_path / "fog.raw").write_bytes(good)
    for name, words in {
        "short.vol": "3 x 4 x 5 x 1 numbers",
        "text.vol": "not a Mitsuba volume of version 3",
        "half.vol": "encoding 2",
        "nan.vol": "NaN",
        "fog.raw": "unknown extension '.raw'",
        "none.vol": "No volume file",
    }.items():
        with pytest.raises(PathreplayError, match=words):
            load_volume(tmp_path / name)
    with pytest.raises(PathreplayError, match="has no name; omit the name"):
        load_volume(tmp_path / "good.vol", "density")
    with pytest.raises(PathreplayError, match=r"shape \(2, 2\)"):
        save_vol(tmp_path / "flat.vol", np.zeros((2, 2)))
