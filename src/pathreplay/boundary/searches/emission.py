"""Boundary term of light paths: edges before the first rough surface or collision, and between it and the sensor.

The random numbers of the first ray of a light path take the place of the film position in `primary`. Let f(u) be the
contribution to the image of a light path whose first ray has the random numbers u. Two of these numbers vary, the
others are fixed. The function f jumps where the light meets an occluder, directly or through chains of delta lobes, and
where an occluder hides a vertex from the sensor. The terms of the derivative are those of `primary`, with the adjoint
of the image as a factor of f.

In a medium, light is also scattered to the sensor by the points x = o + τ d of the first ray (o, d). For each distance
τ, f jumps where an occluder hides x from the sensor. The terms are those of `volumetric`, with the sensor in the place
of a light without extent.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import mitsuba as mi

from pathreplay.boundary.searches.primary import PrimarySearch, Sides
from pathreplay.boundary.searches.volumetric import VolumetricSearch
from pathreplay.transport.vertex import TraceConfig


@dataclass(frozen=True)
class EmissionSearch(PrimarySearch):
    """Edge search over the random numbers of first rays. Positions are random numbers, times the size of the domain."""

    @property
    def along(self) -> TraceConfig:
        """The configuration of the paths to edges."""
        return self.chain

    def jump(self, sides: Sides, key: mi.UInt32) -> mi.Spectrum:
        """Estimate f_a - f_b. Without an adjoint of the image, return 1: the caller adds both sides to the image."""
        assert self.trace.to_sensor is not None
        return mi.Spectrum(1) if self.trace.to_sensor.adjoint is None else super().jump(sides, key)


@dataclass(frozen=True)
class EmissionBeamSearch(VolumetricSearch):
    """Edge search over the random numbers of first rays, and distances along these rays in media."""

    @property
    def along(self) -> TraceConfig:
        """The configuration of the paths to edges."""
        assert self.trace.to_sensor is not None
        return replace(self.trace, to_sensor=replace(self.trace.to_sensor, adjoint=None))
