"""A described scene as Mitsuba XML, whose numbers are those of the scene to the last digit and whose names stay.

Mitsuba's own writer (`mi.parser.write_file`) takes transforms apart into angles, leaves out the names of what is
referenced nowhere, and turns sizes into defaults.
"""

from __future__ import annotations

from collections import Counter
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
"""How the parser begins the names of objects that have none in the file."""


def scene_xml(described: Described, from_file: bool) -> bytes:
    """The scene as the bytes of an XML file; ``from_file``: it comes from one, where an id is a name of the user's.

    Raises PathreplayError for values that XML cannot hold.
    """
    uses = Counter(id(child) for node in described.nodes for _, child in described.children(node))
    names = _Names(described, uses, from_file)
    tree = _element(described, described.nodes[0], "", names, set())
    tree.set("version", mi.__version__)
    ElementTree.indent(tree, "    ")
    return ElementTree.tostring(tree, encoding="utf-8", xml_declaration=True) + b"\n"


class _Names:
    """The ids that objects get: those that are used for references, or are part of the names of parameters."""

    def __init__(self, described: Described, uses: Counter[int], from_file: bool) -> None:
        top = {id(child) for _, child in described.children(described.nodes[0])}
        groups = [node for node in described.nodes if node.props.plugin_name() == "shapegroup"]
        top |= {id(child) for group in groups for _, child in described.children(group)}
        self._of: dict[int, str] = {}
        taken: set[str] = set()
        for i, node in enumerate(described.nodes[1:]):
            name = node.props.id()
            if not (uses[id(node)] > 1 or (name and (from_file or id(node) in top))):
                continue
            if not name or name in taken:
                name = f"{name or 'object'}-{i}"
            taken.add(name)
            self._of[id(node)] = name

    def of(self, node: Node) -> str | None:
        return self._of.get(id(node))


def _element(described: Described, node: Node, name: str, names: _Names, written: set[int]) -> ElementTree.Element:
    called = {} if not name or name.startswith(_UNNAMED) else {"name": name}
    identity = names.of(node)
    if id(node) in written:
        return ElementTree.Element("ref", {"id": str(identity), **called})
    written.add(id(node))
    kind = str(node.type).rsplit(".", 1)[-1]
    if kind not in _TAGS:
        raise PathreplayError(f"{node.props.plugin_name()} '{node.props.id()}' is a {kind}, and cannot be exported")
    element = ElementTree.Element(_TAGS[kind])
    if kind != "Scene":
        element.set("type", node.props.plugin_name())
    for attribute, value in {**({"id": identity} if identity else {}), **called}.items():
        element.set(attribute, value)
    children = dict(described.children(node))
    for key in node.props.keys():
        if key in children:
            element.append(_element(described, children[key], key, names, written))
        else:
            element.append(_property(node, key))
    return element


def _property(node: Node, key: str) -> ElementTree.Element:
    value, kind = node.props.get(key), str(node.props.type(key)).rsplit(".", 1)[-1]
    if kind == "Bool":
        return _made("boolean", key, value=str(value).lower())
    if kind in ("Integer", "Float"):
        return _made(kind.lower(), key, value=repr(value))
    if kind == "String":
        return _made("string", key, value=str(value))
    if kind == "Vector":
        return _made("vector", key, **{axis: repr(float(value[i])) for i, axis in enumerate("xyz")})
    if kind == "Color":
        return _made("rgb", key, value=" ".join(repr(float(value[i])) for i in range(3)))
    if kind == "Spectrum":
        return _made("spectrum", key, value=_samples(value))
    if kind == "Transform":
        element = _made("transform", key)
        numbers = np.array(value.matrix, np.float64).ravel()
        ElementTree.SubElement(element, "matrix", value=" ".join(repr(float(x)) for x in numbers))
        return element
    raise PathreplayError(
        f"'{key}' of {node.props.plugin_name()} '{node.props.id()}' is of type {kind}, which XML cannot hold; describe "
        "it otherwise"
    )


def _made(tag: str, name: str, **attributes: str) -> ElementTree.Element:
    return ElementTree.Element(tag, {"name": name, **attributes})


def _samples(spectrum: Any) -> str:
    if len(spectrum.wavelengths) == 0:
        return repr(float(spectrum.values[0]))
    pairs = zip(spectrum.wavelengths, spectrum.values, strict=True)
    return ", ".join(f"{float(at)!r}:{float(value)!r}" for at, value in pairs)
