"""Connect: next-event estimation, the radiance of an emitter sample that a vertex scatters back along the path."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from pathreplay.samplers.sampler import Sampler
from pathreplay.transport.arrive import Vertex
from pathreplay.transport.emitters import draw_emitter, redraw_emitter
from pathreplay.transport.scatter import towards
from pathreplay.transport.vertex import Shadow, TraceConfig, VertexRecord, VertexSamples, is_smooth, mis_weight
from pathreplay.transport.volume.shadow import shadow, shadow_again


@dataclass
class Connection:
    """An emitter sample as seen from a vertex."""

    light: mi.DirectionSample3f
    Le: mi.Spectrum  # emitted radiance over density, times the transmittance between emitter and vertex
    lit: mi.Bool  # the sample is valid and unoccluded
    shadow: Shadow = None  # type: ignore[assignment]  # None in scenes without media

    def mis(self, pdf: mi.Float) -> mi.Float:
        """Return the MIS weight; ``pdf`` is the density with which the vertex samples the direction to the emitter."""
        return dr.select(self.light.delta, 1, mis_weight(self.light.pdf, pdf))

    def reaches(self, pdf: mi.Float, attached: bool) -> mi.Spectrum:
        """Return the MIS-weighted radiance of the sample that reaches the vertex (Spectrum); for ``pdf`` see `mis`."""
        mis = self.mis(pdf)
        # The MIS weights of a detached path need no derivative: they sum to one for all values of the parameters.
        return self.Le * (mis if attached else dr.detach(mis))


def choose(trace: TraceConfig, v: Vertex, u: VertexSamples, sampler: Sampler, go_on: mi.Bool) -> Connection:
    """Sample an emitter at vertices that support next-event estimation, and test visibility. Detached.

    With media, a shadow ray estimates the transmittance.
    """
    if v.inside is None:
        lit = go_on & v.surface & is_smooth(v.bsdf)
        light, Le = draw_emitter(trace.scene, v.origin, u.light, lit)
        return Connection(light, Le, lit & (light.pdf != 0))
    event = v.inside.event
    lit = go_on & (v.surface | event)
    lit &= dr.select(event, v.inside.around.use_emitter_sampling(), is_smooth(v.bsdf))
    light, Le = draw_emitter(trace.scene, v.origin, u.light, lit, visible=False)
    lit &= light.pdf != 0
    dark = shadow(trace, v.origin.spawn_ray_to(light.p), v.medium(light.d), sampler, lit)
    return Connection(light, Le * dark.T, lit & dr.any(dark.T != 0), dark)


def repeat(trace: TraceConfig, v: Vertex, again: VertexRecord, ctx: mi.BSDFContext, attached: bool) -> mi.Spectrum:
    """Evaluate the next-event estimate of the recorded emitter sample again (Spectrum), differentiably.

    If ``attached``, the point on the emitter moves with the emitter. Visibility is not differentiated.
    """
    kept = again.kept
    if kept.known is not None and not attached:
        f = v.bsdf.eval(ctx, v.si, v.si.to_local(kept.known.d), kept.lit)
        return dr.select(kept.lit, f * kept.known.w, 0)
    light, Le = redraw_emitter(trace, v.origin, again.u.light, kept.light, attached, kept.lit)
    if kept.media is not None:
        Le *= shadow_again(trace, v.origin.spawn_ray_to(light.p), kept.media.shadow, attached, kept.lit)
    f, pdf = towards(v, ctx, light.d, kept.lit)
    return dr.select(kept.lit, f * Connection(light, Le, kept.lit).reaches(pdf, attached), 0)
