"""Parses a scene description into objects that can be edited, and finds the object that each parameter belongs to.

Parameters have the keys of `mi.traverse(scene)`, whereas the parser knows objects and their properties. To relate
parameters to objects, the scene is instantiated once with a unique id per object. The id of the instance that has a
parameter then identifies the object.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import mitsuba as mi

from pathreplay.errors import PathreplayError
from pathreplay.platform.registration import PLUGINS
from pathreplay.platform.traversal import traversed
from pathreplay.scenes.descriptions import copied, require_values
from pathreplay.scenes.scene_files import require_shallow, require_sound_files
from pathreplay.scenes.substitute import exchange, instantiated, parsing

Node: TypeAlias = "mi.parser.SceneNode"


@dataclass(frozen=True)
class Owner:
    """The object of a parameter, and the parameter's path within the object, such as 'reflectance.value' or 'data'."""

    node: Node
    place: str


class Described:
    """The objects of a scene description; the first object is the scene."""

    def __init__(self, state: mi.parser.ParserState, folder: Path | None) -> None:
        self._state, self.nodes, self.folder = state, list(state.nodes), folder

    def add(self, properties: mi.Properties, kind: mi.ObjectType) -> mi.Properties.ResolvedReference:
        """Add an object, and return a reference to the object for use as a property value."""
        node = mi.parser.SceneNode()
        node.props, node.type = properties, kind
        self.nodes.append(node)
        return mi.Properties.ResolvedReference(len(self.nodes) - 1)

    def children(self, node: Node) -> Iterator[tuple[str, Node]]:
        """Yield the child objects of an object, each with its property name."""
        for name in node.props.keys():
            if _is_reference(node, name):
                yield name, self.nodes[node.props.get(name).index()]

    def find_file(self, name: str) -> Path:
        """Resolve a file name of a property; relative names refer to the scene's folder."""
        with parsing(self.folder):
            return Path(str(mi.file_resolver().resolve(name)))


def _is_reference(node: Node, name: str) -> bool:
    return bool(node.props.type(name) == mi.Properties.Type.ResolvedReference)


def describe(
    scene: str | Path | Mapping[str, object],
    arguments: Mapping[str, str],
    plugins: Mapping[str, str],
    cameras: Mapping[str, Mapping[str, object]],
    floats: Collection[str] = (),
    medium: str | None = None,
) -> tuple[Described, list[Owner]]:
    """Parse a scene into its objects and the owners of its parameters, in the order of `mi.traverse`.

    Args:
        scene: path of an XML file, or a dictionary.
        arguments: values that replace ``$name`` in the file.
        plugins: new plugin types by the old types that they replace.
        cameras: dictionaries of additional sensors by id.
        floats: image files whose textures are stored as floating-point numbers; see `load_file_with`.
        medium: id of the medium that surrounds the additional sensors.

    Raises:
        RuntimeError: Mitsuba cannot read the scene.
        PathreplayError: see `load_file_with`, or the scene has no such medium.
    """
    folder = None if isinstance(scene, Mapping) else Path(scene).parent.resolve()
    with parsing(folder) as config:
        if isinstance(scene, Mapping):
            require_values(scene)
            state = mi.parser.parse_dict(config, copied(scene))
        else:
            require_shallow(Path(scene))
            state = mi.parser.parse_file(config, str(scene), **arguments)
        for name, camera in cameras.items():
            _join(state, name, mi.parser.parse_dict(config, dict(camera)))
        for node in state.nodes:
            exchange(node.props, plugins, floats)
            name = node.props.plugin_name()
            if node.type == mi.ObjectType.Unknown and name in PLUGINS:  # a Python plugin in a dictionary
                node.type = _types()[PLUGINS[name][0]]
        require_sound_files(state)
        mi.parser.transform_all(config, state)
        if medium is not None:
            _surround(state, cameras, medium)
        described = Described(state, folder)
        owners = [_deepest(described, owner) for owner in _owners(config, state, described.nodes)]
    return described, owners


def _types() -> dict[str, mi.ObjectType]:
    """Return the types of objects by their names in `PLUGINS`."""
    return {"bsdf": mi.ObjectType.BSDF, "integrator": mi.ObjectType.Integrator, "medium": mi.ObjectType.Medium}


def _join(state: mi.parser.ParserState, name: str, camera: mi.parser.ParserState) -> None:
    """Insert the objects of a separately parsed camera into the scene."""
    offset = len(state.nodes)
    for node in camera.nodes:
        for key in node.props.keys():
            if _is_reference(node, key):
                node.props[key] = mi.Properties.ResolvedReference(node.props.get(key).index() + offset)
        state.nodes.append(node)
    state.nodes[offset].props.set_id(name)
    state.root.props[name] = mi.Properties.ResolvedReference(offset)


def _surround(state: mi.parser.ParserState, cameras: Collection[str], medium: str) -> None:
    """Let sensors, given by id, reference the medium of the scene with the id ``medium``."""
    kind = mi.ObjectType.Medium
    index = next((i for i, node in enumerate(state.nodes) if node.type == kind and node.props.id() == medium), None)
    if index is None:
        raise PathreplayError(
            f"capture.medium '{medium}' has no description in the scene that is exported; give the medium this id"
        )
    for node in state.nodes:
        if node.type == mi.ObjectType.Sensor and node.props.id() in cameras:
            node.props["medium"] = mi.Properties.ResolvedReference(index)


def _owners(config: mi.parser.ParserConfig, state: mi.parser.ParserState, nodes: list[Node]) -> list[Owner]:
    """Return the owners of all parameters, from an instance of the scene in which each object has a unique id."""
    copy = mi.parser.ParserState(state)  # a copy, in which instantiation replaces references by objects
    names = {f"object {i}": i for i in range(1, len(nodes))}
    for name, i in names.items():
        copy.nodes[i].props.set_id(name)
    scene = instantiated(config, copy)
    params = traversed(scene)
    owners = []
    for key in params.keys():
        node, depth = params.properties[key][2], 1
        while node is not scene and node.id() not in names:
            node, depth = params.hierarchy[node][0], depth + 1
        place = ".".join(key.rsplit(".", depth)[-depth:])
        owners.append(Owner(nodes[0 if node is scene else names[node.id()]], place))
    return owners


def _deepest(described: Described, owner: Owner) -> Owner:
    """Return the innermost object that has the parameter, by following the parameter's path from ``owner``.

    `_owners` may find only an outer object: for example, the instance of a bitmap does not keep its id.
    """
    name, dot, rest = owner.place.partition(".")
    if not dot:
        return owner
    children = dict(described.children(owner.node))
    if name not in children:  # the path and the description use different names: choose the only bitmap
        pictures = [child for child in children.values() if child.props.plugin_name() == "bitmap"]
        if rest.split(".")[-1] != "data" or len(pictures) != 1:
            return owner
        return Owner(pictures[0], rest)
    return _deepest(described, Owner(children[name], rest))


def require_no_objects(described: Described) -> None:
    """Raise PathreplayError if the description contains a loaded object, whose own description is unknown."""
    for node in described.nodes:
        for name in node.props.keys():
            kind = node.props.type(name)
            if kind in (mi.Properties.Type.Object, mi.Properties.Type.Any):
                value = node.props.get(name)
                what = value.class_name() if isinstance(value, mi.Object) else type(value).__name__
                raise PathreplayError(
                    f"'{name}' of {node.props.plugin_name()} '{node.props.id()}' is an existing {what} object, which "
                    "cannot be exported; describe it by a dictionary or a file instead"
                )
