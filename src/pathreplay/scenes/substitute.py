"""Load a scene with some plugins replaced by others that have the same properties.

8-bit textures can also be stored as floating-point numbers, through an option of the plugin `bitmap`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import mitsuba as mi

from pathreplay.errors import PathreplayError
from pathreplay.platform.threads import spare_thread
from pathreplay.scenes.descriptions import copied, require_values
from pathreplay.scenes.scene_files import require_shallow, require_sound_files

Cameras = Mapping[str, Mapping[str, object]]
"""Sensors by id, as Mitsuba dictionaries."""


def load_file_with(
    path: str | Path,
    plugins: Mapping[str, str],
    parameters: Mapping[str, str] | None = None,
    cameras: Cameras | None = None,
    floats: Collection[str] = (),
) -> tuple[mi.Scene, list[str]]:
    """Load a file like `mi.load_file(path, optimize=False, **parameters)`, with some plugins replaced.

    ``plugins`` maps a type in the scene or an included file to the type to load instead, for example {"dielectric":
    "dielectric_ad"}. The new plugin must be registered. It receives the properties and the id of the replaced plugin,
    so that parameter keys are preserved. ``cameras`` are added to the sensors of the scene. ``floats`` are names of
    image files (without folders) whose `bitmap` textures are stored as floating-point numbers, regardless of the file
    format.

    Returns the scene (or object) and one line per replaced plugin, with its id and position in the file. Raises
    Mitsuba's RuntimeError if a file cannot be read or has a property unknown to the new plugin. Raises PathreplayError
    if a file would crash the process (see `require_shallow` and `require_sound_files`).
    """
    path = Path(path)
    parameters = parameters or {}
    for name in {"config", "filename"}.intersection(parameters):
        raise PathreplayError(f"Scene parameter '{name}' has a name reserved by Mitsuba's parser; rename ${name}")
    require_shallow(path)
    with parsing(path.parent) as config:
        state = mi.parser.parse_file(config, str(path), **parameters)
        return _instantiate(config, state, plugins, cameras, floats)


def load_dict_with(
    scene: Mapping[str, object],
    plugins: Mapping[str, str],
    cameras: Cameras | None = None,
    floats: Collection[str] = (),
) -> tuple[mi.Scene, list[str]]:
    """Load a dictionary like `mi.load_dict(scene, optimize=False)`, with the arguments of `load_file_with`.

    The dictionary is copied (see `copied`), and objects in it that are already loaded are not changed. Raises
    PathreplayError for a value of None.
    """
    require_values(scene)
    with parsing(None) as config:
        return _instantiate(config, mi.parser.parse_dict(config, copied(scene)), plugins, cameras, floats)


def exchange(props: mi.Properties, plugins: Mapping[str, str], floats: Collection[str]) -> bool:
    """Replace the plugin of an object, or make a bitmap store floats; return whether the plugin was replaced."""
    if (new := plugins.get(props.plugin_name())) is not None:
        props.set_plugin_name(new)
        return True
    if floats and props.plugin_name() == "bitmap" and Path(str(props.get("filename", ""))).name in floats:
        props["format"] = "variant"
    return False


@contextmanager
def parsing(folder: Path | None) -> Iterator[mi.parser.ParserConfig]:
    """Provide options for the parser. Within the block, Mitsuba also finds files relative to ``folder``."""
    config = mi.parser.ParserConfig(mi.variant())
    # Merging equal objects would change parameter keys.
    config.merge_equivalent = config.merge_meshes = False
    outer = mi.file_resolver()
    resolver = mi.FileResolver(outer)
    if folder is not None:
        resolver.prepend(mi.filesystem.path(str(folder)))
    mi.set_file_resolver(resolver)
    try:
        yield config
    finally:
        mi.set_file_resolver(outer)


def _instantiate(
    config: mi.parser.ParserConfig,
    state: mi.parser.ParserState,
    plugins: Mapping[str, str],
    cameras: Cameras | None,
    floats: Collection[str],
) -> tuple[mi.Scene, list[str]]:
    exchanged = []
    taken = {node.props.id() for node in state.nodes}
    for name, camera in (cameras or {}).items():
        if name in taken:
            raise PathreplayError(
                f"The scene has an object '{name}', which is also the name of an added camera; rename one"
            )
        state.root.props[name] = mi.load_dict(dict(camera))
    for node in state.nodes:
        if exchange(node.props, plugins, floats):
            exchanged.append(f"{node.props.id() or 'unnamed'} ({mi.parser.file_location(state, node)})")
    require_sound_files(state)
    mi.parser.transform_all(config, state)
    return instantiated(config, state), exchanged


def instantiated(config: mi.parser.ParserConfig, state: mi.parser.ParserState) -> mi.Scene:
    """Create the objects of a parsed scene. If this fails, the objects that were created already are deleted.

    Dr.Jit traces virtual calls through every live instance. An area light whose shape is missing would crash the next
    image of any scene (SIGSEGV), as long as a traceback keeps ``state`` alive.
    """
    try:
        with spare_thread():
            return mi.parser.instantiate(config, state)
    except Exception:
        state.nodes = type(state.nodes)()
        raise
