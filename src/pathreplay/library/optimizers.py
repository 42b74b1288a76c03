"""Optimisers of others in our loop: those of `mitsuba.ad`, and objects with a step of their own."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.inverse.optim.adaptive import State
from pathreplay.inverse.parameters.values import Array, Arrays


class Stepper(Protocol):
    """An optimiser of the user's own."""

    def step(
        self, values: Arrays, gradients: Arrays, learning_rates: Mapping[str, float], loss: float
    ) -> Mapping[str, Array]:
        """The values after a step; arrays by name, in the shapes of ``values``."""


class _Foreign:
    """What both kinds share: they end with the loop, and what they remember is theirs."""

    finished = ""

    def answer(self) -> dict[str, Array]:
        """See `Optimiser`: the values after the last step."""
        return {}

    def state(self) -> State:
        """See `Optimiser`: not known."""
        raise PathreplayError("An optimizer object keeps its own state; save it yourself")

    def restore(self, state: State, values: Arrays) -> None:
        """See `Optimiser`: not known."""
        self.state()


class OfMitsuba(_Foreign):
    """An optimiser of `mitsuba.ad` or `drjit.opt`; learning rates of ``own`` variables are the problem's."""

    def __init__(self, optimizer: Any, values: Arrays, own: Collection[str]) -> None:
        if any(True for _ in optimizer.keys()):
            raise PathreplayError("optimizer: it holds variables already; give one that was made without any")
        self._optimizer, self._own = optimizer, own
        for key, value in values.items():
            optimizer[key] = mi.TensorXf(value)

    def step(
        self, values: Arrays, gradients: Arrays, rates: Mapping[str, float], loss: float = 0.0
    ) -> dict[str, Array]:
        """See `Optimiser`."""
        optimizer = self._optimizer
        if rates := {key: rates[key] for key in values if key in self._own}:
            optimizer.set_learning_rate(rates)
        for key, value in values.items():
            optimizer[key] = mi.TensorXf(value)
            dr.set_grad(optimizer[key], mi.TensorXf(gradients[key]))
        optimizer.step()
        return {key: np.array(dr.detach(optimizer[key])).reshape(value.shape) for key, value in values.items()}


class OfUser(_Foreign):
    """An object with a ``step``: see `Stepper`."""

    def __init__(self, stepper: Stepper) -> None:
        self._stepper = stepper

    def step(
        self, values: Arrays, gradients: Arrays, rates: Mapping[str, float], loss: float = 0.0
    ) -> dict[str, Array]:
        """See `Optimiser`. Raises PathreplayError for values that are missing, or of another shape."""
        found = self._stepper.step(values, gradients, rates, loss)
        stepped = {}
        for key, value in values.items():
            if not isinstance(found, Mapping) or key not in found:
                raise PathreplayError(f"optimizer: step() gave no value of '{key}'; return arrays by name")
            stepped[key] = np.array(found[key], np.float32)
            if stepped[key].shape != value.shape:
                raise PathreplayError(
                    f"optimizer: step() gave '{key}' the shape {stepped[key].shape}, it has {value.shape}; keep it"
                )
        return stepped


def adapted(optimizer: Any, values: Arrays, own: Collection[str]) -> OfMitsuba | OfUser:
    """The optimiser that our loop steps with an object of somebody else's."""
    if hasattr(optimizer, "set_learning_rate") and hasattr(optimizer, "keys"):
        return OfMitsuba(optimizer, values, own)
    return OfUser(optimizer)
