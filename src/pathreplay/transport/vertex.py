"""Data passed between `step` and the loops over path vertices: configuration, random numbers, choices, results."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

import drjit as dr
import mitsuba as mi

from pathreplay.samplers.sampler import Sampler
from pathreplay.transport.facts.traits import Traits
from pathreplay.transport.sensor import SensorLink
from pathreplay.transport.volume.media import Media

Real = TypeVar("Real", "mi.Float", "mi.Spectrum")


@dataclass(frozen=True, kw_only=True)
class TraceConfig:
    """The scene, and the options for tracing paths. All fields except arrays are constants of a recorded kernel."""

    # The scene.
    scene: mi.Scene
    traits: Traits
    media: Media = None  # type: ignore[assignment]
    """None in a scene without media. Without media, paths follow the conventions of Mitsuba's `path`. With media, they
    follow the conventions of `volpath`: null boundaries (surfaces with a `null` BSDF) do not count as vertices."""

    # Properties of the integrator.
    attach: str
    """Selects which parts of a path move with the parameters. ``none``: no part. ``delta``: hit points and the
    directions of delta lobes. ``all``: also the sampled directions of the BSDFs in ``traits.attachables``."""
    hide_emitters: bool
    """Whether directly visible emitters are hidden."""
    max_depth: int
    """Largest path depth, counted as in Mitsuba. Unbounded depth is 2^32 - 1."""
    rr_depth: int
    """Depth at which Russian roulette begins, counted as in Mitsuba's `prb`. `path` begins one vertex earlier."""

    # Inputs of gradient estimators.
    baseline: Callable[..., mi.Spectrum] | None = None
    """Maps (MediumInteraction3f, extinction, majorant, active) to an estimate of the radiance (Spectrum) that arrives
    along the ray. A poor estimate increases noise, but causes no bias: see `fly_again`. None means zero."""
    branching: mi.Float | None = None
    """Relative weight c of null collisions (see `branch_weight`), or None without null branching. Null branching starts
    an extra path at one null collision of each path, to estimate derivatives where real collisions cannot occur."""
    may_slide: bool = False
    """Whether boundary terms are estimated. Some directions sampled from smooth lobes are then fixed, although edges
    may move across them (see `keeps_direction` and `is_seen_through` in `scatter`)."""
    holds_collisions: bool = False
    """Whether directions from collisions in a medium are fixed. Boundary terms must then be estimated, and no texture
    may have discontinuities. The two sides of an edge that a collision sees can then share the transmittance."""

    # Light paths.
    to_sensor: SensorLink | None = None
    """The sensor to which vertices are connected, if paths start at emitters. None if paths start at the sensor and
    vertices are connected to emitters."""
    without_caustics: bool = False
    """Whether camera paths omit caustics, because light paths estimate them. Caustics are paths with a smooth lobe at
    the first vertex and a delta lobe at the last vertex before the emitter, which is not an environment. A collision
    in a medium counts as a smooth lobe or, if the medium does not use emitter sampling, as a delta lobe."""

    # Choices of the caller.
    balances_lobes: bool = False
    """Whether lobes that are rarely selected beside a delta reflection are selected more often: see
    `scatter.balanced`. True in gradient passes in which paths move."""
    skips_null: bool = False
    """Whether rays pass through null boundaries, as in the search for edges. If True, ``media`` must be None."""
    steady_frames: bool = False
    """Whether the function `steady` replaces the shading frames of meshes."""
    background_apart: bool = False
    """Whether the caller adds the `background` after all paths have ended. Rays that leave the scene then have no
    vertex at their end."""

    @property
    def resamples(self) -> bool:
        """Whether later passes sample BSDFs again with the random numbers of the sampling pass."""
        return bool(self.traits.mirrors) or self.follows

    @property
    def follows(self) -> bool:
        """Whether smooth lobes may be sampled attached.

        With ``attach='delta'``, narrow lobes are sampled attached if the scene has no outlines. Other smooth lobes are
        not sampled attached.
        """
        narrow = self.attach == "delta" and not self.traits.outlines
        return bool(self.traits.attachables) and (narrow or self.attach == "all")

    @property
    def horizon(self) -> mi.Emitter | None:
        """The `sunsky` whose horizon is an edge; None without a `sunsky`, and on light paths, which end at the sky."""
        return self.traits.sunsky if self.to_sensor is None else None

    @property
    def branch(self) -> bool:
        """Whether an extra path starts at one null collision of each path (see `null_branching`)."""
        return self.branching is not None

    @property
    def background_is_opaque(self) -> bool:
        """Whether a camera ray that hits nothing has alpha 1."""
        return not self.hide_emitters and self.scene.environment() is not None


@dataclass
class VertexSamples:
    """The random numbers of one vertex. They are an input of the step, so that later passes repeat the step exactly."""

    light: mi.Point2f  # choice of the emitter and of the point on it
    lobe: mi.Float  # choice of the BSDF's lobe
    direction: mi.Point2f  # direction within the lobe
    roulette: mi.Float  # Russian roulette

    @staticmethod
    def draw(sampler: Sampler) -> VertexSamples:
        """Draw the random numbers of one vertex, in the order of the fields."""
        return VertexSamples(sampler.next_2d(), sampler.next_1d(), sampler.next_2d(), sampler.next_1d())


@dataclass
class Arrival:
    """The arrival of a path at a vertex: the ray, its nearest hit, and the sampling density of its direction."""

    ray: mi.Ray3f
    hit: mi.PreliminaryIntersection3f
    pdf: mi.Float  # solid-angle density of ray.d at the previous vertex
    delta: mi.Bool  # the direction comes from a delta lobe or from the camera
    # The previous vertex is the camera or, on light paths, the emitter. In scenes with media and with `hide_emitters`,
    # surfaces that the path passes unscattered do not count.
    camera: mi.Bool
    # None in scenes without media:
    medium: mi.MediumPtr = None  # type: ignore[assignment]  # the medium that contains the ray
    behind: mi.Float = None  # type: ignore[assignment]  # distance from the ray's origin back to the previous vertex, through null boundaries
    # None unless caustics are omitted:
    scattered: mi.Bool = None  # type: ignore[assignment]  # the first vertex of the path has scattered with a smooth lobe


@dataclass
class SampledContinuation:
    """The choices of the sampling pass at a vertex. Later passes reuse these values and add derivatives."""

    d: mi.Vector3f  # sampled direction, world space
    pdf: mi.Float  # solid-angle density of ``d``, or the probability of the delta lobe
    delta: mi.Bool  # a delta lobe was sampled
    black: mi.Bool  # the weight of the continuation was zero in all channels
    lobe: mi.UInt32  # the BSDF component that was sampled
    lit: mi.Bool  # the emitter sample is valid and unoccluded
    media: SampledInMedia = None  # type: ignore[assignment]  # None in scenes without media
    known: KnownLight | None = None  # recorded emission, if later passes do not differentiate emitters; else None
    light: mi.DirectionSample3f | None = None  # the emitter sample; None on light paths and in records


@dataclass
class SampledInMedia:
    """The choices of the sampling pass at a vertex that exist only in scenes with media."""

    null: mi.Bool  # the continuation passes the surface unscattered
    flight: Flight  # the flight to the vertex
    shadow: Shadow  # the shadow ray from the vertex to its emitter sample


@dataclass
class Flight:
    """The sampled flight between two vertices."""

    event: mi.Bool  # a real collision happened before any surface
    t: mi.Float  # distance to the real collision
    density: mi.Float  # p σ̄, with p the probability of a real collision and σ̄ the majorant; 1 without a collision
    W: mi.Spectrum  # product of the weights of all null collisions on the flight; 1 in grey media
    along: mi.Float  # random offset in [0, 1) of the points at which the transmittance is differentiated
    p: mi.Float = None  # type: ignore[assignment]  # probability that the collision was real (None without null branching)
    # None without emissive media:
    E: mi.Spectrum = None  # type: ignore[assignment]  # emission accumulated along the flight
    t_emit: mi.Float = None  # type: ignore[assignment]  # distance of the tentative collision at which emission is differentiated
    c_emit: mi.Spectrum = None  # type: ignore[assignment]  # weight of the emission at distance t_emit
    # Used by the sampling pass only; None when read from a record:
    σ_s: mi.Spectrum = None  # type: ignore[assignment]  # scattering coefficient at the collision
    null: NullCollision = None  # type: ignore[assignment]  # the null collision at which the path may branch; None without null branching

    @staticmethod
    def none(media: Media) -> Flight:
        """Create a flight of length zero without a collision, with all fields that the sampling pass needs."""
        zero, nothing = mi.Float(0), mi.Spectrum(0)
        flight = Flight(mi.Bool(False), zero, mi.Float(1), mi.Spectrum(1), mi.Float(0), σ_s=nothing)
        if media.emissive:
            flight.t_emit, flight.c_emit, flight.E = mi.Float(0), mi.Spectrum(0), mi.Spectrum(0)
        return flight

    @property
    def weight(self) -> mi.Spectrum:
        """Weight of the radiance from the flight's end: ``W``, multiplied by σ_s / density if ``event``."""
        return dr.select(self.event, self.σ_s * dr.rcp(self.density), 1) * self.W


@dataclass
class NullCollision:
    """The null collision that weighted reservoir sampling selected on a flight, for `null_branching`.

    Each null collision has a resampling weight m and is selected with probability m / ``mass``.
    """

    t: mi.Float  # distance of the collision along the ray
    # W c branch_weight(p, c) / (σ̄ m). Here W is the product of the weights of earlier null collisions on the flight, p
    # the probability of a real collision, c the relative weight of null collisions, and σ̄ the majorant.
    ω: mi.Spectrum
    bare: mi.Float  # ω without the factor W
    mass: mi.Float  # sum of m over all null collisions of the flight
    number: mi.Float  # number of null collisions of the flight
    pick: mi.Float  # random number that selects between this flight and earlier flights of the path


@dataclass
class Shadow:
    """The estimated transmittance between a vertex and its emitter sample."""

    T: mi.Spectrum  # estimate of the transmittance, 0 if occluded
    y: mi.Float  # distance of the point at which the transmittance is differentiated
    medium: mi.MediumPtr  # the medium at distance y; null if the ray crosses no medium
    length: mi.Float  # length of the ray inside media


@dataclass
class KnownLight:
    """Emission and emitter sample at a surface, recorded as values if later passes do not differentiate emitters."""

    glow: mi.Spectrum  # radiance emitted at the vertex, MIS weighted
    d: mi.Vector3f  # direction of the emitter sample
    w: mi.Spectrum  # radiance of the emitter sample divided by its density, MIS weighted


@dataclass
class Lighting:
    """Inputs of `relight`, which evaluates the contribution e of a surface as a linear function of emitted radiance."""

    si: mi.SurfaceInteraction3f
    seen: mi.Bool  # e includes the emission at the vertex (false for hidden emitters)
    light: mi.DirectionSample3f  # the emitter sample
    w: mi.Spectrum  # weight of the sample's radiance: f / density, MIS weighted
    lit: mi.Bool  # the emitter sample is valid and unoccluded


@dataclass
class VertexRecord:
    """The record of a vertex and its continuation, from which later passes evaluate the step again."""

    at: Arrival
    u: VertexSamples
    kept: SampledContinuation
    go_on: mi.Bool  # there is a next vertex
    hit_next: mi.PreliminaryIntersection3f  # hit point of the next vertex
    rr_weight: mi.Float  # 1 / survival probability, times `SampledStep.u_weight`
    β: mi.Spectrum  # throughput before the vertex


@dataclass
class Splat:
    """The contribution of a vertex of a light path to the film, without the throughput up to this vertex."""

    c: mi.Spectrum  # f W: scattering f towards the sensor (see `scatter.towards`), times the importance W of the sensor
    s: mi.Point2f  # film position in pixels


@dataclass
class Step:
    """One vertex of a path, with L_i = e_i + w_i L_{i+1}, and the ray that continues the path."""

    # On camera paths: emission (MIS weighted) plus the next-event estimate. On light paths: the contribution to the
    # film, times the adjoint of the image.
    e: mi.Spectrum
    w: mi.Spectrum  # f/p of a smooth lobe, or the weight of a delta lobe, without Russian roulette
    ray_next: mi.Ray3f
    pdf: mi.Float  # density of the continuation, for the MIS weight at the next vertex
    splat: Splat | None = field(default=None, kw_only=True)  # contribution to the film; None on camera paths


@dataclass
class SampledStep(Step):
    """A step of the sampling pass, with its choices and the state that the next vertex needs."""

    met: mi.Bool  # the ray hit a surface or had a real collision in a medium
    kept: SampledContinuation
    eta: mi.Float  # relative index of refraction across the continuation
    null: mi.Bool  # the continuation passes the surface unscattered
    active: mi.Bool  # there is a continuation
    u: VertexSamples  # the random numbers that sampled the step
    u_weight: mi.Float | None  # 1 / density of ``u``, see `scatter.balanced`; None unless `balances_lobes`
    medium: mi.MediumPtr = None  # type: ignore[assignment]  # medium along the continuation; None in scenes without media
    lighting: Lighting = None  # type: ignore[assignment]  # on surfaces, if emitters have gradients; else None

    @property
    def seen(self) -> mi.Bool:
        """Mitsuba's alpha: whether the ray was scattered or absorbed at a surface, or had a real collision."""
        return self.met & ~self.null


def mis_weight(pdf_a: mi.Float, pdf_b: mi.Float) -> mi.Float:
    """Evaluate Veach's power heuristic, p_a² / (p_a² + p_b²); return zero where the quotient is not finite."""
    a2 = dr.square(pdf_a)
    weight = a2 / dr.fma(pdf_b, pdf_b, a2)
    return dr.select(dr.isfinite(weight), weight, 0)


def reciprocal(x: Real) -> Real:
    """Return 1/x where x is not zero, else zero."""
    return dr.select(x != 0, dr.rcp(x), 0)


def channel_mean(x: mi.Spectrum) -> mi.Float:
    """Return the mean over the channels. `dr.mean` would make the number of lanes a constant of the kernel."""
    return dr.sum(x) * (1 / len(x))


def is_smooth(bsdf: mi.BSDFPtr) -> mi.Bool:
    """Return the lanes whose BSDF has a smooth lobe, so that next-event estimation is possible."""
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
