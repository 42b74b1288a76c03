"""What a gradient is a sum of: terms, which are functions of a pass, and what they give back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, TypeVar

import mitsuba as mi

from ..gradient.baseline import Baseline, Seen
from ..transport.vertex import Walk
from .camera_pass import Pass
from .diagnostics import Diagnostics


@dataclass(frozen=True)
class Found:
    """What terms give back, beside the gradients of parameters: that of several can be added."""

    image: mi.TensorXf | None = None  # tangent of the image (forward mode), or the image itself (pixel sweep)
    diagnostics: Diagnostics = Diagnostics()  # noqa: RUF009 (it is frozen)
    seen: Seen | None = None  # of media, for later passes

    def __add__(self, other: Found) -> Found:
        diagnostics = self.diagnostics + other.diagnostics
        return Found(_sum(self.image, other.image), diagnostics, _sum(self.seen, other.seen))


T = TypeVar("T")


def _sum(a: T | None, b: T | None) -> T | None:
    if a is None or b is None:
        return b if a is None else a
    return a + b  # type: ignore[operator]


class Term(Protocol):
    """A part of the derivative of an image by the parameters: interior, edges, particles.

    It says in its docstring what it does not differentiate. Both functions are called under `dr.suspend_grad`, once in
    a pass; ``learned`` is what earlier passes found out, or None.
    """

    def forward(self, view: Pass, walk: Walk, learned: Baseline | None) -> Found:
        """Its part of the tangent of the image. The parameters carry their tangents already."""

    def backward(self, view: Pass, walk: Walk, grad_in: mi.TensorXf, learned: Baseline | None) -> Found:
        """Back-propagate the adjoint of the image into the parameters. Everything has been launched on return."""
