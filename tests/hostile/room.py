"""A room: the folder in which a case happens, with a job that works and small means to spoil it."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .toml_text import toml

#: A job that works; cases exchange parts of it.
JOB: dict[str, Any] = {
    "scene": "ball.xml",
    "iterations": 2,
    "spp": 2,
    "eval_spp": 2,
    "checkpoint_every": 1,
    "integrator": {"type": "pathreplay", "max_depth": 3},
    "parameters": [{"key": "paint.reflectance.data", "lower": 0.0, "upper": 1.0, "initial": 0.4}],
    "target": {"images": ["target.exr"]},
}

#: The same with a target that is rendered.
RENDERED = {**JOB, "target": {"values": {"paint.reflectance.data": 0.7}, "spp": 2}}

#: The same for where the camera stands.
POSED = {
    **RENDERED,
    "parameters": [{"key": "eye.to_world", "pose": "rigid", "initial": {"translation": [0.1, 0, 0]}}],
}

#: The same for a number from which the picture's brightness is derived.
DERIVED = {
    **RENDERED,
    "parameters": [{"key": "share", "shape": [1], "initial": 0.5}],
    "derived": [{"key": "paint.reflectance.data", "function": "own:scaled", "of": ["share"]}],
}


@dataclass(frozen=True)
class Room:
    """``path`` is the current folder of a case. Beside it lies ``outside``, which no case may write to."""

    path: Path
    assets: Path
    """Good files to copy from: see `assets.make`."""

    @classmethod
    def new(cls, ground: Path, assets: Path) -> Room:
        """A fresh room in a folder, with what must not be touched beside it."""
        room = cls(ground / "room", assets)
        shutil.copytree(assets / "room", room.path)
        room.outside.mkdir()
        (room.outside / "precious").write_text("not to be touched")
        return room

    @property
    def outside(self) -> Path:
        return self.path.parent / "outside"

    def __truediv__(self, name: str) -> Path:
        return self.path / name

    def job(self, values: Mapping[str, Any] | str) -> None:
        """Write job.toml: a dictionary, or its text."""
        text = values if isinstance(values, str) else toml(values)
        (self / "job.toml").write_bytes(text.encode("utf-8", "surrogatepass"))

    def change(self, where: str, value: Any, job: Mapping[str, Any] = JOB) -> None:
        """Write job.toml with one value exchanged or added; ``where`` is a dotted path, lists by index."""
        self.job(changed(job, where.split("."), value))

    def edit(self, name: str, old: str, new: str) -> None:
        """Exchange a text that occurs in a file."""
        text = (self / name).read_text()
        assert old in text, f"{old!r} is not in {name}"
        (self / name).write_bytes(text.replace(old, new).encode("utf-8", "surrogatepass"))

    def into_scene(self, xml: str) -> None:
        """Add XML at the end of the scene."""
        self.edit("ball.xml", "</scene>", xml + "\n</scene>")

    def write(self, name: str, data: bytes | str) -> None:
        """Write a file, in place of whatever has the name."""
        self.remove(name)
        (self / name).write_bytes(data.encode() if isinstance(data, str) else data)

    def remove(self, name: str) -> None:
        """Remove a file, link or folder, if there is one."""
        path = self / name
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)

    def odd_file(self, name: str, kind: str) -> None:
        """Put something that is no regular file, or no reasonable one, in the place of a file."""
        self.remove(name)
        path = self / name
        if kind == "folder":
            path.mkdir()
        elif kind == "fifo":
            os.mkfifo(path)
        elif kind == "loop":
            path.symlink_to(path.name)
        elif kind == "dangling":
            path.symlink_to("nowhere")
        elif kind == "empty":
            path.touch()
        elif kind == "20 GB":
            with path.open("wb") as file:
                file.truncate(20 * 2**30)
        else:
            path.symlink_to(kind)  # a device

    def put_run(self, name: str = "runs/job", iterations: int = 4) -> Path:
        """Put a finished run of two iterations there, whose config asks for more."""
        folder = self / name
        shutil.copytree(self.assets / "run", folder)
        start = json.loads((folder / "run.json").read_text())
        (folder / "run.json").write_text(json.dumps(start | {"base": str(self.path)}))
        text = (folder / "config.toml").read_text()
        (folder / "config.toml").write_text(text.replace("iterations = 2", f"iterations = {iterations}"))
        return folder


#: Kinds of `Room.odd_file`.
ODD_FILES = ("folder", "fifo", "loop", "dangling", "empty", "20 GB", "/dev/zero", "/dev/null", "/dev/full", "/dev/tty")


def changed(values: Any, where: list[str], value: Any) -> Any:
    """A copy of nested dictionaries and lists with one entry exchanged or added."""
    if not where:
        return value
    if isinstance(values, list):
        at = int(where[0])
        return [changed(old, where[1:], value) if i == at else old for i, old in enumerate(values)]
    known = values if isinstance(values, Mapping) else {}
    return {**known, where[0]: changed(known.get(where[0], {}), where[1:], value)}
