"""Terms of a gradient: the interface of a term, and its result."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import mitsuba as mi

from pathreplay.adjoint.baseline import Baseline, BaselineStats
from pathreplay.integrators.camera_pass import Pass
from pathreplay.transport.vertex import TraceConfig


@dataclass(frozen=True)
class TermResult:
    """Results of a term besides the gradients of parameters. Results of several terms or passes can be added."""

    image: mi.TensorXf | None = None  # tangent of the image (forward mode), or the image itself (pixel sweep)
    stats: BaselineStats | None = None  # radiance in media, from which the control variate of later passes is computed
    lost: mi.UInt32 | None = None  # number of paths with an incomplete gradient; None if not counted
    paths: int = 0  # number of paths among which ``lost`` were counted
    moves: bool = False  # whether hit points, directions or emitter samples depend on parameters with gradients

    def __add__(self, other: TermResult) -> TermResult:
        image, stats, lost = (_sum(getattr(self, name), getattr(other, name)) for name in ("image", "stats", "lost"))
        return TermResult(image, stats, lost, self.paths + other.paths, self.moves or other.moves)


def _sum(a: Any, b: Any) -> Any:
    return b if a is None else a if b is None else a + b


class Term(Protocol):
    """A term in the derivative of an image with respect to the parameters: interior, boundary, film motion.

    The docstring of a term states what it does not differentiate. Either `forward` or `backward` is called once per
    pass, under `dr.suspend_grad`; ``learned`` is the control variate from earlier passes, or None.
    """

    def forward(self, view: Pass, trace: TraceConfig, learned: Baseline | None) -> TermResult:
        """Return the contribution to the tangent of the image. The parameters must already carry their tangents."""

    def backward(self, view: Pass, trace: TraceConfig, grad_in: mi.TensorXf, learned: Baseline | None) -> TermResult:
        """Back-propagate the adjoint of the image into the parameters. On return, all kernels have been launched."""

    def note(self, trace: TraceConfig) -> str:
        """Return a message about how the term is computed. The default is "", which means that there is no message."""
        return ""
