"""Checkpoints: variables, Adam state and history in one safetensors file, so that a run goes on as if never stopped."""

from __future__ import annotations

import json
from collections.abc import Collection
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import safetensors
import safetensors.numpy
from drjit.opt import Adam

from pathreplay.errors import PathreplayError
from pathreplay.inverse.values import Array
from pathreplay.parameters import get_array, to_value


@dataclass(frozen=True)
class Entry:
    """One iteration of the history: loss before the step, wall-clock seconds, L2 norm of each variable's gradient.

    ``dropped`` counts gradient entries that were NaN or infinite and were taken as zero in this step. ``errors`` are
    the root mean square errors, after the step, of the variables whose truth is known; ``picture_error`` is that of the
    pictures without their noise, in the iterations in which it was measured (jobs with a rival). Neither costs
    ``seconds``.
    """

    iteration: int
    loss: float
    seconds: float
    gradient_norms: dict[str, float]
    dropped: int = 0
    errors: dict[str, float] = field(default_factory=dict)
    picture_error: float | None = None


def save(adam: Adam, history: list[Entry]) -> bytes:
    """The state after the iterations of ``history``, as the bytes of a safetensors file."""
    tensors: dict[str, Array] = {}
    steps: dict[str, int] = {}
    state: dict[str, Any] = adam.state
    for key, (value, _, _, (step, first, second, _)) in state.items():
        tensors[f"value:{key}"] = get_array(value)
        tensors[f"first:{key}"] = get_array(first)
        tensors[f"second:{key}"] = get_array(second)
        steps[key] = int(step[0])
    metadata = {
        "steps": json.dumps(steps),
        "history": json.dumps([asdict(entry) for entry in history]),
    }
    return safetensors.numpy.save({k: np.ascontiguousarray(v) for k, v in tensors.items()}, metadata)


def restore(path: Path, adam: Adam, refined: Collection[str] = ()) -> list[Entry]:
    """Put the saved state into ``adam``, which already holds the same variables; returns the history.

    Variables in ``refined`` take the shape that they had when they were saved.

    Raises:
        PathreplayError: the file is damaged or belongs to other variables.
    """
    try:
        with safetensors.safe_open(str(path), framework="numpy") as file:
            metadata = file.metadata()
            tensors = {name: file.get_tensor(name) for name in file.keys()}
        steps = json.loads(metadata["steps"])
        history = [Entry(**entry) for entry in json.loads(metadata["history"])]
    except (safetensors.SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        raise PathreplayError(f"Checkpoint {path} cannot be read ({error}); start the job from its config") from None
    if set(steps) != set(adam.state):
        raise PathreplayError(
            f"Checkpoint {path} holds the parameters {', '.join(steps)}, the config names {', '.join(adam.state)}; "
            "start a new run"
        )
    for key in refined:
        adam[key] = type(adam[key])(tensors[f"value:{key}"])
    for key, step in steps.items():
        value, promoted, rate, (count, first, second, greatest) = adam.state[key]
        stored = to_value(value, tensors[f"value:{key}"])
        dr.enable_grad(stored)
        moments = (to_value(first, tensors[f"first:{key}"]), to_value(second, tensors[f"second:{key}"]))
        adam.state[key] = (stored, promoted, rate, (type(count)(step), *moments, greatest))
    return history
