"""Check scene files, and files to which they refer, for content on which Mitsuba or its libraries would crash.

Errors that Mitsuba itself reports, such as wrong OBJ indices, truncated meshes or unknown formats, are not checked.
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
"""Largest depth of nested elements in a scene file. Real files have a depth of about ten. Mitsuba's parser overflows
its stack at about 10 000."""

LONGEST = 2**28
"""Largest size of a scene file in bytes. Mitsuba needs about ten times this amount of memory to read the file."""


def require_shallow(path: Path) -> None:
    """Raise PathreplayError if a scene file, or a file that it includes, is too long or nested too deeply."""
    waiting, seen = [path], set()
    while waiting:
        file = waiting.pop()
        problem = file_problem(file, LONGEST)
        if file.resolve() in seen or problem == MISSING:
            continue  # Mitsuba reports cycles and missing files
        if problem:
            is_long = not file_problem(file)
            remedy = "store meshes and textures in separate files" if is_long else "include a readable XML file"
            raise PathreplayError(f"Scene {file} {problem}; {remedy}")
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
    """Raise PathreplayError if a parsed scene (`mi.parser`) would block or crash Mitsuba.

    The function detects pipes and devices, on which Mitsuba would block, and shape groups without a shape. It also
    checks the indices of PLY and serialized meshes, and the sizes of volumes and images.
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
            require_readable_picture(path, pixels=2**31)  # in practice, available memory limits the number of pixels
        elif kind == "serialized":
            require_sound_serialized(path, node.props.get("shape_index", 0))


def _require_shapes(state: mi.parser.ParserState, group: mi.parser.SceneNode) -> None:
    """Raise PathreplayError for an empty shape group, because Dr.Jit crashes on instances of the group."""
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
