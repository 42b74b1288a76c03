"""Writes a scene description as Mitsuba XML with exact numbers and preserved ids.

Mitsuba's own writer (`mi.parser.write_file`) decomposes transforms into angles, omits the ids of objects without
references, and replaces film sizes and sample counts by variables such as ``$resx``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.output.nodes import Described, Node

_TAGS = {
    "Scene": "scene", "Sensor": "sensor", "Film": "film", "Emitter": "emitter", "Sampler": "sampler",
    "Shape": "shape", "Texture": "texture", "Volume": "volume", "Medium": "medium", "BSDF": "bsdf",
    "Integrator": "integrator", "PhaseFunction": "phase", "ReconstructionFilter": "rfilter",
}  # fmt: skip
_UNNAMED = "_arg_"
"""Prefix of the names that the parser gives to unnamed objects."""


def scene_xml(described: Described, from_file: bool) -> bytes:
    """Encode a scene description as an XML file.

    If the description was read from a file (``from_file``), the user has chosen the ids in this file. Raises
    PathreplayError for values that XML cannot represent.
    """
    uses = Counter(id(child) for node in described.nodes for _, child in described.children(node))
    ids = _ids(described, uses, from_file)
    tree = _element(described, described.nodes[0], "", ids, set())
    tree.set("version", mi.__version__)
    ElementTree.indent(tree, "    ")
    return ElementTree.tostring(tree, encoding="utf-8", xml_declaration=True) + b"\n"


def _ids(described: Described, uses: Counter[int], from_file: bool) -> dict[int, str]:
    """Return the ids of objects in the XML file, by `id` of the node.

    Objects that are used more than once have an id. Ids in a scene file are kept. In a dictionary, only names that are
    part of parameter keys are kept: the names of objects directly in the scene or in a shape group.
    """
    top = {id(child) for _, child in described.children(described.nodes[0])}
    groups = [node for node in described.nodes if node.props.plugin_name() == "shapegroup"]
    top |= {id(child) for group in groups for _, child in described.children(group)}
    ids: dict[int, str] = {}
    taken = {""}
    for i, node in enumerate(described.nodes[1:]):
        name = node.props.id()
        if uses[id(node)] > 1 or (name and (from_file or id(node) in top)):
            ids[id(node)] = f"{name or 'object'}-{i}" if name in taken else name
            taken.add(ids[id(node)])
    return ids


def _element(
    described: Described, node: Node, name: str, ids: Mapping[int, str], written: set[int]
) -> ElementTree.Element:
    called = {} if not name or name.startswith(_UNNAMED) else {"name": name}
    identity = ids.get(id(node))
    if id(node) in written:
        return ElementTree.Element("ref", {"id": str(identity), **called})
    written.add(id(node))
    kind = str(node.type).rsplit(".", 1)[-1]
    if kind not in _TAGS:
        raise PathreplayError(f"{node.props.plugin_name()} '{node.props.id()}' is a {kind}, which cannot be exported")
    element = ElementTree.Element(_TAGS[kind])
    if kind != "Scene":
        element.set("type", node.props.plugin_name())
    for attribute, value in {**({"id": identity} if identity else {}), **called}.items():
        element.set(attribute, value)
    children = dict(described.children(node))
    for key in node.props.keys():
        if key in children:
            element.append(_element(described, children[key], key, ids, written))
        else:
            element.append(_property(node, key))
    return element


def _property(node: Node, key: str) -> ElementTree.Element:
    value, kind = node.props.get(key), str(node.props.type(key)).rsplit(".", 1)[-1]
    if kind == "Bool":
        return _tag("boolean", key, value=str(value).lower())
    if kind in ("Integer", "Float"):
        return _tag(kind.lower(), key, value=repr(value))
    if kind == "String":
        return _tag("string", key, value=str(value))
    if kind == "Vector":
        return _tag("vector", key, **{axis: repr(float(value[i])) for i, axis in enumerate("xyz")})
    if kind == "Color":
        return _tag("rgb", key, value=" ".join(repr(float(value[i])) for i in range(3)))
    if kind == "Spectrum":
        return _tag("spectrum", key, value=_samples(value))
    if kind == "Transform":
        element = _tag("transform", key)
        numbers = np.array(value.matrix, np.float64).ravel()
        ElementTree.SubElement(element, "matrix", value=" ".join(repr(float(x)) for x in numbers))
        return element
    raise PathreplayError(
        f"'{key}' of {node.props.plugin_name()} '{node.props.id()}' has type {kind}, which XML cannot hold; use "
        "another property"
    )


def _tag(tag: str, name: str, **attributes: str) -> ElementTree.Element:
    return ElementTree.Element(tag, {"name": name, **attributes})


def _samples(spectrum: Any) -> str:
    if len(spectrum.wavelengths) == 0:
        return repr(float(spectrum.values[0]))
    pairs = zip(spectrum.wavelengths, spectrum.values, strict=True)
    return ", ".join(f"{float(at)!r}:{float(value)!r}" for at, value in pairs)
