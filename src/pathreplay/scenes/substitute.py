"""Loads a scene with some of its plugins exchanged for others that read the same parameters."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi

from pathreplay.errors import PathreplayError
from pathreplay.files import MISSING, file_problem
from pathreplay.scenes.descriptions import require_values
from pathreplay.scenes.scene_files import require_shallow, require_sound_files
from pathreplay.threads import spare_thread


def load_file_with(
    path: str | Path,
    plugins: Mapping[str, str],
    parameters: Mapping[str, str] | None = None,
    *,
    optimize: bool = False,
) -> tuple[Any, list[str]]:
    """`mi.load_file(path, optimize=optimize, **parameters)` with plugins exchanged, included files' plugins too.

    `plugins` maps the type named in the scene to the type to load in its place, {"dielectric": "smoothdielectric"} for
    one. The new plugin has to be registered and is given the properties and the id of the old one, so that parameter
    keys stay what they were (with `optimize=False`; Mitsuba's merging of equal objects renames things).

    Returns the scene (or object) and one line per exchanged plugin, its id and where it stands in the file.
    Raises RuntimeError (Mitsuba's) for a file that cannot be read or holds a property unknown to the new plugin, and
    PathreplayError for a file that would end the process: see `require_shallow` and `require_sound_files`.
    """
    path = Path(path)
    require_shallow(path)
    config = _config(optimize)
    outer = mi.file_resolver()
    inner = mi.FileResolver(outer)
    inner.prepend(mi.filesystem.path(str(path.parent)))
    mi.set_file_resolver(inner)
    try:
        state = mi.parser.parse_file(config, str(path), **_arguments(parameters or {}))
        return _instantiate(config, state, plugins)
    finally:
        mi.set_file_resolver(outer)


def load_dict_with(
    scene: Mapping[str, Any], plugins: Mapping[str, str], *, optimize: bool = False
) -> tuple[Any, list[str]]:
    """`mi.load_dict(scene, optimize=optimize)` with plugins exchanged; otherwise as `load_file_with`.

    Objects that stand in the dictionary already loaded stay what they are. Raises PathreplayError for a None.
    """
    require_values(scene)
    config = _config(optimize)
    outer = mi.file_resolver()
    mi.set_file_resolver(mi.FileResolver(outer))
    try:
        return _instantiate(config, mi.parser.parse_dict(config, dict(scene)), plugins)
    finally:
        mi.set_file_resolver(outer)


def _arguments(parameters: Mapping[str, str]) -> dict[str, str]:
    for name in ("config", "filename"):
        if name in parameters:
            raise PathreplayError(f"Scene parameter '{name}' has a name that Mitsuba's parser keeps; rename ${name}")
    return dict(parameters)


def _require_regular_files(state: Any) -> None:
    """Raise PathreplayError where a plugin is to read a pipe or a device: Mitsuba would wait or read for ever."""
    for node in state.nodes:
        name = node.props.get("filename")
        problem = file_problem(str(mi.file_resolver().resolve(name))) if isinstance(name, str) else ""
        if problem not in ("", MISSING):  # Mitsuba says what is missing
            where = mi.parser.file_location(state, node)
            raise PathreplayError(f"File '{name}' of the scene {problem}; name a regular file ({where})")


def _config(optimize: bool) -> Any:
    config = mi.parser.ParserConfig(mi.variant())
    config.merge_equivalent = config.merge_meshes = optimize
    return config


def _instantiate(config: Any, state: Any, plugins: Mapping[str, str]) -> tuple[Any, list[str]]:
    exchanged = []
    for node in state.nodes:
        new = plugins.get(node.props.plugin_name())
        if new is not None:
            exchanged.append(f"{node.props.id() or 'unnamed'} ({mi.parser.file_location(state, node)})")
            node.props.set_plugin_name(new)
    _require_regular_files(state)
    require_sound_files(state)
    mi.parser.transform_all(config, state)
    with spare_thread():
        return mi.parser.instantiate(config, state), exchanged
