"""Hard shadows: test whether a light without extent reaches a point, and measure the distance to the shadow boundary.

The shadow boundary is an edge for the camera, and for every vertex that sees the surface on which the shadow falls. On
light paths, the sensor takes the place of the light: a point is dark if an occluder hides it from the sensor.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from pathreplay.platform import compat
from pathreplay.samplers.counter_sampler import CounterSampler
from pathreplay.samplers.sampler import Sampler
from pathreplay.samplers.streams import Stream
from pathreplay.transport import arrive, scatter
from pathreplay.transport.emitters import draw_emitter
from pathreplay.transport.meet import meet
from pathreplay.transport.sensor import SensorLink
from pathreplay.transport.signature import edge_normal, outline_gap
from pathreplay.transport.start import occluder
from pathreplay.transport.vertex import Arrival, Flight, TraceConfig, VertexSamples, is_smooth
from pathreplay.transport.volume.passage import skip_null, transmittance_past_edge


@dataclass
class ShadowTest:
    """Result of a shadow test, i.e. whether a light reaches a point.

    A point is dark if it is occluded, outside a projector's image, or outside the cone of a spot with a sharp cutoff.
    """

    u: mi.Point2f  # random numbers that select the light or, on light paths, the point on the aperture
    lit: mi.Bool  # the point was tested: a light without extent was sampled, or the point projects onto the film
    Le: mi.Spectrum  # radiance divided by the probability of the light; on light paths, importance (`Sighting.W`)
    ray: mi.Ray3f  # towards the light
    hit: mi.PreliminaryIntersection3f
    outside: mi.Bool  # the point is outside a projector's image, or outside the cone of a spot with a sharp cutoff
    uv: mi.Point2f  # position in the projector's image; on light paths, position on the film
    met: mi.PreliminaryIntersection3f | None = None  # surface hit at the tested point; None for a point in a medium

    @staticmethod
    def of(trace: TraceConfig, at: Arrival, sampler: CounterSampler, k: mi.UInt32, active: mi.Bool) -> ShadowTest:
        """Test whether a path's k-th vertex receives light from its emitter sample.

        ``sampler`` is positioned at the k-th vertex.
        """
        u = VertexSamples.draw(sampler).light
        si = at.hit.compute_surface_interaction(at.ray, compat.shading(), active)
        test = ShadowTest.at(trace, si, u, _scatters(trace, si, k, active))
        test.met = at.hit
        return test

    @staticmethod
    def at(trace: TraceConfig, x: mi.Interaction3f, u: mi.Point2f, active: mi.Bool) -> ShadowTest:
        """Test whether the light that ``u`` selects reaches ``x``. At points of a medium, only occlusion is tested."""
        if trace.to_sensor is not None:
            return _test_of_sensor(trace, trace.to_sensor, x, u, active)
        light, Le = draw_emitter(trace.scene, x, u, active, visible=False)
        valid = active & (light.pdf != 0)
        lit, ray = valid & light.delta, x.spawn_ray_to(light.p)
        hit = meet(trace, ray, lit)
        if trace.skips_null or trace.media is not None:
            hit = skip_null(trace, ray, hit, lit)
        outside = mi.Bool(False)
        if isinstance(x, mi.SurfaceInteraction3f):
            for projector in trace.traits.projectors:
                outside |= (light.pdf == 0) & (light.emitter == mi.EmitterPtr(projector))
            for spot in trace.traits.spots:
                outside |= (light.emitter == mi.EmitterPtr(spot)) & _has_sharp_cutoff(spot) & dr.all(Le == 0)
        return ShadowTest(u, lit, Le, ray, hit, outside & active, light.uv)

    @property
    def dark(self) -> mi.Bool:
        return self.outside | self.hit.is_valid()


def _test_of_sensor(
    trace: TraceConfig, link: SensorLink, x: mi.Interaction3f, u: mi.Point2f, active: mi.Bool
) -> ShadowTest:
    """Test whether the sensor sees ``x``. Hidden emitters (`hide_emitters`) are not seen, and do not occlude."""
    if trace.hide_emitters and trace.traits.area_lights and isinstance(x, mi.SurfaceInteraction3f):
        active = active & (x.shape.emitter() == None)  # noqa: E711 (an array of pointers)
    to = link.sight(x, u, active)
    lit, ray = active & to.valid, x.spawn_ray_to(to.end)
    return ShadowTest(u, lit, mi.Spectrum(to.W), ray, occluder(trace, ray, lit), mi.Bool(False), to.s)


@dataclass
class HardShadow:
    """Boundary of a hard shadow between two points. It exists if one of the points is dark and the other is not."""

    trace: TraceConfig
    exists: mi.Bool
    in_a: mi.Bool  # the first point is dark
    test: ShadowTest  # test of the dark point
    lit: ShadowTest  # test of the other point
    n: mi.Vector3f  # normal to the edge of the occluder: see `edge_normal`

    @staticmethod
    def between(trace: TraceConfig, a: ShadowTest, b: ShadowTest, active: mi.Bool) -> HardShadow:
        """Compare two shadow tests. The result is detached."""
        exists, (test, lit) = active & (a.dark != b.dark), (dr.select(a.dark, x, y) for x, y in ((a, b), (b, a)))
        return HardShadow(trace, exists, a.dark, test, lit, edge_normal(test.hit, test.ray, exists & ~test.outside))

    def scattered(self, trace: TraceConfig, at: Arrival, key: mi.UInt32, active: mi.Bool) -> mi.Spectrum:
        """Return the light of the sampled emitter that the lit point scatters back along its path. Detached.

        On a light path, return the contribution of the lit point to the film, times the adjoint of the image if there
        is one. ``at`` is the arrival at the lit point. The ``key`` determines the random numbers of the path.
        """
        active, sampler = active & self.exists, CounterSampler.stream(key, Stream.TRANSMITTANCE_OF_BEAM)
        flight = None if trace.media is None else Flight.none(trace.media)
        v = arrive.choose(trace, at, sampler, mi.Spectrum(1), active, flight)
        link = trace.to_sensor
        ctx = mi.BSDFContext(mi.TransportMode.Radiance if link is None else mi.TransportMode.Importance)
        L = scatter.towards(v, ctx, self.lit.ray.d, active)[0] * self.lit.Le
        if link is not None and link.adjoint is not None:
            L *= link.adjoint(self.lit.uv, at.ray.wavelengths, active)
        if trace.media is not None:
            L *= self.blocked(trace, v.medium(self.lit.ray.d), sampler, active)
        return dr.select(active, L, 0)

    def blocked(self, trace: TraceConfig, medium: mi.MediumPtr, sampler: Sampler, active: mi.Bool) -> mi.Spectrum:
        """Return the part of the light that only the lit point receives, in a scene with media. Detached.

        It is the transmittance of the shadow ray from the lit point, which starts in ``medium``, less the light that
        passes a half-transparent occluder.
        """
        occluded = active & ~self.test.outside & self.test.hit.is_valid()
        t = dr.select(occluded, self.test.hit.t, 0)  # without an occluder, the ray need not be split
        T = transmittance_past_edge(trace, self.lit.ray, t, medium, sampler, active)
        si = self.test.hit.compute_surface_interaction(self.test.ray, compat.shading(), occluded)
        passes = si.bsdf(self.test.ray).eval_null_transmission(si, occluded)
        return T * dr.select(occluded, 1 - passes, 1)

    def gap(self, ray: mi.Ray3f, active: mi.Bool) -> mi.Float:
        """Evaluate B, which is zero on the shadow boundary, at the hit of ``ray``.

        B is differentiable in the ray, the shapes, and the light or sensor.
        """
        assert self.test.met is not None
        si = self.test.met.compute_surface_interaction(ray, compat.shading(), active & self.exists)
        return self.gap_at(si, active)

    def gap_at(self, x: mi.Interaction3f, active: mi.Bool) -> mi.Float:
        """Evaluate B, which is zero on the shadow boundary, at ``x``.

        B is differentiable in ``x``, the shapes, and the light or sensor.
        """
        test, traits, active = self.test, self.trace.traits, active & self.exists
        if self.trace.to_sensor is not None:
            d = self.trace.to_sensor.sight(x, test.u, active).d
            return outline_gap(self.n, x.p, d, test.hit, test.ray, active)
        light, _ = self.trace.scene.sample_emitter_direction(x, test.u, False, active)
        shadow = outline_gap(self.n, x.p, light.d, test.hit, test.ray, active & ~test.outside)
        if not traits.projectors and not traits.spots:
            return shadow
        outside_u = (test.uv.x < 0) | (test.uv.x > 1)
        border = dr.select(dr.select(outside_u, test.uv.x, test.uv.y) > 0.5, mi.Float(1), 0)
        gap = dr.select(outside_u, light.uv.x, light.uv.y) - border
        for spot in traits.spots:
            gap = dr.select(light.emitter == mi.EmitterPtr(spot), _cone_gap(spot, light), gap)
        return dr.select(active & test.outside, gap, shadow)


def _has_sharp_cutoff(spot: mi.Emitter) -> mi.Bool:
    """Return whether the intensity of a spot light is discontinuous at its cutoff angle."""
    angles = mi.traverse(spot)
    return dr.detach(angles["beam_width"]) >= dr.detach(angles["cutoff_angle"])


def _cone_gap(spot: mi.Emitter, light: mi.DirectionSample3f) -> mi.Float:
    """Return the distance of a light direction from the boundary of a spot's cone, as a difference of cosines.

    The result is positive inside the cone, and differentiable in the direction and in the spot.
    """
    axis = dr.normalize(spot.world_transform() @ mi.Vector3f(0, 0, 1))
    return -dr.dot(axis, light.d) - dr.cos(dr.deg2rad(mi.traverse(spot)["cutoff_angle"]))


def sample_light(
    trace: TraceConfig, si: mi.SurfaceInteraction3f, u: mi.Point2f, k: mi.UInt32, active: mi.Bool
) -> tuple[mi.Vector3f, mi.Bool]:
    """Sample the direction to an emitter (on a light path, to the sensor) at the k-th vertex.

    Returns the direction, and whether it is valid.
    """
    lit = _scatters(trace, si, k, active)
    if trace.to_sensor is not None:
        to = trace.to_sensor.sight(si, u, lit)
        return to.d, lit & to.valid
    light, _ = draw_emitter(trace.scene, si, u, lit, visible=False)
    return light.d, lit & (light.pdf != 0)


def _scatters(trace: TraceConfig, si: mi.SurfaceInteraction3f, k: mi.UInt32, active: mi.Bool) -> mi.Bool:
    """Return whether the k-th vertex scatters emitter samples or, on a light path, light to the sensor."""
    smooth = active & si.is_valid() & is_smooth(si.bsdf())
    if trace.to_sensor is not None:
        return smooth & ((k > 0) | (not trace.to_sensor.caustics))
    return smooth & (k + 1 < trace.max_depth)
