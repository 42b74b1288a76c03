"""Descriptions of parameters, derived parameters and views, and their conversion to the tables of a job."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from numbers import Real
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError, shown
from pathreplay.inverse.config.parameter_options import MEMORY
from pathreplay.inverse.config.tables import LARGEST
from pathreplay.inverse.parameters.values import Array
from pathreplay.scenes.parameters import get_array
from pathreplay.types import Json


@dataclass(frozen=True)
class Parameter:
    """Options of one scene parameter, or of all parameters that match a glob.

    The fields have the same names as the keys in a job, except ``bounds``, which is ``lower`` and ``upper`` in a job.
    Values are decoded reflectances and radiances, in the shape that `mi.traverse` shows.

    Args:
        initial: initial value: a number, a colour, an array in the parameter's shape, or an image or volume file. For a
            pose, a displacement ``{"translation": [x, y, z], "rotation": [rx, ry, rz]}`` (scene units, degrees).
            Default: the value in the scene.
        bounds: lower and upper bound, two numbers for all entries, enforced by projection after each step. None is no
            bound.
        learning_rate: learning rate; with Adam, approximately the length of a step. Default: the learning rate of the
            problem.
        parameterization: ``"log"``, ``"softplus"`` or ``"logit"``: steps are taken in this function of the value.
        resolutions: resolutions of a grid, coarse to fine, as the number of entries along its longest axis.
        refine_at: first iteration of the second and each later resolution.
        pyramid: take steps in the levels of a Laplacian pyramid of a texture or volume.
        pose: motion of a ``to_world`` or of ``vertex_positions``: ``"translation"``, ``"rotation"`` or ``"rigid"``.
        pivot: centre of the rotation of a pose.
        rotation_learning_rate: learning rate of the rotation of a pose, in degrees.
        error_scale: length relative to which position errors of a pose are reported.
        large_steps_lambda: λ of Large Steps (Nicolet et al. 2021), for ``vertex_positions``.
        total_variation: weight of the total variation.
        l2_to_initial: weight of the mean squared difference from the initial value.
        laplacian_weight: weight of the mean squared Laplacian of vertices.
        regularizer: function of the values (a tensor); it returns one number, which is added to the loss.
        shape: shape of a parameter that is not part of the scene; scene parameters are `Derived` from it.
    """

    initial: object = None
    bounds: tuple[float | None, float | None] = (None, None)
    learning_rate: float | None = None
    parameterization: str | None = None
    resolutions: Sequence[int] | None = None
    refine_at: Sequence[int] | None = None
    pyramid: bool | None = None
    pose: str | None = None
    pivot: Sequence[float] | None = None
    rotation_learning_rate: float | None = None
    error_scale: float | None = None
    large_steps_lambda: float | None = None
    total_variation: float | None = None
    l2_to_initial: float | None = None
    laplacian_weight: float | None = None
    regularizer: Callable[[mi.TensorXf], object] | str | None = None
    shape: Sequence[int] | None = None


@dataclass(frozen=True)
class Derived:
    """A scene parameter that is computed from other parameters.

    Args:
        function: function that computes the value as ``function(initial, *inputs)``. Here ``initial`` is the value in
            the scene, and ``inputs`` are the values of the parameters in ``of``.
        of: names of the other parameters.
        displace: in place of a function, options of a displacement of ``vertex_positions`` by the height maps in
            ``of``: ``direction``, ``coordinates``, ``interpolation`` and ``weights``, as in a job. ``{}`` displaces
            along the normals, with texture coordinates.
    """

    function: Callable[..., object] | str | None = None
    of: Sequence[str] = ()
    displace: Mapping[str, object] | None = None


@dataclass(frozen=True)
class View:
    """A sensor and its target image.

    Args:
        sensor: index or id of the sensor.
        target: linear pixels (height, width, channels): a NumPy or Dr.Jit array, a `mi.Bitmap`, or an image file.
            Bitmaps and files are decoded from sRGB if they have 8 or 16 bits, and composited over black. Arrays of
            8- or 16-bit integers are refused, because their encoding is unknown. Mitsuba takes the colours of a bitmap
            that was made from an array for premultiplied by alpha; see ``mi.Bitmap.set_premultiplied_alpha``. If the
            film has three channels, a grey target (also of shape (height, width)) is compared with each of them. If
            the film has no alpha, the alpha of a target is dropped. The colours of arrays count as premultiplied by
            alpha, as in renderings.
        weight: nonnegative pixel weights (height, width), normalised to mean 1: an array, a `mi.Bitmap` or an image
            file. The stored values of bitmaps and files are used, without decoding; colours are converted to luminance.
            Default: equal weights.
        share: weight of the view relative to the other views.
        test: whether the view is a test view.
    """

    sensor: int | str = 0
    target: object = None
    weight: object = None
    share: float = 1.0
    test: bool = False


def require_kinds(wanted: Mapping[str, Parameter | None], views: Sequence[View], made: Mapping[str, Derived]) -> None:
    """Raise PathreplayError if an entry has the wrong type."""
    for what, kind, things in (
        ("parameters", Parameter, [each for each in wanted.values() if each is not None]),
        ("views", View, list(views)),
        ("derived", Derived, list(made.values())),
    ):
        if wrong := [each for each in things if not isinstance(each, kind)]:
            raise PathreplayError(f"{what}: {shown(wrong[0])} is not a {kind.__name__}; write {kind.__name__}(...)")


def by_key(parameters: Mapping[str, Parameter | None] | Sequence[str] | str) -> dict[str, Parameter | None]:
    """Return the options of parameters, by key or glob. The value is None for a key without options."""
    if isinstance(parameters, Mapping):
        return dict(parameters)
    return dict.fromkeys([parameters] if isinstance(parameters, str) else parameters)


class Objects:
    """Functions and arrays in memory, which the tables of a job cannot contain.

    ``functions`` are indexed by the names that stand for them in the tables. ``starts`` are initial values by parameter
    key.
    """

    def __init__(self) -> None:
        self.functions: dict[str, Callable[..., object]] = {}
        self.starts: dict[str, Array] = {}

    def named(self, function: Callable[..., object] | str) -> str:
        """Return the name that represents a function; strings are returned unchanged."""
        if isinstance(function, str):
            return function
        plain = getattr(function, "__name__", type(function).__name__).strip("<>")
        name, count = f"{MEMORY}{plain}", 1
        while name in self.functions and self.functions[name] is not function:
            count += 1
            name = f"{MEMORY}{plain}-{count}"
        self.functions[name] = function
        return name

    def tables(self, wanted: Mapping[str, Parameter | None]) -> list[Json]:
        """Convert parameters to tables.

        Raises PathreplayError if the initial value of a pose is an array, an initial value is not finite, or bounds are
        not two numbers.
        """
        return [self._table(key, entry or Parameter()) for key, entry in wanted.items()]

    def _table(self, key: str, entry: Parameter) -> Json:
        lower, upper = _pair(key, entry.bounds)
        table = {"key": key, "lower": lower, "upper": upper}
        table |= {each.name: getattr(entry, each.name) for each in fields(Parameter) if each.name != "bounds"}
        if entry.regularizer is not None:
            table["regularizer"] = self.named(entry.regularizer)
        _require_finite(key, entry.initial)
        given = _array(key, entry.initial)
        if given is not None and given.ndim == 0:
            table["initial"] = given.item()
        elif given is not None:
            self.starts[key] = given
            table["initial"] = None
            if entry.pose is not None:
                raise PathreplayError(
                    f"Parameter '{key}': 'initial' of a pose is a displacement; write {{'translation': [...], "
                    "'rotation': [...]}, and set the scene's own value in the scene"
                )
        return {name: _plain(value) for name, value in table.items() if value is not None}

    def made(self, derived: Mapping[str, Derived]) -> list[Json]:
        tables: list[Json] = []
        for key, each in derived.items():
            options = each.displace
            table = {
                "key": key,
                "of": list(each.of),
                "function": None if each.function is None else self.named(each.function),
                "displace": None if options is None else {name: _plain(value) for name, value in options.items()},
            }
            tables.append({name: value for name, value in table.items() if value is not None})
        return tables


def _pair(key: str, bounds: object) -> tuple[object, object]:
    """Return the lower and the upper bound. Raises PathreplayError unless they are two numbers, or None."""
    if isinstance(bounds, Iterable) and len(pair := list(bounds)) == 2:
        if all(each is None or _is_single(each) for each in pair):
            return pair[0], pair[1]
    raise PathreplayError(
        f"Parameter '{key}': bounds are {shown(bounds)}; give (lower, upper), two finite numbers for all entries, "
        "where None is no bound"
    )


def _is_single(value: object) -> bool:
    """Return whether a value is a number within the range of single precision."""
    try:
        return isinstance(value, Real) and abs(float(value)) <= LARGEST
    except OverflowError:  # the integer exceeds the range of double precision
        return False


def _require_finite(key: str, value: object) -> None:
    """Raise PathreplayError if an initial value is a number, or a list of numbers, that is not finite."""
    entries = value if isinstance(value, (list, tuple)) else [value]
    if not all(np.isfinite(each) for each in entries if isinstance(each, (float, np.floating))):
        raise PathreplayError(f"Parameter '{key}': 'initial' is {shown(value)}; give finite numbers")


def _array(key: str, value: object) -> Array | None:
    """Convert an initial value to an array; None for numbers, lists of numbers, names of files and tables.

    Raises PathreplayError if NumPy cannot convert the value.
    """
    if dr.is_array_v(value):
        return np.array(get_array(value), np.float32)
    nested = isinstance(value, (list, tuple)) and any(isinstance(each, (list, tuple)) for each in value)
    if not nested and (isinstance(value, np.generic) or not hasattr(value, "__array__")):
        return None
    try:
        return np.array(value, np.float32)
    except (TypeError, ValueError, RuntimeError) as error:
        why = " ".join(str(error).split())
        raise PathreplayError(f"Parameter '{key}': 'initial' is not an array ({why}); give a NumPy array") from None


def _plain(value: object) -> object:
    """Convert arrays, NumPy scalars and paths to lists, numbers and strings."""
    if isinstance(value, (str, Mapping)):
        return value
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Iterable):
        return [_plain(each) for each in value]
    return value.item() if isinstance(value, np.generic) else value
