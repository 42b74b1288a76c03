"""A run under way, and its checkpoints: all that it goes on from as if never stopped, in one safetensors file."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
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
from pathreplay.platform.atomic_files import Content


@dataclass(frozen=True)
class Entry:
    """One iteration of the history: loss before the step, wall-clock seconds, L2 norm of each variable's gradient.

    ``dropped`` counts gradient entries that were NaN or infinite in a view and were taken as zero in this step;
    ``dropped_shares`` says how many of each variable's that were, of all in all views. ``spp`` are samples per pixel,
    and ``noise_norms`` how long the noise of a gradient is, where the job measures it (see `noise`). ``errors`` are
    the root mean square errors, after the step, of the variables whose truth is known, and how far poses are from
    theirs (see `PoseError.of`); ``picture_error`` is that of the pictures without their noise, in the iterations in
    which it was measured (jobs with a baseline). Neither costs ``seconds``. ``penalty`` is what values add to the loss.
    ``slopes`` are sums of each gradient over parts of its variable, and ``means`` those of its values after the step
    (see `movement`).
    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    iteration: NonNegativeInt
    loss: FiniteFloat
    seconds: Annotated[FiniteFloat, Field(ge=0)]
    gradient_norms: dict[str, float]
    dropped: NonNegativeInt = 0
    errors: dict[str, float] = field(default_factory=dict)
    picture_error: float | None = None
    penalty: FiniteFloat = 0.0
    spp: NonNegativeInt = 0
    noise_norms: dict[str, float] = field(default_factory=dict)
    dropped_shares: dict[str, float] = field(default_factory=dict)
    slopes: dict[str, list[float]] = field(default_factory=dict)
    means: dict[str, list[float]] = field(default_factory=dict)


@dataclass
class Run:
    """An optimisation under way: who computes and who steps, where it is, and what happened so far."""

    executor: Executor
    optimiser: Optimiser
    values: dict[str, Array]
    """Of the variables, by key: what people see."""
    learned: Arrays = field(default_factory=dict)
    """By the evaluations, from one to the next."""
    history: list[Entry] = field(default_factory=list)
    baseline: Run | None = None
    """Solves the same problem from the same start by another integrator in the same time."""
    whole: bool = True
    """Not in the middle of a step, in which it cannot be saved."""

    def seconds(self) -> float:
        return sum(entry.seconds for entry in self.history)

    def picture_error(self) -> float:
        """The one that was measured last; NaN where none was."""
        return next((e.picture_error for e in reversed(self.history) if e.picture_error is not None), float("nan"))


_HISTORY = TypeAdapter(list[Entry])
_STEPS = TypeAdapter(dict[str, NonNegativeInt])

_VALUE, _LEARNED = "value:", "learned:"


def save(run: Run) -> Content:
    """All that is known after the iterations so far, as a sealed file that is made while it is written."""
    state = run.optimiser.state()
    plain: dict[str, Array] = {
        **{_LEARNED + name: value for name, value in run.learned.items()},
        **{_VALUE + key: value for key, value in run.values.items()},
    }
    metadata = {"steps": json.dumps(state.steps), "history": json.dumps([asdict(entry) for entry in run.history])}
    arrays = {name: partial(each.__getitem__, name) for each in (plain, state.arrays) for name in each}
    return partial(sealed_chunks, WhenAsked(arrays), metadata)


def restore(path: Path, run: Run, levels: Mapping[str, Levels | None], held: Collection[str] = ()) -> None:
    """Bring a run to where it was when ``path`` was saved; ``levels`` are those of its grids, by key.

    ``held`` are variables that some stages do not step.

    Raises PathreplayError if a bit of the file has changed, it holds what no run has written, or belongs to other
    variables.
    """
    try:
        values, state, history, learned = _read(path, run.values, levels, held)
        run.optimiser.restore(state, values)
        run.values, run.history, run.learned = values, history, learned
        return
    except ValidationError as error:
        first = error.errors()[0]
        why = f"{'.'.join(map(str, first['loc']))}: {first['msg'].lower()}"
    except (safetensors.SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        why = str(error)
    raise PathreplayError(f"Checkpoint {path} cannot be read ({why}); start the job from its config")


def _read(
    path: Path, values: Arrays, levels: Mapping[str, Levels | None], held: Collection[str]
) -> tuple[dict[str, Array], State, list[Entry], Arrays]:
    """Values, state of the optimiser, history and what was learned; raises what `restore` makes plain."""
    if not path.is_file():
        raise ValueError("no such file")
    with safetensors.safe_open(str(path), framework="numpy") as file:
        require_seal(path)
        metadata = file.metadata() or {}
        tensors = {name: file.get_tensor(name) for name in file.keys() if name != SEAL}
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
    found = {key: tensors.pop(_VALUE + key) for key in values}
    for key, value in values.items():
        grid, array = levels[key], found[key]
        # Optimisers begin anew on a grid that was refined.
        if steps[key] > len(history) or (steps[key] < len(history) and grid is None and key not in held):
            raise ValueError(f"{steps[key]} steps of '{key}' in {len(history)} iterations")
        shapes = [value.shape] if grid is None else list(grid.shapes)
        if array.dtype != value.dtype or array.shape not in shapes:
            raise ValueError(f"'{key}' is {array.dtype} of shape {array.shape}, in the job {value.dtype} of {shapes}")
    learned = {name.removeprefix(_LEARNED): tensors.pop(name) for name in list(tensors) if name.startswith(_LEARNED)}
    return found, State(steps, tensors), history, learned
