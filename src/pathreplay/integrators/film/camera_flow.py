"""Film flow: the motion of a camera as motion of positions on its film, which needs no boundary term.

A camera that turns sees the same radiance at other places. Let s be a place on the film, c(s, π) its camera ray, and
T(s, π) where a chosen flow takes the place, with T(s, π₀) = s and the velocity v = ∂T/∂π. An integral over the film D
with weights W does not depend on how places are parametrised:

    ∫ W(s) L(c(s, π)) ds = ∫ W(T) L(c(T, π)) |∂T/∂s| ds,

and so its derivative has two parts. One belongs to the weights, with n normal to the border of D (see `CameraMotion`):

    ∫_D div(W v) L ds - ∮_∂D W L v·n dl

The other is that of L along the ray c(T, π), which moves by ∂c/∂π + ∂c/∂s v, the *rest* of the motion. Any smooth v
will do. `CameraFlow` keeps points at a distance r where they are: with p = o + r d on the ray, v = -(∂p/∂s)⁺ ∂p/∂π. A
camera that turns, or widens its view, leaves no rest; one that is carried along leaves parallax. Where the camera
stands still, `SeenFlow` follows what it sees.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, TypeAlias

import drjit as dr
import mitsuba as mi

from pathreplay.transport.facts.nodes import with_gradients

PINHOLE = "PerspectiveCamera"
CAMERAS = frozenset({PINHOLE, "ThinLensCamera", "OrthographicCamera"})
"""By class: those whose rays are smooth functions of places, beyond the border of the film, too."""
ONLY_PLACES = "x_fov", "principal_point_offset_x", "principal_point_offset_y"
"""Parameters of cameras that move nothing but places: they leave no rest."""
OTHERS = "to_world", "focus_distance", "aperture_radius"
STEP = 1 / 256
"""Of central differences, in widths of the film: off by 4e-6 at a field of view of 40 degrees, by 1e-4 at 120."""
GLANCES = 16
"""Rays in a row, and in a column, that tell how far away things are."""


Slopes: TypeAlias = "tuple[list[mi.Vector3f], list[mi.Vector3f]]"
"""∂o/∂s and ∂d/∂s of a ray, along both axes."""


@dataclass(frozen=True)
class Sample:
    """What decides on a camera ray: see Mitsuba's Sensor. Places are in widths and heights of the film."""

    time: mi.Float
    wavelength: mi.Float
    place: mi.Point2f
    aperture: mi.Point2f

    def ray(self, sensor: mi.Sensor) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
        """Of a sensor: the ray, attached to it and to the place, and its weight."""
        return sensor.sample_ray_differential(self.time, self.wavelength, self.place, self.aperture)

    def at(self, place: mi.Point2f) -> Sample:
        """The same at another place."""
        return Sample(self.time, self.wavelength, place, self.aperture)


class FilmFlow(Protocol):
    """A velocity field of positions on the film."""

    @property
    def is_all(self) -> bool:
        """Whether the flow contains the whole derivative."""

    @property
    def samples(self) -> int:
        """Number of samples of the pass per group of paths of the flow."""

    def ray(self, sample: Sample) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
        """The sensor's ray and its weight.

        If the place has gradients, the ray depends on it; otherwise it carries the rest of the motion.
        """

    def velocity(self, sample: Sample) -> mi.Vector2f:
        """v: a vector of zeros, attached to the parameters."""

    def divergence(self, sample: Sample) -> mi.Float:
        """∂v_x/∂x + ∂v_y/∂y: zero, attached to the parameters."""

    def moves_at(self, place: mi.Point2f) -> mi.Bool:
        """Whether the velocity at a film position may be non-zero."""

    def leaves_rest_at(self, place: mi.Point2f) -> mi.Bool:
        """Whether the ray through a film position may move beyond the flow."""

    def carry_tangents(self) -> None:
        """Carry tangents of the parameters as far as terms share what the flow knows, once for all of them."""


@dataclass(frozen=True)
class CameraFlow:
    """The flow of a sensor that moves: see `FilmFlow`."""

    sensor: mi.Sensor
    r: mi.Float  # at this distance nothing moves over the film
    leaves_rest: bool  # whether rays move with parameters beyond the flow
    is_all: bool
    samples: int = 2

    @staticmethod
    def of(scene: mi.Scene, sensor: mi.Sensor) -> CameraFlow | None:
        """The flow of a sensor; None if it has no gradients, or its class is not one of `CAMERAS`."""
        if sensor.class_name() not in CAMERAS or not with_gradients(sensor, *ONLY_PLACES, *OTHERS):
            return None
        rest = _is_carried(sensor) or bool(with_gradients(sensor, *OTHERS[1:]))
        others = any(with_gradients(thing) for thing in (*scene.shapes(), *scene.emitters()))
        alone = not (rest or others or with_gradients(sensor, "medium"))
        return CameraFlow(sensor, _distance(scene, sensor), rest, alone)

    def ray(self, sample: Sample) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
        """See `FilmFlow`."""
        ray, weight = sample.ray(self.sensor)
        if dr.grad_enabled(sample.place) or not dr.grad_enabled(ray.o, ray.d):
            return ray, weight
        if not self.leaves_rest:
            return dr.detach(ray), weight
        slopes = slopes_of(self.sensor, sample)
        move_with_place(ray, slopes, self._followed(ray, slopes))
        return ray, weight

    def velocity(self, sample: Sample) -> mi.Vector2f:
        """See `FilmFlow`."""
        return self._followed(sample.ray(self.sensor)[0], slopes_of(self.sensor, sample))

    def divergence(self, sample: Sample) -> mi.Float:
        """See `FilmFlow`."""
        found = mi.Float(0)
        for axis, step in enumerate((mi.Vector2f(STEP, 0), mi.Vector2f(0, STEP))):
            before, after = (self.velocity(sample.at(sample.place + side * step))[axis] for side in (-1, 1))
            found += (after - before) / (2 * STEP)
        return found

    def moves_at(self, place: mi.Point2f) -> mi.Bool:
        """Everywhere."""
        return mi.Bool(True)

    def leaves_rest_at(self, place: mi.Point2f) -> mi.Bool:
        """Everywhere or nowhere."""
        return mi.Bool(self.leaves_rest)

    def carry_tangents(self) -> None:
        """Nothing: terms ask the sensor."""

    def _followed(self, ray: mi.Ray3f, slopes: Slopes) -> mi.Vector2f:
        """The velocity, of which the value is zero, from a ray and its slopes."""
        δp = (ray.o - dr.detach(ray.o)) + self.r * (ray.d - dr.detach(ray.d))
        return -followed(δp, slopes, self.r)


def followed(δp: mi.Vector3f, slopes: Slopes, t: mi.Float) -> mi.Vector2f:
    """Velocity of film positions whose points at distance t move by δp: least squares with the rays' derivatives."""
    x, y = (o_k + t * d_k for o_k, d_k in zip(*slopes, strict=True))
    xx, xy, yy = dr.dot(x, x), dr.dot(x, y), dr.dot(y, y)
    a, b = dr.dot(x, δp), dr.dot(y, δp)
    return mi.Vector2f(yy * a - xy * b, xx * b - xy * a) / (xx * yy - xy * xy)


def move_with_place(ray: mi.Ray3f, slopes: Slopes, v: mi.Vector2f) -> None:
    """Add to a ray's motion the effect of its film position moving by v."""
    o, d = slopes
    ray.o += o[0] * v.x + o[1] * v.y
    ray.d += d[0] * v.x + d[1] * v.y


def glances_of(sensor: mi.Sensor, n: int) -> Sample:
    """Samples of n x n camera rays in the cells of a grid over the film, row by row."""
    i = dr.arange(mi.UInt32, n * n)
    return Sample(sensor.shutter_open(), mi.Float(0.5), glanced_at(i, n), mi.Point2f(0.5))


def glanced_at(i: mi.UInt32, n: int) -> mi.Point2f:
    """Film position of a ray by its index: see `glances_of`."""
    return (mi.Point2f(i % n, i // n) + 0.5) / n


def slopes_of(sensor: mi.Sensor, sample: Sample) -> Slopes:
    """Derivative of a ray by its film position. Detached."""
    o, d = [], []
    with dr.suspend_grad():
        for step in (mi.Vector2f(STEP, 0), mi.Vector2f(0, STEP)):
            a, b = (sample.at(sample.place + side * step).ray(sensor)[0] for side in (-1, 1))
            o.append((b.o - a.o) / (2 * STEP))
            d.append((b.d - a.d) / (2 * STEP))
    return o, d


def _is_carried(sensor: mi.Sensor) -> bool:
    """Whether the camera translates: the flow of a pinhole that only turns contains all of its motion."""
    poses = with_gradients(sensor, "to_world")
    if sensor.class_name() != PINHOLE:
        return bool(poses)
    with dr.resume_grad():
        return any(dr.grad_enabled(pose.matrix[row, 3]) for pose in poses for row in range(3))


def _distance(scene: mi.Scene, sensor: mi.Sensor) -> mi.Float:
    """The harmonic mean of distances to what a sensor sees: places move by parallax in proportion to 1 / distance."""
    with dr.suspend_grad():
        ray, _ = glances_of(sensor, GLANCES).ray(sensor)
        hit = scene.ray_intersect_preliminary(ray, coherent=True)
        closeness = dr.mean(dr.select(hit.is_valid(), dr.rcp(hit.t), 0))
        return dr.select(closeness > 0, dr.rcp(closeness), 1)
