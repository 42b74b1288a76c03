"""Film positions of a pass: their camera rays, their importance under an adjoint image, and splatting."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
import mitsuba as mi

from pathreplay.integrators.camera_pass import Pass
from pathreplay.integrators.film.image import transposed
from pathreplay.platform.registration import mitsuba_integrator
from pathreplay.samplers.counter_sampler import CounterSampler
from pathreplay.samplers.streams import Stream
from pathreplay.transport.start import medium_around
from pathreplay.transport.vertex import TraceConfig

PROJECTING = frozenset({"PerspectiveCamera", "ThinLensCamera"})
"""Classes of sensors that can project a point onto the film."""
SINGLE_RAY = frozenset({"RadianceMeter"})
"""Classes of sensors that have the same ray at all film positions. Their images show no edges, except in media: there,
the boundary of a hard shadow moves along the ray. This motion is not differentiated."""
BY_APERTURE = frozenset({"DistantSensorImpl"})
"""Classes of sensors whose rays depend on the aperture sample only. The film position takes its place here, so that
rays differ between film positions."""
PIXELS = {"DistantSensorImpl": 32, "IrradianceMeter": 8}
"""Resolution assumed for sensors whose pixels each see the whole scene. Segments of half a pixel would miss small
objects. With shorter segments, fewer cross an edge, and the noise is higher."""
QUADRATURE = 128
"""Number of quadrature points of the integral over a filter."""


@dataclass(frozen=True)
class FilmPlaces:
    """The part of a film on which paths start: the crop window, with the border if it is sampled. See `FilmDomain`."""

    view: Pass
    corner: mi.ScalarPoint2f  # position of the domain's lower corner on the film, in pixels
    size: mi.ScalarVector2f
    reflects: ClassVar[bool] = False

    @staticmethod
    def of(view: Pass) -> FilmPlaces:
        film = view.sensor.film()
        border = film.rfilter().border_size() if film.sample_border() else 0
        corner = mi.ScalarPoint2f(film.crop_offset()) - border
        return FilmPlaces(view, corner, mi.ScalarVector2f(film.crop_size()) + 2 * border)

    def ray(self, s: mi.Point2f, key: mi.UInt32) -> tuple[mi.Ray3f, mi.Spectrum]:
        sensor, sampler, position = self.view.sensor, CounterSampler.stream(key, Stream.CAMERA), self.in_sensor(s)
        time = sensor.shutter_open() + sampler.next_1d() * sensor.shutter_open_time()
        wavelength, aperture = sampler.next_1d(), sampler.next_2d()
        if self.goes_by_aperture:
            aperture = position
        ray, weight = self.view.camera_ray(time, wavelength, position, aperture)
        return mi.Ray3f(ray), dr.detach(weight)

    @property
    def is_extended(self) -> bool:
        """Whether different film positions have different rays."""
        return self.view.sensor.class_name() not in SINGLE_RAY

    @property
    def goes_by_aperture(self) -> bool:
        """Whether the aperture sample takes the place of the film position: see `BY_APERTURE`."""
        return self.view.sensor.class_name() in BY_APERTURE

    @property
    def detail(self) -> float:
        """Size in pixels of the details that the sensor sees: see `PIXELS`."""
        return 1 / PIXELS.get(self.view.sensor.class_name(), 1)

    def flows(self, s: mi.Point2f) -> mi.Bool:
        flow = self.view.flow
        return mi.Bool(False) if flow is None else flow.leaves_rest_at(self.in_sensor(s))

    def medium(self, trace: TraceConfig, ray: mi.Ray3f, active: mi.Bool) -> mi.MediumPtr:
        return medium_around(trace)

    def of_point(self, p: mi.Point3f) -> tuple[mi.Point2f, mi.Bool]:
        sensor = self.view.sensor
        if sensor.class_name() not in PROJECTING:
            return mi.Point2f(0), mi.Bool(False)
        point = dr.zeros(mi.Interaction3f)
        point.p = p
        direction, _ = sensor.sample_direction(point, mi.Point2f(0.5), True)
        return direction.uv + (mi.ScalarPoint2f(sensor.film().crop_offset()) - self.corner), direction.pdf > 0

    def in_sensor(self, s: mi.Point2f) -> mi.Point2f:
        """Convert a film position to units of the crop window's width and height, as sensors expect it."""
        film = self.view.sensor.film()
        return (self.corner + s - mi.ScalarPoint2f(film.crop_offset())) / mi.ScalarVector2f(film.crop_size())

    def undeveloped(self, grad_in: mi.TensorXf) -> mi.TensorXf:
        """Return g_j / ∫ h_j for each pixel j of a block; g_j is the adjoint of image pixel j, and h_j its filter."""
        return transposed(self.developed, mi.TensorXf(self._block().tensor()), grad_in)

    def importance(self, block_grad: mi.TensorXf, s: mi.Point2f, wavelengths: mi.Spectrum) -> mi.Spectrum:
        """Return the adjoint W of the radiance at film positions ``s``.

        Inside the domain, W(s) = Σ_j g_j h_j(s) / ∫ h_j, where g_j is the adjoint of image pixel j, and h_j its filter.
        Outside the domain, W is zero. ``block_grad`` contains g_j / ∫ h_j: see `undeveloped`.
        """
        inside = dr.all((s >= 0) & (s < self.size))
        unit = dr.full(mi.Spectrum, 1.0, dr.width(s))
        return dr.select(inside, transposed(lambda L: self._put(s, L, wavelengths), unit, block_grad), 0)

    def image(self, s: mi.Point2f, L: mi.Spectrum, wavelengths: mi.Spectrum) -> mi.TensorXf:
        """Splat radiance ``L`` at film positions ``s``, and return the image.

        Pixel j is Σ L h_j(s) / ∫ h_j, with h_j the filter of the pixel: see `importance`.
        """
        inside = dr.all((s >= 0) & (s < self.size))
        return self.developed(self._put(s, dr.select(inside, L, 0), wavelengths))

    def importance_of_pixels(self, block_grad: mi.TensorXf, pixel: mi.UInt32, wavelengths: mi.Spectrum) -> mi.Spectrum:
        """Return g_j / ∫ h_j (see `importance`) for each row-major index j in ``pixel``."""
        unit = dr.full(mi.Spectrum, 1.0, dr.width(pixel))
        return transposed(lambda L: self.pixels(pixel, L, wavelengths), unit, block_grad)

    def pixels(self, pixel: mi.UInt32, L: mi.Spectrum, wavelengths: mi.Spectrum) -> mi.TensorXf:
        """Add radiance ``L`` to the pixels of a block by row-major index, without a filter, and return the pixels."""
        film, filtered = self.view.sensor.film(), self._block()
        offset, size = mi.ScalarPoint2i(film.crop_offset()), mi.ScalarVector2u(film.crop_size())
        block = mi.ImageBlock(size, offset, filtered.channel_count())
        position = mi.Point2f(mi.Float(pixel % size.x), mi.Float(pixel // size.x)) + 0.5 + mi.ScalarPoint2f(offset)
        _splat(block, film, position, L, wavelengths)
        return block.tensor()

    def _block(self) -> mi.ImageBlock:
        film = self.view.sensor.film()
        film.prepare([])
        return film.create_block()

    def _put(self, s: mi.Point2f, L: mi.Spectrum, wavelengths: mi.Spectrum) -> mi.TensorXf:
        """Splat radiance into a block with the film's filter, and return its pixels."""
        block = self._block()
        _splat(block, self.view.sensor.film(), self.corner + s, L, wavelengths)
        return block.tensor()

    def developed(self, pixels: mi.TensorXf) -> mi.TensorXf:
        """Develop a block that has no sample weights: divide each pixel j by the integral ∫ h_j of its filter."""
        film, block = self.view.sensor.film(), self._block()
        height, width, channels = pixels.shape
        index = dr.arange(mi.UInt32, height * width * channels)
        pixel = index // channels
        x, y = self._filter_integral(block, pixel % width, 0), self._filter_integral(block, pixel // width, 1)
        weights = dr.select(index % channels == channels - 1, x * y, 0)
        weighted = mi.TensorXf(weights, pixels.shape) + pixels
        film.put_block(mi.ImageBlock(weighted, block.offset(), film.rfilter(), block.has_border()))
        return film.develop()

    def _filter_integral(self, block: mi.ImageBlock, index: mi.UInt32, axis: int) -> mi.Float:
        """Integrate a pixel's filter over the domain along one axis; ``index`` is the pixel's index on this axis."""
        rfilter = self.view.sensor.film().rfilter()
        if rfilter.is_box_filter():
            return mi.Float(1)
        pixel = mi.Float(index) + (block.offset()[axis] - block.border_size() + 0.5)
        begin, end = self.corner[axis], self.corner[axis] + self.size[axis]
        step = 2 * rfilter.radius() / QUADRATURE
        total = mi.Float(0)
        for k in range(QUADRATURE):
            x = (k + 0.5) * step - rfilter.radius()
            total += dr.select((pixel + x >= begin) & (pixel + x < end), rfilter.eval(mi.Float(x)), 0)
        return total * step


def _splat(block: mi.ImageBlock, film: mi.Film, position: mi.Point2f, L: mi.Spectrum, wavelengths: mi.Spectrum) -> None:
    mitsuba_integrator()._splat_to_block(
        block, film, position, value=L, weight=mi.Float(0), alpha=mi.Float(0), aovs=[], wavelengths=wavelengths
    )
