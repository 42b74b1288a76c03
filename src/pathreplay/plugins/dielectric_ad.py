"""`dielectric_ad`: Mitsuba's `dielectric` with a differentiable index of refraction.

Let η be the interior index divided by the exterior index, θ_i and θ_t the angles of incidence and refraction, and
F(θ_i, η) the unpolarised Fresnel reflectance. Let η_ti be 1/η for rays from outside, and η for rays from inside. The
two lobes are

    reflection      wo = (-wi_x, -wi_y, wi_z)                            f = F · specular_reflectance
    transmission    wo = (-η_ti wi_x, -η_ti wi_y, -sign(wi_z) cos θ_t)   f = (1 - F) · specular_transmittance · s

where s = η_ti² in radiance mode and 1 in importance mode. BSDF flags, wo and f are the same as in Mitsuba's plugin. The
probability of reflection is F, as in Mitsuba, with one exception. For rays from the denser side, below the critical
angle, transmission is sampled with a probability of at least 1/4. Near the critical angle the derivative of F is
unbounded, and samples with the small probability 1 - F would contribute nearly all of the derivative of the image.

The direction wo and the weight are differentiated with respect to `eta` and si.wi. The weight is also differentiated
with respect to the tints `specular_reflectance` and `specular_transmittance`. The probability of choosing a lobe and
the critical angle are *not* differentiated (F is continuous at the critical angle). bs.pdf is detached, and the weight
is f / detach(pdf). If both lobes are enabled, the value of the weight is the tint (times s for transmission), and the
derivative of the weight contains the derivative of F. Where F exceeds 3/4, the minimum of 1/4 applies, and the value of
the weight has an additional factor: F / (3/4) for reflection and (1 - F) / (1/4) for transmission. If an edge of the
scene is visible through a lobe, the integrator has to add a boundary term for the motion of the edge.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from pathreplay.errors import PathreplayError
from pathreplay.platform.properties import Property

#: Largest probability of reflection from the denser side, except for total internal reflection.
MAX_REFLECTION = 0.75
TINTS = ("specular_reflectance", "specular_transmittance")
INT_IOR = Property(
    "int_ior",
    "float or string",
    "bk7",
    "Index of refraction inside: a number, or the name of a material that Mitsuba knows.",
    differentiable="eta",
)
EXT_IOR = replace(INT_IOR, name="ext_ior", default="air", meaning=INT_IOR.meaning.replace("inside", "outside"))
REFLECTANCE = Property(TINTS[0], "spectrum or texture", 1.0, "Tint of the reflection.", differentiable=f"{TINTS[0]}.…")
TRANSMITTANCE = Property(
    TINTS[1], "spectrum or texture", 1.0, "Tint of the refraction.", differentiable=f"{TINTS[1]}.…"
)


def _index(props: mi.Properties, declared: Property[str]) -> float:
    """Read an index of refraction: a number, or the name of a material in Mitsuba's table."""
    name = declared.name
    if name in props and props.type(name) == mi.Properties.Type.Integer:
        ior = float(props[name])
    else:
        try:
            ior = float(mi.lookup_ior(props, name, declared.default))
        except RuntimeError:
            raise PathreplayError(
                f"dielectric_ad: {name} = {props[name]!r:.60} is not a material known to Mitsuba; give a number, "
                "or a name such as 'bk7' or 'water'"
            ) from None
    if not 0 < ior < float("inf"):
        raise PathreplayError(f"dielectric_ad: {name} is {ior:g}; give a finite index of refraction above 0")
    return ior


class DielectricAD:
    """A smooth dielectric with differentiable index of refraction. `on_base` combines this template with `mi.BSDF`."""

    properties = (INT_IOR, EXT_IOR, REFLECTANCE, TRANSMITTANCE)
    specular_reflectance: mi.Texture | None  # None: the tint is 1, and no texture is evaluated
    specular_transmittance: mi.Texture | None

    def __init__(self, props: mi.Properties) -> None:
        mi.BSDF.__init__(self, props)
        if mi.is_polarized:
            raise PathreplayError(
                f"dielectric_ad: the polarised variant {mi.variant()} is not supported; use "
                f"{mi.variant().replace('_polarized', '')}, or Mitsuba's dielectric without derivatives"
            )
        self.eta = mi.Float(_index(props, INT_IOR) / _index(props, EXT_IOR))
        for tint in (REFLECTANCE, TRANSMITTANCE):
            name = tint.name
            setattr(self, name, props.get_texture(name, tint.default) if name in props else None)
        both_sides = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
        self.m_components = [
            mi.BSDFFlags.DeltaReflection | both_sides,
            mi.BSDFFlags.DeltaTransmission | both_sides | mi.BSDFFlags.NonSymmetric,
        ]
        self.m_flags = self.m_components[0] | self.m_components[1]
        self.parameters_changed([])

    # ------------------------------------------------ parameters ------------------------------------------------

    def traverse(self, cb: mi.TraversalCallback) -> None:
        # Discontinuous, as in Mitsuba's other dielectrics: edges seen through the surface move with eta.
        cb.put("eta", self.eta, mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous)
        for name in TINTS:
            if getattr(self, name) is not None:
                cb.put(name, getattr(self, name), mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: list[str]) -> None:
        dr.make_opaque(self.eta)  # a literal is a kernel constant: every update would recompile the kernel

    def to_string(self) -> str:
        lines = [f"  eta = {self.eta},"]
        for name in TINTS:
            if getattr(self, name) is not None:
                lines.append(f"  {name} = {getattr(self, name)},".replace("\n", "\n  "))
        return "\n".join(["DielectricAD[", *lines, "]"])

    # -------------------------------------------- sampling, evaluation --------------------------------------------

    def sample(
        self,
        ctx: mi.BSDFContext,
        si: mi.SurfaceInteraction3f,
        sample1: mi.Float,
        sample2: mi.Point2f,
        active: mi.Bool | bool = True,
    ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
        has_r = ctx.is_enabled(mi.BSDFFlags.DeltaReflection, 0)
        has_t = ctx.is_enabled(mi.BSDFFlags.DeltaTransmission, 1)
        bs = dr.zeros(mi.BSDFSample3f)
        if not (has_r or has_t):
            return bs, mi.Spectrum(0)

        # F is the Fresnel reflectance, η_it the relative index in the direction of travel, and η_ti = 1 / η_it.
        F, cos_t, η_it, η_ti = mi.fresnel(mi.Frame3f.cos_theta(si.wi), self.eta)
        # Under total internal reflection, F is 1 at all angles. The derivative that mi.fresnel returns there is a
        # rounding error divided by cos θ_i.
        F = dr.select(cos_t == 0, dr.detach(F), F)

        # Choose the lobe with a detached probability
        p_r = dr.detach(F)
        p_r = dr.select((η_it < 1) & (p_r < 1), dr.minimum(p_r, MAX_REFLECTION), p_r)
        selected_r = mi.Mask(active) & ((sample1 <= p_r) if has_t else True) & has_r
        selected_t = ~selected_r & active
        f = dr.select(selected_r, F, 1 - F)
        if has_r and has_t:
            bs.pdf = dr.select(selected_r, p_r, 1 - p_r)
            weight = f / bs.pdf
            # If p_r is not clamped, f / pdf is 1 up to rounding, or 0 / 0 where the probability is zero. The value of
            # the weight is set to 1 in both cases.
            weight = dr.replace_grad(dr.select(p_r == F, 1, weight), weight)
        else:
            bs.pdf = mi.Float(1)
            weight = F if has_r else 1 - F

        bs.wo = dr.select(selected_r, mi.reflect(si.wi), mi.refract(si.wi, cos_t, η_ti))
        bs.eta = dr.select(selected_r, 1, η_it)
        bs.sampled_component = dr.select(selected_r, mi.UInt32(0), mi.UInt32(1))
        bs.sampled_type = dr.select(
            selected_r, mi.UInt32(+mi.BSDFFlags.DeltaReflection), mi.UInt32(+mi.BSDFFlags.DeltaTransmission)
        )

        tinted = mi.Spectrum(weight)
        if self.specular_reflectance is not None:
            tinted[selected_r] = tinted * self.specular_reflectance.eval(si, selected_r)
        if self.specular_transmittance is not None:
            tinted[selected_t] = tinted * self.specular_transmittance.eval(si, selected_t)
        if ctx.mode == mi.TransportMode.Radiance:
            # Refraction changes the solid angle of a beam. The transmitted radiance is therefore scaled by η_ti².
            tinted[selected_t] = tinted * dr.square(η_ti)
        return bs, dr.select(active, tinted, 0)

    def eval(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool | bool = True
    ) -> mi.Spectrum:
        return mi.Spectrum(0)  # both lobes are Dirac deltas

    def pdf(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool | bool = True
    ) -> mi.Float:
        return mi.Float(0)

    def eval_pdf(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool | bool = True
    ) -> tuple[mi.Spectrum, mi.Float]:
        return mi.Spectrum(0), mi.Float(0)
