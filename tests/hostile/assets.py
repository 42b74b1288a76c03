"""The good files that rooms are copied from: a scene with its files, a job, and a run that was finished."""

from __future__ import annotations

import io
import os
import struct
import zipfile
import zlib
from pathlib import Path

import numpy as np

from .room import JOB
from .toml_text import toml

SCENE = """<scene version="3.0.0">
  <default name="res" value="8"/>
  <sensor type="perspective" id="eye">
    <transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
    <float name="fov" value="45"/>
    <film type="hdrfilm"><integer name="width" value="$res"/><integer name="height" value="6"/>
      <string name="pixel_format" value="rgb"/><rfilter type="box"/></film>
    <sampler type="independent"><integer name="sample_count" value="4"/></sampler></sensor>
  <bsdf type="diffuse" id="paint"><texture type="bitmap" name="reflectance">
    <string name="filename" value="texture.png"/><boolean name="raw" value="true"/>
    <string name="format" value="variant"/></texture></bsdf>
  <shape type="sphere" id="ball"><ref id="paint"/></shape>
  <shape type="ply" id="sheet"><string name="filename" value="sheet.ply"/><ref id="paint"/></shape>
  <shape type="obj" id="tile"><string name="filename" value="tile.obj"/><bsdf type="diffuse" id="clay"/></shape>
  <emitter type="constant" id="sky"><rgb name="radiance" value="1"/></emitter>
</scene>
"""

VERTICES = [(-2.0, -2.0, -1.0), (2.0, -2.0, -1.0), (2.0, 2.0, -1.0), (-2.0, 2.0, -1.0)]
FACES = [(0, 1, 2), (0, 2, 3)]


def ply(vertices: list[tuple[float, ...]] | None = None, faces: list[tuple[int, ...]] | None = None) -> str:
    """A PLY file as text; the default is a square."""
    vertices, faces = vertices or VERTICES, FACES if faces is None else faces
    rows = [" ".join(map(str, v)) for v in vertices] + [" ".join(map(str, (len(f), *f))) for f in faces]
    return (
        f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n" + "\n".join(rows) + "\n"
    )


def binary_ply(vertices: list[tuple[float, ...]] | None = None, faces: list[tuple[int, ...]] | None = None) -> bytes:
    """The same in little endian."""
    vertices, faces = vertices or VERTICES, FACES if faces is None else faces
    head = ply(vertices, faces).split("end_header\n")[0].replace("ascii", "binary_little_endian") + "end_header\n"
    body = b"".join(struct.pack("<3f", *v) for v in vertices)
    return head.encode() + body + b"".join(struct.pack(f"<B{len(f)}i", len(f), *f) for f in faces)


def coordinate_ply() -> str:
    """The square with texture coordinates."""
    lines = ply().split("\n")
    lines[6:6] = ["property float s", "property float t"]
    at = lines.index("end_header") + 1
    lines[at : at + 4] = [f"{line} {i // 2} {i % 2}" for i, line in enumerate(lines[at : at + 4])]
    return "\n".join(lines)


def obj(vertices: list[tuple[float, ...]] | None = None, faces: list[tuple[int, ...]] | None = None) -> str:
    """An OBJ file (its indices count from one); the default is a small triangle."""
    vertices = vertices or [(-3.0, -1.0, 0.0), (-2.0, -1.0, 0.0), (-2.0, 1.0, 0.0)]
    lines = ["v " + " ".join(map(str, v)) for v in vertices]
    return "\n".join(lines + ["f " + " ".join(map(str, f)) for f in faces or [(1, 2, 3)]]) + "\n"


def serialized() -> bytes:
    """The square in Mitsuba's own format, version 4: header, one compressed mesh in single precision, the offsets."""
    body = struct.pack("<I", 0x1000) + b"sheet\0" + struct.pack("<QQ", len(VERTICES), len(FACES))
    body += np.array(VERTICES, "<f4").tobytes() + np.array(FACES, "<u4").tobytes()
    mesh = struct.pack("<HH", 0x041C, 4) + zlib.compress(body)
    return mesh + struct.pack("<QI", 0, 1)


def png(height: int, width: int, mode: str = "RGB") -> bytes:
    """A PNG of a smooth pattern, in one of Pillow's modes."""
    from PIL import Image

    y, x = np.mgrid[:height, :width]
    grey = (100 + 20 * np.sin(y + 2 * x)).astype(np.uint8)
    stream = io.BytesIO()
    Image.fromarray(grey).convert(mode).save(stream, "PNG")
    return stream.getvalue()


def pfm(pixels: np.ndarray) -> bytes:
    """A portable float map; colour (h, w, 3)."""
    height, width = pixels.shape[:2]
    return f"PF\n{width} {height}\n-1.0\n".encode() + np.ascontiguousarray(pixels[::-1], "<f4").tobytes()


def make_room(room: Path, vdb: Path) -> None:
    """Write the files of a good room. Needs an active variant."""
    from pathreplay.inverse.images.io import exr_bytes
    from pathreplay.scenes.volume_files import save_vol

    room.mkdir()
    (room / "ball.xml").write_text(SCENE)
    (room / "job.toml").write_text(toml(JOB))
    (room / "own.py").write_text("def scaled(first, share):\n    return first * share.array\n")
    (room / "texture.png").write_bytes(png(4, 4))
    (room / "sheet.ply").write_text(coordinate_ply())
    (room / "tile.obj").write_text("vt 0 0\nvt 1 0\nvt 1 1\n" + obj().replace("f 1 2 3", "f 1/1 2/2 3/3"))
    (room / "mesh.serialized").write_bytes(serialized())
    (room / "target.exr").write_bytes(exr_bytes(np.full((6, 8, 3), 0.5, np.float32)))
    save_vol(room / "cloud.vol", np.full((3, 4, 5, 1), 0.5, np.float32))
    with zipfile.ZipFile(vdb) as archive:
        archive.extractall(room)


def make(folder: Path, vdb: Path) -> None:
    """Write the folders ``room`` and ``run`` into ``folder``. Runs the job once: needs a process of its own."""
    from pathreplay.jobs import optimize
    from pathreplay.platform import backend

    backend.set_variant("llvm_ad_rgb")
    make_room(folder / "room", vdb)
    os.chdir(folder / "room")
    optimize("job.toml", output=folder / "run", progress=False)
