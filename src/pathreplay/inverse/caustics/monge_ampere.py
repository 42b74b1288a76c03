"""Optimal transport between densities on a rectangle of cells, by Newton's method on the Monge-Ampère equation.

The map S = ∇v with a convex potential v transports the density g to the uniform density if

    det D²v = g,        v(y) = |y|²/2 + φ(y),

It also maps the rectangle to itself, so the normal derivative of φ vanishes on the border. Second derivatives are
finite differences between cells, which gives one equation per pixel of g. A Newton step δ of φ solves the linear
elliptic equation

    cof(D²v) : D²δ = det D²v (log g - log det D²v)

by BiCGStab, preconditioned by the Poisson equation, which a discrete cosine transform solves.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from pathreplay.errors import PathreplayError

Field = NDArray[np.float64]

_MOST_STEPS = 60
_ACCURACY = 1e-3
"""Root mean square of g - det D²v at the solution, relative to the mean of g."""
_LINEAR_ACCURACY, _MOST_LINEAR_STEPS = 1e-3, 100
"""Relative residual at which the linear solver stops, and its maximum number of iterations. With a residual of 1e-2,
Newton's method often fails where dark pixels are next to bright pixels."""
_SHRINKAGE, _SHORTEST = 0.6, 1e-4
"""Factor by which a step is shortened until v is convex, and the shortest step relative to Newton's."""
_LEAST_DETERMINANT = 0.1
"""Lower bound on det D²v after a step, as a fraction of the smaller of two values: g, and det D²v before the step."""


def potential(density: Field, initial: Field | None = None, width: float = 1.0) -> Field:
    """Solve the Monge-Ampère equation.

    Args:
        density: density g per cell, positive; its scale is arbitrary.
        initial: potential of a similar density, from which the iteration starts; default: zero.
        width: width of a cell. Its height is 1.

    Returns:
        The potential φ per cell.

    Raises:
        PathreplayError: the iteration does not converge, because the contrast of the density is too large.
    """
    φ = np.zeros_like(density) if initial is None else initial
    g = density / density.mean()
    poisson = poisson_solver(g.shape, width)
    for _ in range(_MOST_STEPS):
        a, b, c = hessian(φ, width)
        a, b = 1 + a, 1 + b
        determinant = a * b - c * c
        # The mean of the discretised determinant varies slightly with φ, so g is scaled to this mean.
        wanted = g * determinant.mean()
        if np.sqrt(np.mean(np.square(wanted - determinant))) < _ACCURACY:
            return φ

        def linearised(δ: Field, a: Field = a, b: Field = b, c: Field = c) -> Field:
            yy, xx, xy = hessian(δ, width)
            return _centred(b * yy + a * xx - 2 * c * xy)

        residual = _centred(determinant * np.log(wanted / determinant))
        step = _bicgstab(linearised, residual, poisson)
        factor = _longest(φ, step, _LEAST_DETERMINANT * np.minimum(determinant, wanted), width)
        if not factor:
            break
        φ = φ + factor * step
    raise PathreplayError(
        f"The transport of light to the image does not converge at a contrast of {g.max() / g.min():.0f}; raise "
        "'floor', or blur the image"
    )


def hessian(φ: Field, width: float = 1.0) -> tuple[Field, Field, Field]:
    """Return the second differences ∂yy, ∂xx and ∂xy of a field that is mirrored at its border.

    Cells have the given width and the height 1.
    """
    p = np.pad(φ, 1, mode="edge")
    twice = 2 * φ
    yy = p[2:, 1:-1] - twice + p[:-2, 1:-1]
    xx = p[1:-1, 2:] - twice + p[1:-1, :-2]
    xy = (p[2:, 2:] - p[2:, :-2] - p[:-2, 2:] + p[:-2, :-2]) / 4
    return yy, xx / width**2, xy / width


def poisson_solver(shape: tuple[int, ...], width: float = 1.0) -> Callable[[Field], Field]:
    """Return a function that solves ∂yy u + ∂xx u = r - mean(r) for u. The mean of u is zero.

    The field u is mirrored at its border. Cells have the given width and the height 1.
    """
    y, x = (2 * np.cos(np.pi * np.arange(n) / n) - 2 for n in shape)
    eigenvalues = y[:, None] + x / width**2
    eigenvalues[0, 0] = np.inf

    def solve(r: Field) -> Field:
        return scipy.fft.idctn(scipy.fft.dctn(r) / eigenvalues)

    return solve


def _centred(field: Field) -> Field:
    return field - field.mean()


def _longest(φ: Field, step: Field, least: Field, width: float) -> float:
    """Return the factor by which a step must be shortened so that v is convex and det D²v is at least ``least``.

    Returns 0 if no tested factor suffices.
    """
    factor = 1.0
    while factor > _SHORTEST:
        a, b, c = hessian(φ + factor * step, width)
        a, b = 1 + a, 1 + b
        if a.min() > 0 and b.min() > 0 and (a * b - c * c >= least).all():
            return factor
        factor *= _SHRINKAGE
    return 0.0


def _bicgstab(apply: Callable[[Field], Field], r: Field, precondition: Callable[[Field], Field]) -> Field:
    """Solve a linear equation with the right-hand side ``r`` (van der Vorst 1992)."""
    x, shadow, p = np.zeros_like(r), r, r
    ρ, enough = _dot(shadow, r), _LINEAR_ACCURACY * np.sqrt(_dot(r, r))
    for _ in range(_MOST_LINEAR_STEPS):
        p_hat = precondition(p)
        v = apply(p_hat)
        α = ρ / _dot(shadow, v)
        s = r - α * v
        s_hat = precondition(s)
        t = apply(s_hat)
        if not (squared := _dot(t, t)):
            return x + α * p_hat
        ω = _dot(t, s) / squared
        x = x + α * p_hat + ω * s_hat
        r = s - ω * t
        if np.sqrt(_dot(r, r)) <= enough:
            break
        ρ, before = _dot(shadow, r), ρ
        p = r + (ρ / before) * (α / ω) * (p - ω * v)
    return x


def _dot(a: Field, b: Field) -> float:
    # No BLAS function is used, because its threads wait for each other, which is slow on a busy machine.
    return float(np.sum(a * b))
