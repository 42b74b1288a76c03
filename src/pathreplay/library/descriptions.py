"""What a problem is described with: its parameters, what is derived from them, and its views."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import drjit as dr
import numpy as np

from pathreplay.errors import PathreplayError, shown
from pathreplay.inverse.parameters.values import Array


@dataclass(frozen=True)
class Parameter:
    """What is sought of one scene parameter, or of several by a glob; every field has a key of that name in jobs.

    Values are decoded ones: reflectances and radiances as arrays of numbers, in the shape that `mi.traverse` shows.

    Args:
        initial: a number, a colour, an array in the parameter's shape, or an image or volume file; for a pose a
            displacement ``{"translation": [x, y, z], "rotation": [rx, ry, rz]}`` (scene units, degrees). None: the
            value in the scene.
        bounds: lowest and highest value, held by projection after each step; None: none.
        learning_rate: about the length of a step of Adam. None: that of the problem.
        parameterization: ``"log"``, ``"softplus"`` or ``"logit"``: steps are taken in that function of the value.
        resolutions, refine_at: sizes of a grid, coarse to fine, and the iterations at which it is refined.
        pose: ``"translation"``, ``"rotation"`` or ``"rigid"``, of a ``to_world`` or of ``vertex_positions``; with
            ``pivot``, ``rotation_learning_rate`` (degrees) and ``error_scale``.
        large_steps_lambda: λ of Large Steps (Nicolet et al. 2021), for ``vertex_positions``.
        total_variation, l2_to_initial, laplacian_weight: weights of regularizers.
        regularizer: a function of the values (a tensor) that gives one number, which is added to the loss.
        shape: of numbers that are no part of the scene, from which others are `Derived`.
    """

    initial: Any = None
    bounds: tuple[float | None, float | None] = (None, None)
    learning_rate: float | None = None
    parameterization: str | None = None
    resolutions: Sequence[int] | None = None
    refine_at: Sequence[int] | None = None
    pose: str | None = None
    pivot: Sequence[float] | None = None
    rotation_learning_rate: float | None = None
    error_scale: float | None = None
    large_steps_lambda: float | None = None
    total_variation: float | None = None
    l2_to_initial: float | None = None
    laplacian_weight: float | None = None
    regularizer: Callable[[Any], Any] | str | None = None
    shape: Sequence[int] | None = None


@dataclass(frozen=True)
class Derived:
    """A scene parameter that a function makes of others: ``function(value in the scene, *values of those in of)``."""

    function: Callable[..., Any] | str
    of: Sequence[str]


@dataclass(frozen=True)
class View:
    """A sensor and the image that it should see.

    Args:
        sensor: its place in the scene, or its id.
        target: linear pixels (height, width, channels): a NumPy or Dr.Jit array, a `mi.Bitmap`, or an image file.
        weight: how much pixels count (height, width), none negative; scaled to the mean 1. None: all the same.
        share: how much the view counts beside the others.
        test: never learned from.
    """

    sensor: int | str = 0
    target: Any = None
    weight: Any = None
    share: float = 1.0
    test: bool = False


def require_kinds(wanted: Mapping[str, Parameter | None], views: Sequence[View], made: Mapping[str, Derived]) -> None:
    """Raise PathreplayError for a number in the place of a Parameter, and the like."""
    for what, kind, things in (
        ("parameters", Parameter, [each for each in wanted.values() if each is not None]),
        ("views", View, list(views)),
        ("derived", Derived, list(made.values())),
    ):
        if wrong := [each for each in things if not isinstance(each, kind)]:
            raise PathreplayError(f"{what}: {shown(wrong[0])} is no {kind.__name__}; write {kind.__name__}(...)")


def by_key(parameters: Mapping[str, Parameter | None] | Sequence[str] | str) -> dict[str, Parameter | None]:
    """By key or glob; a name stands for a parameter as it is."""
    if isinstance(parameters, Mapping):
        return dict(parameters)
    return dict.fromkeys([parameters] if isinstance(parameters, str) else parameters)


class Objects:
    """What of a problem a job could not name: functions and arrays, by the names that stand for them in its tables."""

    def __init__(self) -> None:
        self.functions: dict[str, Callable[..., Any]] = {}
        self.starts: dict[str, Array] = {}

    def named(self, function: Callable[..., Any] | str) -> str:
        """The name of a function; a text is one already."""
        if isinstance(function, str):
            return function
        plain = getattr(function, "__name__", type(function).__name__).strip("<>")
        name, count = f"memory:{plain}", 1
        while name in self.functions and self.functions[name] is not function:
            count += 1
            name = f"memory:{plain}-{count}"
        self.functions[name] = function
        return name

    def tables(self, wanted: Mapping[str, Parameter | None]) -> list[dict[str, Any]]:
        """Parameters as a job has them. Raises PathreplayError for the start of a pose that is no displacement."""
        return [self._table(key, entry or Parameter()) for key, entry in wanted.items()]

    def _table(self, key: str, entry: Parameter) -> dict[str, Any]:
        lower, upper = entry.bounds
        table = {"key": key, "lower": lower, "upper": upper}
        table |= {each.name: getattr(entry, each.name) for each in fields(Parameter) if each.name != "bounds"}
        if entry.regularizer is not None:
            table["regularizer"] = self.named(entry.regularizer)
        if isinstance(entry.initial, np.ndarray) or dr.is_array_v(entry.initial):
            self.starts[key] = np.array(entry.initial, np.float32)
            table["initial"] = None
            if entry.pose is not None:
                raise PathreplayError(
                    f"Parameter '{key}': 'initial' of a pose is a displacement; write {{'translation': [...], "
                    "'rotation': [...]}, and set the scene's own value in the scene"
                )
        return {name: _plain(value) for name, value in table.items() if value is not None}

    def made(self, derived: Mapping[str, Derived]) -> list[dict[str, Any]]:
        """Derived parameters as a job has them."""
        return [
            {"key": key, "function": self.named(each.function), "of": list(each.of)} for key, each in derived.items()
        ]


def _plain(value: Any) -> Any:
    """Numbers and lists as a job has them."""
    if isinstance(value, (str, Mapping)):
        return value
    if isinstance(value, Iterable):
        return [_plain(each) for each in value]
    return value.item() if isinstance(value, np.generic) else value
