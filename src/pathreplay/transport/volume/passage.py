"""Rays through null boundaries: the first hit behind them, and the transmittance of the media in between.

The search for edges ignores null boundaries, because light passes straight through them and they occlude nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import drjit as dr
import mitsuba as mi

from pathreplay.platform import compat
from pathreplay.samplers.sampler import Sampler
from pathreplay.transport.facts.traits import is_null
from pathreplay.transport.meet import meet
from pathreplay.transport.signature import shape_met
from pathreplay.transport.vertex import TraceConfig
from pathreplay.transport.volume.shadow import Stretch, shadow, transmittance

SHORT_OF = 1 - 1e-3
"""The transmittance up to this fraction of the distance to an edge is estimated once for the rays on both sides. The
value is slightly below 1, so that the surfaces at the edge are at positive distances on the remaining parts of both
rays."""
STEP = 1e-5
"""Offset behind a surface at which the next ray starts, relative to distance and coordinates."""
Passes = Callable[["mi.PreliminaryIntersection3f", "mi.Ray3f", "mi.Bool"], "mi.Bool"]


@dr.syntax
def first_behind(
    trace: TraceConfig, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, passes: Passes, active: mi.Bool
) -> mi.PreliminaryIntersection3f:
    """Return the first hit on a surface that the ray does not pass. ``hit`` is the first hit on any surface.

    The distance of the result is measured from the origin of ``ray``. ``passes`` maps a hit, its ray and a mask to the
    lanes in which the ray passes through the surface.
    """
    here, onward, t = mi.PreliminaryIntersection3f(hit), mi.Ray3f(ray), mi.Float(hit.t)
    passing = active & passes(here, ray, active)
    while dr.hint(passing, exclude=[trace, ray, passes], label="pathreplay: beyond surfaces"):
        onward, gone = past(ray, t)
        here = meet(trace, onward, passing)
        t = gone + here.t
        passing &= passes(here, onward, passing)
    here.t = t
    return here


def skip_null(
    trace: TraceConfig, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, active: mi.Bool
) -> mi.PreliminaryIntersection3f:
    """Return the first hit that is not on a null boundary: see `first_behind`."""
    return first_behind(trace, ray, hit, partial(is_boundary, trace), active)


def is_boundary(trace: TraceConfig, hit: mi.PreliminaryIntersection3f, ray: mi.Ray3f, active: mi.Bool) -> mi.Bool:
    """Return whether a hit is on a null boundary."""
    return hit.is_valid() & is_null(shape_met(trace, hit, ray, active).bsdf())


@dr.syntax
def transmittance_up_to(
    trace: TraceConfig, ray: mi.Ray3f, reach: mi.Float, medium: mi.MediumPtr, sampler: Sampler, active: mi.Bool
) -> tuple[mi.Spectrum, mi.MediumPtr]:
    """Estimate the transmittance up to distance ``reach``, along a ray that starts in ``medium``. Detached.

    Also returns the medium at distance ``reach``.
    """
    ray = mi.Ray3f(ray)
    ray.maxt = reach
    stretch = Stretch.begin(ray, medium, active)
    T = mi.Spectrum(1)
    while dr.hint(stretch.active, exclude=[trace], label="pathreplay: passage"):
        hit, a, b, inside = stretch.part(trace)
        T = dr.select(inside, T * transmittance(trace, stretch.medium, stretch.ray, a, b, sampler, inside), T)
        stretch, T = stretch.beyond(trace, hit, T)
    return T, stretch.medium


def medium_at_origin(
    trace: TraceConfig, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, outside: mi.MediumPtr, active: mi.Bool
) -> mi.MediumPtr:
    """Return the medium that contains the origin of a ray; ``hit`` is the first hit of the ray. Detached.

    It is the medium before the first surface on the ray that separates media. If there is no such surface, it is
    ``outside``, the medium around the whole scene (see `medium_at_end`).
    """
    return _medium_along(trace, ray, hit, outside, active, to_end=False)


def medium_at_end(trace: TraceConfig, ray: mi.Ray3f, medium: mi.MediumPtr) -> mi.MediumPtr:
    """Return the medium in which a ray ends that starts in ``medium`` and passes all surfaces. Detached."""
    return _medium_along(trace, ray, meet(trace, ray, mi.Bool(True)), medium, mi.Bool(True), to_end=True)


@dr.syntax
def _medium_along(
    trace: TraceConfig,
    ray: mi.Ray3f,
    hit: mi.PreliminaryIntersection3f,
    otherwise: mi.MediumPtr,
    active: mi.Bool,
    to_end: bool,
) -> mi.MediumPtr:
    """Return the medium before the first surface on a ray that separates media.

    With ``to_end``, return the medium behind the last such surface. The result is ``otherwise`` if there is no such
    surface. ``hit`` is the first hit of the ray.
    """
    medium = mi.MediumPtr(otherwise)
    if dr.hint(trace.media.bounded, mode="scalar"):
        here, onward = mi.PreliminaryIntersection3f(hit), mi.Ray3f(ray)
        searching = active & here.is_valid()
        while dr.hint(searching, exclude=[trace, to_end], label="pathreplay: medium at an end of a ray"):
            si = here.compute_surface_interaction(onward, compat.minimal(), searching)
            turns = searching & si.is_medium_transition()
            medium = dr.select(turns, si.target_medium(onward.d if to_end else -onward.d), medium)
            onward = si.spawn_ray(onward.d)
            searching &= ~turns | to_end
            here = meet(trace, onward, searching)
            searching &= here.is_valid()
    return medium


def transmittance_past_edge(
    trace: TraceConfig, ray: mi.Ray3f, t: mi.Float, medium: mi.MediumPtr, sampler: Sampler, active: mi.Bool
) -> mi.Spectrum:
    """Estimate the transmittance of a shadow ray that passes an edge at distance ``t``. Detached.

    The ray is split shortly before the edge, and the second part starts exactly on the ray. Otherwise the ray might
    pass the edge on the wrong side: `spawn_ray` at null boundaries shifts rays sideways by more than their distance
    from the edge.
    """
    t = SHORT_OF * t
    T, medium = transmittance_up_to(trace, ray, t, medium, sampler, active)
    return T * shadow(trace, further(ray, t), medium, sampler, active & dr.any(T != 0)).T


def further(ray: mi.Ray3f, t: mi.Float) -> mi.Ray3f:
    """Return the rest of a ray, from distance ``t`` on."""
    rest = mi.Ray3f(ray)
    rest.o, rest.maxt = ray.o + t * ray.d, ray.maxt - t
    return rest


def past(ray: mi.Ray3f, t: mi.Float) -> tuple[mi.Ray3f, mi.Float]:
    """Return the rest of a ray behind the surface at distance ``t``, and the distance at which the rest begins.

    The new origin stays on the ray. `spawn_ray` would move the origin sideways.
    """
    gone = t + STEP * (1 + dr.max(dr.abs(ray.o)) + t)
    return further(ray, gone), gone
