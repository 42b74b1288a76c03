"""Iterate averaging: the result of an optimiser becomes less noisy than its last iterate.

If gradients are noisy, the iterates x_n of an optimiser such as Adam fluctuate about the minimum. A mean over recent
iterates is less noisy than the last iterate, but lags behind iterates that still move towards the minimum. There are
two polynomially weighted means (Shamir and Zhang 2013), one with η = `SHORT` and one with η = `LONG`:

    x̄_n = x̄_{n-1} + w_n (x_n - x̄_{n-1}),      w_n = (η + 1) / (n + η).

The mean age of the averaged iterates is n / (η + 2). With the values of `SHORT` and `LONG`, the long mean is as much
older than the short mean as the short mean is older than x_n. Therefore d = |x̄_long - x̄_short|² is an estimate of the
squared lag of the short mean. Let s be the mean of |x - x̄_short|² over the iterates, with the weights of the short
mean. Then s - d is an estimate of the squared noise of an iterate, and the combination

    x_n + a (x̄_short - x_n),      a = max(0, 1 - d / s),

has the smallest expected squared error, if lag and noise are independent. The combination tends to the mean if the
iterates fluctuate, and equals the last iterate if they move steadily.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from pathreplay.inverse.optim.adaptive import Optimiser, State, WhenAsked
from pathreplay.inverse.parameters.values import Array, Arrays

SHORT, LONG = 8, 3
"""Exponents η of the two means."""
MOST = 2**24
"""Maximum number of entries of an averaged variable. The means of larger variables would take too much memory."""
_SHORT, _LONG, _SCATTER = "short:", "long:", "scatter:"


@dataclass(frozen=True)
class _Means:
    """Means over the iterates of one variable. Before the first iterate, they are the initial value."""

    short: Array
    long: Array
    scatter: float = 0.0
    """The mean s of the module's docstring."""
    count: int = 0
    """Number of iterates."""

    def after(self, x: Array) -> _Means:
        """Return the means that include one more iterate."""
        n = self.count + 1
        short, long = (_between(old, x, _weight(eta, n)) for old, eta in ((self.short, SHORT), (self.long, LONG)))
        scatter = self.scatter + _weight(SHORT, n) * (_square(x - short) - self.scatter)
        return _Means(short, long, scatter, n)

    def combined(self, x: Array) -> Array:
        """Return the combination of the short mean with the last iterate ``x``, which the means include."""
        lag = _square(self.long - self.short)
        return _between(x, self.short, 1 - lag / self.scatter) if lag < self.scatter else x


class Averaged:
    """An optimiser whose result is the combination of its last iterate with a mean of recent iterates.

    The steps are those of the given optimiser. Each variable has its own combination; variables of more than `MOST`
    entries have none.
    """

    finished = ""

    def __init__(self, optimiser: Optimiser) -> None:
        self._optimiser = optimiser
        self._means: dict[str, _Means] = {}

    def step(
        self, values: Arrays, gradients: Arrays, rates: Mapping[str, float], loss: float = 0.0
    ) -> dict[str, Array]:
        """See `Optimiser`. From the second step of a variable on, its means include the given values."""
        for key, value in values.items():
            if value.size > MOST:
                self._means.pop(key, None)
                continue
            known = self._means.get(key)
            same = known is not None and known.short.shape == value.shape
            self._means[key] = known.after(value) if known is not None and same else _Means(value.copy(), value.copy())
        return self._optimiser.step(values, gradients, rates, loss)

    def answer(self, values: Arrays) -> dict[str, Array]:
        """See `Optimiser`."""
        return {
            key: means.after(values[key]).combined(values[key])
            for key, means in self._means.items()
            if means.short.shape == values[key].shape
        }

    def state(self) -> State:
        """See `Optimiser`. The additional arrays are the two means and s."""
        state = self._optimiser.state()
        makers = {name: partial(state.arrays.__getitem__, name) for name in state.arrays}
        for key, means in self._means.items():
            own = {_SHORT: means.short, _LONG: means.long, _SCATTER: np.array([means.scatter])}
            makers |= {what + key: partial(_itself, array) for what, array in own.items()}
        return State(state.steps, WhenAsked(makers))

    def restore(self, state: State, values: Arrays) -> None:
        """See `Optimiser`."""
        own = (_SHORT, _LONG, _SCATTER)
        names = [name for name in state.arrays if not name.startswith(own)]
        rest = WhenAsked({name: partial(state.arrays.__getitem__, name) for name in names})
        self._optimiser.restore(State(state.steps, rest), values)
        self._means = {}
        for key, count in state.steps.items():
            if not count or values[key].size > MOST:
                continue
            short, long, scatter = (np.array(state.arrays[what + key]) for what in own)
            for mean in (short, long):
                if mean.shape != values[key].shape or mean.dtype != values[key].dtype:
                    raise ValueError(f"the means of '{key}' do not have the type of its value")
            if scatter.shape != (1,) or scatter.dtype != np.float64 or scatter[0] < 0:
                raise ValueError(f"'{_SCATTER}{key}' is not a positive number")
            # The first step of a variable initialises the means with a value that is not an iterate.
            self._means[key] = _Means(short, long, float(scatter[0]), count - 1)


def _weight(eta: int, n: int) -> float:
    return (eta + 1) / (n + eta)


def _between(a: Array, b: Array, share: float) -> Array:
    """Return a + share (b - a) with a single temporary array."""
    found: Array = b - a
    found *= np.float32(share)
    found += a
    return found


def _square(difference: Array) -> float:
    return float(np.vdot(difference, difference))


def _itself(array: Array) -> Array:
    return array
