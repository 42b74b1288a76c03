"""Samples of camera rays, and the derivatives of rays with respect to the film position."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import drjit as dr
import mitsuba as mi

from pathreplay.integrators.film.grid import PROBES, probe_position

STEP = 1 / 256
"""Step of central differences in film widths, and relative step for differences in the closeness. The derivatives have
a relative error of 4e-6 for a field of view of 40°, and of 1e-4 for 120°."""

PINHOLE, ORTHOGRAPHIC = "PerspectiveCamera", "OrthographicCamera"
CAMERAS = frozenset({PINHOLE, "ThinLensCamera", ORTHOGRAPHIC})
"""Classes of sensors whose rays are smooth functions of the film position, also outside the border of the film."""

RayDerivatives: TypeAlias = "tuple[list[mi.Vector3f], list[mi.Vector3f]]"
"""∂o/∂s and ∂d/∂s of a ray, along both axes of the film."""


@dataclass(frozen=True)
class Sample:
    """The arguments of Mitsuba's `Sensor.sample_ray`. Positions are in units of the film's width and height."""

    time: mi.Float | float
    wavelength: mi.Float
    position: mi.Point2f
    aperture: mi.Point2f

    def ray(self, sensor: mi.Sensor) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
        """Return the sensor's ray and its weight. The ray is attached to the sensor and to the film position."""
        return sensor.sample_ray_differential(self.time, self.wavelength, self.position, self.aperture)

    def at(self, position: mi.Point2f) -> Sample:
        """Return a copy of the sample at another film position."""
        return Sample(self.time, self.wavelength, position, self.aperture)


def probes_of(sensor: mi.Sensor) -> Sample:
    """Return the samples of the probe rays: see `probe_position`."""
    i = dr.arange(mi.UInt32, PROBES * PROBES)
    return Sample(sensor.shutter_open(), mi.Float(0.5), probe_position(i), mi.Point2f(0.5))


def film_velocity(motion: mi.Vector3f, derivatives: RayDerivatives, closeness: mi.Float) -> mi.Vector2f:
    """Return, by least squares, the film velocity of points on the rays at the distance 1 / ``closeness``.

    ``motion`` is the velocity of the points times the closeness. For points at infinity, it is that of the directions.
    """
    x, y = (closeness * o_k + d_k for o_k, d_k in zip(*derivatives, strict=True))
    xx, xy, yy = dr.dot(x, x), dr.dot(x, y), dr.dot(y, y)
    a, b = dr.dot(x, motion), dr.dot(y, motion)
    return mi.Vector2f(yy * a - xy * b, xx * b - xy * a) / (xx * yy - xy * xy)


def move_with_position(ray: mi.Ray3f, derivatives: RayDerivatives, v: mi.Vector2f) -> None:
    """Add to ``ray`` the motion that a ray has if its film position moves with the velocity v."""
    o, d = derivatives
    ray.o += o[0] * v.x + o[1] * v.y
    ray.d += d[0] * v.x + d[1] * v.y


def ray_derivatives(sensor: mi.Sensor, sample: Sample) -> RayDerivatives:
    """Return detached derivatives of a ray with respect to its film position, by central differences."""
    o, d = [], []
    with dr.suspend_grad():
        for step in (mi.Vector2f(STEP, 0), mi.Vector2f(0, STEP)):
            a, b = (sample.at(sample.position + side * step).ray(sensor)[0] for side in (-1, 1))
            o.append((b.o - a.o) / (2 * STEP))
            d.append((b.d - a.d) / (2 * STEP))
    return o, d
