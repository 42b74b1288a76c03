"""What a gradient is a sum of: terms, which are functions of a pass, and what they give back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import mitsuba as mi

from pathreplay.adjoint.baseline import Baseline, BaselineStats
from pathreplay.integrators.camera_pass import Pass
from pathreplay.transport.vertex import TraceConfig


@dataclass(frozen=True)
class TermResult:
    """What terms give back of their passes, beside the gradients of parameters: it can be added up."""

    image: mi.TensorXf | None = None  # tangent of the image (forward mode), or the image itself (pixel sweep)
    seen: BaselineStats | None = None  # of media, for later passes
    lost: mi.UInt32 | None = None  # how many paths lost a part of their gradient, if they were counted
    paths: int = 0  # how many they were counted out of
    moves: bool = False  # hit points, directions or emitter samples depend on parameters with gradients

    def __add__(self, other: TermResult) -> TermResult:
        image, seen, lost = (_sum(getattr(self, name), getattr(other, name)) for name in ("image", "seen", "lost"))
        return TermResult(image, seen, lost, self.paths + other.paths, self.moves or other.moves)


def _sum(a: Any, b: Any) -> Any:
    return b if a is None else a if b is None else a + b


class Term(Protocol):
    """A part of the derivative of an image by the parameters: interior, edges, particles.

    It says in its docstring what it does not differentiate. Both functions are called under `dr.suspend_grad`, once in
    a pass; ``learned`` is what earlier passes found out, or None.
    """

    def forward(self, view: Pass, trace: TraceConfig, learned: Baseline | None) -> TermResult:
        """Its part of the tangent of the image. The parameters carry their tangents already."""

    def backward(self, view: Pass, trace: TraceConfig, grad_in: mi.TensorXf, learned: Baseline | None) -> TermResult:
        """Back-propagate the adjoint of the image into the parameters. Everything has been launched on return."""

    def note(self, trace: TraceConfig) -> str:
        """What is to be said of how it goes about it; "" if it is nothing."""
