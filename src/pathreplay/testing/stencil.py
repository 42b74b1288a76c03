"""Finite-difference stencils: sample points along a line, and their weights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Stencil:
    """Approximation D(h) = Σ c f(o h) / h of the derivative of f at 0, summed over the ``terms`` (o, c)."""

    name: str
    terms: tuple[tuple[float, float], ...]

    def __call__(self, f: Callable[[float], Any], h: float = 1.0) -> Any:
        """Compute D(h), for numbers or arrays."""
        return sum(c * f(o * h) for o, c in self.terms) / h

    def halved(self) -> Stencil:
        """Return D(h/2) as a stencil with step h."""
        return Stencil(self.name, tuple((o / 2, 2 * c) for o, c in self.terms))

    def points(self) -> tuple[float, ...]:
        """Return all offsets of D(h) and of D(h/2)."""
        return tuple(sorted({o for o, _ in self.terms + self.halved().terms}))

    def rounding(self) -> float:
        """Return the largest factor, in units of 1/h, by which (4 D(h/2) - D(h)) / 3 amplifies errors of f."""
        full, half = dict(self.terms), dict(self.halved().terms)
        return sum(abs(4 * half.get(o, 0) - full.get(o, 0)) for o in self.points()) / 3


CENTRAL = Stencil("central", ((-1, -0.5), (1, 0.5)))
FORWARD = Stencil("one-sided, up", ((0, -1.5), (1, 2), (2, -0.5)))
BACKWARD = Stencil("one-sided, down", ((0, 1.5), (-1, -2), (-2, 0.5)))
# Stencils of fourth and third order for delta tracking, whose random decisions change with the parameter. The noise of
# a difference f(h) - f(-h) therefore does not decrease with h, and h must be a large fraction of the parameter.
WIDE = Stencil("wide", ((-2, 1 / 12), (-1, -8 / 12), (1, 8 / 12), (2, -1 / 12)))
UPWARD = Stencil("wide, up", ((0, -11 / 6), (1, 3), (2, -1.5), (3, 1 / 3)))
