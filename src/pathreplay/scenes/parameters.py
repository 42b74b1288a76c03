"""Find scene parameters by key, report which parameters are differentiable, and convert parameters to and from NumPy.

A parameter is addressed by its key in ``mi.traverse(scene)``. Conversion to NumPy and back preserves types: ``Float``,
``Color3f`` and similar types, ``TensorXf`` (textures, grids) and ``AffineTransform4f``.
"""

from __future__ import annotations

import difflib
import fnmatch
import math
import re
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from pathreplay.errors import PathreplayError
from pathreplay.platform.owned_arrays import with_space

if TYPE_CHECKING:
    from typing_extensions import TypeIs

T = TypeVar("T")
SceneValue: TypeAlias = "dr.ArrayBase | mi.Transform4f"
"""A differentiable value of `mi.SceneParameters`."""

# Name that Mitsuba gives to an object without id; the number is a memory address.
UNNAMED = re.compile(r"object_\d{9,}")

# Remedies for values that Mitsuba 3.9 stores without derivatives, by (class of the owner, last part of the key).
_WAY_OUT = {
    ("SmoothDielectric", "eta"): (
        "BSDF 'dielectric' stores it as a plain number; use BSDF 'dielectric_ad' of this package instead, "
        "whose eta is differentiable"
    ),
    ("SmoothPlastic", "eta"): (
        "BSDF 'plastic' stores it as a plain number and there is no replacement yet; "
        "keep it constant, and differentiate the reflectances"
    ),
    ("BitmapTextureImpl[uint8]", "data"): (
        "Mitsuba stores the texels of this image as 8-bit integers; give the 'bitmap' texture the option "
        "format='variant', which stores them as floating-point numbers"
    ),
    ("HeterogeneousMedium", "scale"): (
        "medium 'heterogeneous' stores it as a plain number; leave it at 1 and multiply the values of 'sigma_t' instead"
    ),
    ("HomogeneousMedium", "scale"): (
        "medium 'homogeneous' stores it as a plain number; leave it at 1 and multiply the value of 'sigma_t' instead"
    ),
}


def resolve_keys(params: Mapping[str, object], patterns: str | Iterable[str], owner: str = "the scene") -> list[str]:
    """Return the keys that match ``patterns``, without duplicates, in the order of the patterns.

    A pattern is an exact key or a shell-style glob (``*``, ``?``, ``[abc]``). The keys that match one glob are in the
    order of the scene. Globs match whole keys, including dots. Names may contain brackets: if a glob matches nothing,
    its brackets are treated as literal characters. ``params`` is the result of ``mi.traverse(scene)``, or another
    dictionary by key, which messages call ``owner``.

    Raises PathreplayError, which lists the nearest keys, if a pattern matches nothing.
    """
    known = list(params.keys())
    selected: dict[str, None] = {}
    for pattern in [patterns] if isinstance(patterns, str) else patterns:
        # In a glob, '[[]' matches the character '['.
        literal = pattern.replace("[", "[[]")
        matches = [pattern] if pattern in known else fnmatch.filter(known, pattern) or fnmatch.filter(known, literal)
        if not matches:
            raise PathreplayError(_no_match(known, pattern, owner))
        selected.update(dict.fromkeys(matches))
    return list(selected)


def notes_on_ids(params: mi.SceneParameters, patterns: Iterable[str]) -> tuple[str, ...]:
    """Return notes on globs in ``patterns`` that match parameters of objects without id.

    Mitsuba calls such an object by its address in memory. No other process can resume or export a run by this name.
    """
    found = (
        (pattern, UNNAMED.sub("", key)[1:])
        for pattern in patterns
        for key in params.keys()
        if UNNAMED.match(key) and fnmatch.fnmatchcase(key, pattern)
    )
    return tuple(
        f"'{pattern}' matches '{place}' of an object without id, whose name is an address in memory; give it an id "
        "in the scene file to resume or export this run"
        for pattern, place in dict(found).items()
    )


def keep_only(params: mi.SceneParameters, keys: Iterable[str]) -> None:
    """Reduce ``mi.traverse(scene)`` to exactly these keys; Mitsuba's ``keep`` treats keys as regular expressions."""
    params.keep([rf"{re.escape(key)}\Z" for key in keys])


def _no_match(known: list[str], pattern: str, owner: str) -> str:
    if not known:
        return f"No parameter '{pattern}': {owner} has no parameters"
    # Keys are compared in lower case, so that a wrong capital letter does not matter. With a cutoff of 0.5, 'red.bsdf'
    # is similar to 'red.bsdf.reflectance.value'.
    lower = {key.lower(): key for key in known}
    close = [lower[match] for match in difflib.get_close_matches(pattern.lower(), lower, n=3, cutoff=0.5)]
    if close:
        return f"No parameter '{pattern}' in {owner}; nearest: {', '.join(close)}"
    listed = f"mitsuba.traverse(scene) lists all {len(known)}"
    if owner != "the scene":
        listed = f"it has {', '.join(known[:8])}{', ...' if len(known) > 8 else ''}"
    return f"No parameter '{pattern}' in {owner}, and no similar one; {listed}"


def owner_class(params: mi.SceneParameters, key: str) -> str:
    """Return the name of the class that owns a parameter, for example 'SmoothDielectric' for plugin 'dielectric'."""
    return str(params.properties[key][2].class_name())


def require_differentiable(params: mi.SceneParameters, key: str, integrator: mi.Integrator | None = None) -> None:
    """Raise PathreplayError unless ``integrator`` can differentiate the parameter ``key``.

    If ``integrator`` is None, Mitsuba's own integrators must be able to differentiate the parameter.

    The error is raised for missing keys, plain numbers, integers, empty arrays, and most parameters with the flag
    ``mi.ParamFlags.NonDifferentiable`` (see `carries_derivative`). The message names a remedy if there is one.
    """
    if key not in params:
        raise PathreplayError(_no_match(list(params.keys()), key, "the scene"))
    if carries_derivative(params, key, integrator):
        return
    value = params[key]
    owner = owner_class(params, key)
    if (known := _WAY_OUT.get((owner, key.rsplit(".", 1)[-1]))) is not None:
        raise PathreplayError(f"Parameter '{key}' carries no derivative: {known}")
    if needs_ray_adjoint(params, key):
        raise PathreplayError(
            f"Parameter '{key}' carries no derivative through this integrator: only 'pathreplay' differentiates "
            "cameras and the motion of emitters; use it, with attach = 'delta' (its default) or 'all'"
        )
    if _is_float(value) and is_empty(value):
        raise PathreplayError(
            f"Parameter '{key}' is empty: its {owner} has no such values; add them to the file, or leave the key out"
        )
    if isinstance(value, (bool, int, float)):
        why = f"its {owner} stores it as a plain number ({value!r})"
    elif not _is_float(value):
        why = f"it is a {type(value).__name__}"
    else:
        why = f"Mitsuba marks this parameter of {owner} as not differentiable"
    raise PathreplayError(f"Parameter '{key}' carries no derivative: {why}; choose one that mi.traverse marks with ∂")


def require_settable(params: mi.SceneParameters, key: str) -> None:
    """Raise PathreplayError, with the remedy, unless floating-point numbers can be assigned to a parameter."""
    value = params[key]
    if isinstance(value, float) or _is_float(value):
        return
    known = _WAY_OUT.get((owner_class(params, key), key.rsplit(".", 1)[-1]))
    why = known or f"it is a {type(value).__name__}; set it in the scene file"
    raise PathreplayError(f"Parameter '{key}' cannot be given a value: {why}")


def resolve_differentiable(
    params: mi.SceneParameters, patterns: str | Iterable[str], integrator: mi.Integrator | None = None
) -> list[str]:
    """Return the differentiable keys among those that `resolve_keys` returns.

    Raises PathreplayError if a pattern matches no key, or no differentiable key.
    """
    selected: dict[str, None] = {}
    for pattern in [patterns] if isinstance(patterns, str) else patterns:
        matches = resolve_keys(params, pattern)
        usable = [key for key in matches if carries_derivative(params, key, integrator)]
        if not usable:
            require_differentiable(params, matches[0], integrator)
        selected.update(dict.fromkeys(usable))
    return list(selected)


def carries_derivative(params: mi.SceneParameters, key: str, integrator: mi.Integrator | None = None) -> bool:
    """Return whether a parameter is differentiable.

    A differentiable parameter is a non-empty Dr.Jit float array. For most integrators, it must not have the flag
    ``mi.ParamFlags.NonDifferentiable``. Mitsuba sets this flag for parameters of cameras and for parameters that move
    emitters. The integrator ``pathreplay`` differentiates such parameters nevertheless, unless its ``attach`` is
    'none'.
    """
    if not _is_float(params[key]) or is_empty(params[key]):
        return False
    if not params.flags(key) & mi.ParamFlags.NonDifferentiable:
        return True
    return getattr(integrator, "moves_rays", False) and needs_ray_adjoint(params, key)


# Parameters that `pathreplay` differentiates. Mitsuba marks them as NonDifferentiable, because its own integrators drop
# their derivatives. tests/scenes/test_cameras_and_lights.py compares each derivative with finite differences.
_PRINCIPAL_POINT = {"principal_point_offset_x", "principal_point_offset_y"}
_CAMERA = {"to_world", "x_fov", "aperture_radius", "focus_distance"} | _PRINCIPAL_POINT
_LIGHT = {"to_world", "position"}


def needs_ray_adjoint(params: mi.SceneParameters, key: str) -> bool:
    """Return whether a parameter belongs to a camera, or moves an emitter that has no shape.

    To differentiate such a parameter, an integrator needs the adjoints of rays. Mitsuba's integrators do not compute
    them.
    """
    node, name = params.properties[key][2], key.rsplit(".", 1)[-1]
    placed = (isinstance(node, mi.Sensor) and name in _CAMERA) or (isinstance(node, mi.Emitter) and name in _LIGHT)
    return placed and _is_float(params[key])


def is_transform(value: object) -> TypeIs[mi.Transform4f]:
    """Return whether a value is a transform of Dr.Jit floats, like ``to_world``."""
    # Dr.Jit arrays also have an attribute ``matrix``. Scalar transforms (``to_uv`` of textures) contain no Dr.Jit array
    # and have no derivative.
    return not dr.is_array_v(value) and hasattr(value, "matrix") and dr.is_diff_v(value.matrix)


def _array(value: T) -> T | mi.Matrix4f:
    """Return the Dr.Jit array of a value; for a transform, return its matrix."""
    return value.matrix if is_transform(value) else value


def _is_float(value: object) -> bool:
    array = _array(value)
    return bool(dr.is_array_v(array) and dr.is_float_v(array) and dr.is_diff_v(array))


def is_empty(value: object) -> bool:
    """Return whether an array has no entries, for example if a mesh has no texture coordinates."""
    return 0 in dr.shape(_array(value))


def require_finite(params: mi.SceneParameters) -> None:
    """Raise PathreplayError, which names key and index, if a parameter contains NaN or infinite values.

    Plain numbers, for example distances, may be infinite. The check costs one reduction per array.
    """
    counts: dict[str, mi.UInt32] = {}
    for key in params.keys():
        value = params[key]
        if isinstance(value, float) and math.isnan(value):
            raise PathreplayError(f"Parameter '{key}' is NaN; give it a number in the scene file")
        if _is_float(value) and not is_empty(value):
            counts[key] = dr.count(~dr.isfinite(dr.ravel(dr.detach(_array(value)))))
    dr.eval(*counts.values())
    for key, count in counts.items():
        if count[0] > 0:
            values = get_array(params[key])
            bad = np.argwhere(~np.isfinite(values))
            first = tuple(bad[0].tolist())
            raise PathreplayError(
                f"Parameter '{key}' holds {len(bad)} NaN or infinite of {values.size} values, the first "
                f"({values[first]}) at index {first}; fix the source file (numpy.nan_to_num helps)"
            )


def get_array(value: SceneValue | float) -> np.ndarray:
    """Copy the value of a floating-point parameter to a NumPy array of the same precision, without derivatives.

    A plain number is converted to single precision. The result has the shape (1,) for a plain number, (n,) for
    ``Float``, and (4, 4) for ``AffineTransform4f``. A single ``Color3f`` gives the shape (3,), and n colours give the
    shape (3, n). The shape of a ``TensorXf`` is kept.
    """
    if isinstance(value, float):
        return np.array([value], np.float32)
    array = np.array(dr.detach(_array(value)))
    if not dr.is_tensor_v(value) and array.ndim > 1 and array.shape[-1] == 1:
        array = array[..., 0]
    return array


def to_value(like: SceneValue | float, array: ArrayLike) -> Any:
    """Convert ``array`` to a value of the type of ``like``; the inverse of `get_array`.

    Raises PathreplayError if the shapes differ.
    """
    expected = get_array(like)
    given = np.asarray(array)
    if given.shape != expected.shape:
        raise PathreplayError(f"Value of shape {given.shape} given for a parameter of shape {expected.shape}")
    given = with_space(np.ascontiguousarray(given, dtype=expected.dtype))
    if isinstance(like, float):
        return float(given[0])
    if is_transform(like):
        return type(like)(type(like.matrix)(given))
    return type(like)(given)


def displaced(value: SceneValue, direction: np.ndarray, t: mi.Float) -> SceneValue:
    """Compute ``value + t * direction`` for a differentiable scalar ``t`` (``mi.Float`` of size 1).

    ``direction`` has the shape of ``get_array(value)``, and the result has the type of ``value``. For transforms, the
    matrices are added, so that ``direction`` need not be invertible. Derivatives propagate from ``t``.
    """
    if is_transform(value):
        return type(value)(value.matrix + to_value(value.matrix, direction) * t)
    step = to_value(value, direction)
    return step if is_empty(value) else value + step * t
