"""Hard shadows: what keeps a light without extent from a point, and how far a point is from where that ends.

The border of such a shadow is an edge for whoever sees the surface it falls on: the camera, or a point that scatters.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from pathreplay.samplers.counter_sampler import CounterSampler
from pathreplay.transport.emitters import draw_emitter
from pathreplay.transport.meet import meet
from pathreplay.transport.signature import edge_normal, outline_gap
from pathreplay.transport.vertex import Arrival, TraceConfig, VertexSamples, is_smooth
from pathreplay.transport.volume.passage import skip_null


@dataclass
class ShadowTest:
    """What keeps a light from a point: something between, or that it is outside of a projector's picture or a cone."""

    u: mi.Point2f  # which light
    ray: mi.Ray3f  # towards it
    hit: mi.PreliminaryIntersection3f
    outside: mi.Bool  # of the picture, or of the cone of a spot that ends at once
    uv: mi.Point2f  # place in it

    @staticmethod
    def of(trace: TraceConfig, at: Arrival, numbers: CounterSampler, k: mi.UInt32, active: mi.Bool) -> ShadowTest:
        """That of the light which is sampled where a path arrives as its k-th vertex, if that has no extent.

        ``numbers`` are those of the vertex.
        """
        u = VertexSamples.draw(numbers).light
        si = at.hit.compute_surface_interaction(at.ray, mi.RayFlags.All, active)
        scatters = _scatters(trace, si, k, active)
        light, Le = draw_emitter(trace.scene, si, u, scatters, visible=False)
        lit = scatters & (light.pdf != 0)
        ray = si.spawn_ray_to(light.p)
        hit = meet(trace, ray, lit & light.delta)
        if trace.clear:
            hit = skip_null(trace, ray, hit, lit)
        outside = mi.Bool(False)
        for projector in trace.traits.projectors:
            outside |= (light.pdf == 0) & (light.emitter == mi.EmitterPtr(projector))
        for spot in trace.traits.spots:
            outside |= (light.emitter == mi.EmitterPtr(spot)) & _ends_at_once(spot) & dr.all(Le == 0)
        return ShadowTest(u, ray, hit, outside & scatters, light.uv)

    @property
    def dark(self) -> mi.Bool:
        return self.outside | self.hit.is_valid()

    def normal(self, active: mi.Bool) -> mi.Vector3f:
        """That of the edge of what is between: see `edge_normal`."""
        return edge_normal(self.hit, self.ray, active & ~self.outside)

    def gap(
        self, trace: TraceConfig, n: mi.Vector3f, met: mi.PreliminaryIntersection3f, ray: mi.Ray3f, active: mi.Bool
    ) -> mi.Float:
        """B: zero where the shadow on the surface that was ``met`` ends; ``n`` is the `normal`.

        Differentiable in the ray, which slides over that surface, in the surfaces and in the light.
        """
        si = met.compute_surface_interaction(ray, mi.RayFlags.All, active)
        light, _ = trace.scene.sample_emitter_direction(si, self.u, False, active)
        shadow = outline_gap(n, si.p, light.d, self.hit, self.ray, active & ~self.outside)
        if not trace.traits.projectors and not trace.traits.spots:
            return shadow
        beside = (self.uv.x < 0) | (self.uv.x > 1)
        border = dr.select(dr.select(beside, self.uv.x, self.uv.y) > 0.5, mi.Float(1), 0)
        gap = dr.select(beside, light.uv.x, light.uv.y) - border
        for spot in trace.traits.spots:
            gap = dr.select(light.emitter == mi.EmitterPtr(spot), _inside_cone(spot, light), gap)
        return dr.select(active & self.outside, gap, shadow)


@dataclass
class HardShadow:
    """The border of a hard shadow, which is between two places of what a ray meets."""

    trace: TraceConfig
    there: mi.Bool
    in_a: mi.Bool  # whether the first of the places is in the shadow
    shade: ShadowTest  # of the place in the shadow
    n: mi.Vector3f

    @staticmethod
    def between(trace: TraceConfig, a: ShadowTest, b: ShadowTest, active: mi.Bool) -> HardShadow:
        """That between two places, of which one is in the shadow and the other is not. Detached."""
        there, shade = active & (a.dark != b.dark), dr.select(a.dark, a, b)
        return HardShadow(trace, there, a.dark, shade, shade.normal(there))

    def gap(self, met: mi.PreliminaryIntersection3f, ray: mi.Ray3f, active: mi.Bool) -> mi.Float:
        """B: see `ShadowTest.gap`."""
        return self.shade.gap(self.trace, self.n, met, ray, active & self.there)


def _ends_at_once(spot: mi.Emitter) -> mi.Bool:
    """Whether the light of a spot does not fade towards the border of its cone, which is an edge then."""
    angles = mi.traverse(spot)
    return dr.detach(angles["beam_width"]) >= dr.detach(angles["cutoff_angle"])


def _inside_cone(spot: mi.Emitter, light: mi.DirectionSample3f) -> mi.Float:
    """How far its sample is inside of the cone of a spot, as a difference of cosines; differentiable in both."""
    axis = dr.normalize(spot.world_transform() @ mi.Vector3f(0, 0, 1))
    return -dr.dot(axis, light.d) - dr.cos(dr.deg2rad(mi.traverse(spot)["cutoff_angle"]))


def light_of(
    trace: TraceConfig, si: mi.SurfaceInteraction3f, u: mi.Point2f, k: mi.UInt32, active: mi.Bool
) -> tuple[mi.DirectionSample3f, mi.Bool]:
    """The emitter sample of the k-th vertex, and whether there is any."""
    lit = _scatters(trace, si, k, active)
    light, _ = draw_emitter(trace.scene, si, u, lit, visible=False)
    return light, lit & (light.pdf != 0)


def _scatters(trace: TraceConfig, si: mi.SurfaceInteraction3f, k: mi.UInt32, active: mi.Bool) -> mi.Bool:
    """Whether the k-th vertex scatters light of emitters."""
    return active & si.is_valid() & is_smooth(si.bsdf()) & (k + 1 < trace.max_depth)
