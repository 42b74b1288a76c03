"""State of a run, and its checkpoints: safetensors files with a checksum, from which a run resumes exactly."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
import safetensors
from pydantic import ConfigDict, Field, FiniteFloat, NonNegativeInt, TypeAdapter, ValidationError

from pathreplay.errors import PathreplayError
from pathreplay.inverse.loop.checksums import SEAL, require_seal, sealed_chunks
from pathreplay.inverse.objective.evaluate import Executor
from pathreplay.inverse.optim.adaptive import Optimiser, State, WhenAsked
from pathreplay.inverse.parameters.grids import Levels
from pathreplay.inverse.parameters.values import Array, Arrays
from pathreplay.inverse.parameters.variables import Variable, decoded, latents
from pathreplay.platform.atomic_files import Content


@dataclass(frozen=True)
class Entry:
    """One iteration of the history of a run. Dictionaries are indexed by the key of the variable."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    iteration: NonNegativeInt
    loss: FiniteFloat
    """Loss before the step, without regularizers."""
    seconds: Annotated[FiniteFloat, Field(ge=0)]
    """Wall-clock time of the iteration, without the time to compute ``errors`` and ``picture_error``."""
    gradient_norms: dict[str, float]
    """L2 norms of the gradients."""
    dropped: NonNegativeInt = 0
    """Number of NaN or infinite gradient entries, summed over the views. They count as zero."""
    errors: dict[str, float] = field(default_factory=dict)
    """Errors after the step: RMS errors of variables with a known true value, and errors of poses (`PoseError.of`)."""
    picture_error: float | None = None
    """RMS error of the images without rendering noise (`image_error`). None in iterations that do not measure it."""
    penalty: FiniteFloat = 0.0
    """Sum of all regularizers."""
    spp: NonNegativeInt = 0
    """Samples per pixel."""
    noise_norms: dict[str, float] = field(default_factory=dict)
    """L2 norms of the noise of the gradients, if the job measures it (see `noise`)."""
    dropped_shares: dict[str, float] = field(default_factory=dict)
    """Fraction of NaN or infinite entries in the gradients of each variable, over all views."""
    slopes: dict[str, list[float]] = field(default_factory=dict)
    """Sums of each gradient over contiguous parts of its variable (see `movement.parts_of`)."""
    means: dict[str, list[float]] = field(default_factory=dict)
    """Means of each variable over the same parts, after the step."""


@dataclass
class Run:
    """An optimisation in progress."""

    executor: Executor
    optimiser: Optimiser
    values: dict[str, Array]
    """Decoded values of the variables, by key."""
    learned: Arrays = field(default_factory=dict)
    """Arrays, by name, that the integrator passes on to later evaluations, such as the control variates of media."""
    history: list[Entry] = field(default_factory=list)
    starts: dict[str, list[float]] = field(default_factory=dict)
    """Means over parts of each initial value (see `movement.parts_of`), by key."""
    baseline: Run | None = None
    """A run of another integrator for comparison, with the same initial values and the same computation time."""
    whole: bool = True
    """False during a step, when the state is inconsistent and cannot be saved."""

    def seconds(self) -> float:
        return sum(entry.seconds for entry in self.history)

    def picture_error(self) -> float:
        """Return the last image error that was measured; NaN if there is none."""
        return next((e.picture_error for e in reversed(self.history) if e.picture_error is not None), float("nan"))


_HISTORY = TypeAdapter(list[Entry])
_STEPS = TypeAdapter(dict[str, NonNegativeInt])
_STARTS = TypeAdapter(dict[str, list[FiniteFloat]])

_VALUE, _LEARNED = "value:", "learned:"
HISTORY = "history"
"""Name of the tensor with the history: the bytes of a JSON text. Headers of safetensors files have a limit of 100 MB,
which the history of a long run with many variables exceeds."""


def save(run: Run) -> Content:
    """Serialise a run as a file with a checksum. The content is generated while the file is written."""
    state = run.optimiser.state()
    plain: dict[str, Array] = {
        **{_LEARNED + name: value for name, value in run.learned.items()},
        **{_VALUE + key: value for key, value in run.values.items()},
    }
    plain[HISTORY] = _bytes_of(json.dumps([asdict(entry) for entry in run.history]))
    metadata = {"steps": json.dumps(state.steps), "starts": json.dumps(run.starts)}
    arrays = {name: partial(group.__getitem__, name) for group in (plain, state.arrays) for name in group}
    return partial(sealed_chunks, WhenAsked(arrays), metadata)


def _bytes_of(text: str) -> np.ndarray:
    """Encode a JSON text. Spaces at its end align the next tensor to eight bytes."""
    data = text.encode()
    return np.frombuffer(data + b" " * (-len(data) % 8), np.uint8)


def history_of(metadata: Mapping[str, str] | None, tensor: np.ndarray | None) -> list[Entry]:
    """Decode the history in a checkpoint.

    Args:
        metadata: text fields of the checkpoint's header. Files of older versions have the history there.
        tensor: the tensor `HISTORY`; None if the checkpoint has none.

    Raises:
        ValidationError: the history is missing or damaged.
    """
    text = (metadata or {}).get(HISTORY, "") if tensor is None else tensor.tobytes()
    return _HISTORY.validate_json(text, strict=True)


def restore(path: Path, run: Run, variables: Sequence[Variable], held: Collection[str] = ()) -> None:
    """Restore a run from a checkpoint.

    Args:
        path: the checkpoint.
        run: a new run of the same job, which is changed in place.
        variables: the variables of the job.
        held: keys of variables that are frozen in some stages.

    Raises:
        PathreplayError: the file is damaged or invalid, or belongs to other variables or other initial values.
    """
    try:
        levels = {v.key: v.levels for v in variables}
        values, state, history, learned = _read(path, run, levels, held)
        try:
            run.optimiser.restore(state, latents(variables, values))
        except (KeyError, ValueError) as error:
            raise PathreplayError(
                f"Checkpoint {path} has no state of this optimizer ({error}); resume with the optimizer of the run, or "
                "start a new run"
            ) from None
        # A search that had ended has its best point as values, but may go on at another point.
        run.values = decoded(variables, run.optimiser.awaited(), values)
        run.history, run.learned = history, learned
        return
    except ValidationError as error:
        first = error.errors()[0]
        why = f"{'.'.join(map(str, first['loc']))}: {first['msg'].lower()}"
    except (safetensors.SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        why = str(error)
    raise PathreplayError(f"Checkpoint {path} cannot be read ({why}); start a new run")


def _read(
    path: Path, run: Run, levels: Mapping[str, Levels | None], held: Collection[str]
) -> tuple[dict[str, Array], State, list[Entry], Arrays]:
    """Read values, optimiser state, history and learned statistics. `restore` translates the errors raised here."""
    values = run.values
    if not path.is_file():
        raise ValueError("no such file")
    with safetensors.safe_open(str(path), framework="numpy") as file:
        require_seal(path)
        metadata = file.metadata() or {}
        tensors = {name: file.get_tensor(name) for name in file.keys() if name != SEAL}
    steps = _STEPS.validate_json(metadata.get("steps", ""), strict=True)
    history = history_of(metadata, tensors.pop(HISTORY, None))
    if set(steps) != set(values):
        raise PathreplayError(
            f"Checkpoint {path} has the parameters {', '.join(steps)}, but the config names {', '.join(values)}; "
            "start a new run"
        )
    starts = _STARTS.validate_json(metadata.get("starts", "{}"), strict=True)
    for key, now in run.starts.items():
        start = starts.get(key, now)
        if len(now) != len(start) or not np.allclose(now, start, rtol=1e-4, atol=1e-5 * max(map(abs, now), default=0)):
            raise PathreplayError(
                f"The initial value of '{key}' differs from the one at the start of the run {path.parent}; restore it "
                "in the config, scene or file that gives it, or start a new run"
            )
    for index, entry in enumerate(history):
        if entry.iteration != index:
            raise ValueError(f"entry {index} of its history has the iteration {entry.iteration}")
    for name, array in tensors.items():
        if not np.isfinite(array).all():
            raise ValueError(f"'{name}' has NaN or infinite values")
    saved = {key: tensors.pop(_VALUE + key) for key in values}
    for key, value in values.items():
        grid, array = levels[key], saved[key]
        # Refining a grid resets its optimiser state, so a grid may have fewer steps than iterations.
        if steps[key] > len(history) or (steps[key] < len(history) and grid is None and key not in held):
            raise ValueError(f"{steps[key]} steps of '{key}' in {len(history)} iterations")
        shapes = [value.shape] if grid is None else list(grid.shapes)
        if array.dtype != value.dtype or array.shape not in shapes:
            raise ValueError(f"'{key}' is {array.dtype} of shape {array.shape}, not {value.dtype} of {shapes}")
    learned = {name.removeprefix(_LEARNED): tensors.pop(name) for name in list(tensors) if name.startswith(_LEARNED)}
    return saved, State(steps, tensors), history, learned
