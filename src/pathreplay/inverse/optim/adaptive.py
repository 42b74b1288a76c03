"""Interface of optimisers whose state can be saved, and an adapter for the optimisers of Dr.Jit."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from math import prod
from typing import Protocol

import drjit as dr
import drjit.opt
import mitsuba as mi
import numpy as np

from pathreplay.inverse.config.optimizer_options import Optimizer
from pathreplay.inverse.parameters.values import Array, Arrays
from pathreplay.platform.owned_arrays import with_space

_CLASSES = {"adam": drjit.opt.Adam, "adamw": drjit.opt.AdamW, "sgd": drjit.opt.SGD, "rmsprop": drjit.opt.RMSProp}
# Names of state arrays. Adam and AdamW have the first moment, the second moment and, with AMSGrad, the maximum of the
# second moment, in Dr.Jit's order. RMSProp has the second moment, and SGD the velocity.
_FIRST, _SECOND, _GREATEST, _VELOCITY = "first", "second", "greatest", "velocity"
_KEPT = {"sgd": (_VELOCITY,), "rmsprop": (_SECOND,)}
_MOMENTS = _FIRST, _SECOND, _GREATEST
MEANS = "short:", "long:", "scatter:"
"""Prefixes of the state arrays of `Averaged`, which an optimiser without averaging ignores."""
PIECE = 2**22
"""Maximum number of entries per step. Larger variables are stepped in pieces, to limit temporary arrays to 16 MB."""


@dataclass(frozen=True)
class State:
    """State of an optimiser."""

    steps: dict[str, int]
    """Number of steps of each variable since its state was last reset."""
    arrays: Mapping[str, Array]
    """State arrays by name. `DrJitOptimiser` uses names ``kind:key``, e.g. ``first:KEY`` for the first moment."""


class Optimiser(Protocol):
    """Interface of optimisers. Dictionaries are indexed by the key of the variable.

    If the shape of a variable changes, its state is reset. Variables that are missing from a step keep their state.
    """

    finished: str = ""
    """Reason why the optimiser has stopped; "" while it runs."""

    def step(
        self, values: Arrays, gradients: Arrays, rates: Mapping[str, float], loss: float = 0.0
    ) -> dict[str, Array]:
        """Return the values after one step.

        Args:
            values: current values.
            gradients: gradients of the loss at these values.
            rates: learning rate of each variable.
            loss: loss at the values, for optimisers that need it.
        """

    def answer(self, values: Arrays) -> dict[str, Array]:
        """Return the best values so far. Variables that are missing have their best values after the last step.

        Args:
            values: values after the last step.
        """
        return {}

    def awaited(self) -> dict[str, Array]:
        """Return the values that the next step must get. Variables that are missing keep their current values.

        The result is empty, unless a search that had ended goes on after `restore`: the values are then its best point.
        """
        return {}

    def state(self) -> State:
        """Return all state that later steps depend on, besides the values."""

    def restore(self, state: State, values: Arrays) -> None:
        """Restore a state bit for bit. Raises KeyError or ValueError if it does not fit the variables."""


class DrJitOptimiser(Optimiser):
    """An `Optimiser` of ``drjit.opt``.

    Large variables are stepped in pieces (see `PIECE`). Between steps, the optimiser keeps the state of each variable,
    but no copy of its values.

    Args:
        values: initial values by key.
        options: type and options of the optimiser; default: Adam.
        uniform: keys of variables for which Adam and AdamW normalise all entries by the variable's largest second
            moment (UniformAdam). Entries with small gradients then hardly move.
    """

    def __init__(self, values: Arrays, options: Optimizer | None = None, uniform: Collection[str] = ()) -> None:
        wanted = Optimizer() if options is None else options
        self._moments = wanted.type not in _KEPT  # Adam and AdamW
        self._names = _MOMENTS if self._moments else _KEPT[wanted.type]
        given = wanted.options()
        del given["iterate_averaging"]  # see `averaging`
        self._everywhere, self._uniform = given.pop("uniform", False), frozenset(uniform if self._moments else ())
        self._parts = {
            even: _CLASSES[wanted.type](1.0, None, **given, **({"uniform": even} if self._moments else {}))
            for even in (False, True)
        }
        self._steps = dict.fromkeys(values, 0)
        self._shapes: dict[str, tuple[int, ...]] = {}
        self._piece = PIECE
        for key, value in values.items():
            self._begin(key, value)

    def _is_uniform(self, key: str) -> bool:
        return self._everywhere or key in self._uniform

    def _of(self, key: str) -> drjit.opt.Optimizer:
        return self._parts[self._is_uniform(key)]

    def _pieces(self, key: str) -> dict[str, slice]:
        """Return the slices of the pieces of a variable, by the names of the pieces in Dr.Jit's optimiser.

        A variable of UniformAdam is a single piece.
        """
        size = prod(self._shapes[key])
        length = max(size, 1) if self._is_uniform(key) else self._piece
        return {f"{key}:{begin}": slice(begin, min(begin + length, size)) for begin in range(0, size, length)}

    def _begin(self, key: str, value: Array) -> None:
        """Reset the state of a variable."""
        part = self._of(key)
        for name in self._pieces(key) if key in self._shapes else ():
            del part[name]
        self._shapes[key] = value.shape
        for name, piece in self._pieces(key).items():
            part[name] = mi.TensorXf(value.reshape(-1)[piece])
            _let_go(part, name)

    def step(
        self, values: Arrays, gradients: Arrays, rates: Mapping[str, float], loss: float = 0.0
    ) -> dict[str, Array]:
        for key, value in values.items():
            reset = self._shapes.get(key) != value.shape
            if reset:
                self._begin(key, value)
            self._steps[key] = 1 if reset else self._steps[key] + 1
        stepped = {key: np.empty_like(value, order="C") for key, value in values.items()}
        for even, part in self._parts.items():
            mine = [key for key in values if self._is_uniform(key) == even]
            pieces = {name: (key, piece) for key in mine for name, piece in self._pieces(key).items()}
            # Rates must be floats: Dr.Jit 1.5.0 multiplies array rates in place, which would also scale AdamW's decay.
            part.set_learning_rate({name: rates[key] for name, (key, _) in pieces.items()})
            known = part.state
            for names in _together(pieces, self._piece):
                part.state = {name: known[name] for name in names}
                for name in names:
                    key, piece = pieces[name]
                    part[name] = mi.TensorXf(with_space(values[key].reshape(-1)[piece]))
                    dr.set_grad(part[name], mi.TensorXf(with_space(gradients[key].reshape(-1)[piece])))
                part.step()
                for name in names:
                    key, piece = pieces[name]
                    stepped[key].reshape(-1)[piece] = np.array(dr.detach(part[name]))
                    _let_go(part, name)
                known |= part.state
            part.state = known
        return stepped

    def _remembered(self, name: str, part: drjit.opt.Optimizer) -> dict[str, dr.ArrayBase]:
        """Return the state arrays of a piece of a variable, by kind (first moment, etc.)."""
        kept = part.state[name][3]
        arrays = kept[1:] if self._moments else (kept,)
        return {what: array for what, array in zip(self._names, arrays, strict=True) if array is not None}

    def state(self) -> State:
        """See `Optimiser`. Each array is assembled from the pieces of its variable when it is accessed."""
        kinds = {key: self._remembered(next(iter(self._pieces(key))), self._of(key)) for key in self._steps}
        makers = {f"{what}:{key}": partial(self._whole, what, key) for key in self._steps for what in kinds[key]}
        return State(dict(self._steps), WhenAsked(makers))

    def _whole(self, what: str, key: str) -> Array:
        part, pieces = self._of(key), self._pieces(key)
        whole = np.empty(prod(self._shapes[key]), np.float32)
        for name, piece in pieces.items():
            whole[piece] = np.array(self._remembered(name, part)[what]).ravel()
        return whole

    def restore(self, state: State, values: Arrays) -> None:
        for key, value in values.items():
            part = self._of(key)
            if self._shapes.get(key) != value.shape:
                self._begin(key, value)
            self._steps[key] = state.steps[key]
            kinds = self._remembered(next(iter(self._pieces(key))), part)
            saved = {what: state.arrays[f"{what}:{key}"] for what in kinds}
            for what, array in saved.items():
                shapes = value.shape, (value.size,)  # Dr.Jit's state arrays are flat
                if array.shape not in shapes or array.dtype != value.dtype:
                    wanted = f"{value.dtype} of shape {value.shape}"
                    raise ValueError(f"the state of '{key}' does not have the type of its value, {wanted}")
                if what in (_SECOND, _GREATEST) and (array < 0).any():
                    raise ValueError(f"'{what}:{key}', a second moment, is negative")
            for name, piece in self._pieces(key).items():
                like = self._remembered(name, part)
                flat = {what: with_space(array.reshape(-1)[piece]) for what, array in saved.items()}
                restored = {what: type(like[what])(array) for what, array in flat.items()}
                stored, promoted, rate, kept = part.state[name]
                arrays = tuple(restored.get(what) for what in self._names)
                kept = (type(kept[0])(state.steps[key]), *arrays) if self._moments else arrays[0]
                part.state[name] = stored, promoted, rate, kept
        given = {name for name in state.arrays if not name.startswith(MEANS)}
        if rest := given - set(self.state().arrays):
            raise ValueError(f"'{min(rest)}' is not a state array of this optimizer")


def _let_go(part: drjit.opt.Optimizer, name: str) -> None:
    """Replace the value of a piece by literal zeros, which take no memory, and keep the state of the piece."""
    value, *rest = part.state[name]
    part.state[name] = (dr.zeros(type(value), value.shape), *rest)


def _together(pieces: Mapping[str, tuple[str, slice]], most: int) -> Iterator[list[str]]:
    """Group the pieces that are stepped at once. A group has at most ``most`` entries, or is a single larger piece."""
    group: list[str] = []
    size = 0
    for name, (_, piece) in pieces.items():
        if group and size + piece.stop - piece.start > most:
            yield group
            group, size = [], 0
        group.append(name)
        size += piece.stop - piece.start
    if group:
        yield group


class WhenAsked(Mapping[str, Array]):
    """A read-only mapping whose arrays are computed on each access and not cached."""

    def __init__(self, makers: Mapping[str, Callable[[], Array]]) -> None:
        self._makers = dict(makers)

    def __getitem__(self, name: str) -> Array:
        return self._makers[name]()

    def __iter__(self) -> Iterator[str]:
        return iter(self._makers)

    def __len__(self) -> int:
        return len(self._makers)
