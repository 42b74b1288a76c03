"""Load scenes from files, dictionaries or the names of built-in scenes, and preserve the keys of parameters."""

from __future__ import annotations

import difflib
import gc
import inspect
import re
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from pathlib import Path

import mitsuba as mi

from pathreplay.errors import PathreplayError, shown
from pathreplay.platform import memory
from pathreplay.platform.files import MISSING, file_problem
from pathreplay.platform.traversal import traversed
from pathreplay.scenes import parameters as scene_parameters
from pathreplay.scenes.builtin import BUILTINS, COSTS, SceneDict
from pathreplay.scenes.descriptions import errors_as
from pathreplay.scenes.substitute import Cameras, load_dict_with, load_file_with

# Class name of a `bitmap` stored in 8 bits.
_COARSE = "BitmapTextureImpl[uint8]"


def load_scene(spec: str | Path, base: Path | None = None, /, **parameters: object) -> mi.Scene:
    """Load a scene such that parameter keys contain the ids of the objects in the file.

    ``spec`` is the path of a Mitsuba XML file, relative to ``base`` (default: the current folder), or the name of a
    built-in scene (see ``BUILTINS``). ``parameters`` are the values of ``$name`` in the file, or the arguments of the
    built-in scene. A Mitsuba variant must be active.

    Raises PathreplayError if the scene does not exist, a parameter is wrong, Mitsuba cannot read the scene, or no
    variant is active.
    """
    return load_scene_with(spec, {}, base, **parameters)[0]


def load_scene_with(
    spec: str | Path | SceneDict,
    plugins: Mapping[str, str],
    base: Path | None = None,
    cameras: Cameras | None = None,
    floats: Collection[str] = (),
    /,
    **parameters: object,
) -> tuple[mi.Scene, list[str]]:
    """Load a scene like `load_scene`, with some plugins replaced. ``plugins`` maps old plugin types to new types.

    ``spec`` may also be a dictionary. ``cameras`` are added to the sensors of the scene. `load_file_with` describes
    ``floats``. Returns the scene, and one line per replaced plugin. The line contains the id of the plugin, and its
    position in the scene file.
    """
    if mi.variant() is None:
        raise PathreplayError("No Mitsuba variant is active; call mitsuba.set_variant('llvm_ad_rgb') first")
    if isinstance(spec, Mapping):
        with errors_as("The scene's dictionary cannot be loaded", (RuntimeError, ValueError, TypeError)):
            scene, exchanged = load_dict_with(spec, plugins, cameras, floats)
        if not isinstance(scene, mi.Scene):
            raise PathreplayError(f"The dictionary describes a {type(scene).__name__}, not a scene; give a 'scene'")
        return scene, exchanged
    if str(spec) in BUILTINS:
        with errors_as(f"Built-in scene '{spec}' cannot be created with {parameters}"):
            made = builtin_dict(str(spec), parameters)
            glass = _exchanged_glass(made, plugins)
            scene, exchanged = load_dict_with(made, plugins, cameras, floats)
        return scene, [*glass, *exchanged]
    path = Path(spec) if base is None else Path(base) / spec
    if (problem := file_problem(path)) == MISSING:
        raise PathreplayError(_unknown(str(spec), path))
    if problem:
        raise PathreplayError(f"Scene {path} {problem}; give the path of a Mitsuba XML file")
    arguments = as_xml_has_them(parameters)
    with errors_as(f"Scene {path} cannot be loaded", (RuntimeError, ValueError, TypeError)):
        scene, exchanged = load_file_with(path, plugins, arguments, cameras, floats)
    if not isinstance(scene, mi.Scene):
        raise PathreplayError(f"{path} describes a {type(scene).__name__}, not a <scene>; wrap it in <scene>")
    return scene, exchanged


def as_xml_has_them(parameters: Mapping[str, object]) -> dict[str, str]:
    """Convert scene parameters to XML text, for example True to 'true'."""
    return {name: str(v).lower() if isinstance(v, bool) else str(v) for name, v in parameters.items()}


def load_scene_for(
    spec: str | Path | SceneDict,
    wanted: Iterable[str],
    base: Path | None = None,
    cameras: Cameras | None = None,
    /,
    **parameters: object,
) -> tuple[mi.Scene, tuple[str, ...]]:
    """Load a scene, and replace plugins where this makes the ``wanted`` parameters (keys, globs) differentiable.

    If a pattern that ends in ``eta`` matches the index of a ``dielectric``, the scene is loaded again with
    `dielectric_ad` in place of every ``dielectric``. If a pattern that ends in ``data`` matches an 8-bit texture, the
    scene is loaded again with floating-point texels for this texture. ``cameras`` are added to the sensors of the
    scene. Returns the scene and a one-line note for each kind of change. A pattern that matches no key causes no error
    in this function. Raises the same errors as `load_scene`.
    """
    scene, _ = load_scene_with(spec, {}, base, cameras, **parameters)
    params = traversed(scene)
    eta = _matching(params, wanted, "eta")
    smooth = any(scene_parameters.owner_class(params, key) == "SmoothDielectric" for key in eta)
    plugins, floats = {"dielectric": "dielectric_ad"} if smooth else {}, coarse_pictures(params, wanted)
    if not plugins and not floats:
        return scene, ()
    # Dr.Jit traces virtual calls through every live instance. The first scene must therefore be freed before the second
    # scene is loaded.
    del scene, params
    gc.collect()
    scene, exchanged = load_scene_with(spec, plugins, base, cameras, floats, **parameters)
    names = [f"'{name}'" if name else "images in memory" for name in floats]
    notes = [f"stored the texels of {name} as floating-point numbers: they carry derivatives" for name in names]
    if exchanged:
        count = "one" if len(exchanged) == 1 else f"all {len(exchanged)}"
        notes.append(f"replaced 'dielectric' by 'dielectric_ad' ({count} of them): its eta carries a derivative")
    return scene, tuple(notes)


def load_scene_with_floats(
    spec: str | Path, wanted: Iterable[str], base: Path | None = None, /, **parameters: object
) -> mi.Scene:
    """Load a scene like `load_scene`, and convert 8-bit textures that match ``wanted`` (keys, globs) to floats."""
    scene = load_scene(spec, base, **parameters)
    if not (floats := coarse_pictures(traversed(scene), wanted)):
        return scene
    del scene
    gc.collect()
    return load_scene_with(spec, {}, base, None, floats, **parameters)[0]


def coarse_pictures(params: mi.SceneParameters, wanted: Iterable[str]) -> tuple[str, ...]:
    """Return the image files of 8-bit textures whose texels match a pattern in ``wanted``.

    An empty name stands for the images in memory. Only patterns whose last part is ``data`` are used.
    """
    owners = [params.properties[key][2] for key in _matching(params, wanted, "data")]
    matches = [re.search(r'name = "(.*)"', str(owner)) for owner in owners if owner.class_name() == _COARSE]
    return tuple(dict.fromkeys(match[1] for match in matches if match))


def _matching(params: mi.SceneParameters, wanted: Iterable[str], name: str) -> list[str]:
    """Return the keys that match a pattern in ``wanted``. Only patterns whose last part is ``name`` are used."""
    keys: list[str] = []
    for pattern in wanted:
        if pattern.rsplit(".", 1)[-1] == name:
            with suppress(PathreplayError):
                keys += scene_parameters.resolve_keys(params, pattern)
    return keys


def builtin_dict(name: str, parameters: Mapping[str, object]) -> SceneDict:
    """Return the dictionary of a built-in scene. Raises PathreplayError for a wrong parameter."""
    make = BUILTINS[name]
    known = inspect.signature(make).parameters
    for key, value in parameters.items():
        if key not in known:
            raise PathreplayError(f"Built-in scene '{name}' has no parameter '{key}'; it has: {', '.join(known)}")
        what = f"Parameter '{key}' of scene '{name}' is {shown(value)}"
        kind = str(known[key].annotation).removesuffix(" | None")
        if remedy := _remedy(kind, value):
            raise PathreplayError(f"{what}; give {remedy}")
        if key in COSTS:
            assert isinstance(value, int)  # `_remedy` has checked the type
            memory.require(COSTS[key](value), f"{what} and", "give a smaller number")
    return make(**parameters)


def _exchanged_glass(scene: SceneDict, plugins: Mapping[str, str]) -> list[str]:
    """Replace the `dielectric` of the meshes of a built-in scene, which `load_dict_with` does not change.

    Returns one line per replaced plugin, with the id of its mesh.
    """
    glass = {
        name: mesh
        for name, mesh in scene.items()
        if "dielectric" in plugins and isinstance(mesh, mi.Mesh) and mesh.bsdf().class_name() == "SmoothDielectric"
    }
    for mesh in glass.values():
        index = mi.traverse(mesh.bsdf())["eta"]
        mesh.set_bsdf(mi.load_dict({"type": plugins["dielectric"], "int_ior": index, "ext_ior": 1.0}))
    return [f"{name} (mesh of the built-in scene)" for name in glass]


def _remedy(kind: str, value: object) -> str:
    """Describe the valid values of a built-in scene's argument. Return an empty string if ``value`` is valid."""
    if kind == "bool":
        return "" if isinstance(value, bool) else "true or false"
    if kind == "float":
        given = isinstance(value, int | float) and not isinstance(value, bool) and 1e-3 <= value <= 1e3
        return "" if given else "a number from 0.001 to 1000"
    given = isinstance(value, int) and not isinstance(value, bool) and value >= 1
    return "" if given else "a whole number above 0"


def _unknown(spec: str, path: Path) -> str:
    names = ", ".join(sorted(BUILTINS))
    neighbours = [p.name for p in path.parent.glob("*.xml")] if path.parent.is_dir() else []
    close = difflib.get_close_matches(Path(spec).name, [*BUILTINS, *neighbours], n=1, cutoff=0.5)
    hint = f"; did you mean '{close[0]}'?" if close else ""
    return f"No scene '{spec}': neither the file {path} nor a built-in of that name exists{hint} (built-ins: {names})"
