"""Optimisers: from values and their gradients to the next values; what they remember can be saved, by name."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from math import prod
from typing import Any, Protocol

import drjit as dr
import drjit.opt
import mitsuba as mi
import numpy as np

from pathreplay.inverse.config.optimizer_options import Optimizer
from pathreplay.inverse.parameters.values import Array, Arrays

_CLASSES = {"adam": drjit.opt.Adam, "adamw": drjit.opt.AdamW, "sgd": drjit.opt.SGD, "rmsprop": drjit.opt.RMSProp}
# What they remember, in Dr.Jit's order: means of gradients and of their squares, and the greatest of those.
_FIRST, _SECOND, _GREATEST, _VELOCITY = "first", "second", "greatest", "velocity"
_KEPT = {"sgd": (_VELOCITY,), "rmsprop": (_SECOND,)}
_MOMENTS = _FIRST, _SECOND, _GREATEST
PIECE = 2**22
"""Entries of a large variable that are stepped at once: what a step makes on the way is some times 16 MB."""


@dataclass(frozen=True)
class State:
    """What an optimiser remembers: steps since each variable began anew, and arrays by name (``what:variable``)."""

    steps: dict[str, int]
    arrays: Mapping[str, Array]


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

    Large variables are stepped in pieces, and between steps only what is remembered of them is held: see `PIECE`.
    """

    finished = ""

    def __init__(self, values: Arrays, options: Optimizer | None = None, uniform: Collection[str] = ()) -> None:
        wanted = Optimizer() if options is None else options
        self._moments = wanted.type not in _KEPT  # Adam's
        self._names = _MOMENTS if self._moments else _KEPT[wanted.type]
        given = wanted.options()
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
        """The pieces of a variable, by the names that Dr.Jit's optimiser has for them."""
        size = prod(self._shapes[key])
        length = max(size, 1) if self._is_uniform(key) else self._piece
        return {f"{key}:{begin}": slice(begin, min(begin + length, size)) for begin in range(0, size, length)}

    def _begin(self, key: str, value: Array) -> None:
        """Remember nothing of a variable yet."""
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
        """See `Optimiser`."""
        for key, value in values.items():
            anew = self._shapes.get(key) != value.shape
            if anew:
                self._begin(key, value)
            self._steps[key] = 1 if anew else self._steps[key] + 1
        stepped = {key: np.empty_like(value, order="C") for key, value in values.items()}
        for even, part in self._parts.items():
            mine = [key for key in values if self._is_uniform(key) == even]
            pieces = {name: (key, piece) for key in mine for name, piece in self._pieces(key).items()}
            # As numbers: Dr.Jit 1.5.0 would multiply arrays in place, and AdamW's decay with them.
            part.set_learning_rate({name: rates[key] for name, (key, _) in pieces.items()})
            known = part.state
            for names in _together(pieces, self._piece):
                part.state = {name: known[name] for name in names}
                for name in names:
                    key, piece = pieces[name]
                    part[name] = mi.TensorXf(values[key].reshape(-1)[piece])
                    dr.set_grad(part[name], mi.TensorXf(gradients[key].reshape(-1)[piece]))
                part.step()
                for name in names:
                    key, piece = pieces[name]
                    stepped[key].reshape(-1)[piece] = np.array(dr.detach(part[name]))
                    _let_go(part, name)
                known |= part.state
            part.state = known
        return stepped

    def answer(self) -> dict[str, Array]:
        """See `Optimiser`."""
        return {}

    def _remembered(self, name: str, part: drjit.opt.Optimizer) -> dict[str, Any]:
        """What the optimiser remembers of a piece, by what it is: Dr.Jit's arrays."""
        kept = part.state[name][3]
        arrays = kept[1:] if self._moments else (kept,)
        return {what: array for what, array in zip(self._names, arrays, strict=True) if array is not None}

    def state(self) -> State:
        """See `Optimiser`; the arrays are means of gradients and of their squares, or the velocity of SGD.

        Each is put together when it is asked for.
        """
        kinds = {key: self._remembered(next(iter(self._pieces(key))), self._of(key)) for key in self._steps}
        makers = {f"{what}:{key}": partial(self._whole, what, key) for key in self._steps for what in kinds[key]}
        return State(dict(self._steps), WhenAsked(makers))

    def _whole(self, what: str, key: str) -> Array:
        part, pieces = self._of(key), self._pieces(key)
        found = np.empty(prod(self._shapes[key]), np.float32)
        for name, piece in pieces.items():
            found[piece] = np.array(self._remembered(name, part)[what]).ravel()
        return found

    def restore(self, state: State, values: Arrays) -> None:
        """See `Optimiser`."""
        for key, value in values.items():
            part = self._of(key)
            if self._shapes.get(key) != value.shape:
                self._begin(key, value)
            self._steps[key] = state.steps[key]
            kinds = self._remembered(next(iter(self._pieces(key))), part)
            found = {what: state.arrays[f"{what}:{key}"] for what in kinds}
            for what, array in found.items():
                shapes = value.shape, (value.size,)  # Dr.Jit keeps them flat
                if array.shape not in shapes or array.dtype != value.dtype:
                    wanted = f"{value.dtype} of shape {value.shape}"
                    raise ValueError(f"the means of '{key}' are not like its value, {wanted}")
                if what in (_SECOND, _GREATEST) and (array < 0).any():
                    raise ValueError(f"'{what}:{key}', a mean of squares, is negative")
            for name, piece in self._pieces(key).items():
                like = self._remembered(name, part)
                restored = {what: type(like[what])(array.reshape(-1)[piece]) for what, array in found.items()}
                stored, promoted, rate, kept = part.state[name]
                arrays = tuple(restored.get(what) for what in self._names)
                kept = (type(kept[0])(state.steps[key]), *arrays) if self._moments else arrays[0]
                part.state[name] = stored, promoted, rate, kept
        if rest := set(state.arrays) - set(self.state().arrays):
            raise ValueError(f"'{min(rest)}' is nothing that this optimizer keeps")


def _let_go(part: drjit.opt.Optimizer, name: str) -> None:
    """Hold no value of a piece, but what is remembered of it: zeros that nobody has written down have its shape."""
    value, *rest = part.state[name]
    part.state[name] = (dr.zeros(type(value), value.shape), *rest)


def _together(pieces: Mapping[str, tuple[str, slice]], most: int) -> Iterator[list[str]]:
    """The pieces in groups that are stepped at once, of up to ``most`` entries."""
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


class WhenAsked(Mapping[str, Any]):
    """Arrays by name that are made each time when they are asked for, and held by nobody else."""

    def __init__(self, makers: Mapping[str, Callable[[], Any]]) -> None:
        self._makers = dict(makers)

    def __getitem__(self, name: str) -> Any:
        return self._makers[name]()

    def __iter__(self) -> Iterator[str]:
        return iter(self._makers)

    def __len__(self) -> int:
        return len(self._makers)
