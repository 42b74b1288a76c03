"""Film flow: the motion of a camera as motion of places on its film, which needs no edges.

A camera that turns sees the same radiance at other places. Let s be a place on the film, c(s, π) its camera ray, and
T(s, π) where a chosen flow takes the place, with T(s, π₀) = s and the velocity v = ∂T/∂π. An integral over the film D
with weights W does not depend on how places are parametrised:

    ∫ W(s) L(c(s, π)) ds = ∫ W(T) L(c(T, π)) |∂T/∂s| ds,

and so its derivative has two parts. One belongs to the weights, with n normal to the border of D (see `CameraMotion`):

    ∫_D div(W v) L ds - ∮_∂D W L v·n dl

The other is that of L along the ray c(T, π), which moves by ∂c/∂π + ∂c/∂s v, the *rest* of the motion. Any smooth v
will do. This one keeps points at a distance r where they are: with p = o + r d on the ray, v = -(∂p/∂s)⁺ ∂p/∂π. A
camera that turns, or widens its view, leaves no rest; one that is carried along leaves parallax.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..transport.nodes import with_gradients

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


@dataclass(frozen=True)
class FilmFlow:
    """The flow of a sensor's film, whose places are in widths and heights of it."""

    sensor: mi.Sensor
    r: mi.Float  # at this distance nothing moves over the film
    leaves_rest: bool  # whether rays move with parameters beyond the flow
    is_all: bool  # whether nothing but the places of the film depends on parameters with gradients

    @staticmethod
    def of(scene: mi.Scene, sensor: mi.Sensor) -> FilmFlow | None:
        """The flow of a sensor; None if it has no gradients, or its class is not one of `CAMERAS`."""
        if sensor.class_name() not in CAMERAS or not with_gradients(sensor, *ONLY_PLACES, *OTHERS):
            return None
        rest = _is_carried(sensor) or bool(with_gradients(sensor, *OTHERS[1:]))
        others = any(with_gradients(thing) for thing in (*scene.shapes(), *scene.emitters()))
        alone = not (rest or others or with_gradients(sensor, "medium"))
        return FilmFlow(sensor, _distance(scene, sensor), rest, alone)

    def ray(
        self, time: mi.Float, wavelength: mi.Float, place: mi.Point2f, aperture: mi.Point2f
    ) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
        """The sensor's ray through a place and its weight: see Mitsuba's Sensor.

        If the place has gradients, the ray depends on it; otherwise it carries the rest of the camera's motion.
        """
        ray, weight = self.sensor.sample_ray_differential(time, wavelength, place, aperture)
        if dr.grad_enabled(place) or not dr.grad_enabled(ray.o, ray.d):
            return ray, weight
        if not self.leaves_rest:
            return dr.detach(ray), weight
        o, d = self._slopes(time, wavelength, place, aperture)
        v = self._followed(ray, o, d)
        ray.o += o[0] * v.x + o[1] * v.y
        ray.d += d[0] * v.x + d[1] * v.y
        return ray, weight

    def place(self, time: mi.Float, wavelength: mi.Float, place: mi.Point2f, aperture: mi.Point2f) -> mi.Point2f:
        """T: the place, attached to the parameters."""
        ray, _ = self.sensor.sample_ray_differential(time, wavelength, place, aperture)
        return place + self._followed(ray, *self._slopes(time, wavelength, place, aperture))

    def _followed(self, ray: mi.Ray3f, o: list[mi.Vector3f], d: list[mi.Vector3f]) -> mi.Vector2f:
        """T - s, of which the value is zero, by least squares: from a ray, and its slopes."""
        δp = (ray.o - dr.detach(ray.o)) + self.r * (ray.d - dr.detach(ray.d))
        p_x, p_y = (o_k + self.r * d_k for o_k, d_k in zip(o, d, strict=True))
        xx, xy, yy = dr.dot(p_x, p_x), dr.dot(p_x, p_y), dr.dot(p_y, p_y)
        x, y = dr.dot(p_x, δp), dr.dot(p_y, δp)
        return mi.Vector2f(yy * x - xy * y, xx * y - xy * x) / (xy * xy - xx * yy)

    def _slopes(
        self, time: mi.Float, wavelength: mi.Float, place: mi.Point2f, aperture: mi.Point2f
    ) -> tuple[list[mi.Vector3f], list[mi.Vector3f]]:
        """∂o/∂s and ∂d/∂s, along both axes."""
        o, d = [], []
        with dr.suspend_grad():
            for step in (mi.Vector2f(STEP, 0), mi.Vector2f(0, STEP)):
                a, b = (
                    self.sensor.sample_ray_differential(time, wavelength, place + side * step, aperture)[0]
                    for side in (-1, 1)
                )
                o.append((b.o - a.o) / (2 * STEP))
                d.append((b.d - a.d) / (2 * STEP))
        return o, d


def _is_carried(sensor: mi.Sensor) -> bool:
    """Whether its pose has gradients, and leaves a rest: a pinhole that only turns leaves none."""
    poses = with_gradients(sensor, "to_world")
    if sensor.class_name() != PINHOLE:
        return bool(poses)
    with dr.resume_grad():
        return any(dr.grad_enabled(pose.matrix[row, 3]) for pose in poses for row in range(3))


def _distance(scene: mi.Scene, sensor: mi.Sensor) -> mi.Float:
    """The harmonic mean of distances to what a sensor sees: places move by parallax in proportion to 1 / distance."""
    with dr.suspend_grad():
        i = dr.arange(mi.UInt32, GLANCES * GLANCES)
        place = (mi.Point2f(i % GLANCES, i // GLANCES) + 0.5) / GLANCES
        ray, _ = sensor.sample_ray_differential(sensor.shutter_open(), 0.5, place, mi.Point2f(0.5))
        hit = scene.ray_intersect_preliminary(ray, coherent=True)
        closeness = dr.mean(dr.select(hit.is_valid(), dr.rcp(hit.t), 0))
        return dr.select(closeness > 0, dr.rcp(closeness), 1)
