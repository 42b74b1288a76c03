"""The interior term: the derivative of what paths carry, visibility held, by any driver that follows camera rays."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..gradient.adjoint import LostPaths
from ..gradient.baseline import FIRST_BRANCHING, Baseline, Seen
from ..gradient.forward import forward
from ..gradient.pixel_sweep import PixelLoss, pixel_sweep
from ..gradient.primal import primal
from ..gradient.ray_jacobian import Recovery
from ..gradient.record import deepest
from ..gradient.replay import replay
from ..gradient.sweep import sweep
from ..transport.start import CameraStart
from ..transport.vertex import Walk
from .camera_pass import Pass
from .diagnostics import Diagnostics
from .film import adjoint, splat
from .pixels import pixel_camera
from .term import Found


def image(view: Pass, walk: Walk) -> mi.TensorXf:
    """The image of a pass (height x width x channels)."""
    rays = view.rays()
    return splat(view, rays, *primal(walk, rays.start))


class Interior(ABC):
    """A term by drivers: classes below say which, and what is to be said of them."""

    @abstractmethod
    def tangent(self, walk: Walk, start: CameraStart) -> tuple[mi.Spectrum, mi.Bool, Diagnostics]:
        """Tangent of the radiance, whether anything was met, and what is to be said."""

    @abstractmethod
    def propagate(self, walk: Walk, start: CameraStart, δL: mi.Spectrum, seen: Seen | None = None) -> Diagnostics:
        """Back-propagate the adjoint of the radiance; ``seen`` (or None) collects what is seen of media."""

    def forward(self, view: Pass, walk: Walk, learned: Baseline | None) -> Found:
        """Tangent of the image: see `Term`."""
        rays = view.rays()
        δL, valid, diagnostics = self.tangent(walk, rays.start)
        tangent = splat(view, rays, δL, valid)
        if diagnostics.counters:
            dr.eval(tangent)  # in one kernel with the count of lost paths
        return Found(tangent, diagnostics)

    def backward(
        self, view: Pass, walk: Walk, grad_in: mi.TensorXf, learned: Baseline | None, seen: Seen | None = None
    ) -> Found:
        """Back-propagate the adjoint of the image: see `Term`."""
        rays = view.rays()
        δL = adjoint(view, rays, grad_in)
        diagnostics = self.propagate(walk, rays.start, δL, seen)
        del rays, δL  # so that loops need not compute what comes out of them
        dr.eval()
        return Found(None, diagnostics, seen)


@dataclass(frozen=True)
class PathReplay(Interior):
    """The interior by our own drivers: forward, and sweep or replay.

    Not differentiated: see `sweep`, `replay` and `forward`; weights that are exactly zero with the replay driver.
    """

    driver: str  # sweep or replay
    auto: bool  # replay where the sweep cannot hold the paths
    branch: str | bool  # whether a null collision of each path is kept (auto: where it is needed)
    recovery: Recovery  # of the replay driver

    def tangent(self, walk: Walk, start: CameraStart) -> tuple[mi.Spectrum, mi.Bool, Diagnostics]:
        lost = LostPaths()
        δL, valid, moves = forward(walk, start, lost)
        return δL, valid, Diagnostics((lost,), dr.width(start.ray), True) if moves else Diagnostics()

    def propagate(self, walk: Walk, start: CameraStart, δL: mi.Spectrum, seen: Seen | None = None) -> Diagnostics:
        lost = LostPaths()
        if self._sweeps(walk):
            moves = sweep(walk, start, δL, lost, seen)
        else:
            moves = replay(replace(walk, baseline=None), start, δL, lost, self.recovery)
        counted = moves or walk.media is not None
        return Diagnostics((lost,), dr.width(start.ray), moves) if counted else Diagnostics()

    def forward(self, view: Pass, walk: Walk, learned: Baseline | None) -> Found:
        return super().forward(view, self._informed(walk, learned), learned)

    def backward(
        self, view: Pass, walk: Walk, grad_in: mi.TensorXf, learned: Baseline | None, seen: Seen | None = None
    ) -> Found:
        if learned is not None and walk.media is not None and self._sweeps(walk):
            seen = Seen.none(learned.cells, view.key)
        return super().backward(view, self._informed(walk, learned), grad_in, learned, seen)

    def pixels(self, view: Pass, walk: Walk, loss: PixelLoss) -> Found:
        """The image, while the loss is back-propagated: see `pixel_sweep`. For scenes without media."""
        width, height = view.size
        lost = LostPaths()
        camera = pixel_camera(view.sensor, dr.arange(mi.UInt32, width * height))
        moves, L = pixel_sweep(walk, view.pixel_sampler(), camera, view.spp, loss, lost)
        dr.eval(L)  # in one kernel with the gradients
        diagnostics = Diagnostics((lost,), width * height * view.spp, True) if moves else Diagnostics()
        return Found(mi.TensorXf(dr.ravel(L), (height, width, 3)), diagnostics)

    def _sweeps(self, walk: Walk) -> bool:
        return self.driver == "sweep" and not (self.auto and walk.max_depth > deepest(walk))

    def _informed(self, walk: Walk, learned: Baseline | None) -> Walk:
        """The walk, with what earlier passes found out about media."""
        if walk.media is None:
            return walk
        branching = None
        if walk.media.branches if self.branch == "auto" else self.branch:
            branching = dr.opaque(mi.Float, FIRST_BRANCHING) if learned is None else learned.branching
        return replace(walk, baseline=None if learned is None else learned.look, branching=branching)
