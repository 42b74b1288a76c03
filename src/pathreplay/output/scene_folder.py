"""Exports a scene to a folder with Mitsuba XML and all referenced files, which `mitsuba` renders to the same image."""

from __future__ import annotations

import gc
from collections import defaultdict
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.inverse.dataset.capture import put_inside
from pathreplay.inverse.parameters.values import Arrays
from pathreplay.output.nodes import Described, describe, require_no_objects
from pathreplay.output.placed import Placing, copied_files, made_otherwise
from pathreplay.output.xml import scene_xml
from pathreplay.platform.files import file_names
from pathreplay.platform.registration import PLUGINS
from pathreplay.platform.threads import spare_thread
from pathreplay.platform.traversal import traversed
from pathreplay.scenes.descriptions import errors_as
from pathreplay.scenes.loading import as_xml_has_them, coarse_pictures
from pathreplay.scenes.parameters import UNNAMED, get_array, is_empty, to_value
from pathreplay.scenes.stored import form_of
from pathreplay.scenes.substitute import load_dict_with, load_file_with
from pathreplay.types import Json

SCENE = "scene.xml"

_STANDS_IN = {"dielectric_ad": "dielectric"}
"""Mitsuba's equivalents of our plugins."""
_PARTICLES = "pathreplay_particles"
_DEPTHS = {"direct_projective": 2} | dict.fromkeys(
    ("pathreplay", _PARTICLES, "prb", "prb_basic", "prb_projective", "rb", "prbvolpath"), 6
)
"""Differentiable integrators and their default depths. Exported scenes have `path`, `volpath` or `ptracer` instead."""
_KEPT = ("max_depth", "rr_depth", "hide_emitters")
"""Properties that `path`, `volpath` and `ptracer` share with differentiable integrators."""


@dataclass(frozen=True)
class Source:
    """The description of a scene, before recovered values are assigned."""

    scene: str | Path | Mapping[str, object]
    """Path of an XML file, or a Mitsuba dictionary."""
    arguments: Mapping[str, str]
    """Values that replace ``$name`` in the file."""
    plugins: Mapping[str, str]
    """New plugin types by the old types that they replace."""
    cameras: Mapping[str, Mapping[str, object]]
    """Additional sensors by id."""
    medium: str | None = None
    """Id of the medium that surrounds the additional sensors."""

    def load(self, floats: Collection[str] = ()) -> mi.Scene:
        """Load the scene; `load_file_with` describes ``floats``.

        Raises the errors of Mitsuba, of `load_file_with` and of `put_inside`.
        """
        if isinstance(self.scene, Mapping):
            scene = load_dict_with(self.scene, self.plugins, self.cameras, floats)[0]
        else:
            scene = load_file_with(self.scene, self.plugins, self.arguments, self.cameras, floats)[0]
        if self.medium is not None:
            put_inside(scene, set(self.cameras), self.medium)
        return scene


@dataclass(frozen=True)
class Exported:
    """An exported scene: the scene with the assigned values, and its files."""

    scene: mi.Scene
    files: dict[str, bytes]
    """Content of new files by name."""
    copies: dict[str, Path]
    """Paths of files to copy, by new name."""
    notes: tuple[str, ...]
    """Differences from the original scene."""


def exported(source: Source, values: Arrays, integrator: Mapping[str, object] | None = None) -> Exported:
    """Export a scene with the given parameter values.

    Args:
        source: the scene.
        values: decoded values by parameter key.
        integrator: dictionary of the integrator; default: the scene's integrator, or `pathreplay` if the scene has
            none. `path`, `volpath` or `ptracer` replaces a differentiable integrator.

    Returns:
        The scene with these values, and the content of its files.

    Raises:
        PathreplayError: a Mitsuba scene file cannot describe a part of the scene.
    """
    with errors_as("The scene cannot be loaded", (RuntimeError, ValueError, TypeError)):
        scene, floats = _loaded(source, values)
        values = {**values, **_turned_suns(traversed(scene), values)}
        params = _set(scene, values)
        described, owners = describe(
            source.scene, source.arguments, source.plugins, source.cameras, floats, source.medium
        )
    keys = list(params.keys())
    if len(keys) != len(owners):
        raise PathreplayError("The scene differs each time it is loaded, and cannot be exported")
    names = file_names([*keys, *(shape.id() for shape in scene.shapes())])
    placing = Placing(described, scene, names, values)
    for key, owner in zip(keys, owners, strict=True):
        if owner.node is described.nodes[0]:  # the parameter belongs to an existing mesh object: `meshes` writes it
            continue
        if key in values or (owner.place == "data" and made_otherwise(owner.node)):
            placing.put(key, owner)
    placing.meshes()
    notes = _plain_plugins(described) + _plain_integrator(described, integrator)
    require_no_objects(described)
    copies = copied_files(described, placing.owners)
    files = {**placing.files, SCENE: scene_xml(described, not isinstance(source.scene, Mapping))}
    return Exported(scene, files, copies, tuple(notes))


def require_same(original: mi.Scene, folder: Path) -> None:
    """Raise PathreplayError unless the exported scene has the parameter values of the original, up to rounding."""
    gc.collect()
    try:
        with errors_as("The exported scene cannot be loaded"), spare_thread():
            copy = mi.load_file(str(folder / SCENE), optimize=False)
    except PathreplayError as error:
        remedy = "if a value is outside of its range, give the parameter 'lower' and 'upper'"
        raise PathreplayError(f"{error}; {remedy}") from None
    ours, theirs = traversed(original), traversed(copy)
    # Match objects without id by their order, which is the same in both scenes.
    waiting: defaultdict[str, list[str]] = defaultdict(list)
    for key in theirs.keys():
        waiting[UNNAMED.sub("object", key)].append(key)
    for key in ours.keys():
        others = waiting[UNNAMED.sub("object", key)]
        if not others or not _alike(ours[key], theirs[others.pop(0)]):
            raise PathreplayError(
                f"Parameter '{key}' of {ours.properties[key][2].class_name()} is missing or different in the exported "
                "scene; it cannot be exported"
            )


def _alike(value: object, other: object) -> bool:
    if isinstance(value, (bool, int, str)) or isinstance(other, (bool, int, str)):
        return bool(value == other)
    if dr.is_array_v(value) and dr.is_array_v(other) and dr.is_float_v(value) != dr.is_float_v(other):
        return False
    try:
        a, b = (_numbers(x) for x in (value, other))
    except (TypeError, ValueError):
        return True  # values that are not numeric arrays are not compared: no run optimizes them
    if a.size == 0 or b.size == 0:
        return a.size == b.size
    a, b = (x.astype(np.float64).ravel() for x in (a, b))
    a, b = (
        np.full(max(a.size, b.size), x[0]) if x.size == 1 else x for x in (a, b)
    )  # a grey colour may be a single number
    return a.shape == b.shape and np.allclose(a, b, rtol=1e-5, atol=1e-6 * (1 + np.abs(a).max()))


def _numbers(value: Any) -> np.ndarray:
    if hasattr(value, "matrix") and not dr.is_jit_v(value.matrix):
        return np.array(value.matrix, np.float64)
    if dr.is_array_v(value) or isinstance(value, float) or hasattr(value, "matrix"):
        return np.zeros(0) if not isinstance(value, float) and is_empty(value) else get_array(value)
    return np.array(value, np.float64)


def _loaded(source: Source, values: Arrays) -> tuple[mi.Scene, tuple[str, ...]]:
    """Load the scene, and return it with the names of the image files whose texels are stored as floats.

    These are the 8-bit textures with a recovered value; runs store their texels as floats.
    """
    scene = source.load()
    floats = coarse_pictures(traversed(scene), values)
    if floats:
        del scene
        gc.collect()  # Dr.Jit traces virtual calls through every instance in memory
        scene = source.load(floats)
    return scene, floats


def _turned_suns(params: mi.SceneParameters, values: Arrays) -> Arrays:
    """Return the directions of suns after a rotation by a recovered ``to_world``, by parameter key.

    When ``to_world`` of a `sunsky` is assigned, Mitsuba rotates the sun, but does not update the parameter
    ``sun_direction``. When Mitsuba loads a `sunsky`, ``sun_direction`` is the direction after ``to_world``. A `sunsky`
    with a date has no property ``sun_direction``.
    """
    suns = {}
    for key, value in values.items():
        sky, _, name = key.rpartition(".")
        sun = f"{sky}.sun_direction"
        if name == "to_world" and sun in params and f"{sky}.hour" not in params and sun not in values:
            new, old = (np.asarray(matrix, np.float64)[:3, :3] for matrix in (value, get_array(params[key])))
            suns[sun] = np.float32(new @ np.linalg.inv(old) @ get_array(params[sun]).ravel())
    return suns


def _set(scene: mi.Scene, values: Arrays) -> mi.SceneParameters:
    params = traversed(scene)
    for key, value in values.items():
        if key not in params:
            raise PathreplayError(f"The scene no longer has the parameter '{key}'; export with the scene of the run")
        form = form_of(params, key)
        seen = form.see(params[key])
        array = np.ascontiguousarray(value, np.float32)
        if key.endswith(".sun_direction"):  # `sunsky` normalizes it when it is loaded
            array = array / np.linalg.norm(array)
        params[key] = form.store(type(seen)(array) if dr.is_tensor_v(seen) else to_value(seen, array))
    params.update()
    return traversed(scene)


def _plain_plugins(described: Described) -> list[str]:
    """Replace pathreplay's plugins by equivalents of Mitsuba, and return notes on plugins without an equivalent."""
    notes = []
    for node in described.nodes:
        name = node.props.plugin_name()
        if name in _STANDS_IN:
            node.props.set_plugin_name(_STANDS_IN[name])
        elif name in PLUGINS and node.type != mi.ObjectType.Integrator:
            notes.append(f"the scene needs the plugin '{name}' of pathreplay: import pathreplay before loading it")
    return notes


def _plain_integrator(described: Described, wanted: Mapping[str, object] | None) -> list[str]:
    """Set the ``wanted`` integrator; default: the scene's, or `pathreplay` if the scene has none.

    `ptracer` replaces `pathreplay_particles`, and `path` or `volpath` other differentiable integrators. Returns notes
    about the replacement, and about the light paths that it lacks.
    """
    root = described.nodes[0]
    children = dict(described.children(root))
    own = next((name for name, node in children.items() if node.type == mi.ObjectType.Integrator), None)
    if wanted is not None:
        options: Json = dict(wanted)
    elif own is None:
        options = {"type": "pathreplay"}  # the default integrator of jobs
    else:
        props = children[own].props
        read = [name for name in (*_KEPT, "caustics") if name in props]
        options = {"type": props.plugin_name(), **{name: props.get(name) for name in read}}
    name = options.pop("type")
    depth = _DEPTHS.get(name)
    if wanted is None and own is not None and depth is None:
        return []
    media = any(node.type == mi.ObjectType.Medium for node in described.nodes)
    plain = "ptracer" if name == _PARTICLES else "volpath" if media else "path"
    properties = mi.Properties(name if depth is None else plain)
    caustics = options.get("caustics")
    if depth is not None:
        options = {"max_depth": depth, **{option: value for option, value in options.items() if option in _KEPT}}
    for option, value in options.items():
        properties[option] = value
    if own is not None:
        del root.props[own]
    root.props["integrator"] = described.add(properties, mi.ObjectType.Integrator)
    if depth is None:
        return []
    notes = [f"'{plain}' renders the exported scene instead of '{name}', a differentiable integrator"]
    if caustics == "particles":
        given = as_xml_has_them({"caustics": caustics, **options})
        flags = " ".join(f"-I {option}={value}" for option, value in given.items())
        notes.append(
            f"'{plain}' renders no caustics of lights without extent, and other caustics with more noise; to render "
            f"them, append `--integrator {name} {flags}` to the command `pathreplay render`"
        )
    return notes
