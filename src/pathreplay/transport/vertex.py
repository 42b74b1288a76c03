"""The records that pass between the step and its drivers: options, random numbers, what is kept, the result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from pathreplay.transport.facts.traits import Traits
from pathreplay.transport.volume.media import Media


@dataclass(frozen=True)
class TraceConfig:
    """The scene and the options of a trace: Python values, fixed when the kernel is recorded.

    ``attach`` says what the path follows when parameters move: ``none`` nothing, ``delta`` hit points and directions
    sampled from delta lobes, ``all`` also directions from the BSDFs in ``traits.attachables``. ``hide_emitters``
    leaves out emitters that the camera sees directly. ``max_depth`` and ``rr_depth`` are Mitsuba's; an unbounded depth
    is 2^32 - 1. ``media`` is None in a scene without them, which then walks as Mitsuba's `path` does; with media all
    conventions are those of `volpath`: null boundaries are no vertices. ``baseline`` (MediumInteraction3f, extinction,
    majorant, Bool) -> Spectrum guesses the radiance that arrives at a point of a medium from beyond (None: zero); a
    better guess makes gradients less noisy, and none makes them wrong. ``edges`` says that what vertices slide over is
    looked for.
    """

    scene: mi.Scene
    traits: Traits
    attach: str
    hide_emitters: bool
    max_depth: int
    rr_depth: int
    skip_area_emitters: Callable[..., mi.PreliminaryIntersection3f]  # Mitsuba's, an integrator's method
    media: Media = None  # type: ignore[assignment]  # not in scenes without media
    baseline: Callable[..., mi.Spectrum] | None = None
    # To keep a null collision of each path, for derivatives where collisions are never real: how much it counts (Float,
    # see `branch_weight`); else None.
    branching: mi.Float = None
    edges: bool = False
    # Null boundaries are passed as if they were not there, and ``media`` is None: what edges are looked for with.
    clear: bool = False
    # Shading frames of meshes are `steady` ones.
    steady: bool = False
    # A ray that leaves the scene arrives at no vertex: whoever walks so asks for the `background` when all paths ended.
    leaves: bool = False

    @property
    def resamples(self) -> bool:
        """Whether a later pass samples BSDFs once more, with the random numbers of the first walk."""
        return self.traits.lobes > 0 or self.follows

    @property
    def follows(self) -> bool:
        """Whether smooth lobes may be sampled attached: all that can be, or where nothing has an outline the narrow."""
        narrow = self.attach == "delta" and not self.traits.outlines
        return bool(self.traits.attachables) and (narrow or self.attach == "all")

    @property
    def branch(self) -> bool:
        """Whether a null collision of each path is kept."""
        return self.branching is not None

    @property
    def background_is_opaque(self) -> bool:
        """Whether a camera ray that hits nothing counts as covered in the alpha channel."""
        return not self.hide_emitters and self.scene.environment() is not None


@dataclass
class VertexSamples:
    """The random numbers of one vertex: an input of the step, so that a second walk repeats the first exactly."""

    light: mi.Point2f  # which emitter, and where on it
    lobe: mi.Float  # which lobe of the BSDF
    direction: mi.Point2f  # which direction in the lobe
    roulette: mi.Float  # whether the path goes on

    @staticmethod
    def draw(sampler: mi.Sampler) -> VertexSamples:
        """Draw the numbers of one vertex, in the order that all drivers share."""
        return VertexSamples(sampler.next_2d(), sampler.next_1d(), sampler.next_2d(), sampler.next_1d())


@dataclass
class Arrival:
    """How the path came to a vertex: the ray, its nearest hit, and the density with which it was sampled."""

    ray: mi.Ray3f
    hit: mi.PreliminaryIntersection3f
    pdf: mi.Float  # solid-angle density of ray.d at the previous vertex
    delta: mi.Bool  # it was a delta lobe, or the camera
    camera: mi.Bool  # the previous vertex is the camera
    # With media only, else None:
    medium: mi.MediumPtr = None  # what the ray goes through
    behind: mi.Float = None  # distance to the previous vertex behind the ray's origin, through null boundaries


@dataclass
class SampledContinuation:
    """What a first walk chose at a vertex. Later passes hold these values while derivatives flow around them."""

    d: mi.Vector3f  # sampled direction, world space
    pdf: mi.Float  # its solid-angle density, or the probability of the delta lobe
    delta: mi.Bool  # a delta lobe was sampled
    black: mi.Bool  # the weight of the continuation was zero in all channels
    lobe: mi.UInt32  # the BSDF component that was sampled
    lit: mi.Bool  # an emitter sample was taken, and nothing is in its way
    media: SampledInMedia = None  # type: ignore[assignment]  # not in scenes without media
    known: KnownLight | None = None  # on surfaces, if nothing about emitters is differentiated, else None
    light: mi.DirectionSample3f = None  # the emitter sample, where it is still at hand


@dataclass
class SampledInMedia:
    """What was chosen besides in a scene with media."""

    null: mi.Bool  # the lobe passes straight through
    flight: Flight  # on the way to the vertex
    shadow: Shadow  # between the vertex and its emitter sample


@dataclass
class Flight:
    """What a first walk found between two vertices."""

    event: mi.Bool  # a real collision, before any surface
    t: mi.Float  # distance to it
    density: mi.Float  # probability density of a collision there, p σ̄; 1 if there was none
    W: mi.Spectrum  # weight of the null collisions on the way; 1 where the medium is grey
    along: mi.Float  # shifts the points at which its derivative is taken, in [0, 1) of their distance
    p: mi.Float = None  # probability that the collision was real (if the walk branches, else None)
    # Of walks with emission only, else None:
    E: mi.Spectrum = None  # emission gathered on the way
    t_emit: mi.Float = None  # distance of the tentative collision at which emission is differentiated
    c_emit: mi.Spectrum = None  # weight of the emission there
    # Only the first walk needs these; they are None in a record that is read back.
    σ_s: mi.Spectrum = None  # scattering coefficient at the collision
    null: NullCollision = None  # type: ignore[assignment]  # one of those on the way, if the walk branches

    @staticmethod
    def none(media: Media) -> Flight:
        """One that met nothing, as a first walk has it."""
        zero, nothing = mi.Float(0), mi.Spectrum(0)
        flight = Flight(mi.Bool(False), zero, mi.Float(1), mi.Spectrum(1), mi.Float(0), σ_s=nothing)
        if media.emissive:
            flight.t_emit, flight.c_emit, flight.E = mi.Float(0), mi.Spectrum(0), mi.Spectrum(0)
        return flight

    @property
    def weight(self) -> mi.Spectrum:
        """Of what comes from its end: scattering coefficient over density at a collision, times that of null ones."""
        return dr.select(self.event, self.σ_s * dr.rcp(self.density), 1) * self.W


@dataclass
class NullCollision:
    """A null collision, kept with a probability proportional to ``mass``: see `branch_weight`."""

    t: mi.Float  # distance
    ω: mi.Spectrum  # weight of the collision and of those before, over the probability that it was kept
    bare: mi.Float  # the same without those before
    mass: mi.Float  # of all null collisions on the way
    number: mi.Float  # of null collisions on the way
    pick: mi.Float  # a random number, to choose among flights


@dataclass
class Shadow:
    """What a first walk found between a vertex and its emitter sample."""

    T: mi.Spectrum  # estimate of the transmittance, 0 if something is in the way
    y: mi.Float  # distance of the point where its derivative is taken
    medium: mi.MediumPtr  # the medium there; null if there is none on the way
    length: mi.Float  # length of medium on the ray


@dataclass
class KnownLight:
    """What emitters bring to a surface, where later passes need not find it out again."""

    glow: mi.Spectrum  # emission, a part of e
    d: mi.Vector3f  # direction of the emitter sample
    w: mi.Spectrum  # its radiance over its density, MIS weighted


@dataclass
class Lighting:
    """What a surface adds by itself, e, as a function of what emitters emit: see `relight`."""

    si: mi.SurfaceInteraction3f
    seen: mi.Bool  # what is emitted there counts
    light: mi.DirectionSample3f  # the emitter sample
    w: mi.Spectrum  # weight of its radiance: scattering over density, MIS weighted
    lit: mi.Bool


@dataclass
class VertexRecord:
    """What later passes know about a vertex and its continuation."""

    at: Arrival
    u: VertexSamples
    kept: SampledContinuation
    go_on: mi.Bool  # there is a next vertex
    hit_next: mi.PreliminaryIntersection3f  # of the next vertex
    rr_weight: mi.Float  # 1 / survival probability
    β: mi.Spectrum  # throughput before the vertex


@dataclass
class Signature:
    """Where a vertex lies among the discontinuities of its path: two paths that differ in it have an edge between."""

    met: mi.Bool  # the ray met something: a surface or, in a medium, a particle
    shape: mi.UInt32  # registry index of the shape, 0 for a particle or none
    lobe: mi.UInt32  # the lobe of the continuation


@dataclass
class Step:
    """One vertex of a path, L_i = e_i + w_i L_{i+1}, together with the continuation r_{i+1}."""

    e: mi.Spectrum  # emission (MIS weighted) + next-event estimate
    w: mi.Spectrum  # f/p or lobe weight, before Russian roulette
    ray_next: mi.Ray3f
    pdf: mi.Float  # density of the continuation, for the next vertex
    signature: Signature


@dataclass
class SampledStep(Step):
    """A step of a first walk, with what it chose and what the walk needs to go on."""

    kept: SampledContinuation
    eta: mi.Float  # relative index of refraction that the continuation crosses
    null: mi.Bool  # the continuation passes straight through
    active: mi.Bool  # there is a continuation
    medium: mi.MediumPtr = None  # what the continuation goes through, with media only
    lighting: Lighting = None  # type: ignore[assignment]  # of surfaces, if emitters have gradients, else None

    @property
    def seen(self) -> mi.Bool:
        """Mitsuba's alpha: the ray met something that does not merely let it pass."""
        return self.signature.met & ~self.null


def mis_weight(pdf_a: mi.Float, pdf_b: mi.Float) -> mi.Float:
    """Power heuristic of Veach, p_a² / (p_a² + p_b²); zero where that is not finite."""
    a2 = dr.square(pdf_a)
    weight = a2 / dr.fma(pdf_b, pdf_b, a2)
    return dr.select(dr.isfinite(weight), weight, 0)


def reciprocal(x: mi.Float) -> mi.Float:
    """1/x where x is not zero, else zero."""
    return dr.select(x != 0, dr.rcp(x), 0)


def is_smooth(bsdf: mi.BSDFPtr) -> mi.Bool:
    """True where next-event estimation can reach a lobe of the BSDF."""
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
