"""Terms of a gradient: functions of a pass, and their results."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import mitsuba as mi

from pathreplay.adjoint.baseline import Baseline, BaselineStats
from pathreplay.integrators.camera_pass import Pass
from pathreplay.transport.vertex import TraceConfig


@dataclass(frozen=True)
class TermResult:
    """Result of a term, besides the gradients of parameters. Results add up."""

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

    Its docstring says what it does not differentiate. Both functions are called once per pass under
    `dr.suspend_grad`; ``learned`` is the control variate of earlier passes, or None.
    """

    def forward(self, view: Pass, trace: TraceConfig, learned: Baseline | None) -> TermResult:
        """Return its part of the tangent of the image. The parameters carry their tangents already."""

    def backward(self, view: Pass, trace: TraceConfig, grad_in: mi.TensorXf, learned: Baseline | None) -> TermResult:
        """Back-propagate the adjoint of the image into the parameters. All kernels have been launched on return."""

    def note(self, trace: TraceConfig) -> str:
        """Message about how the term is computed; "" if there is none."""
