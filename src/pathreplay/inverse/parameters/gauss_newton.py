"""Gauss-Newton model of a weighted least-squares loss: the Gauss-Newton matrix, and the noise of matrix and gradient.

With residuals r = I - T, weights W and the Jacobian J = ∂I/∂v, the loss is ½ rᵀWr, its gradient g = JᵀWr and the
Gauss-Newton matrix H = JᵀWJ. Two halves a and b of the samples estimate all three without bias:

    ½ r_aᵀ W r_b,      g = ½ (J_aᵀ W r_b + J_bᵀ W r_a),      H = ½ (J_aᵀ W J_b + J_bᵀ W J_a).

Products within one half would be biased by the variance of I, the covariance of J and I, and the variance of J,
respectively. The halves have equal biases, which cancel in the difference of the halves. The covariance of
½ (J_aᵀ W r_a - J_bᵀ W r_b) therefore equals the covariance of g, up to terms of second order in the noise.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pathreplay.inverse.images.io import Image
from pathreplay.inverse.parameters.values import Array

Matrix = NDArray[np.float64]
TILE = 4
"""Width of square tiles of pixels. The noise of different tiles counts as independent, because tiles are wider than the
usual reconstruction filters."""
DIFFERENCE = 1e-2
"""Step of finite differences, relative to the magnitude of an entry or to this number, whichever is larger."""
_AT_ONCE = 2**22
"""Number of derivatives that are converted to double precision at once."""


@dataclass(frozen=True)
class Half:
    """Image and Jacobian of a view, from one half of the samples."""

    residual: Image
    """Image minus target, height x width x channels."""
    jacobian: Array
    """Derivative of the image with respect to each of n entries, n x height x width x channels."""


def places(sizes: Mapping[str, int]) -> dict[str, slice]:
    """Return the place of each variable in an array of all entries, for variables of the given ``sizes``."""
    ends = np.cumsum(list(sizes.values())).tolist()
    return {key: slice(end - sizes[key], end) for key, end in zip(sizes, ends, strict=True)}


@dataclass(frozen=True)
class GaussNewton:
    """Model of a loss as a function of all entries of its variables.

    The sum of the models of two losses is the model of the sum of the losses.
    """

    sizes: dict[str, int]
    """Number of entries of each variable, in the order of the matrices."""
    matrix: Matrix
    """H, symmetric; unbiased, and therefore not always positive semidefinite."""
    robust: Matrix
    """JᵀWJ, where each entry of J is the entry of J_a or J_b with the smaller magnitude, or zero if their signs differ.
    It is positive semidefinite. Outliers of one half have no effect on it, but noise of both halves raises it."""
    bias: Matrix
    """Bias of JᵀWJ due to noise, if J were the mean of both halves; positive semidefinite."""
    noise: Matrix
    """Covariance of the gradient."""
    spread: Matrix
    """Variance of the diagonal of H that is due to the noise of J alone. Outliers dominate it."""
    excess: float
    """Expected contribution of the noise of I to the loss of the mean image."""

    def __add__(self, other: GaussNewton) -> GaussNewton:
        names = "matrix", "robust", "bias", "noise", "spread", "excess"
        return replace(self, **{name: getattr(self, name) + getattr(other, name) for name in names})

    def times(self, share: float) -> GaussNewton:
        """Return the model of ``share`` times the loss."""
        square = share * share
        once = {name: getattr(self, name) * share for name in ("matrix", "robust", "bias", "excess")}
        return replace(self, **once, noise=self.noise * square, spread=self.spread * square)

    def within(self, sizes: Mapping[str, int]) -> GaussNewton:
        """Return the model with additional variables, on which the loss does not depend."""
        n, of = sum(sizes.values()), places(sizes)
        at = np.concatenate([np.arange(n)[of[key]] for key in self.sizes])
        (matrix, robust, bias, noise), spread = np.zeros((4, n, n)), np.zeros(n)
        for whole, part in ((matrix, self.matrix), (robust, self.robust), (bias, self.bias), (noise, self.noise)):
            whole[np.ix_(at, at)] = part
        spread[at] = self.spread
        return GaussNewton(dict(sizes), matrix, robust, bias, noise, spread, self.excess)

    def curved(self, key: str, matrix: Matrix) -> GaussNewton:
        """Add the curvature of a regularizer of one variable."""
        if key not in self.sizes:
            return self
        here = places(self.sizes)[key]
        total, robust = self.matrix.copy(), self.robust.copy()
        total[here, here] += matrix
        robust[here, here] += matrix
        return replace(self, matrix=total, robust=robust)

    def mapped(self, gradients: Mapping[str, Callable[[Array], Array]]) -> GaussNewton:
        """Return the model in other coordinates.

        Args:
            gradients: by key of a variable, the linear map of gradients to the new coordinates.
        """
        change = np.eye(sum(self.sizes.values()))
        for key, here in places(self.sizes).items():
            if key in gradients:
                n = self.sizes[key]
                change[here, here] = np.transpose([gradients[key](np.eye(n)[k]).ravel() for k in range(n)])
        names = "matrix", "robust", "bias", "noise"
        return replace(
            self,
            **{name: change @ getattr(self, name) @ change.T for name in names},
            spread=change**4 @ self.spread,
        )


def model_of(a: Half, b: Half, weight: Image, sizes: dict[str, int]) -> tuple[float, Matrix, GaussNewton]:
    """Compute loss, gradient and model from two halves of the samples.

    Args:
        a: one half.
        b: the other half, with independent samples.
        weight: the weights W, shape (height, width, channels).
        sizes: number of entries of each variable, in the order of the Jacobians.

    Returns:
        The loss ½ rᵀWr of the mean of the two images, the gradient, and the model. The noise of the mean image
        contributes `GaussNewton.excess` to the expected loss.
    """
    n = len(a.jacobian)
    matrix, robust, bias, noise = np.zeros((4, n, n))
    gradient, spread = np.zeros((2, n))
    rows = TILE * max(1, _AT_ONCE // max(1, n * TILE * weight[0].size))
    loss = excess = 0.0
    for begin in range(0, len(weight), rows):
        some = slice(begin, begin + rows)
        w = weight[some].astype(np.float64)
        r, s = (half.residual[some].astype(np.float64) for half in (a, b))
        J, K = (half.jacobian[:, some].astype(np.float64) for half in (a, b))
        loss += 0.125 * float((w * (r + s) ** 2).sum())
        excess += 0.125 * float((w * (r - s) ** 2).sum())
        gradient += 0.5 * (w * (J * s + K * r)).sum(axis=(1, 2, 3))
        matrix += (w * J).reshape(n, -1) @ K.reshape(n, -1).T
        differences = 0.5 * (J - K)
        bias += (w * differences).reshape(n, -1) @ differences.reshape(n, -1).T
        shared = np.where(J * K > 0, np.where(np.abs(J) < np.abs(K), J, K), 0)
        robust += (w * shared).reshape(n, -1) @ shared.reshape(n, -1).T
        errors = _tiles(0.5 * (w * (J * r - K * s)).sum(axis=3))
        noise += errors @ errors.T
        spread += (_tiles((w * differences**2).sum(axis=3)) ** 2).sum(axis=1)
    return loss, gradient, GaussNewton(sizes, 0.5 * (matrix + matrix.T), robust, bias, noise, spread, excess)


def _tiles(images: Matrix) -> Matrix:
    """Sum n images over square tiles. The result has the shape (n, number of tiles)."""
    for axis in (1, 2):
        images = np.add.reduceat(images, range(0, images.shape[axis], TILE), axis=axis)
    return images.reshape(len(images), -1)


def curvature(
    penalty: Callable[[Array], tuple[float, Array]], value: Array, within: tuple[float, float] = (-np.inf, np.inf)
) -> Matrix:
    """Compute the Hessian of a regularizer by finite differences of its gradient. Negative eigenvalues are set to 0.

    Args:
        penalty: value and gradient of the regularizer as a function of the variable.
        value: the variable.
        within: lower and upper end of the range of the variable. The regularizer may be undefined at the ends and
            beyond, so entries move at most half of their distance from them.
    """
    columns = []
    for k, entry in enumerate(value.ravel().tolist()):
        slopes, ends = [], []
        for side in (1, -1):
            moved = value.copy()
            farthest = 0.5 * (within[0] - entry), 0.5 * (within[1] - entry)
            moved.flat[k] += np.float32(np.clip(side * DIFFERENCE * max(abs(entry), DIFFERENCE), *farthest))
            ends.append(float(moved.flat[k]))
            slopes.append(penalty(moved)[1].astype(np.float64).ravel())
        columns.append((slopes[0] - slopes[1]) / ((ends[0] - ends[1]) or 1.0))  # equal ends: the slopes are equal, too
    matrix = np.array(columns)
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    return (vectors * np.maximum(values, 0)) @ vectors.T
