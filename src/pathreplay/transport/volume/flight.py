"""Free flight through a medium: delta tracking to the next real collision, and its derivative in later passes.

Tentative collisions are sampled from a majorant, and each is either real or null. The flight ends at the first real
collision, or at the surface that bounds the medium. The sampling is not differentiated. Later passes differentiate the
integrand, which is transmittance times scattering coefficient, at the sampled distance. The derivative of the log
transmittance is

    d log T = -∫ dσ_t ds,  estimated as  -(t - a) · mean of dσ_t(y),

where the flight extends from distance a to t, and the points y on the flight are evenly spaced. This estimator contains
no division by a value that may be zero. It is therefore also correct where null collisions are never sampled, for
example in a constant grid.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from pathreplay.samplers.sampler import Sampler
from pathreplay.transport.vertex import Arrival, Flight, NullCollision, TraceConfig, channel_mean, reciprocal
from pathreplay.transport.volume.media import (
    Grid,
    Media,
    carried,
    extinction_of,
    interaction,
    is_grid,
    majorant,
    span,
)

# Number of points of a flight at which its transmittance is differentiated. Fewer points increase the variance, more
# points take more time. Four give the lowest variance at equal time for the cloud of `pathreplay bench media`.
POINTS = 4


def branch_weight(p: mi.Float, c: mi.Float) -> mi.Float:
    """Return 1 / (p + c (1 - p)) for probability p of a real collision and relative weight c of null collisions.

    The derivative of in-scattering is dσ_s L_s, with L_s the in-scattered radiance. This derivative may be nonzero
    where σ_s is zero and real collisions cannot occur. Real collisions therefore estimate only the fraction
    p / (p + c (1 - p)) of this derivative, and null collisions estimate the rest. L_s is estimated at each real
    collision, but at only one null collision per path. All estimates have equal weight if c is the inverse of the
    number of null collisions.
    """
    return dr.rcp(p + c * (1 - p))


@dr.syntax
def fly(trace: TraceConfig, at: Arrival, sampler: Sampler, β: mi.Spectrum, active: mi.Bool) -> Flight:
    """Sample the flight along ``at.ray``, in ``at.medium``, up to the surface ``at.hit``. Detached.

    Let ``β`` be the throughput, and W the product of the weights of previous null collisions on the flight. Let σ_k be
    the extinction in channel k, and σ̄ the majorant. In chromatic media, a collision is real with the probability
    p = Σ_k |β_k W_k| σ_k / (σ̄ Σ_k |β_k W_k|), which takes the previous weights of all channels into account.
    """
    media = trace.media
    ray, medium = dr.detach(at.ray), at.medium
    flying = active & (medium != None)  # noqa: E711 (an array of pointers)
    reach = dr.select(at.hit.is_valid(), at.hit.t, dr.inf)
    a, b = span(medium, ray, reach, flying)
    flying &= a < b
    σ_max = majorant(medium, ray, flying)
    if dr.hint(trace.branch, mode="scalar"):  # null branching needs null collisions in empty media, too
        σ_max = dr.maximum(σ_max, dr.select(dr.isfinite(b), dr.rcp(b - a), 0))

    t = mi.Float(a)
    event = mi.Bool(False)
    density = mi.Float(1)
    p_real = mi.Float(1)
    W = mi.Spectrum(1)
    σ_s = mi.Spectrum(0)
    E = mi.Spectrum(0)
    t_emit, c_emit, count = mi.Float(0), mi.Spectrum(0), mi.Float(0)
    t_null, ω_null, bare, mass, nulls = mi.Float(0), mi.Spectrum(0), mi.Float(0), mi.Float(0), mi.Float(0)

    while dr.hint(flying, exclude=[trace, at, media], label="pathreplay: flight"):
        step, σ_bar = _tentative(trace, medium, ray, t, b, sampler.next_1d(flying), σ_max, flying)
        t_next = t + step
        inside = flying & (t_next < b)
        mei = interaction(medium, ray, t_next)
        σ_s_here, _, σ_t = medium.get_scattering_coefficients(mei, inside)
        σ_s_here, σ_t = dr.detach(σ_s_here), dr.detach(σ_t)

        if dr.hint(media.emissive, mode="scalar"):
            for grid in media.grids:
                if dr.hint(grid.emission is not None, mode="scalar"):
                    glows = inside & is_grid(grid, medium)
                    c = mi.Spectrum(W * dr.rcp(σ_bar))
                    E = _emission_added(grid, mei, E, c, glows)
                    count = dr.select(glows, count + 1, count)
                    picked = glows & (sampler.next_1d(glows) * count < 1)
                    t_emit = dr.select(picked, t_next, t_emit)
                    c_emit = dr.select(picked, c, c_emit)

        p = _reality(media, dr.abs(β * W), σ_t, σ_bar)
        real = inside & (sampler.next_1d(inside) < p)
        flying = inside & ~real
        if dr.hint(trace.branch, mode="scalar"):
            assert trace.branching is not None
            share = trace.branching * branch_weight(p, trace.branching) / σ_bar
            m = share * channel_mean(dr.abs(β) * dr.maximum(dr.abs(W), 1))
            mass += dr.select(flying, m, 0)
            nulls += dr.select(flying, 1, 0)
            kept = flying & (sampler.next_1d(flying) * mass < m)
            t_null = dr.select(kept, t_next, t_null)
            ω_null = dr.select(kept, W * (share / m), ω_null)
            bare = dr.select(kept, share / m, bare)
        if dr.hint(media.chromatic, mode="scalar"):
            W = dr.select(flying, W * (1 - σ_t / σ_bar) * reciprocal(1 - p), W)
        E = _emission_at_end(media, mei, E, W * σ_t * dr.rcp(p * σ_bar), real)
        event |= real
        density = dr.select(real, p * σ_bar, density)
        p_real = dr.select(real, p, p_real)
        σ_s = dr.select(real, σ_s_here, σ_s)
        t = dr.select(inside, t_next, t)

    along = sampler.next_1d(active)
    flight = Flight(event=event, t=t, density=density, W=W, along=along, σ_s=σ_s)
    if dr.hint(media.emissive, mode="scalar"):
        flight.t_emit, flight.c_emit, flight.E = t_emit, c_emit * count, E
    if dr.hint(trace.branch, mode="scalar"):
        flight.p, flight.null = p_real, NullCollision(t_null, ω_null, bare, mass, nulls, sampler.next_1d(active))
    return flight


def _emission_added(
    grid: Grid, mei: mi.MediumInteraction3f, E: mi.Spectrum, c: mi.Spectrum, active: mi.Bool
) -> mi.Spectrum:
    """Add the weighted emission at a tentative collision to ``E``, if the grid emits per unit of length."""
    if grid.emission_per_extinction:
        return E
    return dr.select(active, E + c * dr.detach(grid.emission_at(mei, active)), E)


def _emission_at_end(
    media: Media, mei: mi.MediumInteraction3f, E: mi.Spectrum, c: mi.Spectrum, real: mi.Bool
) -> mi.Spectrum:
    """Estimate the emission of flights that end at a real collision in a grid that emits per unit of optical depth.

    In opaque media, this estimate has little noise. For all other flights, the result is ``E``.
    """
    for grid in media.grids:
        if grid.emission is not None and grid.emission_per_extinction:
            glows = real & is_grid(grid, mei.medium)
            E = dr.select(glows, c * dr.detach(grid.emission_at(mei, glows)), E)
    return E


def _tentative(
    trace: TraceConfig,
    medium: mi.MediumPtr,
    ray: mi.Ray3f,
    t: mi.Float,
    b: mi.Float,
    u: mi.Float,
    σ: mi.Float,
    active: mi.Bool,
) -> tuple[mi.Float, mi.Float]:
    """Return the distance from ``t`` to the next tentative collision, and the majorant at this collision.

    Outside grids, the majorant is ``σ``.
    """
    step = dr.select(σ > 0, -dr.log(1 - u) * dr.rcp(σ), dr.inf)
    for grid in trace.media.grids:
        mine = active & is_grid(grid, medium)
        onward = mi.Ray3f(ray.o + t * ray.d, ray.d, ray.time, ray.wavelengths)
        onward.maxt = b - t
        step_grid, σ_grid = grid.free_flight(onward, u, mine)
        step, σ = dr.select(mine, step_grid, step), dr.select(mine, σ_grid, σ)
    return step, mi.Float(σ)


def _reality(media: Media, βW: mi.Spectrum, σ_t: mi.Spectrum, σ_bar: mi.Float) -> mi.Float:
    """Return the probability that a collision is real."""
    p = σ_t[0] / σ_bar
    if media.chromatic:
        total = dr.sum(βW)
        p = dr.select(total > 0, dr.sum(βW * σ_t) / (σ_bar * total), channel_mean(σ_t) / σ_bar)
    return dr.clip(p, 0, 1)


@dataclass
class Flown:
    """A recorded flight, evaluated again differentiably."""

    mei: mi.MediumInteraction3f  # the interaction at the collision
    w: mi.Spectrum  # weight of the radiance from the flight's end, as in `Flight.weight`, but differentiable
    e: mi.Spectrum  # emission along the flight, plus a control variate with value zero, whose derivative has mean zero


def fly_again(
    trace: TraceConfig, at: Arrival, flight: Flight, reach: mi.Float, attached: bool, active: mi.Bool
) -> Flown:
    """Evaluate a recorded flight again, differentiable in the coefficients and, if ``attached``, in ray and ``reach``.

    ``reach`` is the distance to the surface, or infinity if there is none. The medium covers an interval of the ray,
    and a collision moves with the ends of this interval (see `carried`). It never crosses an end of the interval. Such
    a crossing would add a boundary term.

    Let a and t be the ends of the flight, y a random point between them, x the collision, and b any function of
    position and direction (`TraceConfig.baseline`). The control variate

        (t - a) dσ_t(y) b(y) - dσ_t(x) b(x) / density        (without a collision, only the first term)

    has mean zero, because both terms have the same expectation. The first term is averaged over `POINTS` points y. For
    b = 1, the control variate is the score of the sampling density, up to sign. Without the control variate, the
    variance is high where the radiance is large and the derivative of the radiance with respect to the medium is small.
    """
    medium, ray = at.medium, at.ray
    in_medium = active & (medium != None)  # noqa: E711
    event = in_medium & flight.event
    with dr.suspend_grad(when=not attached):
        a, b = span(medium, ray, reach, in_medium)
        t, stretch, κ = flight.t, mi.Float(1), None
        if attached:
            κ = extinction_of(trace.media, medium, ray, in_medium)
            t, stretch = carried(t, a, b, event, κ)
        end = dr.select(event, t, b)
        mei = interaction(medium, ray, t)
        through = in_medium & dr.isfinite(end)
        length = dr.select(through, end - a, 0)
        points = [interaction(medium, ray, a + (flight.along + k) / POINTS * length) for k in range(POINTS)]

    σ_s, _, σ_t = medium.get_scattering_coefficients(mei, event)
    σ_y = [medium.get_scattering_coefficients(y, through)[2] for y in points]
    if trace.branch:
        # Null collisions estimate a part of the derivative, at fixed positions. This part is subtracted here.
        assert trace.branching is not None
        rest = 1 - flight.p * branch_weight(flight.p, trace.branching)
        still = medium.get_scattering_coefficients(dr.detach(mei), event) if attached else (σ_s, None, σ_t)
        σ_s, σ_t = (σ - rest * (σ_0 - dr.detach(σ_0)) for σ, σ_0 in ((σ_s, still[0]), (σ_t, still[2])))
    w_event = σ_s * stretch * dr.rcp(flight.density)
    w = dr.select(event, w_event, 1) * flight.W
    e, T = mi.Spectrum(0), mi.Spectrum(1)
    if dr.grad_enabled(σ_y, length):
        log_T = dr.select(through, -length / POINTS * sum(σ_y), 0)
        w *= dr.replace_grad(mi.Spectrum(1), log_T)
        T = dr.replace_grad(T, log_T)
        if trace.baseline is not None:
            σ_bar = majorant(medium, ray, in_medium)
            guesses = [σ * _guess(trace, y, σ, σ_bar, through) for y, σ in zip(points, σ_y, strict=True)]
            l, J = length, stretch
            if κ is not None:  # y moves unlike x; the motion has little noise, and needs no control variate
                l, J = dr.select(κ > 0, dr.detach(l), l), dr.select(κ > 0, dr.detach(J), J)
            score = dr.select(through, l / POINTS * sum(guesses), 0)
            scored = event
            for grid in trace.media.grids:
                if _scores_at_collisions(trace, grid):
                    scored &= ~is_grid(grid, medium)
            score -= dr.select(scored, σ_t * J * dr.rcp(flight.density) * _guess(trace, mei, σ_t, σ_bar, event), 0)
            e += score - dr.detach(score)

    if trace.media.emissive:
        e += dr.replace_grad(flight.E, _emission_again(trace, at, flight, (a, b), mei, T, attached, in_medium))
    return Flown(mei=mei, w=w, e=e)


def _emission_again(
    trace: TraceConfig,
    at: Arrival,
    flight: Flight,
    ends: tuple[mi.Float, mi.Float],
    mei: mi.MediumInteraction3f,
    T: mi.Spectrum,
    attached: bool,
    in_medium: mi.Bool,
) -> mi.Spectrum:
    """Return the emission along a flight; only the derivative of the result is meaningful.

    Emission per unit of length is differentiated at one tentative collision. The transmittance up to this collision is
    differentiated, too.

    Emission per unit of optical depth is ∫ T σ B ds, with transmittance T, extinction σ and emitted radiance B. Three
    derivatives are needed. The derivatives of T and B are estimated at the real collision. The argument ``T`` has the
    value 1 and the derivative of the log transmittance up to the end of the flight. The derivative of σ is estimated at
    a tentative collision, because tentative collisions also occur where σ is zero.
    """
    medium, ray, (a, b) = at.medium, at.ray, ends
    emitted = mi.Spectrum(0)
    for grid in trace.media.grids:
        if grid.emission is None:
            continue
        glows = in_medium & is_grid(grid, medium) & (flight.t_emit > 0)
        with dr.suspend_grad(when=not attached):
            t, J = flight.t_emit, mi.Float(1)
            if attached:
                t, J = carried(t, a, b, glows)
            length = dr.select(glows, t - a, 0)
            at_e = interaction(medium, ray, t)
            at_y = interaction(medium, ray, a + flight.along * length)
        ε = grid.emission_at(at_e, glows)
        if grid.emission_per_extinction:
            σ_e = medium.get_scattering_coefficients(at_e, glows)[2]
            value = dr.detach(ε)
            if _scores_at_collisions(trace, grid):
                value -= _guess(trace, at_e, σ_e, majorant(medium, ray, glows), glows)
            emitted += dr.select(glows, value * σ_e * flight.c_emit * J, 0)
            real = in_medium & flight.event & is_grid(grid, medium)
            c = flight.W * dr.detach(medium.get_scattering_coefficients(mei, real)[2]) * dr.rcp(flight.density)
            emitted += dr.select(real, T * c * grid.emission_at(mei, real), 0)
            continue
        ε *= flight.c_emit * J
        _, _, σ_here = medium.get_scattering_coefficients(at_y, glows)
        if dr.grad_enabled(σ_here, length):
            ε *= dr.replace_grad(mi.Spectrum(1), -length * σ_here)
        emitted += dr.select(glows, ε, 0)
    return emitted


def _scores_at_collisions(trace: TraceConfig, grid: Grid) -> bool:
    """Return whether the second term of the control variate is evaluated at a tentative collision, not a real one.

    For the control variate, see `fly_again`. The derivative of emission per unit of optical depth with respect to σ is
    estimated at the same tentative collision. The noise of the second term and the noise of this derivative then
    cancel.
    """
    return (
        trace.baseline is not None and not trace.branch and grid.emission is not None and grid.emission_per_extinction
    )


def _guess(
    trace: TraceConfig, mei: mi.MediumInteraction3f, σ_t: mi.Spectrum, σ_bar: mi.Float, active: mi.Bool
) -> mi.Spectrum:
    """Evaluate `TraceConfig.baseline`. Without null branching, return zero where σ_t = 0, to avoid bias."""
    b = trace.baseline(mei, σ_t, σ_bar, active)  # type: ignore[misc]
    return b if trace.branch else mi.Spectrum(dr.select(dr.detach(σ_t) != 0, b, 0))
