"""Base class of optimisers that treat the entries of all variables as one vector within bounds."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import NDArray

from pathreplay.errors import PathreplayError
from pathreplay.inverse.optim.adaptive import Optimiser, State
from pathreplay.inverse.parameters.values import Arrays

Vector = NDArray[np.float64]


class VectorOptimiser(Optimiser):
    """Base class of optimisers for few entries.

    Raises PathreplayError if there are more than ``most`` entries. The message names the type ``kind`` of the optimiser
    in a job, and the types ``others`` that take more entries.
    """

    def __init__(
        self, values: Arrays, bounds: Mapping[str, tuple[float, float]], kind: str, most: int, others: str
    ) -> None:
        self._shapes = {key: value.shape for key, value in values.items()}
        self._n = sum(value.size for value in values.values())
        if self._n > most:
            raise PathreplayError(
                f"The parameters have {self._n} entries, but optimizer type = '{kind}' takes up to {most}; use {others}"
            )
        ends = [np.broadcast_to(np.array(bounds[key], float), (value.size, 2)) for key, value in values.items()]
        self._bounds = np.concatenate(ends)

    def _steps_of(self, state: State, values: Arrays, names: Collection[str]) -> int:
        """Return the number of steps of a saved state.

        Raises ValueError if the variables have other shapes, or if an array of the state is not one of ``names``.
        """
        (count,) = {state.steps[key] for key in values} or {0}
        if {key: value.shape for key, value in values.items()} != self._shapes:
            raise ValueError("the shapes of its parameters differ")
        if rest := set(state.arrays) - set(names):
            raise ValueError(f"'{min(rest)}' is not a state array of this optimizer")
        return count


def require_float64(name: str, array: NDArray[np.floating], shape: tuple[int, ...]) -> None:
    """Raise ValueError unless an array of a saved state is in double precision and has the given shape."""
    if array.shape != shape or array.dtype != np.float64:
        raise ValueError(f"'{name}' is {array.dtype} of shape {array.shape}, not float64 of {shape}")


def flat(arrays: Arrays) -> Vector:
    """Concatenate the entries of all arrays in double precision."""
    return np.concatenate([np.ravel(array).astype(np.float64) for array in arrays.values()])
