"""BSDFs on light paths: the adjoint of the scattering that camera paths use.

Let n_s be the shading normal and n_g the geometric normal. On camera paths, light that arrives from ω_l and is
scattered into ω_c has the weight F = f(ω_c, ω_l) |ω_l·n_s|. Light paths carry flux, which is proportional to the cosine
between direction and geometric normal. On light paths, the weight is therefore

    F |ω_c·n_g| / |ω_l·n_g|        [Veach, Robust Monte Carlo Methods for Light Transport Simulation, 1997, p. 155]

Here F is evaluated exactly as on camera paths, with ``wi`` = ω_c and ``wo`` = ω_l. At the vertices of light paths,
however, ``si.wi`` is ω_l. `smooth_adjoint` therefore exchanges the two directions. The quotient of cosines does not
contain n_s. The weight is therefore also correct for BSDFs that perturb the normal (`bumpmap`, `normalmap`), for which
Mitsuba does not return n_s.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from pathreplay.transport.arrive import Vertex


def smooth_adjoint(v: Vertex, wo: mi.Vector3f, active: mi.Bool) -> mi.Spectrum:
    """Evaluate F |ω_c·n_g| / |ω_l·n_g| for the smooth lobes, with ω_c the local direction ``wo`` (Spectrum)."""
    turned = mi.SurfaceInteraction3f(v.si)
    turned.wi = wo
    return v.bsdf.eval(mi.BSDFContext(), turned, v.si.wi, active) * _tilt(v, wo)


def delta_adjoint(v: Vertex, wo: mi.Vector3f, eta: mi.Float) -> mi.Float:
    """Return the factor by which the weight of a delta lobe sampled in importance mode must be multiplied.

    The normal at which the light is reflected or refracted is parallel to h = ω_l + η ω_c, with η the relative index of
    refraction across the lobe. Refraction changes solid angles by |h·ω_l| / |h·ω_c| times a power of η. The returned
    factor contains this quotient, but no power of η, which is not part of weights in importance mode.
    """
    cos = dr.dot(v.si.wi, wo)
    a, b = 1 + eta * cos, cos + eta  # h·ω_l and h·ω_c
    regular = (a != 0) & (b != 0)
    return dr.select(regular, dr.abs(a) * dr.rcp(dr.abs(dr.select(regular, b, 1))), 1) * _tilt(v, wo)


def _tilt(v: Vertex, wo: mi.Vector3f) -> mi.Float:
    n = v.si.to_local(v.si.n) if v.n is None else v.n
    before = dr.abs(dr.dot(n, v.si.wi))
    lit = before > 0
    return dr.select(lit, dr.abs(dr.dot(n, wo)) * dr.rcp(dr.select(lit, before, 1)), 0)
