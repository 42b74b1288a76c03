"""Scenes by name or file: the one door through which every command loads a scene, with its names kept."""

from __future__ import annotations

import difflib
import inspect
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError

SceneDict = dict[str, Any]

BUILTINS: dict[str, Callable[..., SceneDict]] = {}
"""Built-in scenes: name -> function that returns a Mitsuba scene dictionary."""


def builtin(name: str) -> Callable[[Callable[..., SceneDict]], Callable[..., SceneDict]]:
    """Decorator that makes a function's scene dictionary known under ``name``."""

    def register(make: Callable[..., SceneDict]) -> Callable[..., SceneDict]:
        BUILTINS[name] = make
        return make

    return register


@builtin("cornell-box")
def cornell_box(resolution: int = 256) -> SceneDict:
    """Mitsuba's own Cornell box: two white boxes, a red and a green wall, one area light."""
    scene: SceneDict = mi.cornell_box()
    scene["sensor"]["film"].update(width=resolution, height=resolution)
    return scene


@builtin("cornell-box-photo")
def cornell_box_photo(resolution: int = 128, texture: int = 96) -> SceneDict:
    """The Cornell box with a grey picture (``texture`` x ``texture`` texels) as its back wall, seen by two sensors.

    ``overview`` is the classical camera. ``closeup`` stands in the box, behind the two white boxes, which were moved
    to the front so that it sees every texel of the wall. Key of the picture: ``back.bsdf.reflectance.data``.
    """
    T = mi.ScalarTransform4f
    scene = cornell_box(resolution)
    overview = scene.pop("sensor")
    # A texel is little wider than a pixel: a wider filter would blur neighbours into each other, slow to undo.
    overview["film"]["rfilter"] = {"type": "box"}
    scene["overview"] = overview
    scene["closeup"] = {
        **overview,
        # 1.3 from the wall, whose half side is 1: tan(fov / 2) = 1 / 1.3 and a margin of one per cent.
        "to_world": T().look_at(origin=[0, 0, 0.3], target=[0, 0, -1], up=[0, 1, 0]),
        "fov": 75.8,
    }
    scene["large-box"]["to_world"] = T().translate([-0.45, -0.65, 0.42]).rotate([0, 1, 0], 18).scale([0.26, 0.35, 0.26])
    scene["small-box"]["to_world"] = T().translate([0.45, -0.78, 0.5]).rotate([0, 1, 0], -17).scale(0.22)
    grey = mi.Bitmap(np.full((texture, texture, 3), 0.5, np.float32))
    scene["back"]["bsdf"] = {
        "type": "diffuse",
        # raw: the texels are linear reflectances, which is what is optimised.
        # to_uv turns v round: the first row of an image belongs at the top of the wall.
        "reflectance": {
            "type": "bitmap",
            "bitmap": grey,
            "raw": True,
            "wrap_mode": "clamp",
            "to_uv": T().translate([0, 1, 0]).scale([1, -1, 1]),
        },
    }
    return scene


def load_scene(spec: str | Path, base: Path | None = None, **parameters: Any) -> mi.Scene:
    """Load a scene so that its parameter keys keep the names that the file gives.

    ``spec`` is the path of a Mitsuba XML file (relative paths start at ``base``, or else at the current folder) or the
    name of a built-in scene (see ``BUILTINS``). ``parameters`` replace ``$name`` in the file, or are the arguments of
    the built-in. Needs an active Mitsuba variant.

    Raises:
        PathreplayError: no such file or built-in, a wrong parameter, a file that Mitsuba cannot read, no variant.
    """
    if mi.variant() is None:
        raise PathreplayError("No Mitsuba variant is active; call mitsuba.set_variant('llvm_ad_rgb') first")
    if str(spec) in BUILTINS:
        return _load_builtin(str(spec), parameters)
    path = Path(spec) if base is None else Path(base) / spec
    if not path.is_file():
        raise PathreplayError(_unknown(str(spec), path))
    arguments: dict[str, Any] = {name: str(value) for name, value in parameters.items()}
    try:
        # optimize=False: merging equal objects would lose the names by which parameters are addressed.
        scene = mi.load_file(str(path), optimize=False, **arguments)
    except (RuntimeError, ValueError, TypeError) as error:
        raise PathreplayError(f"Scene {path} cannot be loaded: {one_line(error)}") from error
    if not isinstance(scene, mi.Scene):
        raise PathreplayError(f"{path} describes no <scene> but a {type(scene).__name__}; wrap it in <scene>")
    return scene


def _load_builtin(name: str, parameters: dict[str, Any]) -> mi.Scene:
    make = BUILTINS[name]
    known = inspect.signature(make).parameters
    for key, value in parameters.items():
        if key not in known:
            raise PathreplayError(f"Built-in scene '{name}' has no parameter '{key}'; it has: {', '.join(known)}")
        if not isinstance(value, int) or isinstance(value, bool) or value < 1:
            raise PathreplayError(f"Parameter '{key}' of scene '{name}' is {value!r}; give a whole number above 0")
    return mi.load_dict(make(**parameters), optimize=False)


def _unknown(spec: str, path: Path) -> str:
    names = ", ".join(sorted(BUILTINS))
    neighbours = [p.name for p in path.parent.glob("*.xml")] if path.parent.is_dir() else []
    close = difflib.get_close_matches(Path(spec).name, [*BUILTINS, *neighbours], n=1, cutoff=0.5)
    hint = f"; did you mean '{close[0]}'?" if close else ""
    return f"No scene '{spec}': {path} is no file and no built-in has that name{hint} (built-ins: {names})"


def one_line(error: BaseException) -> str:
    """A Mitsuba or Dr.Jit error as one readable line: without C++ source positions, without a plugin's traceback."""
    text = str(error)
    if "PathreplayError: " in text:  # raised by a plugin of ours: it already is what the user should read
        return " ".join(text.rsplit("PathreplayError: ", 1)[1].split())
    text = re.sub(r"Traceback \(most recent call last\):\n(?:[ ]+.*\n)*", "", text)
    text = re.sub(r"\[[A-Za-z_]+\.cpp:\d+\] ", "", text)
    return " ".join(re.sub(r'(At|While loading) dictionary node "root": ', "", text).split())
