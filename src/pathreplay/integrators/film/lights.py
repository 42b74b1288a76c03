"""Lights that the camera sees, from which film flows keep away.

Film positions that move across a static light must sample its edge and the motion of all its radiance. Both are large,
and cancel on average only. In the disc of the sun of a `sunsky`, only the second part can be sampled, because the edge
of the disc is no edge of a surface. A film flow is therefore zero near static lights, and contains no parallax near
bright parts of the sky.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from pathreplay.integrators.film.grid import CELLS, REACH, distance_to
from pathreplay.integrators.film.sample import film_velocity, probes_of, ray_derivatives
from pathreplay.samplers.counter_sampler import CounterSampler

BRIGHT = 2.0
"""Density per steradian above which a part of the sky is bright; the density of uniform directions is 0.08."""
ORTHOGRAPHIC = "OrthographicCamera"
AWAY = 1.5 / CELLS
"""Distance from a light, in film widths, up to which a flow is zero. It exceeds the diagonal of a cell of the grid."""


@dataclass(frozen=True)
class SeenLights:
    """Points of lights that may be visible at film positions."""

    position: mi.Point2f
    hit: mi.PreliminaryIntersection3f  # what the camera sees at the position
    sky: mi.Bool  # a bright part of the sky is visible
    shape: mi.Bool  # a shape that emits light is visible

    @staticmethod
    def of(scene: mi.Scene, sensor: mi.Sensor) -> SeenLights:
        """Sample points of lights as they are sampled from the sensor's position. The result is detached."""
        with dr.suspend_grad():
            sample = probes_of(sensor)
            origin = dr.zeros(mi.Interaction3f)
            origin.p = sample.ray(sensor)[0].o
            sampler = CounterSampler.of(dr.arange(mi.UInt32, dr.width(sample.position)))
            light, _ = scene.sample_emitter_direction(origin, sampler.next_2d(), False)
            position, inside = _position_of(sensor, light.p)
            hit = scene.ray_intersect_preliminary(mi.Ray3f(sample.at(position).ray(sensor)[0]), coherent=False)
            active = (light.pdf > 0) & ~light.delta & inside
            flags, glows = light.emitter.flags(), hit.shape.emitter() != None  # noqa: E711
            bright = light.pdf * len(scene.emitters()) > BRIGHT
            sky = active & mi.has_flag(flags, mi.EmitterFlags.Infinite) & bright & ~hit.is_valid()
            shape = active & mi.has_flag(flags, mi.EmitterFlags.Surface) & hit.is_valid() & glows
            dr.eval(position, hit, sky, shape)
            return SeenLights(position, hit, sky, shape)

    def share_kept(self, near: mi.Bool) -> mi.Float:
        """Return the share of a flow that remains at each node of the grid: 0 near the lights in the lanes ``near``."""
        return dr.square(dr.clip((distance_to(self.position, near) - AWAY) / REACH, 0, 1))


def _position_of(sensor: mi.Sensor, p: mi.Point3f) -> tuple[mi.Point2f, mi.Bool]:
    """Return the film position at which the camera would see a point, and whether it lies on the film.

    Mitsuba's orthographic camera does not project points, but its film positions are linear functions of points.
    """
    if sensor.class_name() == ORTHOGRAPHIC:
        middle = probes_of(sensor).at(mi.Point2f(0.5))
        ray = middle.ray(sensor)[0]
        t = dr.dot(p - ray.o, ray.d)
        position = mi.Point2f(middle.position + film_velocity(p - ray(t), ray_derivatives(sensor, middle), t))
        return position, (t > 0) & dr.all((position >= 0) & (position <= 1))
    point = dr.zeros(mi.Interaction3f)
    point.p = p
    seen, _ = sensor.sample_direction(point, mi.Point2f(0.5))
    return mi.Point2f(seen.uv) / mi.ScalarVector2f(sensor.film().crop_size()), seen.pdf > 0
