"""Optimisers: from values and their gradients to the next values; what they remember can be saved, by name."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Protocol

import drjit as dr
import drjit.opt
import mitsuba as mi
import numpy as np

from pathreplay.inverse.values import Array, Arrays

# The second moment remembers about 1 / (1 - beta_2) steps. Its usual 0.999 outlasts a whole run of a few hundred.
BETA_1, BETA_2 = 0.9, 0.99


@dataclass(frozen=True)
class State:
    """What an optimiser remembers: steps since each variable began anew, and arrays by name (``what:variable``)."""

    steps: dict[str, int]
    arrays: dict[str, Array]


class Optimiser(Protocol):
    """Arrays are by key of the variable. A variable that comes in another shape than before begins anew."""

    def step(self, values: Arrays, gradients: Arrays, rates: Mapping[str, float]) -> dict[str, Array]:
        """The values after a step against the gradients; ``rates`` are about its length in each variable."""

    def state(self) -> State:
        """All that later steps depend on, besides the values."""

    def restore(self, state: State, values: Arrays) -> None:
        """Go on from ``state`` at ``values``, bit for bit. Raises KeyError or ValueError if they do not belong."""


class Adam:
    """Dr.Jit's Adam, of variables that begin at ``values``.

    Of those that are ``uniform`` all entries are measured by the largest mean of squares, so that entries with little
    gradient stay where they are (UniformAdam).
    """

    def __init__(self, values: Arrays, uniform: Collection[str] = ()) -> None:
        self._adams = {
            even: drjit.opt.Adam(
                1.0,
                {k: mi.TensorXf(v) for k, v in values.items() if (k in uniform) == even},
                beta_1=BETA_1,
                beta_2=BETA_2,
                uniform=even,
            )
            for even in (False, True)
        }
        self._uniform = frozenset(uniform)

    def _of(self, key: str) -> drjit.opt.Adam:
        return self._adams[key in self._uniform]

    def step(self, values: Arrays, gradients: Arrays, rates: Mapping[str, float]) -> dict[str, Array]:
        """See `Optimiser`."""
        for key, value in values.items():
            adam = self._of(key)
            adam[key] = mi.TensorXf(value)
            dr.set_grad(adam[key], mi.TensorXf(gradients[key]))
        for even, adam in self._adams.items():
            # Opaque: as a literal the changing rate would be compiled into the kernel anew in every iteration.
            mine = {key: dr.opaque(mi.Float, rate) for key, rate in rates.items() if (key in self._uniform) == even}
            adam.set_learning_rate(mine)
            adam.step()
        return {key: np.array(dr.detach(self._of(key)[key])) for key in values}

    def state(self) -> State:
        """See `Optimiser`; the arrays are ``first`` and ``second``, the means of gradients and of their squares."""
        steps: dict[str, int] = {}
        arrays: dict[str, Array] = {}
        for adam in self._adams.values():
            for key, (_, _, _, (step, first, second, _)) in adam.state.items():
                steps[key] = int(step[0])
                arrays |= {f"first:{key}": np.array(first), f"second:{key}": np.array(second)}
        return State(steps, arrays)

    def restore(self, state: State, values: Arrays) -> None:
        """See `Optimiser`."""
        for key, value in values.items():
            moments = [state.arrays[f"first:{key}"], state.arrays[f"second:{key}"]]
            shapes = value.shape, (value.size,)  # Dr.Jit keeps them flat
            if any(moment.shape not in shapes or moment.dtype != value.dtype for moment in moments):
                raise ValueError(f"the means of '{key}' are not like its value, {value.dtype} of shape {value.shape}")
            if (moments[1] < 0).any():
                raise ValueError(f"'second:{key}', a mean of squares, is negative")
            adam = self._of(key)
            adam[key] = mi.TensorXf(value)
            stored, promoted, rate, (count, first, _, greatest) = adam.state[key]
            m, v = (type(first)(moment.ravel()) for moment in moments)
            adam.state[key] = (stored, promoted, rate, (type(count)(state.steps[key]), m, v, greatest))
