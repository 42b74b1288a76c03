"""Lights that the camera sees, near which film flows are zero.

If film positions moved across a static light, the motion of its edge and of its whole radiance would have to be
sampled. Both terms are large, and they cancel only on average. In the disc of the sun of a `sunsky`, the first term
would even be missing, because the edge of the disc is not the edge of a surface. A film flow is therefore zero near
static lights, and contains no parallax near bright parts of the sky.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from pathreplay.integrators.film.grid import CELLS, REACH, distance_to
from pathreplay.integrators.film.sample import ORTHOGRAPHIC, Sample, film_velocity, probes_of, ray_derivatives
from pathreplay.platform import compat
from pathreplay.samplers.counter_sampler import CounterSampler
from pathreplay.transport.meet import meet
from pathreplay.transport.vertex import TraceConfig
from pathreplay.transport.volume.passage import skip_null

BRIGHT = 2.0
"""Density per steradian of an emitter's samples above which a part of the sky is bright; uniform samples have 0.08."""
MOST = 8
"""Largest number of sampled points of emitters, relative to the number of probe rays."""
AWAY = 1.5 / CELLS
"""Distance from a light, in film widths, up to which a flow is zero. It exceeds the diagonal of a cell of the grid."""


@dataclass(frozen=True)
class SeenLights:
    """Film positions at which lights may be visible."""

    position: mi.Point2f
    hit: mi.PreliminaryIntersection3f  # what the camera sees at the position
    sky: mi.Bool  # a bright part of the sky is visible
    shape: mi.Bool  # a shape that emits light towards the camera is visible

    @staticmethod
    def of(trace: TraceConfig, sensor: mi.Sensor) -> SeenLights:
        """Test the positions of probe rays, and positions at which points of emitters would be visible; detached."""
        scene = trace.scene
        with dr.suspend_grad():
            sample = probes_of(sensor)
            probes = dr.width(sample.position)
            per_probe = min(-(-len(scene.emitters()) // probes), MOST)
            position, inside, bright = _emitters_on_film(scene, sensor, sample, max(per_probe, 1) * probes)
            position = mi.Point2f(*(dr.concat([sample.position[k], position[k]]) for k in (0, 1)))
            inside = dr.concat([dr.full(mi.Bool, True, probes), inside])
            bright = dr.concat([dr.full(mi.Bool, False, probes), bright])
            ray = mi.Ray3f(sample.at(position).ray(sensor)[0])
            hit = meet(trace, ray, inside)
            glows = _shines(trace, ray, hit, inside)
            if trace.media is not None:
                behind = skip_null(trace, ray, hit, inside)
                hit = dr.select(glows, hit, behind)
                glows |= _shines(trace, ray, behind, inside)
            met = inside & hit.is_valid()
            passes = ~met | mi.has_flag(hit.shape.bsdf().flags(), mi.BSDFFlags.Null)  # the sky is visible
            sky, shape = inside & bright & passes, glows
            dr.eval(position, hit, sky, shape)
            return SeenLights(position, hit, sky, shape)

    def share_kept(self, near: mi.Bool) -> mi.Float:
        """Return the share of a flow that remains at each node of the grid: 0 near the lights in the lanes ``near``."""
        return dr.square(dr.clip((distance_to(self.position, near) - AWAY) / REACH, 0, 1))


def _shines(trace: TraceConfig, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, active: mi.Bool) -> mi.Bool:
    """Return whether the surface that a ray hits emits light towards the origin of the ray."""
    met = active & hit.is_valid()
    si = hit.compute_surface_interaction(ray, compat.minimal(), met)
    return met & dr.any(si.emitter(trace.scene, met).eval(si, met) > 0)


def _emitters_on_film(
    scene: mi.Scene, sensor: mi.Sensor, sample: Sample, n: int
) -> tuple[mi.Point2f, mi.Bool, mi.Bool]:
    """Sample n points of emitters with extent, as seen from the origins of camera rays, and project them onto the film.

    All emitters get equally many points; if there are more than n, one in several gets a point. Returns the positions,
    and two masks: whether a position lies on the film, and whether the point is a bright part of the sky.
    """
    count = len(scene.emitters())
    if count == 0:
        return dr.zeros(mi.Point2f, n), dr.full(mi.Bool, False, n), dr.full(mi.Bool, False, n)
    i = dr.arange(mi.UInt32, n)
    origin, sources = dr.zeros(mi.Interaction3f, n), sample.ray(sensor)[0].o
    origin.p = dr.gather(mi.Point3f, sources, i % dr.width(sources))
    emitter = dr.gather(mi.EmitterPtr, scene.emitters_dr(), i % count if count <= n else i * (count // n))
    light, _ = emitter.sample_direction(origin, CounterSampler.of(i).next_2d(), True)
    sky, extended = mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite), (light.pdf > 0) & ~light.delta
    if sensor.class_name() == ORTHOGRAPHIC:
        # Mitsuba does not project points here, but film positions are linear functions of points. All rays see the same
        # point of the sky.
        middle = sample.at(mi.Point2f(0.5))
        ray = middle.ray(sensor)[0]
        t = dr.dot(light.p - ray.o, ray.d)
        motion = film_velocity(light.p - ray(t), ray_derivatives(sensor, middle), mi.Float(1))
        position = mi.Point2f(middle.position + motion)
        return position, extended & ~sky & (t > 0) & dr.all((position >= 0) & (position <= 1)), mi.Bool(sky)
    distance = dr.sqrt(sensor.near_clip() * sensor.far_clip())  # a projection leaves out what is beyond the clips
    point = dr.zeros(mi.Interaction3f, n)
    point.p = dr.select(sky, origin.p + distance * light.d, light.p)
    seen, _ = sensor.sample_direction(point, mi.Point2f(0.5))
    position = mi.Point2f(seen.uv) / mi.ScalarVector2f(sensor.film().crop_size())
    return position, extended & (seen.pdf > 0), sky & (light.pdf > BRIGHT)
