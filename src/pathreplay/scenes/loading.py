"""Scenes by name or file: the one door through which every command loads a scene, with its names kept."""

from __future__ import annotations

import difflib
import gc
import inspect
import re
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi

from pathreplay.errors import PathreplayError, shown
from pathreplay.platform import memory
from pathreplay.platform.files import MISSING, file_problem
from pathreplay.platform.traversal import traversed
from pathreplay.scenes import parameters as scene_parameters
from pathreplay.scenes.builtin import BUILTINS, COSTS, SceneDict
from pathreplay.scenes.descriptions import told
from pathreplay.scenes.substitute import Cameras, load_dict_with, load_file_with

# What Mitsuba calls the class of a `bitmap` in 8 bits.
_COARSE = "BitmapTextureImpl[uint8]"


def load_scene(spec: str | Path, base: Path | None = None, /, **parameters: Any) -> mi.Scene:
    """Load a scene so that its parameter keys keep the names that the file gives.

    ``spec`` is the path of a Mitsuba XML file (relative paths start at ``base``, or else at the current folder) or the
    name of a built-in scene (see ``BUILTINS``). ``parameters`` replace ``$name`` in the file, or are the arguments of
    the built-in. Needs an active Mitsuba variant.

    Raises PathreplayError for no such file or built-in, a wrong parameter, what Mitsuba cannot read, no variant.
    """
    return load_scene_with(spec, {}, base, **parameters)[0]


def load_scene_with(
    spec: str | Path | SceneDict,
    plugins: Mapping[str, str],
    base: Path | None = None,
    cameras: Cameras | None = None,
    floats: Collection[str] = (),
    /,
    **parameters: Any,
) -> tuple[mi.Scene, list[str]]:
    """`load_scene` with plugins exchanged (old type -> new type), and one line for each that was: id and place.

    ``spec`` may be a dictionary, too. ``cameras`` are added to those of the scene. For ``floats`` see `load_file_with`.
    """
    if mi.variant() is None:
        raise PathreplayError("No Mitsuba variant is active; call mitsuba.set_variant('llvm_ad_rgb') first")
    if isinstance(spec, Mapping):
        with told("The scene's dictionary cannot be loaded", (RuntimeError, ValueError, TypeError)):
            scene, exchanged = load_dict_with(_copied(spec), plugins, cameras, floats)
        if not isinstance(scene, mi.Scene):
            raise PathreplayError(f"The dictionary describes no scene but a {type(scene).__name__}; give a 'scene'")
        return scene, exchanged
    if str(spec) in BUILTINS:
        with told(f"Built-in scene '{spec}' cannot be made of {parameters}"):
            return load_dict_with(builtin_dict(str(spec), parameters), plugins, cameras, floats)
    path = Path(spec) if base is None else Path(base) / spec
    if (problem := file_problem(path)) == MISSING:
        raise PathreplayError(_unknown(str(spec), path))
    if problem:
        raise PathreplayError(f"Scene {path} {problem}; give the path of a Mitsuba XML file")
    arguments = as_xml_has_them(parameters)
    with told(f"Scene {path} cannot be loaded", (RuntimeError, ValueError, TypeError)):
        scene, exchanged = load_file_with(path, plugins, arguments, cameras, floats)
    if not isinstance(scene, mi.Scene):
        raise PathreplayError(f"{path} describes no <scene> but a {type(scene).__name__}; wrap it in <scene>")
    return scene, exchanged


def _copied(description: Mapping[str, Any]) -> SceneDict:
    """A dictionary with tensors of its own: Mitsuba moves those of a dictionary into what it loads."""
    return {
        name: _copied(value) if isinstance(value, Mapping) else type(value)(value) if dr.is_array_v(value) else value
        for name, value in description.items()
    }


def as_xml_has_them(parameters: Mapping[str, Any]) -> dict[str, str]:
    """Scene parameters as texts: true and not True."""
    return {name: str(v).lower() if isinstance(v, bool) else str(v) for name, v in parameters.items()}


def load_scene_for(
    spec: str | Path | SceneDict,
    wanted: Iterable[str],
    base: Path | None = None,
    cameras: Cameras | None = None,
    /,
    **parameters: Any,
) -> tuple[mi.Scene, tuple[str, ...]]:
    """Load a scene in which the ``wanted`` keys and globs carry derivatives, as far as exchanging plugins brings it.

    Where a pattern that ends in ``eta`` matches the index of a ``dielectric``, the scene is loaded once more with
    `dielectric_ad` in the place of every ``dielectric``; where one that ends in ``data`` matches a texture of 8
    bits, with its texels as floating-point numbers. ``cameras`` are added to those of the scene. Returns the scene and
    what is to be said about it, one line each. Patterns that match nothing are left for others to complain about.
    Raises what `load_scene` does.
    """
    scene, _ = load_scene_with(spec, {}, base, cameras, **parameters)
    params = traversed(scene)
    eta = _matching(params, wanted, "eta")
    smooth = any(scene_parameters.owner_class(params, key) == "SmoothDielectric" for key in eta)
    plugins, floats = {"dielectric": "dielectric_ad"} if smooth else {}, coarse_pictures(params, wanted)
    if not plugins and not floats:
        return scene, ()
    # Dr.Jit traces calls through every instance alive, so the first scene has to go before the second one comes.
    del scene, params
    gc.collect()
    scene, exchanged = load_scene_with(spec, plugins, base, cameras, floats, **parameters)
    notes = [f"stored the texels of '{name}' as floating-point numbers: they carry derivatives" for name in floats]
    if exchanged:
        count = "one" if len(exchanged) == 1 else f"all {len(exchanged)}"
        notes.append(f"replaced 'dielectric' by 'dielectric_ad' ({count} of them): its eta carries a derivative")
    return scene, tuple(notes)


def load_scene_with_floats(
    spec: str | Path, wanted: Iterable[str], base: Path | None = None, /, **parameters: Any
) -> mi.Scene:
    """`load_scene` with textures of 8 bits as floating-point numbers where ``wanted`` keys and globs name them."""
    scene = load_scene(spec, base, **parameters)
    if not (floats := coarse_pictures(traversed(scene), wanted)):
        return scene
    del scene
    gc.collect()
    return load_scene_with(spec, {}, base, None, floats, **parameters)[0]


def coarse_pictures(params: Any, wanted: Iterable[str]) -> tuple[str, ...]:
    """The files of the textures that keys and globs ending in ``data`` name and Mitsuba holds as 8-bit integers."""
    owners = [params.properties[key][2] for key in _matching(params, wanted, "data")]
    found = [re.search(r'name = "(.*)"', str(owner)) for owner in owners if owner.class_name() == _COARSE]
    return tuple(dict.fromkeys(match[1] for match in found if match))


def _matching(params: Any, wanted: Iterable[str], name: str) -> list[str]:
    """The keys that patterns with this last part name."""
    keys: list[str] = []
    for pattern in wanted:
        if pattern.rsplit(".", 1)[-1] == name:
            with suppress(PathreplayError):
                keys += scene_parameters.resolve_keys(params, pattern)
    return keys


def builtin_dict(name: str, parameters: Mapping[str, Any]) -> SceneDict:
    """The built-in scene of that name. Raises PathreplayError for a wrong parameter."""
    make = BUILTINS[name]
    known = inspect.signature(make).parameters
    for key, value in parameters.items():
        if key not in known:
            raise PathreplayError(f"Built-in scene '{name}' has no parameter '{key}'; it has: {', '.join(known)}")
        what = f"Parameter '{key}' of scene '{name}' is {shown(value)}"
        if not isinstance(value, int) or isinstance(value, bool) or value < 1:
            raise PathreplayError(f"{what}; give a whole number above 0")
        if key in COSTS:
            memory.require(COSTS[key](value), f"{what} and", "take a smaller number")
    return make(**parameters)


def _unknown(spec: str, path: Path) -> str:
    names = ", ".join(sorted(BUILTINS))
    neighbours = [p.name for p in path.parent.glob("*.xml")] if path.parent.is_dir() else []
    close = difflib.get_close_matches(Path(spec).name, [*BUILTINS, *neighbours], n=1, cutoff=0.5)
    hint = f"; did you mean '{close[0]}'?" if close else ""
    return f"No scene '{spec}': {path} is no file and no built-in has that name{hint} (built-ins: {names})"
