"""A pass: scene, sensor, seed and samples per pixel. It gives the camera rays, and tells itself from other passes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import drjit as dr
import mitsuba as mi

from ..plugins import mitsuba_integrator
from ..transport.start import CameraStart

Seed: TypeAlias = "int | mi.UInt32"
Which: TypeAlias = "int | mi.Sensor"
"""A sensor, or its index in the scene."""


@dataclass(frozen=True)
class Rays:
    """The camera rays of a pass, one for every sample of every pixel."""

    sampler: mi.Sampler  # goes on where the rays' own random numbers end
    ray: mi.RayDifferential3f  # attached to the camera, if that has gradients
    weight: mi.Spectrum
    position: mi.Vector2f  # on the film, in pixels: where the sample is splatted
    spp: int  # samples per pixel: those of the pass, rounded as the sampler needs them

    @property
    def start(self) -> CameraStart:
        return CameraStart(self.ray, self.sampler, mi.Bool(True))


@dataclass(frozen=True)
class Pass:
    """Everything that decides which paths are walked, but for the integrator's options. Gives the same rays each time.

    ``spp`` of 0 are the samples per pixel of the sensor's sampler.
    """

    scene: mi.Scene
    sensor: mi.Sensor
    seed: Seed
    spp: int = 0
    share: float = 1.0  # of a larger pass, whose part this is: see `parts`

    @staticmethod
    def of(scene: mi.Scene, sensor: Which, seed: Seed, spp: int) -> Pass:
        """A pass by the arguments of Mitsuba's integrators: the sensor may be an index."""
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        return Pass(scene, sensor, seed, spp or sensor.sampler().sample_count())

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the picture, in pixels."""
        width, height = self.sensor.film().crop_size()
        return int(width), int(height)

    def rays(self) -> Rays:
        """The camera rays, as Mitsuba's integrators draw them; makes the film ready for their samples."""
        mitsuba = mitsuba_integrator()
        sampler, spp = mitsuba.prepare(None, self.sensor, self.seed, self.spp, [])
        ray, weight, position = mitsuba.sample_rays(None, self.scene, self.sensor, sampler)
        return Rays(sampler, ray, weight, position, spp)

    def pixel_sampler(self, pixels: int) -> mi.Sampler:
        """Random numbers for a lane per pixel, each of which draws its own camera rays."""
        sampler = self.sensor.sampler().clone()
        sampler.seed(self.seed, pixels)
        return sampler

    @cached_property
    def keys(self) -> tuple[tuple[int, int, int], ...]:
        """What tells the passes over one scene apart. Reads the seed, which takes time if it is an array.

        Nothing in a frozen function, which cannot read it.
        """
        if dr.flag(dr.JitFlag.FreezingScope):
            return ()
        seed = int(self.seed) if isinstance(self.seed, int) else int(self.seed[0])
        return ((seed, self.spp, self.sensor.ptr),)
