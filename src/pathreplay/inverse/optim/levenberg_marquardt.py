"""Levenberg-Marquardt steps on noisy Gauss-Newton models: a search on common random numbers, then averaging.

*Search.* All evaluations use the same random numbers, so that losses can be compared. A step solves
(H + λ diag H) δ = -g within the bounds. The step is rejected if the loss grows by more than the noise along the step,
√(δᵀΣδ), with the covariance Σ of the gradient. λ falls after good steps and grows after rejected steps.

*Averaging.* The noise of g displaces the minimum of the model by a random vector with the covariance H⁻¹ΣH⁻¹. On
average, this displacement raises the loss by ν = ½ tr(H⁻¹Σ). The search ends when the predicted decrease of the loss is
below a fraction of ν, or when steps do not lower the loss by more than its noise. After the search, each evaluation
uses new random numbers, and H and Σ are weighted means over the evaluations since the search. After the k-th of these
evaluations, the optimiser takes the step 2 δ / (k + 2).

The values are then a weighted mean of the minima that these evaluations predict. The weight of the k-th evaluation is
proportional to k + 1. The error of the mean decreases like 1/√k, and is 15 % larger than with equal weights. In return,
the influence of the values at the end of the search decreases like 1/k². With equal weights, this influence would
decrease like 1/k. If the predicted decrease of the loss is very large twice in succession, the search begins again.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from pathreplay.inverse.config.optimizer_options import Optimizer
from pathreplay.inverse.optim.adaptive import State
from pathreplay.inverse.optim.vectors import VectorOptimiser, flat, require_float64
from pathreplay.inverse.parameters.gauss_newton import GaussNewton, Matrix
from pathreplay.inverse.parameters.values import Array, Arrays, split

MOST = 200
"""Largest number of entries. Each entry takes two forward passes per view and iteration."""
CONVERGED, NEAR = 0.25, 4.0
"""Multiples of ν at which the search ends. Below `CONVERGED` ν, the predicted decrease of the loss suffices. Below
`NEAR` ν, the last step must also have failed to lower the loss by more than its noise."""
STALLED = 6
"""Number of consecutive rejections, or of consecutive steps that change the loss by less than its noise, after which
the search ends."""
OUTLIER, FAR = 9.0, 25.0
"""Multiples of ν during averaging. If the predicted decrease of the loss exceeds `OUTLIER` ν, the step is shortened. If
it exceeds `FAR` ν twice in succession, the search begins again."""
RESTARTS = 3
"""Maximum number of times that the search begins again. The limit matters if the noise is underestimated."""
GOOD, POOR = 0.75, 0.25
"""Ratios of the actual to the predicted decrease of the loss, above which λ falls, and below which it grows."""
FALL, RISE = 0.1, 2.0
LEAST, MOST_DAMPING = 1e-9, 1e9
FLAT = 1e-8
"""Ratio of an eigenvalue of H, scaled to unit diagonal, to the largest eigenvalue. Below this ratio, the loss counts as
constant along the eigenvector."""
LARGEST = 4.0
"""Upper limit of the eigenvalues of H relative to `GaussNewton.robust`. Noise lowers that matrix by less than this
factor, so larger eigenvalues are due to outliers."""
SIGNAL = 1e-3
"""Ratio of the diagonals of `GaussNewton.robust` and `GaussNewton.bias`, below which an entry does not move."""
EFFECT = 10.0
"""Upper limit of ½ δᵀ(R + B)δ relative to the loss, with R = `GaussNewton.robust` and B = `GaussNewton.bias`. This is
the predicted squared change of the mean image by a step δ. Gauss-Newton steps exceed a ratio of 1 only if the gradient
has outliers."""
ROUNDING = 1e-6
"""Relative error of losses in single precision."""

_CONTROLS = "loss", "excess", "damping", "growth", "predicted", "first"
_COUNTS = "rejections", "stalls", "count", "far", "restarts", "draw"
_ARRAYS = "at", "gradient", "matrix", "robust", "bias", "noise", "spread"
_NAMES = {name: f"levenberg:{name}" for name in (*_ARRAYS, "numbers", "next")}
REASON = "the noise of the values affects the loss less than the tolerance"


@dataclass(frozen=True)
class Point:
    """An evaluation: values in a flat array, loss, gradient and model.

    The loss excludes the expected contribution of the noise of the images (`GaussNewton.excess`).
    """

    at: Matrix
    loss: float
    gradient: Matrix
    model: GaussNewton


class LevenbergMarquardt(VectorOptimiser):
    """Levenberg-Marquardt with bounds, as an `Optimiser`: `observe` has to precede each `step`.

    Learning rates have no effect.

    Args:
        values: initial values by key.
        options: options of the optimiser.
        bounds: lower and upper bound of each variable, by key.

    Raises:
        PathreplayError: there are more than `MOST` entries.
    """

    def __init__(self, values: Arrays, options: Optimizer, bounds: Mapping[str, tuple[float, float]]) -> None:
        super().__init__(values, bounds, options.type, MOST, "'adam' or 'l-bfgs-b'")
        self._sizes = {key: value.size for key, value in values.items()}
        given = options.options()
        self._initial, self._tolerance = float(given["damping"]), float(given["tolerance"])  # type: ignore[arg-type]
        self._low, self._high = self._bounds.T
        self._model: GaussNewton | None = None
        self._reset()

    def _reset(self) -> None:
        self.finished = ""
        self.draw = 0
        """Index of the random numbers of the next evaluation. It is constant in a search, and increases afterwards."""
        self._steps = 0
        self._base: Point | None = None
        self._next = np.zeros(self._n)
        self._damping, self._growth, self._rejections, self._stalls = self._initial, RISE, 0, 0
        self._predicted = 0.0
        self._count, self._far, self._restarts, self._first = 0, 0, 0, 0.0

    def observe(self, model: GaussNewton) -> None:
        """Receive the Gauss-Newton model of the loss.

        The next call of `step` must get the values at which the model was computed. The variables must have the same
        order in the model and in these values.
        """
        self._model = model

    def step(
        self, values: Arrays, gradients: Arrays, rates: Mapping[str, float], loss: float = 0.0
    ) -> dict[str, Array]:
        """See `Optimiser`; returns the next point to evaluate."""
        model, self._model = self._model, None
        assert model is not None, "observe() has to precede step()"
        seen = Point(flat(values), loss - model.excess, flat({key: gradients[key] for key in values}), model)
        self._steps += 1
        if self.finished:
            return self.answer(values)
        if self._count:
            self._average(seen)
        else:
            self._search(seen)
        return split(self._next, self._shapes)

    def _search(self, seen: Point) -> None:
        """Accept or reject a step on common random numbers, and propose the next step."""
        lowered = True
        if self._base is None:
            self._base, self._first = seen, self._first or abs(seen.loss)
        else:
            lowered = self._judge(self._base, seen)
        base = self._base
        step, promise = self._solved(base, LEAST)
        usual, rounding = self._excess(base.model), ROUNDING * abs(base.loss)
        if promise <= CONVERGED * usual + rounding:
            self._begin_averaging(base.at + step, LEAST)
        elif (promise <= NEAR * usual and not lowered) or self._stalls == STALLED:
            self._begin_averaging(base.at, LEAST)
        elif self._rejections == STALLED:  # after so many rejections, an undamped step would not be reliable
            self._begin_averaging(base.at, self._damping)
        else:
            step, self._predicted = self._solved(base, self._damping)
            self._next = base.at + step

    def _judge(self, base: Point, seen: Point) -> bool:
        """Accept or reject a step, and adapt the damping.

        Returns whether the step lowered the loss by more than the noise along the step.
        """
        moved, gain = seen.at - base.at, base.loss - seen.loss
        noise = math.sqrt(max(float(moved @ base.model.noise @ moved), 0.0)) + ROUNDING * abs(base.loss)
        self._stalls = self._stalls + 1 if abs(gain) <= noise else 0
        if gain >= -noise:
            self._base, self._rejections, self._growth = seen, 0, RISE
            if gain > GOOD * self._predicted:
                self._damping *= FALL
            elif gain < POOR * self._predicted - noise:
                self._damping *= RISE
        else:
            self._rejections += 1
            self._damping = max(self._damping, self._initial) * self._growth
            self._growth *= RISE
        self._damping = float(np.clip(self._damping, LEAST, MOST_DAMPING))
        return gain > noise

    def _begin_averaging(self, at: Matrix, damping: float) -> None:
        self._count, self._far, self._next, self.draw, self._damping = 1, 0, at, self._steps, damping
        self._end()

    def _average(self, seen: Point) -> None:
        """Take a step that averages over the random numbers of all evaluations since the search."""
        assert self._base is not None
        share = 2 / (self._count + 2)
        model = self._base.model.times(1 - share) + seen.model.times(share)
        # The covariance is the weighted mean of the covariances of single evaluations. In ``model``, however, `times`
        # has scaled the covariances by the squared weights, which gives the covariance of the mean gradient.
        noise = self._base.model.noise * (1 - share) + seen.model.noise * share
        point = replace(seen, model=replace(model, noise=noise))
        step, promise = self._solved(point, self._damping)
        usual = self._excess(point.model)
        self._far = self._far + 1 if promise > FAR * usual + ROUNDING * self._first else 0
        if self._far == 2 and self._restarts < RESTARTS:
            self._restarts += 1
            self._base, self._count, self._far = None, 0, 0
            self._damping, self._growth, self._rejections, self._stalls = self._initial, RISE, 0, 0
            self._search(seen)
            return
        if promise > OUTLIER * usual > 0:
            step *= math.sqrt(OUTLIER * usual / promise)
        self._count += 1
        self._base = point
        self._next = seen.at + share * step
        self.draw = self._steps
        self._end()

    def _end(self) -> None:
        """Finish if the noise of the values raises the loss by less than the tolerance."""
        assert self._base is not None
        if self._tolerance and self._excess(self._base.model) / self._count < self._tolerance * self._first:
            self.finished = REASON

    def _solved(self, point: Point, damping: float) -> tuple[Matrix, float]:
        """Return the step within the bounds, and the decrease of the loss that the model predicts.

        Entries that cross a bound are set to the bound, and the linear system is solved again for the other entries.
        """
        model = _positive(point.model)
        damped = model + damping * np.diag(_scale(point.model))
        free = _scale(point.model) > 0
        step = np.zeros(self._n)
        for _ in range(self._n + 1):
            if not free.any():
                break
            right = -point.gradient[free] - damped[np.ix_(free, ~free)] @ step[~free]
            step[free] = np.linalg.solve(damped[np.ix_(free, free)], right)
            aim = point.at + step
            beyond = free & ((aim < self._low) | (aim > self._high))
            if not beyond.any():
                break
            step[beyond] = (np.clip(aim, self._low, self._high) - point.at)[beyond]
            free &= ~beyond
        effect = 0.5 * float(step @ (point.model.robust + point.model.bias) @ step)
        most = EFFECT * (abs(point.loss) + point.model.excess)
        if effect > most:
            step *= math.sqrt(most / effect)
        return step, float(-point.gradient @ step - 0.5 * step @ model @ step)

    def _excess(self, model: GaussNewton) -> float:
        """Return ν, the mean increase of the loss when the noise of one evaluation displaces the minimum of the model.

        Directions in which the loss hardly changes, such as the common scale of exposures, do not contribute.
        """
        scale = _scale(model)
        free = scale > 0
        unit = np.sqrt(np.outer(scale[free], scale[free]))
        H, noise = (matrix[np.ix_(free, free)] / unit for matrix in (_positive(model), model.noise))
        return 0.5 * float(np.trace(scipy.linalg.pinvh(H, rtol=FLAT) @ noise)) if free.any() else 0.0

    def answer(self, values: Arrays) -> dict[str, Array]:
        """Return the last accepted point of a search; an empty dictionary before the first step and while averaging."""
        if self._base is None or (self._count and not self.finished):
            return {}
        return split(self._next if self._count else self._base.at, self._shapes)

    def state(self) -> State:
        """See `Optimiser`. The state is the last accepted evaluation and the numbers that control the steps."""
        steps = dict.fromkeys(self._shapes, self._steps)
        if self._base is None:
            return State(steps, {})
        model = self._base.model
        controls = self._base.loss, model.excess, self._damping, self._growth, self._predicted, self._first
        counts = self._rejections, self._stalls, self._count, self._far, self._restarts, self.draw
        matrices = model.matrix, model.robust, model.bias, model.noise
        arrays = (self._base.at, self._base.gradient, *matrices, model.spread)
        named = dict(zip(_NAMES, (*arrays, np.array([*controls, *counts], float), self._next), strict=True))
        return State(steps, {_NAMES[name]: array for name, array in named.items()})

    def restore(self, state: State, values: Arrays) -> None:
        """See `Optimiser`. A search that has finished goes on if the tolerance is now lower."""
        count = self._steps_of(state, values, _NAMES.values())
        self._reset()
        self._steps = count
        if not count:
            return
        n = self._n
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(_NAMES, (n,))
        shapes |= dict.fromkeys(("matrix", "robust", "bias", "noise"), (n, n))
        shapes["numbers"] = (len(_CONTROLS + _COUNTS),)
        for name, full in _NAMES.items():
            require_float64(full, state.arrays[full], shapes[name])
        saved = {name: np.array(state.arrays[full], np.float64) for name, full in _NAMES.items()}
        loss, excess, self._damping, self._growth, self._predicted, self._first = saved["numbers"][
            : len(_CONTROLS)
        ].tolist()
        counts = saved["numbers"][len(_CONTROLS) :].astype(int).tolist()
        self._rejections, self._stalls, self._count, self._far, self._restarts, self.draw = counts
        if self._damping <= 0:
            raise ValueError("its damping is not positive")
        matrix, robust, bias, noise, spread = (saved[name] for name in _ARRAYS[2:])
        model = GaussNewton(self._sizes, matrix, robust, bias, noise, spread, excess)
        self._base = Point(saved["at"], loss, saved["gradient"], model)
        self._next = saved["next"]
        if self._count:
            self._end()


def _positive(model: GaussNewton) -> Matrix:
    """Return H with its eigenvalues clipped to an interval.

    For the entries that move, the result is positive definite. For all other entries (see `_scale`), it is zero.

    The eigenvalues are relative to the matrix `GaussNewton.robust` (generalised eigenvalues). The lower limit is the
    relative noise of H, which is estimated from its diagonal. The upper limit is `LARGEST`, which bounds the effect of
    outliers.
    """
    scale = _scale(model)
    used = scale > 0
    back = np.where(used, np.sqrt(scale), 0)
    unit = np.where(used, 1 / np.where(used, back, 1), 0)
    robust = model.robust * np.outer(unit, unit) + LEAST * np.eye(len(unit))
    least = min(1.0, max(LEAST, math.sqrt(float((model.spread * unit**4).max()))))
    ratios, vectors = scipy.linalg.eigh(model.matrix * np.outer(unit, unit), robust)
    dual = robust @ vectors
    return (dual * np.clip(ratios, least, LARGEST)) @ dual.T * np.outer(back, back)


def _scale(model: GaussNewton) -> Matrix:
    """Return the diagonal of `GaussNewton.robust`, with zeros for entries that do not move (see `SIGNAL`)."""
    diagonal, noise = np.diag(model.robust), np.diag(model.bias)
    return np.where(diagonal > SIGNAL * noise, diagonal, 0)
