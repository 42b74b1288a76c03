"""Hard shadows: what keeps a light without extent from a point, and how far a point is from where that ends.

The border of such a shadow is an edge as seen from the camera or from a vertex that sees the surface on which it falls.
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
    """What keeps a light from a point: an occluder, or the border of a projector's image or of a spot's cone."""

    u: mi.Point2f  # which light
    lit: mi.Bool  # there is such a light, which has no extent
    Le: mi.Spectrum  # over the probability of the light
    ray: mi.Ray3f  # towards it
    hit: mi.PreliminaryIntersection3f
    outside: mi.Bool  # of the image, or of a cone without falloff
    uv: mi.Point2f  # place in it
    met: mi.PreliminaryIntersection3f = None  # the point, if it is on the surface that a ray met

    @staticmethod
    def of(trace: TraceConfig, at: Arrival, numbers: CounterSampler, k: mi.UInt32, active: mi.Bool) -> ShadowTest:
        """That of the light which is sampled where a path arrives as its k-th vertex; ``numbers`` are the vertex's."""
        u = VertexSamples.draw(numbers).light
        si = at.hit.compute_surface_interaction(at.ray, mi.RayFlags.All, active)
        test = ShadowTest.at(trace, si, u, _scatters(trace, si, k, active))
        test.met = at.hit
        return test

    @staticmethod
    def at(trace: TraceConfig, x: mi.Interaction3f, u: mi.Point2f, active: mi.Bool) -> ShadowTest:
        """That of the light which ``u`` samples from a point. In media, borders of images and cones are left out."""
        light, Le = draw_emitter(trace.scene, x, u, active, visible=False)
        found = active & (light.pdf != 0)
        lit, ray = found & light.delta, x.spawn_ray_to(light.p)
        hit = meet(trace, ray, lit)
        if trace.skips_null or trace.media is not None:
            hit = skip_null(trace, ray, hit, lit)
        outside = mi.Bool(False)
        if trace.media is None:
            for projector in trace.traits.projectors:
                outside |= (light.pdf == 0) & (light.emitter == mi.EmitterPtr(projector))
            for spot in trace.traits.spots:
                outside |= (light.emitter == mi.EmitterPtr(spot)) & _ends_at_once(spot) & dr.all(Le == 0)
        return ShadowTest(u, lit, Le, ray, hit, outside & active, light.uv)

    @property
    def dark(self) -> mi.Bool:
        return self.outside | self.hit.is_valid()


@dataclass
class HardShadow:
    """The border of a hard shadow between two points of a surface, if one is in the shadow and the other is not."""

    trace: TraceConfig
    there: mi.Bool
    in_a: mi.Bool  # whether the first of the points is in the shadow
    test: ShadowTest  # of the point in the shadow
    n: mi.Vector3f  # normal to the edge of what is between: see `edge_normal`

    @staticmethod
    def between(trace: TraceConfig, a: ShadowTest, b: ShadowTest, active: mi.Bool) -> HardShadow:
        """Detached."""
        there, test = active & (a.dark != b.dark), dr.select(a.dark, a, b)
        return HardShadow(trace, there, a.dark, test, edge_normal(test.hit, test.ray, there & ~test.outside))

    def gap(self, ray: mi.Ray3f, active: mi.Bool) -> mi.Float:
        """B. Differentiable in the ray, which slides over the surface, in the surfaces and in the light."""
        si = self.test.met.compute_surface_interaction(ray, mi.RayFlags.All, active & self.there)
        return self.gap_at(si, active)

    def gap_at(self, x: mi.Interaction3f, active: mi.Bool) -> mi.Float:
        """B, as a function of the point. Differentiable in the point, in the surfaces and in the light."""
        test, traits, active = self.test, self.trace.traits, active & self.there
        light, _ = self.trace.scene.sample_emitter_direction(x, test.u, False, active)
        shadow = outline_gap(self.n, x.p, light.d, test.hit, test.ray, active & ~test.outside)
        if not traits.projectors and not traits.spots:
            return shadow
        beside = (test.uv.x < 0) | (test.uv.x > 1)
        border = dr.select(dr.select(beside, test.uv.x, test.uv.y) > 0.5, mi.Float(1), 0)
        gap = dr.select(beside, light.uv.x, light.uv.y) - border
        for spot in traits.spots:
            gap = dr.select(light.emitter == mi.EmitterPtr(spot), _inside_cone(spot, light), gap)
        return dr.select(active & test.outside, gap, shadow)


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
