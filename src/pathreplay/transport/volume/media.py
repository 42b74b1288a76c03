"""Facts about the media of a scene, computed before a kernel is traced, and medium interactions along rays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeGuard

import drjit as dr
import mitsuba as mi

from pathreplay.samplers.sampler import Sampler
from pathreplay.transport.facts.nodes import nodes_of, with_gradients

LINEAR = 1e-2
"""Optical depth below which `carried` takes the limit κ = 0, to avoid cancellation."""


class Grid(Protocol):
    """A medium that implements free flight and transmittance itself: see `gridmedium`."""

    emission: mi.Volume | None
    emission_per_extinction: bool  # `emission_at` is per optical depth, not per length; unused if `emission` is None
    is_chromatic: bool

    def free_flight(self, ray: mi.Ray3f, u: mi.Float, active: mi.Bool) -> tuple[mi.Float, mi.Float]: ...

    def transmittance(self, ray: mi.Ray3f, sampler: Sampler, active: mi.Bool) -> mi.Spectrum: ...

    def emission_at(self, mei: mi.MediumInteraction3f, active: mi.Bool) -> mi.Spectrum: ...


@dataclass(frozen=True)
class Media:
    """Facts about the media of a scene. Recorded kernels depend on these facts."""

    grids: tuple[Grid, ...]  # media that implement free flight and transmittance themselves (`gridmedium`)
    plain: bool  # there are media other than grids, accessible only through Mitsuba's interface
    homogeneous: bool  # some medium other than a grid has constant coefficients
    chromatic: bool  # some extinction differs between channels
    emissive: bool  # some medium emits
    passes: bool  # some surface that is not a null boundary may transmit light unscattered
    branches: bool  # see `wants_branch`
    around: mi.Medium | None  # the medium that contains the sensor
    bounded: bool  # some shape separates media; otherwise the medium of the sensor fills the whole space


def scene_media(
    media: Sequence[mi.Medium],
    passes: bool,
    sensor: mi.Sensor | None,
    branches: bool | None = None,
    bounded: bool = True,
) -> Media | None:
    """Collect the facts about the media of a scene, or return None without media.

    ``passes`` tells whether some surface that is not a null boundary may transmit light unscattered. ``branches`` is
    the result of `wants_branch`, or None if it must be computed. ``bounded`` is stored in `Media`.
    """
    if not media:
        return None
    grids = tuple(medium for medium in media if _is_grid(medium))
    plain = [medium for medium in media if not _is_grid(medium)]
    below = set() if sensor is None else nodes_of(sensor)
    return Media(
        grids=grids,
        plain=bool(plain),
        homogeneous=any(medium.is_homogeneous() for medium in plain),
        chromatic=any(grid.is_chromatic for grid in grids) or any(map(_is_chromatic, plain)),
        emissive=any(grid.emission is not None for grid in grids),
        passes=passes,
        branches=wants_branch(media) if branches is None else branches,
        around=next((node for node in below if isinstance(node, mi.Medium)), None),
        bounded=bounded,
    )


def _is_chromatic(medium: mi.Medium) -> bool:
    if dr.size_v(mi.Spectrum) == 1:
        return False
    params = mi.traverse(medium)
    extinction = [params[key] for key in params.keys() if key.startswith("sigma_t.")]
    one_number = [
        value.shape[-1] == 1 if dr.is_tensor_v(value) else not dr.is_vector_v(value) and dr.width(value) == 1
        for value in extinction
        if dr.is_tensor_v(value) or dr.is_diff_v(value)
    ]
    return not one_number or not all(one_number)


def _is_grid(medium: mi.Medium) -> TypeGuard[Grid]:
    return hasattr(medium, "free_flight")


def wants_branch(media: Sequence[mi.Medium]) -> bool:
    """Return whether null branching is needed: some extinction has gradients and may be zero somewhere."""
    return any(map(_misses, media))


def _misses(medium: mi.Medium) -> bool:
    """Return whether the extinction of a medium has gradients and may be zero somewhere.

    Extinction may be zero unless it is constant and its value is known to be nonzero. While `dr.freeze` records, no
    values are known.
    """
    moving = with_gradients(medium, "sigma_t", "scale")
    known = medium.is_homogeneous() and not dr.flag(dr.JitFlag.FreezingScope)
    return bool(moving) and not (known and all(dr.all(dr.detach(value) != 0, axis=None) for value in moving))


def interaction(medium: mi.MediumPtr, ray: mi.Ray3f, t: mi.Float) -> mi.MediumInteraction3f:
    """Create the medium interaction at distance ``t`` along ``ray``, differentiable in ``ray`` and ``t``."""
    mei = dr.zeros(mi.MediumInteraction3f)
    mei.t = t
    mei.p = ray.o + t * ray.d
    mei.wi = -ray.d
    mei.sh_frame = mi.Frame3f(mei.wi)
    mei.time = ray.time
    mei.wavelengths = ray.wavelengths
    mei.medium = medium
    return mei


def span(medium: mi.MediumPtr, ray: mi.Ray3f, reach: mi.Float, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
    """Return the part [a, b] of the ray up to ``reach`` in which collisions may occur; a = b = 0 if none exists.

    Differentiable in the ray and in ``reach``.
    """
    met, near, far = medium.intersect_aabb(ray)
    met &= active & (dr.isfinite(near) | dr.isfinite(far))
    a, b = dr.maximum(near, 0), dr.minimum(far, reach)
    met &= a < b
    return dr.select(met, a, 0), dr.select(met, b, 0)


def carried(
    t: mi.Float, a: mi.Float, b: mi.Float, where: mi.Bool, κ: mi.Float | None = None
) -> tuple[mi.Float, mi.Float]:
    """Attach the distance ``t`` to the moving ends of the interval [a, b]; return ``t`` and the stretch factor.

    The returned numbers are ``t`` and 1. Their derivatives are those of a + τ(b - a) and of the Jacobian ∂τ/∂τ₀, where
    the distance τ = t - a is a sample of the density ∝ e^(-κτ) on [0, b - a], with a fixed random number:

        dτ = φ(τ) d(b - a),    φ(τ) = (e^(κτ) - 1) / (e^(κ(b - a)) - 1).

    For κ = 0 or None, the density is uniform, and φ(τ) = τ / (b - a). All κ give the correct expectation. The noise is
    lowest if κ is the extinction of the medium (see `extinction_of`). Where ``where`` is false or b is infinite, both
    derivatives are zero.
    """
    a0, b0 = dr.detach(a), dr.detach(b)
    held = where & dr.isfinite(b0) & (a0 < b0)
    L, τ = dr.select(held, b0 - a0, 1), t - a0
    slope = dr.rcp(L)  # dφ/dτ
    φ = τ * slope
    if κ is not None:
        curved = κ * L > LINEAR
        rest = dr.exp(κ * (τ - L)) * dr.rcp(1 - dr.select(curved, dr.exp(-κ * L), 0))
        slope, φ = dr.select(curved, κ * rest, slope), dr.select(curved, rest * (1 - dr.exp(-κ * τ)), φ)
    moved = dr.select(held, dr.replace_grad(t, a + φ * (b - a)), t)
    return moved, dr.select(held, dr.replace_grad(mi.Float(1), slope * (b - a)), 1)


def extinction_of(media: Media, medium: mi.MediumPtr, ray: mi.Ray3f, active: mi.Bool) -> mi.Float | None:
    """Return κ of `carried` for collisions: the extinction of a homogeneous medium, and 0 in all others.

    The result is None if all media of the scene are heterogeneous.
    """
    if not media.homogeneous:
        return None
    return dr.select(active & medium.is_homogeneous(), majorant(medium, ray, active), 0)


def majorant(medium: mi.MediumPtr, ray: mi.Ray3f, active: mi.Bool) -> mi.Float:
    """Return an upper bound of the extinction in all channels and everywhere in the medium. Detached.

    In spectral variants, Mitsuba takes the mean of a colour's spectrum for its maximum. A `heterogeneous` medium whose
    extinction is a colour then has a majorant below its extinction at some wavelengths. The extinction of such a medium
    is the same at all points, so its value at the ray's origin is a bound.
    """
    mei = interaction(medium, dr.detach(ray), mi.Float(0))
    bound = dr.max(dr.detach(medium.get_majorant(mei, active)))
    if mi.is_spectral:
        bound = dr.fmax(bound, dr.max(dr.detach(medium.get_scattering_coefficients(mei, active)[2])))
    return bound


def is_grid(grid: Grid, medium: mi.MediumPtr) -> mi.Bool:
    """Return the lanes whose medium is this grid."""
    return medium == mi.MediumPtr(grid)
