"""Cheap looks into the files of a scene, before a library reads them that would die of what is in there.

What Mitsuba itself refuses with a message (OBJ indices, truncated meshes, unknown formats) is left to Mitsuba.
"""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.parsers import expat

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pathreplay.errors import PathreplayError
from pathreplay.files import MISSING, file_problem
from pathreplay.media.volume_files import require_whole_vol
from pathreplay.scenes.serialized_files import require_sound_serialized, require_vertices

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
    depth = 0
    parser = expat.ParserCreate()

    def begin(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > DEEPEST:
            raise PathreplayError(
                f"Scene {path} has more than {DEEPEST} elements inside each other (line {parser.CurrentLineNumber}); "
                "flatten it with <ref id=…/>"
            )
        if tag == "include" and "filename" in attributes:
            names.append(attributes["filename"])

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1

    parser.StartElementHandler, parser.EndElementHandler = begin, end
    try:
        with path.open("rb") as file:
            parser.ParseFile(file)
    except (expat.ExpatError, OSError):
        pass  # Mitsuba says where it is no XML
    return names


def require_sound_files(state: Any) -> None:
    """Raise PathreplayError where a file that a parsed scene (`mi.parser`) names cannot be given to Mitsuba.

    Looks at the indices of PLY and serialized meshes and at the sizes of volumes; and for groups without a shape.
    """
    for node in state.nodes:
        kind, name = node.props.plugin_name(), node.props.get("filename", None)
        if kind == "shapegroup":
            _require_shapes(state, node)
        path = Path(str(mi.file_resolver().resolve(name))) if isinstance(name, str) else None
        if path is None or not path.is_file():
            continue
        if kind == "ply":
            _require_sound_ply(path)
        elif kind == "gridvolume":
            require_whole_vol(path)
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


_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: list[tuple[str, ...]]

    @property
    def kinds(self) -> list[str]:
        return [kinds[0] for kinds in self.properties]

    def triangles(self, order: str) -> np.dtype[Any]:
        """The layout of one entry, where lists have three members."""
        fields: list[Any] = []
        for i, (*kinds, name) in enumerate(self.properties):
            if kinds[0] == "list":
                fields += [(f"count {i}", order + _TYPES[kinds[1]]), (name, order + _TYPES[kinds[2]], 3)]
            else:
                fields.append((name, order + _TYPES[kinds[0]]))
        return np.dtype(fields)


def _require_sound_ply(path: Path) -> None:
    with path.open("rb") as file:
        if file.read(3) != b"ply":
            raise PathreplayError(f"Mesh {path} is no PLY file: it does not begin with 'ply'; get it anew")
        kind, elements = _ply_header(file)
        begin = file.tell()
    if kind is None or [element.name for element in elements[:2]] != ["vertex", "face"] or "list" in elements[0].kinds:
        return
    vertices, faces = elements[0].count, elements[1].count
    if not vertices or not faces:
        raise PathreplayError(f"Mesh {path} has {vertices} vertices and {faces} faces; give it some, or leave it out")
    try:
        indices = (_ascii_indices if kind == "ascii" else _binary_indices)(path, begin, elements, kind)
    except (KeyError, ValueError, IndexError):
        return  # not what we know: Mitsuba may
    if indices is not None and indices.size:
        require_vertices(path, indices, vertices)


def _ply_header(file: Any) -> tuple[str | None, list[_Element]]:
    kind, elements = None, []
    for _ in range(1000):
        words = file.readline(4096).decode("latin-1").split()
        if words[:1] == ["format"] and len(words) > 1:
            kind = words[1]
        elif words[:1] == ["element"] and len(words) == 3 and re.fullmatch(r"\d+", words[2]):
            elements.append(_Element(words[1], int(words[2]), []))
        elif words[:1] == ["property"] and len(words) > 2 and elements:
            elements[-1].properties.append(tuple(words[1:]))
        elif words[:1] == ["end_header"]:
            return kind, elements
    return None, []


def _binary_indices(path: Path, begin: int, elements: list[_Element], kind: str) -> NDArray[Any] | None:
    order = "<" if kind == "binary_little_endian" else ">"
    vertex, face = (element.triangles(order) for element in elements[:2])
    begin += vertex.itemsize * elements[0].count
    if path.stat().st_size < begin + face.itemsize * elements[1].count:
        return None
    entries = np.memmap(path, face, "r", begin, elements[1].count)
    at = elements[1].kinds.index("list")
    # Mitsuba refuses other faces.
    return entries[elements[1].properties[at][-1]] if (entries[f"count {at}"] == 3).all() else None


def _ascii_indices(path: Path, begin: int, elements: list[_Element], kind: str) -> NDArray[Any] | None:
    with path.open("rb") as file:
        file.seek(begin)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # where numbers end and text begins
            numbers = np.fromstring(file.read().decode("latin-1"), np.float64, sep=" ")
    begin = elements[0].count * len(elements[0].properties)
    width = len(elements[1].properties) + 3
    entries = numbers[begin : begin + width * elements[1].count].reshape(-1, width)
    at = elements[1].kinds.index("list")
    return entries[:, at + 1 : at + 4] if (entries[:, at] == 3).all() else None
