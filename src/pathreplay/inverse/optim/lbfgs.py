"""Adapter of SciPy's minimisers, such as L-BFGS-B, to the `Optimiser` interface.

Each iteration of a job is one function evaluation. The evaluation may be a trial step of the line search, so its loss
may exceed the previous loss. The result of a run is the evaluation with the lowest loss.

SciPy's minimisers do not expose their state, but they are deterministic. Each iteration therefore restarts the
minimiser and replays the recorded evaluations, until the minimiser requests a new evaluation. The replay takes
negligible time compared with rendering, and makes resuming from a checkpoint exact to the bit.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
import scipy.optimize
from numpy.typing import NDArray

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.optimizer_options import Optimizer
from pathreplay.inverse.optim.adaptive import State
from pathreplay.inverse.optim.vectors import Vector, VectorOptimiser, flat, require_float64
from pathreplay.inverse.parameters.values import Array, Arrays, split

MOST = 1000
"""Maximum number of parameter entries, because checkpoints contain the gradients of all iterations."""

ENDLESS = 10**9

Search = Callable[..., object]
"""Minimiser ``search(function, start, jac=True, bounds=...)``, whose result may be any object; see `LineSearch`."""
_START, _SCALE, _LOSSES, _GRADIENTS, _NEXT = (f"search:{n}" for n in ("start", "scale", "losses", "gradients", "next"))


class _Asked(Exception):
    """SciPy requests an evaluation that is not in the record."""


class LineSearch(VectorOptimiser):
    """`Optimiser` that runs a deterministic minimiser with bounds.

    The minimiser sees variables divided by their initial learning rates, and losses divided by the initial loss.

    Args:
        values: initial values by key.
        options: options of the optimiser.
        bounds: lower and upper bound of each variable, by key.
        search: deterministic minimiser with the interface of `scipy.optimize.minimize`; default: L-BFGS-B with
            ``options``. Its arguments are a function that returns loss and gradient, the start point, ``jac=True`` and
            ``bounds``.

    Raises:
        PathreplayError: the variables have more than `MOST` entries in total.
    """

    def __init__(
        self,
        values: Arrays,
        options: Optimizer,
        bounds: Mapping[str, tuple[float, float]],
        search: Search | None = None,
    ) -> None:
        super().__init__(values, bounds, options.type, MOST, "'adam'")
        self._search = partial(_of_scipy, **options.options()) if search is None else search
        self._start, self._scale, self._next = np.zeros(0), np.zeros(0), np.zeros(0)
        self._points: list[Vector] = []
        self._losses: list[float] = []
        self._gradients: list[Vector] = []
        self._goes_on = False
        """Whether the search had ended, and goes on since it was restored with a lower tolerance."""

    def step(
        self, values: Arrays, gradients: Arrays, rates: Mapping[str, float], loss: float = 0.0
    ) -> dict[str, Array]:
        """See `Optimiser`. Returns the next point to evaluate, or the best point if the search has finished."""
        if self.finished:
            return self.answer(values)
        if not self._losses:
            self._scale = np.concatenate([np.full(value.size, rates[key]) for key, value in values.items()])
            self._start = flat(values) / self._scale
        self._goes_on = False
        self._losses.append(float(loss))
        self._gradients.append(flat({key: gradients[key] for key in values}) * self._scale)
        self._ask()
        return self.answer(values) if self.finished else split(self._next * self._scale, self._shapes)

    def _ask(self) -> None:
        """Run the minimiser on the recorded evaluations, until it requests a new evaluation or finishes."""
        self._points, unit = [], abs(self._losses[0]) or 1.0

        def recorded(x: Vector) -> tuple[float, Vector]:
            k = len(self._points)
            self._points.append(x.copy())
            if k == len(self._losses):
                raise _Asked
            return self._losses[k] / unit, self._gradients[k] / unit

        low, high = (self._bounds / self._scale[:, None]).T
        free = np.isinf(self._bounds).all()
        try:
            with warnings.catch_warnings():
                warnings.filterwarnings("error", ".* cannot handle .*bounds", RuntimeWarning)
                warnings.filterwarnings("ignore", ".* does not use gradient information", RuntimeWarning)
                bounds = None if free else scipy.optimize.Bounds(low, high)
                result = self._search(recorded, self._start, jac=True, bounds=bounds)
        except RuntimeWarning as error:
            why = str(error).rstrip(".")
            raise PathreplayError(
                f"optimizer: {why}; remove the bounds, use a parameterization that enforces them, or another method"
            ) from None
        except _Asked:
            self._next = self._points.pop()
            return
        success, message = getattr(result, "success", True), str(getattr(result, "message", "it returned"))
        reason = "the loss has converged" if success else "no step lowers the loss, possibly because of noise"
        self.finished = f"{reason} ({' '.join(message.split())})"

    def answer(self, values: Arrays) -> dict[str, Array]:
        """Return the point with the lowest loss so far, or an empty dictionary before the first step."""
        if not self._losses:
            return {}
        return split(self._points[int(np.argmin(self._losses))] * self._scale, self._shapes)

    def awaited(self) -> dict[str, Array]:
        return split(self._next * self._scale, self._shapes) if self._goes_on else {}

    def state(self) -> State:
        """See `Optimiser`. The state consists of start, scales, recorded evaluations and next point."""
        steps = dict.fromkeys(self._shapes, len(self._losses))
        if not self._losses:
            return State(steps, {})
        arrays: dict[str, NDArray[np.floating]] = {
            _START: self._start,
            _SCALE: self._scale,
            _LOSSES: np.array(self._losses, np.float64),
            _GRADIENTS: np.array(self._gradients),
        }
        if not self.finished:
            arrays[_NEXT] = self._next
        return State(steps, arrays)

    def restore(self, state: State, values: Arrays) -> None:
        n = self._n
        count = self._steps_of(state, values, {_START, _SCALE, _LOSSES, _GRADIENTS, _NEXT})
        self.finished, self._points, self._losses, self._gradients, self._goes_on = "", [], [], [], False
        if not count:
            return
        shapes = {_START: (n,), _SCALE: (n,), _LOSSES: (count,), _GRADIENTS: (count, n), _NEXT: (n,)}
        for name, array in state.arrays.items():
            require_float64(name, array, shapes[name])
        self._start, self._scale = (np.asarray(state.arrays[name], np.float64) for name in (_START, _SCALE))
        if (self._scale <= 0).any():
            raise ValueError(f"'{_SCALE}' is not positive")
        self._losses = [float(loss) for loss in state.arrays[_LOSSES]]
        self._gradients = [np.asarray(gradient, np.float64) for gradient in state.arrays[_GRADIENTS]]
        self._ask()
        expected = state.arrays.get(_NEXT)
        if len(self._points) != count or (expected is not None and not np.array_equal(self._next, expected)):
            raise ValueError("SciPy requests other points than recorded; its version may have changed")
        self._goes_on = expected is None and not self.finished


def _of_scipy(
    function: Callable[[Vector], tuple[float, Vector]],
    start: Vector,
    history_size: int,
    tolerance: float,
    **more: object,
) -> object:
    options = {"maxcor": history_size, "ftol": tolerance, "gtol": 0.0, "maxfun": ENDLESS, "maxiter": ENDLESS}
    return scipy.optimize.minimize(function, start, method="L-BFGS-B", options=options, **more)
