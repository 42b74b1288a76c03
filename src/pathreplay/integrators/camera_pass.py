"""A rendering pass, defined by scene, sensor, seed and samples per pixel. It generates the camera rays."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from types import SimpleNamespace
from typing import TypeAlias

import drjit as dr
import mitsuba as mi

from pathreplay.integrators.film.camera_flow import FilmFlow
from pathreplay.integrators.film.sample import Sample
from pathreplay.integrators.lifetimes import is_recording
from pathreplay.platform.registration import mitsuba_integrator
from pathreplay.samplers.owen_sobol import OwenSobolSampler, key_of, morton_index
from pathreplay.samplers.pixel_samples import IndependentSets, PixelSamples, SobolSets
from pathreplay.samplers.sampler import Sampler
from pathreplay.transport.facts.nodes import with_gradients
from pathreplay.transport.start import CameraStart

Seed: TypeAlias = "int | mi.UInt32"
Which: TypeAlias = "int | mi.Sensor"
"""A sensor, or its index in the scene."""
FLAT = frozenset({"Rectangle", "Disk"})
"""Classes of shapes whose sampled normals Mitsuba 3.9 does not attach to ``to_world``."""


@dataclass(frozen=True)
class Rays:
    """The camera rays of a pass, one per sample of each pixel."""

    sampler: Sampler  # has already generated the random numbers of the camera ray
    ray: mi.RayDifferential3f  # attached to the camera if the camera has gradients
    weight: mi.Spectrum
    position: mi.Vector2f  # film position in pixels, where the sample is splatted
    spp: int  # samples per pixel of the pass, after rounding by the sampler

    @property
    def start(self) -> CameraStart:
        return CameraStart(self.ray, self.sampler, mi.Bool(True))


@dataclass(frozen=True)
class _PassSensor:
    """Adapter of the sensor of a pass to the interface that Mitsuba's `sample_rays` expects."""

    view: Pass

    def __getattr__(self, name: str) -> object:
        """Forward attribute access to the sensor."""
        return getattr(self.view.sensor, name)

    def sample_ray_differential(
        self, time: mi.Float, sample1: mi.Float, sample2: mi.Point2f, sample3: mi.Point2f
    ) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
        return self.view.camera_ray(time, sample1, sample2, sample3)


@dataclass(frozen=True)
class Pass:
    """The inputs that, together with the integrator's options, determine the paths of an image.

    Every call of `rays` generates the same rays. ``spp`` = 0 means the samples per pixel of the sensor's sampler. With
    ``uses_sobol``, Owen-scrambled Sobol samples replace an `independent` sampler; other samplers are kept.
    """

    scene: mi.Scene
    sensor: mi.Sensor
    seed: Seed
    spp: int = 0
    share: float = 1.0  # weight of this pass in a mean of images, if the pass is a part of another: see `parts`
    uses_sobol: bool = False
    # If set, film positions s move with the velocity v of the flow. The derivative of a camera ray c(s, π) with respect
    # to the parameters π is then ∂c/∂π + ∂c/∂s v, in place of ∂c/∂π: see `camera_flow`.
    flow: FilmFlow | None = None

    @staticmethod
    def of(scene: mi.Scene, sensor: Which, seed: Seed, spp: int, uses_sobol: bool = False) -> Pass:
        """Create a pass from the arguments of a Mitsuba integrator; ``sensor`` is a sensor or its index."""
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        uses_sobol = uses_sobol and sensor.sampler().class_name() == "IndependentSampler"
        return Pass(scene, sensor, seed, spp or sensor.sampler().sample_count(), uses_sobol=uses_sobol)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image in pixels."""
        width, height = self.sensor.film().crop_size()
        return int(width), int(height)

    def rays(self) -> Rays:
        """Sample camera rays as Mitsuba's integrators do, and prepare the film."""
        mitsuba = mitsuba_integrator()
        sampler, spp = mitsuba.prepare(None, self.sensor, self.seed, self.spp, [])
        if self.uses_sobol:
            film = self.sensor.film()
            border = 2 * film.rfilter().border_size() if film.sample_border() else 0
            width, height = (n + border for n in self.size)
            i, paths = dr.arange(mi.UInt32, width * height * spp), dr.opaque(mi.UInt32, spp)
            sampler = self.sobol_sampler(i // paths, width, i % paths, spp)
            # `sample_rays` also needs the number of paths per pixel.
            camera = SimpleNamespace(sample_count=lambda: spp, next_1d=sampler.next_1d, next_2d=sampler.next_2d)
        else:
            camera = sampler
        ray, weight, position = mitsuba.sample_rays(None, self.scene, _PassSensor(self), camera)
        return Rays(sampler, ray, weight, position, spp)

    def camera_ray(
        self, time: mi.Float, wavelength: mi.Float, position: mi.Point2f, aperture: mi.Point2f
    ) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
        """Sample a ray of the sensor and the weight of the ray: see Mitsuba's `Sensor.sample_ray_differential`.

        The ray is attached to the camera. With a ``flow``, the ray moves as described in `FilmFlow.ray`.
        """
        if self.flow is not None:
            return self.flow.ray(Sample(time, wavelength, position, aperture))
        # Irradiance meters do not implement `sample_ray`.
        ray, weight = self.sensor.sample_ray_differential(time, wavelength, position, aperture)
        shape = self.sensor.get_shape()
        if shape is not None and shape.class_name() in FLAT and with_gradients(shape, "to_world"):
            ray.d = _turned(shape, ray.d)
        return ray, weight

    def sobol_sampler(
        self, pixel: mi.UInt32, width: int, path: mi.UInt32, paths: int, of: int | mi.UInt32 = 0
    ) -> OwenSobolSampler:
        """Create the Sobol sampler of one path of a pixel.

        ``path`` is the index of the path in the pixel, which has ``paths`` paths in total. ``pixel`` is the row-major
        index of the pixel in a film of ``width`` pixels. Samplers with different values of ``of`` are independent.
        Kernels do not depend on ``paths``.
        """
        bits = dr.opaque(mi.UInt32, (paths - 1).bit_length())
        morton = morton_index(pixel % width, pixel // width)
        # A Sobol index has 32 bits. The bits of ``morton`` that do not fit select the set of samples, with the seed and
        # ``of``. There are two shifts, because a shift by 32 bits (if ``bits`` is 0) is undefined.
        overflow = (morton >> 1) >> (31 - bits)
        return OwenSobolSampler.of((morton << bits) | path, key_of(self.opaque_seed, mi.UInt32(of), overflow))

    @property
    def opaque_seed(self) -> mi.UInt32:
        """The seed as an opaque variable. A literal seed would compile a new kernel for each value."""
        seed = mi.UInt32(self.seed)
        if seed.state == dr.VarState.Literal:
            dr.make_opaque(seed)
        return seed

    def pixel_samples(self, pixel: mi.UInt32) -> PixelSamples:
        """Create samplers for lanes that each trace all paths of one pixel. ``pixel`` contains row-major indices."""
        if self.uses_sobol:
            width, _ = self.size
            return SobolSets(partial(self.sobol_sampler, pixel, width))
        sampler = self.sensor.sampler().clone()
        sampler.seed(self.seed, dr.width(pixel))
        return IndependentSets(sampler)

    @cached_property
    def keys(self) -> tuple[tuple[int, int, int], ...]:
        """Keys that identify this pass among passes over the same scene: seed, samples per pixel and sensor.

        Reading a seed that is an array synchronises with the device. The tuple is empty while `dr.freeze` records,
        because a recorded function cannot read the seed.
        """
        if is_recording():
            return ()
        seed = int(self.seed) if isinstance(self.seed, int) else int(self.seed[0])
        return ((seed, self.spp, self.sensor.ptr),)


def _turned(shape: mi.Shape, d: mi.Vector3f) -> mi.Vector3f:
    """Attach a direction, which is fixed in the frame of a flat shape's normal, to the ``to_world`` of the shape.

    The direction of a ray from an irradiance meter does not depend on the film position.
    """
    n = dr.normalize(mi.traverse(shape)["to_world"] @ mi.Normal3f(0, 0, 1))
    return dr.replace_grad(d, mi.Frame3f(n).to_world(mi.Frame3f(dr.detach(n)).to_local(dr.detach(d))))
