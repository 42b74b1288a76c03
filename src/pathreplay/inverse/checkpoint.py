"""Checkpoints: all that a run goes on from as if it had never been stopped, in one safetensors file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
import safetensors
import safetensors.numpy
from pydantic import ConfigDict, Field, NonNegativeInt, TypeAdapter, ValidationError

from pathreplay.errors import PathreplayError
from pathreplay.inverse.grids import Levels
from pathreplay.inverse.optimiser import Optimiser, State
from pathreplay.inverse.values import Array, Arrays

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

_VALUE, _LEARNED = "value:", "learned:"


def save(values: Arrays, state: State, history: list[Entry], learned: Arrays) -> bytes:
    """All that is known after the iterations of ``history``, as the bytes of a safetensors file."""
    tensors = {
        **{_LEARNED + name: value for name, value in learned.items()},
        **{_VALUE + key: value for key, value in values.items()},
        **state.arrays,
    }
    metadata = {
        "steps": json.dumps(state.steps),
        "history": json.dumps([asdict(entry) for entry in history]),
    }
    return safetensors.numpy.save({k: np.ascontiguousarray(v) for k, v in tensors.items()}, metadata)


@dataclass(frozen=True)
class Saved:
    """What a checkpoint holds: values by key, what the optimiser remembers, history, and what was learned by name."""

    values: dict[str, Array]
    state: State
    history: list[Entry]
    learned: dict[str, Array]


def restore(path: Path, optimiser: Optimiser, values: Arrays, levels: Mapping[str, Levels]) -> Saved:
    """Read what was saved, and bring the optimiser back to it.

    ``values`` are like those that were saved, but for the shapes of those in ``levels``.

    Raises:
        PathreplayError: the file is damaged, holds what no run has written, or belongs to other variables.
    """
    try:
        saved = _read(path, values, levels)
        optimiser.restore(saved.state, saved.values)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise _unusable(path, f"{where}: {first['msg'].lower()}") from None
    except (safetensors.SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        raise _unusable(path, str(error)) from None
    return saved


def _unusable(path: Path, why: str) -> PathreplayError:
    return PathreplayError(f"Checkpoint {path} cannot be read ({why}); start the job from its config")


def _read(path: Path, values: Arrays, levels: Mapping[str, Levels]) -> Saved:
    """What the file holds, checked; raises what `restore` makes plain."""
    if not path.is_file():
        raise ValueError("no such file")
    with safetensors.safe_open(str(path), framework="numpy") as file:
        metadata = file.metadata() or {}
        tensors = {name: file.get_tensor(name) for name in file.keys()}
    steps = _STEPS.validate_json(metadata.get("steps", ""), strict=True)
    history = _HISTORY.validate_json(metadata.get("history", ""), strict=True)
    if set(steps) != set(values):
        raise PathreplayError(
            f"Checkpoint {path} holds the parameters {', '.join(steps)}, the config names {', '.join(values)}; "
            "start a new run"
        )
    for index, entry in enumerate(history):
        if entry.iteration != index:
            raise ValueError(f"iteration {entry.iteration} of its history stands in place {index}")
    for name, array in tensors.items():
        if not np.isfinite(array).all():
            raise ValueError(f"'{name}' holds NaN or infinite values")
    for key, value in values.items():
        # Optimisers begin anew on a grid that was refined.
        if steps[key] > len(history) or (steps[key] < len(history) and key not in levels):
            raise ValueError(f"{steps[key]} steps of '{key}' in {len(history)} iterations")
        _require_like(tensors[_VALUE + key], key, value, levels.get(key))
    found = {key: tensors.pop(_VALUE + key) for key in values}
    learned = {name.removeprefix(_LEARNED): tensors.pop(name) for name in list(tensors) if name.startswith(_LEARNED)}
    return Saved(found, State(steps, tensors), history, learned)


def _require_like(found: Array, key: str, value: Array, levels: Levels | None) -> None:
    shapes = [value.shape] if levels is None else list(levels.shapes)
    if found.dtype != value.dtype or found.shape not in shapes:
        raise ValueError(f"'{key}' is {found.dtype} of shape {found.shape}, in the job {value.dtype} of {shapes}")
