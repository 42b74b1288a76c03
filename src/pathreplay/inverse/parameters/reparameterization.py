"""Where steps are taken instead of the values themselves: in logarithms, say, where a step is a share of a value."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import scipy.special
from numpy.typing import NDArray

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.parameter_options import TransformKind
from pathreplay.inverse.parameters.values import Array

CLOSEST = 1e-6
"""How close values come to a bound of theirs, in shares of the range: beyond, a step would do nothing more."""

LARGEST_LOG = 88.0
"""The largest logarithm of a value: beyond, single precision ends."""


class Coordinates(Protocol):
    """Other coordinates u of values v."""

    uniform: bool
    """Whether all entries of u are of one kind, so that an optimiser is to measure them by one number."""

    def latent(self, values: Array) -> Array:
        """u of v."""

    def gradient(self, values: Array, by_values: Array) -> Array:
        """The derivative by u at v, of that by v."""

    def values(self, latent: Array) -> Array:
        """v of u."""


class Transform:
    """Each value for itself, so that none leaves (lower, upper).

    log       v = exp u
    softplus  v = lower + log(1 + exp u)
    logit     v = lower + (upper - lower) / (1 + exp(-u))

    Computed in double precision, returned in single.
    """

    uniform = False

    def __init__(self, kind: TransformKind, lower: float = -np.inf, upper: float = np.inf) -> None:
        self.kind = kind
        self.lower = 0.0 if kind == "log" or not np.isfinite(lower) else lower
        self.upper = (1.0 if not np.isfinite(upper) else upper) if kind == "logit" else np.inf

    def require_inside(self, key: str, values: Array) -> None:
        """Raise PathreplayError unless all values are between the bounds, and not on them."""
        for wrong, what in ((values <= self.lower, "above"), (values >= self.upper, "below")):
            if wrong.any():
                bound = self.lower if what == "above" else self.upper
                raise PathreplayError(
                    f"Parameter '{key}' starts at {values[wrong].flat[0]:g}, and parameterization = '{self.kind}' "
                    f"wants values {what} {bound:g}; start elsewhere with 'initial', or leave it out"
                )

    def latent(self, values: Array) -> Array:
        """See `Coordinates`."""
        v = self._inside(values)
        if self.kind == "log":
            u = np.log(v)
        elif self.kind == "softplus":
            above = v - self.lower
            u = above + np.log(-np.expm1(-above))
        else:
            u = scipy.special.logit((v - self.lower) / (self.upper - self.lower))
        return np.asarray(u, np.float32)

    def gradient(self, values: Array, by_values: Array) -> Array:
        """See `Coordinates`."""
        v = self._inside(values)
        if self.kind == "log":
            slope = v
        elif self.kind == "softplus":
            slope = -np.expm1(self.lower - v)
        else:
            slope = (v - self.lower) * (self.upper - v) / (self.upper - self.lower)
        return np.asarray(by_values * slope, np.float32)

    def values(self, latent: Array) -> Array:
        """See `Coordinates`."""
        u = latent.astype(np.float64)
        if self.kind == "log":
            v = np.exp(np.minimum(u, LARGEST_LOG))
        elif self.kind == "softplus":
            v = self.lower + np.logaddexp(0, u)
        else:
            v = self.lower + (self.upper - self.lower) * scipy.special.expit(u)
        return np.asarray(self._inside(v), np.float32)

    def _inside(self, values: NDArray[np.floating]) -> NDArray[np.float64]:
        """The values, held off the bounds."""
        v = values.astype(np.float64)
        if self.kind == "logit":
            off = CLOSEST * (self.upper - self.lower)
            return np.clip(v, self.lower + off, self.upper - off)
        return np.maximum(v, self.lower + float(np.finfo(np.float32).tiny) + CLOSEST * abs(self.lower))
