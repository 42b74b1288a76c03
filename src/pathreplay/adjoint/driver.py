"""The driver interface: a driver differentiates the light paths that begin at the rays of a `CameraStart`."""

from __future__ import annotations

from typing import Protocol

import mitsuba as mi

from pathreplay.adjoint.autodiff import NonFiniteCounter
from pathreplay.transport.start import CameraStart
from pathreplay.transport.vertex import TraceConfig


class Driver(Protocol):
    """Back-propagates the adjoint radiance ``δL`` of each path into the parameters and into the ``start``.

    Returns whether the paths move, i.e. whether their vertices or directions depend on parameters with gradients.
    ``lost`` counts the paths whose gradient is incomplete. The caller suspends gradients (`dr.suspend_grad`). Each
    driver documents what it does not differentiate.
    """

    def __call__(self, trace: TraceConfig, start: CameraStart, δL: mi.Spectrum, lost: NonFiniteCounter) -> bool: ...


class ForwardDriver(Protocol):
    """Computes the tangent of the radiance from the tangents of the parameters.

    Returns the tangent and Mitsuba's alpha of each path, and whether paths move (see `Driver`). ``lost`` counts the
    paths whose tangent is incomplete.
    """

    def __call__(
        self, trace: TraceConfig, start: CameraStart, lost: NonFiniteCounter
    ) -> tuple[mi.Spectrum, mi.Bool, bool]: ...
