"""Reparameterization: the optimiser steps a function of the values, such as their logarithm."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import scipy.special
from numpy.typing import NDArray

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.parameter_options import TransformKind
from pathreplay.inverse.parameters.values import Array

CLOSEST = 1e-6
"""Minimum distance from a bound, relative to the range. At a bound, dv/du = 0, and no step could leave it."""

LARGEST_LOG = 88.0
"""Maximum logarithm of a value. The exponential of a larger number overflows in single precision."""


class Coordinates(Protocol):
    """A change of coordinates between values v and the latent variables u that the optimiser steps."""

    uniform: bool = False
    """Whether the optimiser should normalise all entries of u by their largest second moment (UniformAdam)."""

    def latent(self, values: Array) -> Array:
        """Compute u from v."""

    def gradient(self, values: Array, by_values: Array) -> Array:
        """Convert the gradient with respect to v, at ``values``, to the gradient with respect to u."""

    def values(self, latent: Array) -> Array:
        """Compute v from u."""


class Transform(Coordinates):
    """Entrywise coordinates that keep values within (lower, upper).

    log       v = exp u
    softplus  v = lower + log(1 + exp u)
    logit     v = lower + (upper - lower) / (1 + exp(-u))

    The computation is in double precision. The results are in single precision.
    """

    def __init__(self, kind: TransformKind, lower: float = -np.inf, upper: float = np.inf) -> None:
        self.kind = kind
        self.lower = 0.0 if kind == "log" or not np.isfinite(lower) else lower
        self.upper = (1.0 if not np.isfinite(upper) else upper) if kind == "logit" else np.inf

    def require_inside(self, key: str, values: Array) -> None:
        for wrong, what in ((values <= self.lower, "above"), (values >= self.upper, "below")):
            if wrong.any():
                bound = self.lower if what == "above" else self.upper
                raise PathreplayError(
                    f"Parameter '{key}' starts at {values[wrong].flat[0]:g}, but parameterization = '{self.kind}' "
                    f"needs values {what} {bound:g}; set another 'initial', or remove 'parameterization'"
                )

    def bounds(self, lower: float, upper: float) -> tuple[float, float]:
        """Return the bounds of u for values in [lower, upper].

        A bound at or beyond an end of the range of the transform becomes infinite.
        """
        low = float(self.latent(np.array([lower], np.float32))[0]) if lower > self.lower else -np.inf
        high = float(self.latent(np.array([upper], np.float32))[0]) if upper < self.upper else np.inf
        return low, high

    def latent(self, values: Array) -> Array:
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
        v = self._inside(values)
        if self.kind == "log":
            slope = v
        elif self.kind == "softplus":
            slope = -np.expm1(self.lower - v)
        else:
            slope = (v - self.lower) * (self.upper - v) / (self.upper - self.lower)
        return np.asarray(by_values * slope, np.float32)

    def values(self, latent: Array) -> Array:
        u = latent.astype(np.float64)
        if self.kind == "log":
            v = np.exp(np.minimum(u, LARGEST_LOG))
        elif self.kind == "softplus":
            v = self.lower + np.logaddexp(0, u)
        else:
            v = self.lower + (self.upper - self.lower) * scipy.special.expit(u)
        return np.asarray(self._inside(v), np.float32)

    def _inside(self, values: NDArray[np.floating]) -> NDArray[np.float64]:
        """Clamp the values to keep a small distance from the bounds (see `CLOSEST`)."""
        v = values.astype(np.float64)
        if self.kind == "logit":
            off = CLOSEST * (self.upper - self.lower)
            return np.clip(v, self.lower + off, self.upper - off)
        return np.maximum(v, self.lower + float(np.finfo(np.float32).tiny) + CLOSEST * abs(self.lower))
