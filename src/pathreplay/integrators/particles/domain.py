"""Random numbers of the first rays of light paths, as the domain of an edge search (`boundary.searches.emission`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
import mitsuba as mi

from pathreplay.particles.start import Emission, EmitterSamples
from pathreplay.samplers.counter_sampler import CounterSampler
from pathreplay.samplers.streams import Stream
from pathreplay.transport.meet import meet
from pathreplay.transport.vertex import TraceConfig
from pathreplay.transport.volume.passage import medium_at_origin

CELLS = 32
"""Number of cells along a side of the unit square. The density of segments is constant in each cell. With more cells
than pilot segments, the density would be estimated poorly."""
BY_PLACE = frozenset({"SpotLight", "DirectionalEmitter", "DirectionalArea", "EnvironmentMapEmitter"})
"""Classes of emitters whose rays vary continuously with the random numbers ``place`` (of `EmitterSamples`). The rays of
all others vary continuously with the random numbers ``direction``."""
WHOLE = frozenset({"Rectangle", "Disk"})
"""Classes of shapes whose points vary continuously with the random numbers ``place``."""
SPHERICAL = "PointLight"
"""Class of emitters that sample directions in polar coordinates. See `_polar`."""


@dataclass(frozen=True)
class EmissionDomain:
    """The unit square of two random numbers of the first ray, scaled by `CELLS`. See `FilmDomain`.

    Positions beyond the border are reflected at the border. All other random numbers are a function of the key.
    """

    trace: TraceConfig
    emission: Emission
    reflects: ClassVar[bool] = True

    @property
    def size(self) -> mi.ScalarVector2f:
        return mi.ScalarVector2f(CELLS, CELLS)

    def ray(self, s: mi.Point2f, key: mi.UInt32) -> tuple[mi.Ray3f, mi.Spectrum]:
        sampler = CounterSampler.stream(key, Stream.EMITTER)
        u = EmitterSamples.draw(sampler)
        varied = 1 - dr.abs(1 - dr.abs(s / CELLS))
        index, _, _ = self.emission.pick(u.emitter)
        by_place, polar, jumps = mi.Bool(False), mi.Bool(False), mi.Bool(False)
        for k, emitter in enumerate(self.emission.scene.emitters()):
            by_place |= (index == k) & (emitter.class_name() in BY_PLACE)
            polar |= (index == k) & (emitter.class_name() == SPHERICAL)
            jumps |= (index == k) & has_jumps(emitter)
        u.place = dr.select(by_place, varied, u.place)
        direction = dr.select(polar, _polar(varied, sampler.next_1d() < 0.5), varied)
        u.direction = dr.select(by_place, u.direction, direction)
        ray, weight = self.emission.emit(self.trace, u, mi.Bool(True))
        return mi.Ray3f(ray), dr.select(jumps, 0, dr.detach(weight))

    def flows(self, s: mi.Point2f) -> mi.Bool:
        return mi.Bool(False)

    def medium(self, trace: TraceConfig, ray: mi.Ray3f, active: mi.Bool) -> mi.MediumPtr:
        return medium_at_origin(trace, ray, meet(trace, ray, active), self.emission.outside, active)

    def of_point(self, p: mi.Point3f) -> tuple[mi.Point2f, mi.Bool]:
        return mi.Point2f(0), mi.Bool(False)


def has_jumps(emitter: mi.Emitter) -> bool:
    """Return whether the rays of an emitter may jump as the random numbers vary, between texels or between triangles.

    In the light of such an emitter, no edges are found.
    """
    kind, shape = emitter.class_name(), emitter.get_shape()
    return kind == "Projector" or (kind == "DirectionalArea" and shape.class_name() not in WHOLE)


def _polar(u: mi.Point2f, up: mi.Bool) -> mi.Point2f:
    """Map the unit square to the polar coordinates of a hemisphere, in units of the coordinates' ranges.

    The map preserves areas up to a factor of two. Edges near the poles have bounded curvature in ``u``.
    """
    p = mi.warp.square_to_uniform_disk_concentric(u)
    turn = dr.inv_two_pi * dr.atan2(p.y, p.x)
    height = 0.5 * dr.squared_norm(p)
    return mi.Point2f(turn - dr.floor(turn), dr.select(up, height, 1 - height))
