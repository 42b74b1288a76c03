"""Files that would end the process: one line instead, before Mitsuba reads them. What is sound loads as before."""

from __future__ import annotations

import os
import struct
from collections.abc import Sequence
from pathlib import Path

import mitsuba as mi
import pytest

from pathreplay.errors import PathreplayError
from pathreplay.scenes.loading import load_scene
from pathreplay.scenes.scene_files import DEEPEST

CORNERS = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 0.0), (0.0, 1.0, 0.0)]
FORMATS = ("ascii", "binary_little_endian", "binary_big_endian")


def ply(faces: Sequence[tuple[int, ...]], form: str) -> bytes:
    """Four corners and these faces; each face ends with a property of its own."""
    head = (
        f"ply\nformat {form} 1.0\ncomment by hand\nelement vertex 4\nproperty float x\nproperty float y\n"
        f"property float z\nelement face {len(faces)}\nproperty list uchar int vertex_indices\nproperty uchar part\n"
        "end_header\n"
    ).encode()
    if form == "ascii":
        lines = ["{:g} {:g} {:g}".format(*corner) for corner in CORNERS]
        lines += [" ".join(map(str, (len(face), *face, 7))) for face in faces]
        return head + ("\n".join(lines) + "\n").encode()
    order = "<" if form == "binary_little_endian" else ">"
    body = b"".join(struct.pack(order + "3f", *corner) for corner in CORNERS)
    return head + body + b"".join(struct.pack(f"{order}B{len(f)}iB", len(f), *f, 7) for f in faces)


def load(folder: Path, inside: str) -> mi.Scene:
    (folder / "scene.xml").write_text(f'<scene version="3.0.0">{inside}</scene>')
    return load_scene("scene.xml", folder)


def mesh(kind: str) -> str:
    return f'<shape type="{kind}" id="m"><string name="filename" value="m.{kind}"/></shape>'


def refused(folder: Path, inside: str) -> str:
    with pytest.raises(PathreplayError) as caught:
        load(folder, inside)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("form", FORMATS)
def test_ply_faces_name_vertices_that_there_are(form: str, tmp_path: Path) -> None:
    (tmp_path / "m.ply").write_bytes(ply([(0, 1, 2), (0, 2, 3)], form))
    assert load(tmp_path, mesh("ply")).shapes()[0].face_count() == 2
    for face, wrong in (((0, 1, 4), "vertex 4"), ((0, 900_000_000, 1), "vertex 900000000"), ((-1, 0, 1), "vertex -1")):
        (tmp_path / "m.ply").write_bytes(ply([(0, 1, 2), face], form))
        message = refused(tmp_path, mesh("ply"))
        assert "m.ply" in message and wrong in message and "4 vertices" in message
    (tmp_path / "m.ply").write_bytes(ply([], form))
    assert "0 faces" in refused(tmp_path, mesh("ply"))
    for damaged in (ply([(0, 1, 2, 3)], form), ply([(0, 1, 2)] * 9, form)[:-40]):
        (tmp_path / "m.ply").write_bytes(damaged)
        assert "m.ply" in refused(tmp_path, mesh("ply"))  # in Mitsuba's words


@pytest.mark.parametrize("face", ["1 2 9", "0 1 2", "1/9 2/9 3/9", "1//9 2//9 3//9"])
def test_obj_faces_name_what_there_is(face: str, tmp_path: Path) -> None:
    (tmp_path / "m.obj").write_text(
        "".join("v {} {} {}\n".format(*c) for c in CORNERS) + f"vt 0 0\nvn 0 0 1\nf {face}\n"
    )
    assert "reference to invalid" in refused(tmp_path, mesh("obj"))


FOG = """<shape type="cube"><bsdf type="null"/><medium name="interior" type="heterogeneous">
<float name="albedo" value="0.5"/>
<volume type="gridvolume" name="sigma_t"><string name="filename" value="f.vol"/></volume></medium></shape>"""


@pytest.mark.parametrize("sides", [(2, 2, 3), (2**30, 2**30, 2**30), (-2, 2, 2)])
def test_volumes_are_as_long_as_they_say(sides: tuple[int, ...], tmp_path: Path) -> None:
    good = struct.pack("<4s5i6f", b"VOL\x03", 1, 2, 2, 2, 1, *[0.0] * 3, *[1.0] * 3) + bytes(32)
    (tmp_path / "f.vol").write_bytes(good)
    load(tmp_path, FOG)
    (tmp_path / "f.vol").write_bytes(good[:8] + struct.pack("<3i", *sides) + good[20:])
    assert f"{sides[0]} x {sides[1]} x {sides[2]} x 1 numbers and has 80 bytes" in refused(tmp_path, FOG)


def test_included_files_are_regular_ones(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "part.xml")
    line = refused(tmp_path, '<include filename="part.xml"/>')
    assert "part.xml is a pipe; include a readable XML file" in line


def test_long_scene_files_are_told_to_store_meshes_elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pathreplay.scenes.scene_files.LONGEST", 10)
    assert "more than the limit of 10; store meshes and textures in separate files" in refused(tmp_path, "")


def test_nesting_has_a_bound_in_included_files_too(tmp_path: Path) -> None:
    deep = "<bsdf>" * 50_000 + "</bsdf>" * 50_000
    assert f"more than {DEEPEST} nested elements" in refused(tmp_path, deep)
    (tmp_path / "part.xml").write_text(f'<scene version="3.0.0">{deep}</scene>')
    assert "part.xml has more than" in refused(tmp_path, '<include filename="part.xml"/>')
    (tmp_path / "part.xml").write_text('<scene version="3.0.0"><include filename="part.xml"/></scene>')
    assert "include" in refused(tmp_path, '<include filename="part.xml"/>')  # in Mitsuba's words
