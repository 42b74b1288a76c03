"""Finite differences: which points along a line are looked at, and how their values are weighed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Stencil:
    """D(h) = Σ c f(o h) / h over the ``terms`` (o, c), for the derivative of f at 0."""

    name: str
    terms: tuple[tuple[float, float], ...]

    def __call__(self, f: Callable[[float], Any], h: float = 1.0) -> Any:
        """D(h), of numbers or of arrays."""
        return sum(c * f(o * h) for o, c in self.terms) / h

    def halved(self) -> Stencil:
        """D(h/2), as a stencil of step h."""
        return Stencil(self.name, tuple((o / 2, 2 * c) for o, c in self.terms))

    def points(self) -> tuple[float, ...]:
        """All offsets of D(h) and of D(h/2)."""
        return tuple(sorted({o for o, _ in self.terms + self.halved().terms}))

    def rounding(self) -> float:
        """How errors of f add up at worst, in units of h, in Richardson's combination (4 D(h/2) - D(h)) / 3."""
        full, half = dict(self.terms), dict(self.halved().terms)
        return sum(abs(4 * half.get(o, 0) - full.get(o, 0)) for o in self.points()) / 3


CENTRAL = Stencil("central", ((-1, -0.5), (1, 0.5)))
FORWARD = Stencil("one-sided, up", ((0, -1.5), (1, 2), (2, -0.5)))
BACKWARD = Stencil("one-sided, down", ((0, 1.5), (-1, -2), (-2, 0.5)))
# Of fourth and third order. They let h be a large share of the parameter: delta tracking decides anew at every h, so
# that its noise does not shrink with h as that of a smooth path does.
WIDE = Stencil("wide", ((-2, 1 / 12), (-1, -8 / 12), (1, 8 / 12), (2, -1 / 12)))
UPWARD = Stencil("wide, up", ((0, -11 / 6), (1, 3), (2, -1.5), (3, 1 / 3)))
