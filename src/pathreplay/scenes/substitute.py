"""Loads a scene with some of its plugins exchanged for others that read the same parameters.

Where textures of 8 bits are to be floating-point numbers, the plugin `bitmap` gets another option.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import mitsuba as mi

from pathreplay.errors import PathreplayError
from pathreplay.platform.threads import spare_thread
from pathreplay.scenes.descriptions import require_values
from pathreplay.scenes.scene_files import require_shallow, require_sound_files

Cameras = Mapping[str, Mapping[str, Any]]
"""Sensors by their ids, as dictionaries of Mitsuba's."""


def load_file_with(
    path: str | Path,
    plugins: Mapping[str, str],
    parameters: Mapping[str, str] | None = None,
    cameras: Cameras | None = None,
    floats: Collection[str] = (),
) -> tuple[Any, list[str]]:
    """`mi.load_file(path, optimize=False, **parameters)` with plugins exchanged, included files' plugins too.

    `plugins` maps the type named in the scene to the type to load in its place, {"dielectric": "dielectric_ad"} for
    one. The new plugin has to be registered and is given the properties and the id of the old one, so that parameter
    keys stay what they were. ``cameras`` are added to what the scene has. ``floats`` are names of picture files
    (without their folders) whose `bitmap` textures are stored as floating-point numbers, whatever the files have.

    Returns the scene (or object) and one line per exchanged plugin, its id and where it stands in the file.
    Raises RuntimeError (Mitsuba's) for a file that cannot be read or holds a property unknown to the new plugin, and
    PathreplayError for a file that would end the process: see `require_shallow` and `require_sound_files`.
    """
    path = Path(path)
    parameters = parameters or {}
    for name in {"config", "filename"}.intersection(parameters):
        raise PathreplayError(f"Scene parameter '{name}' has a name that Mitsuba's parser keeps; rename ${name}")
    require_shallow(path)
    with _parsing() as config:
        mi.file_resolver().prepend(mi.filesystem.path(str(path.parent)))
        state = mi.parser.parse_file(config, str(path), **parameters)
        return _instantiate(config, state, plugins, cameras, floats)


def load_dict_with(
    scene: Mapping[str, Any],
    plugins: Mapping[str, str],
    cameras: Cameras | None = None,
    floats: Collection[str] = (),
) -> tuple[Any, list[str]]:
    """`mi.load_dict(scene, optimize=False)` with plugins exchanged; otherwise as `load_file_with`.

    Objects that stand in the dictionary already loaded stay what they are. Raises PathreplayError for a None.
    """
    require_values(scene)
    with _parsing() as config:
        return _instantiate(config, mi.parser.parse_dict(config, dict(scene)), plugins, cameras, floats)


def exchange(props: Any, plugins: Mapping[str, str], floats: Collection[str]) -> bool:
    """Exchange the plugin of an object, by its properties, or its option; whether it has another plugin now."""
    if (new := plugins.get(props.plugin_name())) is not None:
        props.set_plugin_name(new)
        return True
    if floats and props.plugin_name() == "bitmap" and Path(str(props.get("filename", ""))).name in floats:
        props["format"] = "variant"
    return False


@contextmanager
def _parsing() -> Iterator[mi.parser.ParserConfig]:
    """How to parse, which within this block finds files by a resolver of its own."""
    config = mi.parser.ParserConfig(mi.variant())
    # Merging equal objects would rename parameters.
    config.merge_equivalent = config.merge_meshes = False
    outer = mi.file_resolver()
    mi.set_file_resolver(mi.FileResolver(outer))
    try:
        yield config
    finally:
        mi.set_file_resolver(outer)


def _instantiate(
    config: Any, state: Any, plugins: Mapping[str, str], cameras: Cameras | None, floats: Collection[str]
) -> tuple[Any, list[str]]:
    exchanged = []
    taken = {node.props.id() for node in state.nodes}
    for name, camera in (cameras or {}).items():
        if name in taken:
            raise PathreplayError(f"The scene has an object '{name}', as a camera is called that joins it; rename one")
        state.root.props[name] = mi.load_dict(dict(camera))
    for node in state.nodes:
        if exchange(node.props, plugins, floats):
            exchanged.append(f"{node.props.id() or 'unnamed'} ({mi.parser.file_location(state, node)})")
    require_sound_files(state)
    mi.parser.transform_all(config, state)
    with spare_thread():
        return mi.parser.instantiate(config, state), exchanged
