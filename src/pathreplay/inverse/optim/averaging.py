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

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from pathreplay.inverse.optim.adaptive import MEANS, Optimiser, State, WhenAsked
from pathreplay.inverse.parameters.values import Array, Arrays

SHORT, LONG = 8, 3
"""Exponents η of the two means."""
MOST = 2**24
"""Maximum number of entries of an averaged variable. The means of larger variables would take too much memory."""
BLOCK = 2**16
"""Number of entries that are processed at once, so that temporary arrays stay in the processor's cache."""
_SHORT, _LONG, _SCATTER = MEANS


@dataclass
class _Means:
    """Means over the iterates of one variable. Before the first iterate, they are the initial value."""

    short: Array
    long: Array
    scatter: float = 0.0
    """The mean s of the module's docstring."""
    count: int = 0
    """Number of iterates."""

    def add(self, x: Array) -> None:
        self.scatter, _ = self._ahead(x, store=True)
        self.count += 1

    def combined(self, x: Array) -> Array:
        """Return the combination of the last iterate ``x`` with the short mean that includes it."""
        scatter, lag = self._ahead(x)
        if lag >= scatter:
            return x
        # With x included, the distance of the short mean from x shrinks by the factor 1 - w.
        share = np.float32((1 - lag / scatter) * (1 - _weight(SHORT, self.count + 1)))
        found = np.array(x, order="C")
        for value, short in _blocks(found, self.short):
            value += share * (short - value)
        return found

    def _ahead(self, x: Array, store: bool = False) -> tuple[float, float]:
        """Return s and d for the means that include the iterate ``x``. If ``store`` is set, store these means."""
        n, scatter, lag = self.count + 1, 0.0, 0.0
        a, b = (np.float32(1 - _weight(eta, n)) for eta in (SHORT, LONG))
        for value, short, long in _blocks(x, self.short, self.long):
            near, far = a * (short - value), b * (long - value)
            if store:
                np.add(value, near, out=short)
                np.add(value, far, out=long)
            far -= near
            scatter += float(near @ near)
            lag += float(far @ far)
        return self.scatter + _weight(SHORT, n) * (scatter - self.scatter), lag


class Averaged(Optimiser):
    """An `Optimiser` whose result is the combination of its last iterate with a mean of recent iterates.

    The steps are those of the given optimiser. Each variable has its own combination; variables of more than `MOST`
    entries have none.
    """

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
            if known is not None and known.short.shape == value.shape:
                known.add(value)
            else:
                self._means[key] = _Means(np.array(value, order="C"), np.array(value, order="C"))
        return self._optimiser.step(values, gradients, rates, loss)

    @property
    def averaged(self) -> Collection[str]:
        """Return the keys of the variables that have means."""
        return self._means.keys()

    def freeze(self, values: Arrays) -> dict[str, Array]:
        """Return the combinations of variables that have means, and begin new means with their next step."""
        means = {key: self._means.pop(key) for key in values}
        return {k: means[k].combined(value) for k, value in values.items() if means[k].short.shape == value.shape}

    def answer(self, values: Arrays) -> dict[str, Array]:
        return {
            key: means.combined(values[key])
            for key, means in self._means.items()
            if means.short.shape == values[key].shape
        }

    def state(self) -> State:
        """See `Optimiser`. The additional arrays are the two means, and an array of s and the number of iterates."""
        state = self._optimiser.state()
        makers = {name: partial(state.arrays.__getitem__, name) for name in state.arrays}
        for key, means in self._means.items():
            own = {_SHORT: means.short, _LONG: means.long, _SCATTER: np.array([means.scatter, means.count])}
            makers |= {what + key: partial(np.copy, array) for what, array in own.items()}
        return State(state.steps, WhenAsked(makers))

    def restore(self, state: State, values: Arrays) -> None:
        """See `Optimiser`. The means of a variable whose means are not in the state begin with its next step."""
        stored = set(state.arrays)
        self._optimiser.restore(state, values)  # ignores the arrays of the means
        self._means = {}
        for key, count in state.steps.items():
            if not count or values[key].size > MOST or stored.isdisjoint(what + key for what in MEANS):
                continue
            short, long, scatter = (np.array(state.arrays[what + key]) for what in MEANS)
            for mean in (short, long):
                if mean.shape != values[key].shape or mean.dtype != values[key].dtype:
                    raise ValueError(f"the means of '{key}' do not have the type of its value")
            if scatter.shape != (2,) or scatter.dtype != np.float64 or scatter[0] < 0:
                raise ValueError(f"'{_SCATTER}{key}' is not a positive number and a count")
            # The first step of a variable initialises the means with a value that is not an iterate.
            if scatter[1] not in range(count):
                raise ValueError(f"'{_SCATTER}{key}' counts {scatter[1]:g} iterates in {count} steps")
            self._means[key] = _Means(short, long, float(scatter[0]), int(scatter[1]))


def _weight(eta: int, n: int) -> float:
    return (eta + 1) / (n + eta)


def _blocks(*arrays: Array) -> Iterator[tuple[Array, ...]]:
    """Yield flat views of at most `BLOCK` entries of C-contiguous arrays of equal size."""
    flat = [array.reshape(-1) for array in arrays]
    for begin in range(0, flat[0].size, BLOCK):
        yield tuple(array[begin : begin + BLOCK] for array in flat)
