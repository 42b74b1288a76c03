"""A pass: scene, sensor, seed and samples per pixel. It gives the camera rays, and tells itself from other passes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from typing import TypeAlias

import drjit as dr
import mitsuba as mi

from pathreplay.integrators.film.camera_flow import FilmFlow, Sample
from pathreplay.integrators.lifetimes import is_recording
from pathreplay.platform.registration import mitsuba_integrator
from pathreplay.samplers.owen_sobol import OwenSobolSampler, in_order, key_of
from pathreplay.samplers.pixel_samples import Alone, EvenSets, PixelSamples
from pathreplay.transport.start import CameraStart

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
class _ForCamera:
    """Numbers, as Mitsuba's integrators want them to draw camera rays."""

    numbers: OwenSobolSampler
    count: int

    def sample_count(self) -> int:
        """Paths of a pixel."""
        return self.count

    def next_1d(self) -> mi.Float:
        return self.numbers.next_1d()

    def next_2d(self) -> mi.Point2f:
        return self.numbers.next_2d()


@dataclass(frozen=True)
class _Seen:
    """The sensor of a pass, as Mitsuba's integrators want it to draw camera rays."""

    view: Pass

    def __getattr__(self, name: str) -> object:
        """What a sensor has."""
        return getattr(self.view.sensor, name)

    def sample_ray_differential(
        self, time: mi.Float, sample1: mi.Float, sample2: mi.Point2f, sample3: mi.Point2f
    ) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
        return self.view.camera_ray(time, sample1, sample2, sample3)


@dataclass(frozen=True)
class Pass:
    """Everything that decides which paths are walked, but for the integrator's options. Gives the same rays each time.

    ``spp`` of 0 are the samples per pixel of the sensor's sampler. If that is an `independent` one, ``even`` numbers
    can take its place; other samplers are taken as they are.
    """

    scene: mi.Scene
    sensor: mi.Sensor
    seed: Seed
    spp: int = 0
    share: float = 1.0  # of a larger pass, whose part this is: see `parts`
    even: bool = False
    flow: FilmFlow | None = None  # of the film, if rays move by the rest only

    @staticmethod
    def of(scene: mi.Scene, sensor: Which, seed: Seed, spp: int, even: bool = False) -> Pass:
        """A pass by the arguments of Mitsuba's integrators: the sensor may be an index."""
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        even = even and sensor.sampler().class_name() == "IndependentSampler"
        return Pass(scene, sensor, seed, spp or sensor.sampler().sample_count(), even=even)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the picture, in pixels."""
        width, height = self.sensor.film().crop_size()
        return int(width), int(height)

    def rays(self) -> Rays:
        """The camera rays, as Mitsuba's integrators draw them; makes the film ready for their samples."""
        mitsuba = mitsuba_integrator()
        sampler, spp = mitsuba.prepare(None, self.sensor, self.seed, self.spp, [])
        if self.even:
            film = self.sensor.film()
            border = 2 * film.rfilter().border_size() if film.sample_border() else 0
            width, height = (n + border for n in self.size)
            i = dr.arange(mi.UInt32, width * height * spp)
            sampler = self.numbers(i // spp, width, i % spp, spp)
        camera = _ForCamera(sampler, spp) if self.even else sampler
        ray, weight, position = mitsuba.sample_rays(None, self.scene, _Seen(self), camera)
        return Rays(sampler, ray, weight, position, spp)

    def camera_ray(
        self, time: mi.Float, wavelength: mi.Float, place: mi.Point2f, aperture: mi.Point2f
    ) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
        """The sensor's ray and its weight (see Mitsuba's Sensor), attached to the camera as the pass has it."""
        if self.flow is not None:
            return self.flow.ray(Sample(time, wavelength, place, aperture))
        # Not `sample_ray`, which irradiance meters do not have.
        return self.sensor.sample_ray_differential(time, wavelength, place, aperture)

    def numbers(
        self, pixel: mi.UInt32, width: int, path: mi.UInt32, paths: int, of: int | mi.UInt32 = 0
    ) -> OwenSobolSampler:
        """Even numbers of a path in a pixel (row by row, of that width) that has so many; ``of`` keeps sets apart."""
        bits = (paths - 1).bit_length()
        place = in_order(pixel % width, pixel // width)
        # What does not fit into 32 bits tells sets apart, too.
        beyond = place >> (32 - bits) if bits else mi.UInt32(0)
        return OwenSobolSampler.of((place << bits) | path, key_of(self.opaque_seed, mi.UInt32(of), beyond))

    @property
    def opaque_seed(self) -> mi.UInt32:
        """The seed, as no constant of a kernel, which would be another one for each seed."""
        seed = mi.UInt32(self.seed)
        if seed.state == dr.VarState.Literal:
            dr.make_opaque(seed)
        return seed

    def of_pixels(self, pixel: mi.UInt32) -> PixelSamples:
        """Random numbers for a lane per pixel (row by row), which walks all paths of it."""
        if self.even:
            width, _ = self.size
            return EvenSets(partial(self.numbers, pixel, width))
        sampler = self.sensor.sampler().clone()
        sampler.seed(self.seed, dr.width(pixel))
        return Alone(sampler)

    @cached_property
    def keys(self) -> tuple[tuple[int, int, int], ...]:
        """What tells the passes over one scene apart. Reads the seed, which takes time if it is an array.

        Nothing in a frozen function, which cannot read it.
        """
        if is_recording():
            return ()
        seed = int(self.seed) if isinstance(self.seed, int) else int(self.seed[0])
        return ((seed, self.spp, self.sensor.ptr),)
