"""Checks of scene files before they reach a library that crashes on their content.

Errors that Mitsuba itself reports (OBJ indices, truncated meshes, unknown formats) are left to Mitsuba.
"""

from __future__ import annotations

from pathlib import Path
from xml.parsers import expat

import mitsuba as mi

from pathreplay.errors import PathreplayError
from pathreplay.platform.files import MISSING, file_problem
from pathreplay.scenes.image_files import require_readable_picture
from pathreplay.scenes.mesh_files import require_sound_ply, require_sound_serialized
from pathreplay.scenes.volume_files import require_whole_vol

DEEPEST = 64
"""Largest depth of nested elements in a scene file. Real files have ten; Mitsuba's parser overflows its stack at about
10 000."""

LONGEST = 2**28
"""Largest size of a scene file in bytes. Mitsuba takes about ten times as much memory to read one."""


def require_shallow(path: Path) -> None:
    """Raise PathreplayError if a scene file, or one that it includes, is too long or nested too deeply."""
    waiting, seen = [path], set()
    while waiting:
        file = waiting.pop()
        problem = file_problem(file, LONGEST)
        if file.resolve() in seen or problem == MISSING:
            continue  # Mitsuba reports cycles and missing files
        if problem:
            raise PathreplayError(f"Scene {file} {problem}; store meshes and textures in separate files")
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
                f"Scene {path} has more than {DEEPEST} nested elements (line {parser.CurrentLineNumber}); "
                "flatten it with <ref id=…/>"
            )
        if tag == "include" and "filename" in attributes:
            names.append(attributes["filename"])

    parser.StartElementHandler, parser.EndElementHandler = begin, lambda tag: inside.pop()
    try:
        with path.open("rb") as file:
            parser.ParseFile(file)
    except (expat.ExpatError, OSError):
        pass  # Mitsuba reports the position of XML errors
    return names


def require_sound_files(state: mi.parser.ParserState) -> None:
    """Raise PathreplayError if a parsed scene (`mi.parser`) refers to a file that is unsafe to give to Mitsuba.

    Checked are pipes and devices, on which Mitsuba would block, the indices of PLY and serialized meshes, the sizes of
    volumes and images, and groups without a shape.
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
                continue  # Mitsuba reports missing files
            where = mi.parser.file_location(state, node)
            raise PathreplayError(f"File '{name}' of the scene {problem}; name a regular file ({where})")
        if kind == "ply":
            require_sound_ply(path)
        elif kind == "gridvolume":
            require_whole_vol(path)
        elif kind in ("bitmap", "envmap"):
            require_readable_picture(path, pixels=2**31)  # only memory limits its size
        elif kind == "serialized":
            require_sound_serialized(path, node.props.get("shape_index", 0))


def _require_shapes(state: mi.parser.ParserState, group: mi.parser.SceneNode) -> None:
    """Raise PathreplayError for an empty shape group; Dr.Jit crashes on its instances."""
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
    raise PathreplayError(f"Shape group '{group.props.id()}' contains no shape; add one, or leave the group out")
