"""Cheap looks into the files of a scene, before a library reads them that would die of what is in there.

What Mitsuba itself refuses with a message (OBJ indices, truncated meshes, unknown formats) is left to Mitsuba.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.parsers import expat

import mitsuba as mi

from pathreplay.errors import PathreplayError
from pathreplay.platform.files import MISSING, file_problem
from pathreplay.scenes.image_files import require_readable_picture
from pathreplay.scenes.mesh_files import require_sound_ply, require_sound_serialized
from pathreplay.scenes.volume_files import require_whole_vol

DEEPEST = 64
"""Elements inside each other in a scene file. Real ones have ten; Mitsuba's parser runs out of stack at some 10 000."""

LONGEST = 2**28
"""Bytes of a scene file. Mitsuba takes some ten times as much memory to read one."""


def require_shallow(path: Path) -> None:
    """Raise PathreplayError where a scene file, or one that it includes, is too long, or an element nested too deep."""
    waiting, seen = [path], set()
    while waiting:
        file = waiting.pop()
        problem = file_problem(file, LONGEST)
        if file.resolve() in seen or problem == MISSING:
            continue  # Mitsuba tells of circles and of what is missing
        if problem:
            raise PathreplayError(f"Scene {file} {problem}; keep meshes and textures in files of their own")
        seen.add(file.resolve())
        waiting += [path.parent / name for name in _included(file)]


def _included(path: Path) -> list[str]:
    names: list[str] = []
    inside: list[str] = []
    parser = expat.ParserCreate()

    def begin(tag: str, attributes: dict[str, str]) -> None:
        inside.append(tag)
        if len(inside) > DEEPEST:
            raise PathreplayError(
                f"Scene {path} has more than {DEEPEST} elements inside each other (line {parser.CurrentLineNumber}); "
                "flatten it with <ref id=…/>"
            )
        if tag == "include" and "filename" in attributes:
            names.append(attributes["filename"])

    parser.StartElementHandler, parser.EndElementHandler = begin, lambda tag: inside.pop()
    try:
        with path.open("rb") as file:
            parser.ParseFile(file)
    except (expat.ExpatError, OSError):
        pass  # Mitsuba says where it is no XML
    return names


def require_sound_files(state: Any) -> None:
    """Raise PathreplayError where a file that a parsed scene (`mi.parser`) names cannot be given to Mitsuba.

    Looks for pipes and devices, where Mitsuba would wait or read for ever; at the indices of PLY and serialized meshes
    and at the sizes of volumes and pictures; and for groups without a shape.
    """
    for node in state.nodes:
        kind, name = node.props.plugin_name(), node.props.get("filename")
        if kind == "shapegroup":
            _require_shapes(state, node)
        if not isinstance(name, str):
            continue
        path = Path(str(mi.file_resolver().resolve(name)))
        if problem := file_problem(path):
            if problem == MISSING:
                continue  # Mitsuba says what is missing
            where = mi.parser.file_location(state, node)
            raise PathreplayError(f"File '{name}' of the scene {problem}; name a regular file ({where})")
        if kind == "ply":
            require_sound_ply(path)
        elif kind == "gridvolume":
            require_whole_vol(path)
        elif kind in ("bitmap", "envmap"):
            require_readable_picture(path, pixels=2**31)  # of its size only memory decides
        elif kind == "serialized":
            require_sound_serialized(path, node.props.get("shape_index", 0))


def _require_shapes(state: Any, group: Any) -> None:
    """Raise PathreplayError for a group in which nothing is; Dr.Jit dies of its instances."""
    by_id = {node.props.id(): node for node in state.nodes}
    for key in group.props.keys():
        child, kind = group.props.get(key), group.props.type(key)
        node = None
        if kind == mi.Properties.Type.ResolvedReference:
            node = state.nodes[child.index()]
        elif kind == mi.Properties.Type.Reference:
            node = by_id.get(child.id())
        if kind == mi.Properties.Type.Object or (node is not None and node.type == mi.ObjectType.Shape):
            return
    raise PathreplayError(f"Shape group '{group.props.id()}' holds no shape; put one into it, or leave it out")
