"""The interior term: the derivative of what paths carry, visibility held, by any driver that follows camera rays."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import drjit as dr
import mitsuba as mi

from ..device import device_of
from ..gradient.adjoint import LostPaths
from ..gradient.baseline import FIRST_BRANCHING, Guess, Seen
from ..gradient.driver import Driver, ForwardDriver
from ..gradient.forward import forward
from ..gradient.lights import lights_or
from ..gradient.pixel_sweep import PixelLoss, pixel_sweep
from ..gradient.primal import primal
from ..gradient.ray_jacobian import Recovery
from ..gradient.record import deepest
from ..gradient.replay import replay
from ..gradient.sweep import sweep
from ..transport.vertex import Walk
from .camera_pass import Pass
from .film import adjoint, splat
from .pixels import pixel_camera
from .term import Found


def image(view: Pass, walk: Walk) -> mi.TensorXf:
    """The image of a pass (height x width x channels)."""
    rays = view.rays()
    return splat(view, rays, *primal(walk, rays.start))


def tangent(view: Pass, walk: Walk, driver: ForwardDriver) -> Found:
    """Tangent of the image, by a driver. Paths are counted where they move."""
    rays, lost = view.rays(), LostPaths()
    δL, valid, moves = driver(walk, rays.start, lost)
    image = splat(view, rays, δL, valid)
    if not moves:
        return Found(image)
    dr.eval(image)  # in one kernel with the count of lost paths
    return Found(image, lost=lost.count, paths=dr.width(rays.ray), moves=True)


def back_propagate(view: Pass, walk: Walk, grad_in: mi.TensorXf, driver: Driver) -> Found:
    """Back-propagate the adjoint of the image by a driver. Paths are counted where they move, and in media."""
    rays, lost = view.rays(), LostPaths()
    δL, paths = adjoint(view, rays, grad_in), dr.width(rays.ray)
    moves = driver(walk, rays.start, δL, lost)
    del rays, δL  # so that loops need not compute what comes out of them
    dr.eval()
    return Found(lost=lost.count, paths=paths, moves=moves) if moves or walk.media is not None else Found()


@dataclass(frozen=True)
class PathReplay:
    """The interior by our own drivers: forward, and sweep, replay or lights.

    Not differentiated: see `sweep`, `replay` and `forward`; weights that are exactly zero with the replay driver.
    """

    driver: str  # sweep or replay
    auto: bool  # replay where the sweep cannot hold the paths, and lights where nothing else has gradients
    branch: str | bool  # whether a null collision of each path is kept (auto: where it is needed)
    recovery: Recovery  # of the replay driver

    def forward(self, view: Pass, walk: Walk, learned: Guess | None) -> Found:
        """Tangent of the image: see `Term`."""
        return tangent(view, self._informed(walk, learned), forward)

    def backward(self, view: Pass, walk: Walk, grad_in: mi.TensorXf, learned: Guess | None) -> Found:
        """Back-propagate the adjoint of the image: see `Term`."""
        walk = self._informed(walk, learned)
        if not self._sweeps(walk):
            again = partial(replay, recovery=self.recovery)
            return back_propagate(view, replace(walk, baseline=None), grad_in, self._or_lights(again))
        seen = None if learned is None or walk.media is None else Seen.none(learned.cells, *view.keys)
        found = back_propagate(view, walk, grad_in, self._or_lights(partial(sweep, seen=seen)))
        return replace(found, seen=seen)

    def pixels(self, view: Pass, walk: Walk, loss: PixelLoss, some: mi.UInt32 | None) -> Found:
        """The image, while the loss is back-propagated: see `pixel_sweep`. For scenes without media.

        If only ``some`` pixels are asked for, a row for each of them.
        """
        width, height = view.size
        lost, pixel = LostPaths(), dr.arange(mi.UInt32, width * height) if some is None else some
        lanes = dr.width(pixel)
        numbers, camera = view.of_pixels(pixel), pixel_camera(view.sensor, pixel)
        moves, L = pixel_sweep(walk, numbers, camera, view.spp, loss, lost)
        dr.eval(L)  # in one kernel with the gradients
        image = mi.TensorXf(dr.ravel(L), (height, width, 3) if some is None else (lanes, 1, 3))
        return Found(image, lost=lost.count, paths=lanes * view.spp, moves=True) if moves else Found(image)

    def _or_lights(self, driver: Driver) -> Driver:
        """The driver, where one was asked for; else one of its own where only lights have gradients."""
        return lights_or(driver) if self.auto else driver

    def note(self, walk: Walk) -> str:
        """What is to be said of the driver that was chosen; "" if it is nothing."""
        device = device_of(mi.variant())
        if self._sweeps(walk) or self.driver == "replay" or not device.is_gpu:
            return ""
        return (
            f"records of {walk.max_depth} vertices are more than {device.name or 'the GPU'} can hold for each of its "
            f"threads: paths are walked twice instead (driver = 'replay'); up to max_depth = {deepest(walk, device)} "
            "they are recorded"
        )

    def _sweeps(self, walk: Walk) -> bool:
        return self.driver == "sweep" and not (self.auto and walk.max_depth > deepest(walk))

    def _informed(self, walk: Walk, learned: Guess | None) -> Walk:
        """The walk, with what earlier passes found out about media."""
        if walk.media is None:
            return walk
        branching = None
        if walk.media.branches if self.branch == "auto" else self.branch:
            branching = dr.opaque(mi.Float, FIRST_BRANCHING) if learned is None else learned.branching
        return replace(walk, baseline=None if learned is None else learned.look, branching=branching)
