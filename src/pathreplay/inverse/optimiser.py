"""Optimisers: from values and their gradients to the next values; what they remember can be saved, by name."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr
import drjit.opt
import mitsuba as mi
import numpy as np

from pathreplay.inverse.optimizer_options import Optimizer
from pathreplay.inverse.values import Array, Arrays

_CLASSES = {"adam": drjit.opt.Adam, "adamw": drjit.opt.AdamW, "sgd": drjit.opt.SGD, "rmsprop": drjit.opt.RMSProp}
# What they remember, in Dr.Jit's order: means of gradients and of their squares, and the greatest of those.
_FIRST, _SECOND, _GREATEST, _VELOCITY = "first", "second", "greatest", "velocity"
_KEPT = {"sgd": (_VELOCITY,), "rmsprop": (_SECOND,)}
_MOMENTS = _FIRST, _SECOND, _GREATEST


@dataclass(frozen=True)
class State:
    """What an optimiser remembers: steps since each variable began anew, and arrays by name (``what:variable``)."""

    steps: dict[str, int]
    arrays: dict[str, Array]


class Optimiser(Protocol):
    """Arrays are by key of the variable. A variable that comes in another shape than before begins anew.

    One that does not come stays as it is, and so does what is remembered of it.
    """

    finished: str
    """Why it takes no more steps; "" while it does."""

    def step(
        self, values: Arrays, gradients: Arrays, rates: Mapping[str, float], loss: float = 0.0
    ) -> dict[str, Array]:
        """The values after a step against the gradients; ``rates`` are about its length in each variable.

        ``loss`` is that at ``values``, for those that look at it.
        """

    def answer(self) -> dict[str, Array]:
        """The values that the steps so far have come to, where they are not those after the last one; else nothing."""

    def state(self) -> State:
        """All that later steps depend on, besides the values."""

    def restore(self, state: State, values: Arrays) -> None:
        """Go on from ``state`` at ``values``, bit for bit. Raises KeyError or ValueError if they do not belong."""


class DrJitOptimiser:
    """One of Dr.Jit's, of variables that begin at ``values``.

    With Adam and AdamW all entries of those that are ``uniform`` are measured by the largest mean of squares, so that
    entries with little gradient stay where they are (UniformAdam). The lengths of SGD's steps are rate x gradient.
    """

    finished = ""

    def __init__(self, values: Arrays, options: Optimizer | None = None, uniform: Collection[str] = ()) -> None:
        wanted = Optimizer() if options is None else options
        self._moments = wanted.type not in _KEPT  # Adam's
        self._names = _MOMENTS if self._moments else _KEPT[wanted.type]
        given = wanted.options()
        self._everywhere, self._uniform = given.pop("uniform", False), frozenset(uniform if self._moments else ())
        self._parts = {
            even: _CLASSES[wanted.type](
                1.0,
                {k: mi.TensorXf(v) for k, v in values.items() if self._is_uniform(k) == even},
                **given,
                **({"uniform": even} if self._moments else {}),
            )
            for even in (False, True)
        }
        self._steps = dict.fromkeys(values, 0)

    def _is_uniform(self, key: str) -> bool:
        return self._everywhere or key in self._uniform

    def _of(self, key: str) -> drjit.opt.Optimizer:
        return self._parts[self._is_uniform(key)]

    def step(
        self, values: Arrays, gradients: Arrays, rates: Mapping[str, float], loss: float = 0.0
    ) -> dict[str, Array]:
        """See `Optimiser`."""
        for key, value in values.items():
            part = self._of(key)
            anew = key not in part or part[key].shape != value.shape
            self._steps[key] = 1 if anew else self._steps[key] + 1
            part[key] = mi.TensorXf(value)
            dr.set_grad(part[key], mi.TensorXf(gradients[key]))
        for even, part in self._parts.items():
            held = {key: kept for key, kept in part.state.items() if key not in values}
            # As numbers: Dr.Jit 1.5.0 would multiply arrays in place, and AdamW's decay with them.
            part.set_learning_rate({key: rate for key, rate in rates.items() if self._is_uniform(key) == even})
            part.step()
            part.state.update(held)
        return {key: np.array(dr.detach(self._of(key)[key])) for key in values}

    def answer(self) -> dict[str, Array]:
        """See `Optimiser`."""
        return {}

    def _remembered(self, key: str) -> dict[str, Any]:
        """What the optimiser remembers of a variable, by name: Dr.Jit's arrays."""
        kept = self._of(key).state[key][3]
        arrays = kept[1:] if self._moments else (kept,)
        return {name: array for name, array in zip(self._names, arrays, strict=True) if array is not None}

    def state(self) -> State:
        """See `Optimiser`; the arrays are means of gradients and of their squares, or the velocity of SGD."""
        arrays = {f"{name}:{key}": np.array(a) for key in self._steps for name, a in self._remembered(key).items()}
        return State(dict(self._steps), arrays)

    def restore(self, state: State, values: Arrays) -> None:
        """See `Optimiser`."""
        for key, value in values.items():
            part = self._of(key)
            part[key] = mi.TensorXf(value)
            self._steps[key], restored = state.steps[key], {}
            for name, like in self._remembered(key).items():
                array = state.arrays[f"{name}:{key}"]
                shapes = value.shape, (value.size,)  # Dr.Jit keeps them flat
                if array.shape not in shapes or array.dtype != value.dtype:
                    wanted = f"{value.dtype} of shape {value.shape}"
                    raise ValueError(f"the means of '{key}' are not like its value, {wanted}")
                if name in (_SECOND, _GREATEST) and (array < 0).any():
                    raise ValueError(f"'{name}:{key}', a mean of squares, is negative")
                restored[name] = type(like)(array.ravel())
            stored, promoted, rate, kept = part.state[key]
            arrays = tuple(restored.get(name) for name in self._names)
            kept = (type(kept[0])(state.steps[key]), *arrays) if self._moments else arrays[0]
            part.state[key] = stored, promoted, rate, kept
        if rest := set(state.arrays) - set(self.state().arrays):
            raise ValueError(f"'{min(rest)}' is nothing that this optimizer keeps")
