"""Checkpoints: variables, Adam state and history in one safetensors file, so that a run goes on as if never stopped."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar

import drjit as dr
import numpy as np
import safetensors
import safetensors.numpy
from drjit.opt import Adam
from pydantic import ConfigDict, Field, NonNegativeInt, TypeAdapter, ValidationError

from pathreplay.errors import PathreplayError
from pathreplay.inverse.grids import Levels
from pathreplay.inverse.values import Array
from pathreplay.scenes.parameters import get_array, to_value

Finite = Annotated[float, Field(allow_inf_nan=False)]


@dataclass(frozen=True)
class Entry:
    """One iteration of the history: loss before the step, wall-clock seconds, L2 norm of each variable's gradient.

    ``dropped`` counts gradient entries that were NaN or infinite and were taken as zero in this step. ``errors`` are
    the root mean square errors, after the step, of the variables whose truth is known; ``picture_error`` is that of the
    pictures without their noise, in the iterations in which it was measured (jobs with a rival). Neither costs
    ``seconds``.
    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    iteration: NonNegativeInt
    loss: Finite
    seconds: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    gradient_norms: dict[str, float]
    dropped: NonNegativeInt = 0
    errors: dict[str, float] = field(default_factory=dict)
    picture_error: float | None = None


_HISTORY = TypeAdapter(list[Entry])
_STEPS = TypeAdapter(dict[str, NonNegativeInt])

_VALUE, _FIRST, _SECOND, _LEARNED = "value:", "first:", "second:", "learned:"


def save(adam: Adam, history: list[Entry], learned: Mapping[str, Array]) -> bytes:
    """The state after the iterations of ``history``, as the bytes of a safetensors file.

    ``learned`` is what the integrator knows from earlier passes, by name.
    """
    tensors: dict[str, Array] = {_LEARNED + name: value for name, value in learned.items()}
    steps: dict[str, int] = {}
    state: dict[str, Any] = adam.state
    for key, (value, _, _, (step, first, second, _)) in state.items():
        tensors[_VALUE + key] = get_array(value)
        tensors[_FIRST + key] = get_array(first)
        tensors[_SECOND + key] = get_array(second)
        steps[key] = int(step[0])
    metadata = {
        "steps": json.dumps(steps),
        "history": json.dumps([asdict(entry) for entry in history]),
    }
    return safetensors.numpy.save({k: np.ascontiguousarray(v) for k, v in tensors.items()}, metadata)


@dataclass(frozen=True)
class _Saved:
    steps: dict[str, int]
    history: list[Entry]
    tensors: dict[str, Array]


def restore(path: Path, adam: Adam, levels: Mapping[str, Levels]) -> tuple[list[Entry], dict[str, Array]]:
    """Put the saved state into ``adam``, which already holds the same variables; returns history and what was learned.

    Variables in ``levels`` take the shape that they had when they were saved.

    Raises:
        PathreplayError: the file is damaged, holds what no run has written, or belongs to other variables.
    """
    try:
        saved = _read(path, adam, levels)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise _unusable(path, f"{where}: {first['msg'].lower()}") from None
    except (safetensors.SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        raise _unusable(path, str(error)) from None
    for key in levels:
        adam[key] = type(adam[key])(saved.tensors[_VALUE + key])
    for key, step in saved.steps.items():
        value, promoted, rate, (count, first, second, greatest) = adam.state[key]
        stored = to_value(value, saved.tensors[_VALUE + key])
        dr.enable_grad(stored)
        moments = (to_value(first, saved.tensors[_FIRST + key]), to_value(second, saved.tensors[_SECOND + key]))
        adam.state[key] = (stored, promoted, rate, (type(count)(step), *moments, greatest))
    learned = {n.removeprefix(_LEARNED): value for n, value in saved.tensors.items() if n.startswith(_LEARNED)}
    return saved.history, learned


def _unusable(path: Path, why: str) -> PathreplayError:
    return PathreplayError(f"Checkpoint {path} cannot be read ({why}); start the job from its config")


def _read(path: Path, adam: Adam, levels: Mapping[str, Levels]) -> _Saved:
    """What the file holds, checked; raises what `restore` makes plain."""
    if not path.is_file():
        raise ValueError("no such file")
    with safetensors.safe_open(str(path), framework="numpy") as file:
        metadata = file.metadata() or {}
        steps = _STEPS.validate_json(metadata.get("steps", ""), strict=True)
        history = _HISTORY.validate_json(metadata.get("history", ""), strict=True)
        if set(steps) != set(adam.state):
            raise PathreplayError(
                f"Checkpoint {path} holds the parameters {', '.join(steps)}, the config names {', '.join(adam.state)}; "
                "start a new run"
            )
        for index, entry in enumerate(history):
            if entry.iteration != index:
                raise ValueError(f"iteration {entry.iteration} of its history stands in place {index}")
        for key, step in steps.items():
            # Adam begins anew on a grid that was refined.
            if step > len(history) or (step < len(history) and key not in levels):
                raise ValueError(f"{step} steps of '{key}' in {len(history)} iterations")
            _require_shapes(file, key, adam, levels.get(key))
        tensors = {name: file.get_tensor(name) for name in file.keys()}
    for name, value in tensors.items():
        if not np.isfinite(value).all():
            raise ValueError(f"'{name}' holds NaN or infinite values")
        if name.startswith(_SECOND) and (value < 0).any():
            raise ValueError(f"'{name}', a mean of squares, is negative")
    return _Saved(steps, history, tensors)


def _require_shapes(file: Any, key: str, adam: Adam, levels: Levels | None) -> None:
    """Value and moments of one variable: float32, in the shapes that Adam has, or in those that a grid goes through."""
    values = [get_array(adam[key]).shape] if levels is None else list(levels.shapes)
    moments = [get_array(adam.state[key][3][1]).shape] if levels is None else [(int(np.prod(s)),) for s in values]
    found = {name: file.get_slice(name) for name in (_VALUE + key, _FIRST + key, _SECOND + key)}
    shapes = {name: tuple(part.get_shape()) for name, part in found.items()}
    for name, part in found.items():
        if part.get_dtype() != "F32":
            raise ValueError(f"'{name}' is {part.get_dtype()}, not F32")
    possible = [dict(zip(found, (v, m, m), strict=True)) for v, m in zip(values, moments, strict=True)]
    if shapes not in possible:
        raise ValueError(f"value and moments of '{key}' have the shapes {list(shapes.values())}, the job's {values}")
