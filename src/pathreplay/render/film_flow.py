"""Film flow: the motion of a camera as motion of places on its film, which needs no edges.

A camera that turns sees the same radiance at other places. Let s be a place on the film, c(s, π) its camera ray, and
T(s, π) where a chosen flow takes the place, with T(s, π₀) = s and the velocity v = ∂T/∂π. An integral over the film D
with weights W does not depend on how places are parametrised:

    ∫ W(s) L(c(s, π)) ds = ∫ W(T) L(c(T, π)) |∂T/∂s| ds,

and so its derivative has two parts. One belongs to the weights, with n normal to the border of D (see `FilmMotion`):

    ∫_D div(W v) L ds - ∮_∂D W L v·n dl

The other is that of L along the ray c(T, π), which moves by ∂c/∂π + ∂c/∂s v, the *rest* of the motion. Any smooth v
will do. This one keeps points at a distance r where they are: with p = o + r d on the ray, v = -(∂p/∂s)⁺ ∂p/∂π. A
camera that turns, or widens its view, leaves no rest; one that is carried along leaves parallax.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..gradient.adjoint import tangents
from ..transport.motion import moving_shapes
from ..transport.nodes import with_gradients
from ..transport.vertex import Walk
from .seen_flow import SeenFlow, Slopes, followed

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
    camera_moves: bool  # whether the camera has gradients
    leaves_rest: bool  # whether its rays move with parameters beyond its flow
    is_all: bool  # whether nothing but the places of the film depends on parameters with gradients
    seen: SeenFlow | None = None  # of the motion that the rest of the flow does not follow

    @staticmethod
    def following(scene: mi.Scene, sensor: mi.Sensor, walk: Walk, camera: FilmFlow | None) -> FilmFlow:
        """The flow of a sensor that follows all that it sees move, with that of the ``camera`` as a part of it."""
        walk = replace(walk, traits=replace(walk.traits, moving=moving_shapes(scene, scene.sensors())))
        flow = camera or FilmFlow(sensor, mi.Float(1), False, False, False)

        def glance(place: mi.Point2f) -> tuple[mi.Ray3f, Slopes]:
            of_ray = sensor.shutter_open(), mi.Float(0.5), place, mi.Point2f(0.5)
            return mi.Ray3f(flow.ray(*of_ray)[0]), flow._slopes(*of_ray)

        return replace(flow, seen=SeenFlow.of(walk, glance, flow.leaves_rest))

    @staticmethod
    def of(scene: mi.Scene, sensor: mi.Sensor) -> FilmFlow | None:
        """The flow of a sensor; None if it has no gradients, or its class is not one of `CAMERAS`."""
        if sensor.class_name() not in CAMERAS or not with_gradients(sensor, *ONLY_PLACES, *OTHERS):
            return None
        rest = _is_carried(sensor) or bool(with_gradients(sensor, *OTHERS[1:]))
        others = any(with_gradients(thing) for thing in (*scene.shapes(), *scene.emitters()))
        alone = not (rest or others or with_gradients(sensor, "medium"))
        return FilmFlow(sensor, _distance(scene, sensor), True, rest, alone)

    def ray(
        self, time: mi.Float, wavelength: mi.Float, place: mi.Point2f, aperture: mi.Point2f
    ) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
        """The sensor's ray through a place and its weight: see Mitsuba's Sensor.

        If the place has gradients, the ray depends on it; otherwise it carries the rest of the camera's motion.
        """
        ray, weight = self.sensor.sample_ray_differential(time, wavelength, place, aperture)
        if dr.grad_enabled(place):
            return ray, weight
        carried = self.leaves_rest and dr.grad_enabled(ray.o, ray.d)
        if not carried:
            ray.o, ray.d = dr.detach(ray.o), dr.detach(ray.d)
        if carried or self._sees_motion():
            o, d = slopes = self._slopes(time, wavelength, place, aperture)
            v = self._velocity(ray, slopes, place)
            ray.o += o[0] * v.x + o[1] * v.y
            ray.d += d[0] * v.x + d[1] * v.y
        return ray, weight

    def place(self, time: mi.Float, wavelength: mi.Float, place: mi.Point2f, aperture: mi.Point2f) -> mi.Point2f:
        """T: the place, attached to the parameters."""
        ray, _ = self.sensor.sample_ray_differential(time, wavelength, place, aperture)
        return place + self._velocity(ray, self._slopes(time, wavelength, place, aperture), place)

    def moves_at(self, place: mi.Point2f) -> mi.Bool:
        """Whether a place may move over the film."""
        return mi.Bool(True) if self.seen is None or self.camera_moves else self.seen.is_at(place)

    def leaves_rest_at(self, place: mi.Point2f) -> mi.Bool:
        """Whether the ray through a place may move beyond the flow."""
        return mi.Bool(self.leaves_rest) if self.seen is None or self.leaves_rest else self.seen.is_at(place)

    def carry_tangents(self) -> None:
        """Carry tangents from the parameters to what terms ask for, once for all of them."""
        if self.seen is not None:
            with dr.resume_grad():
                tangents(self.seen.nodes)

    def _sees_motion(self) -> bool:
        return self.seen is not None and dr.grad_enabled(self.seen.nodes)

    def _velocity(self, ray: mi.Ray3f, slopes: Slopes, place: mi.Point2f) -> mi.Vector2f:
        """T - s, of which the value is zero."""
        v = mi.Vector2f(0)
        if dr.grad_enabled(ray.o, ray.d):
            v -= followed((ray.o - dr.detach(ray.o)) + self.r * (ray.d - dr.detach(ray.d)), *slopes, self.r)
        return v + self.seen.velocity(place) if self._sees_motion() else v

    def _slopes(self, time: mi.Float, wavelength: mi.Float, place: mi.Point2f, aperture: mi.Point2f) -> Slopes:
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


def can_follow(walk: Walk, sensor: mi.Sensor) -> bool:
    """Whether places may follow what is seen: then all else slides under them, and all of its edges have to be found.

    Those in textures, behind mirrors, glass and sheets, and on bent curves are not, and media are not asked.
    """
    traits = walk.traits
    hidden = traits.seams or traits.mirrors or traits.veils or traits.splines
    return walk.media is None and not hidden and sensor.class_name() in CAMERAS


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
