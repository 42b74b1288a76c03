"""The records that pass between the step and its drivers: options, random numbers, what is kept, the result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from .traits import Traits


@dataclass(frozen=True)
class Walk:
    """The scene that is walked through and how: Python values, fixed when the kernel is traced.

    ``attach`` says what the path follows when parameters move: ``none`` nothing, ``delta`` hit points and directions
    sampled from delta lobes, ``all`` also directions from the BSDFs in ``traits.attachables``. ``hide_emitters``
    leaves out emitters that the camera sees directly. ``max_depth`` and ``rr_depth`` are Mitsuba's; an unbounded depth
    is 2^32 - 1. ``media`` is None in a scene without media, which then walks as Mitsuba's `path` does; with media all
    conventions are those of `volpath`: null boundaries are no vertices. ``baseline`` (MediumInteraction3f, extinction,
    majorant, Bool) -> Spectrum guesses the radiance that arrives at a point of a medium from beyond (None: zero); a
    better guess makes gradients less noisy, and none makes them wrong.
    """

    scene: Any  # mi.Scene
    traits: Traits
    attach: str
    hide_emitters: bool
    max_depth: int
    rr_depth: int
    skip_area_emitters: Callable[..., Any]  # Mitsuba's, an integrator's method
    media: Any = None  # Media
    baseline: Any = None
    # To keep a null collision of each path, for derivatives where collisions are never real: how much it counts (Float,
    # see `branch_weight`); else None.
    branching: Any = None
    listing: bool = False  # leave the coefficients of media along flights and shadow rays to the `listing` driver

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
class Numbers:
    """The random numbers of one vertex: an input of the step, so that a second walk repeats the first exactly."""

    light: Any  # Point2f: which emitter, and where on it
    lobe: Any  # Float: which lobe of the BSDF
    direction: Any  # Point2f: which direction in the lobe
    roulette: Any  # Float: whether the path goes on

    @staticmethod
    def draw(sampler: Any) -> Numbers:
        """Draw the numbers of one vertex, in the order that all drivers share."""
        return Numbers(sampler.next_2d(), sampler.next_1d(), sampler.next_2d(), sampler.next_1d())


@dataclass
class Arrival:
    """How the path came to a vertex: the ray, its nearest hit, and the density with which it was sampled."""

    ray: Any  # Ray3f
    hit: Any  # PreliminaryIntersection3f
    pdf: Any  # Float: solid-angle density of ray.d at the previous vertex
    delta: Any  # Bool: it was a delta lobe, or the camera
    camera: Any  # Bool: the previous vertex is the camera
    # With media only, else None:
    medium: Any = None  # MediumPtr: what the ray goes through
    behind: Any = None  # Float: distance to the previous vertex behind the ray's origin, through null boundaries


@dataclass
class Kept:
    """What a first walk chose at a vertex. Later passes hold these values while derivatives flow around them."""

    d: Any  # Vector3f: sampled direction, world space
    pdf: Any  # Float: its solid-angle density, or the probability of the delta lobe
    delta: Any  # Bool: a delta lobe was sampled
    black: Any  # Bool: the weight of the continuation was zero in all channels
    lobe: Any  # UInt32: the BSDF component that was sampled
    lit: Any  # Bool: an emitter sample was taken, and nothing is in its way
    null: Any = None  # Bool: the lobe passes straight through (None in a record without media)
    # With media only, else None:
    flight: Any = None  # Flight on the way to the vertex
    shadow: Any = None  # Shadow between the vertex and its emitter sample
    # On surfaces, if nothing about emitters is differentiated: what later passes need not find out again. Else None.
    glow: Any = None  # Spectrum: emission, a part of e
    light_d: Any = None  # Vector3f: direction of the emitter sample
    light_w: Any = None  # Spectrum: its radiance over its density, MIS weighted
    # Only the first walk needs these; they are None in a record that is read back.
    light: Any = None  # DirectionSample3f of the emitter sample
    eta: Any = None  # Float: relative index of refraction that it crosses
    # With media only: where the shadow ray started (Interaction3f), in what (MediumPtr), whether there was one (Bool),
    # and what came of it (Spectrum: a part of e).
    origin: Any = None
    start: Any = None
    shaded: Any = None
    lighting: Any = None


@dataclass
class Step:
    """One vertex of a path, L_i = e_i + w_i L_{i+1}, together with the continuation r_{i+1}."""

    e: Any  # Spectrum: emission (MIS weighted) + next-event estimate
    w: Any  # Spectrum: f/p or lobe weight, before Russian roulette
    ray_next: Any  # Ray3f
    pdf: Any  # Float: density of the continuation, for the next vertex
    kept: Kept
    met: Any  # Bool: the ray met something: a surface or, in a medium, a particle
    active: Any  # Bool: there is a continuation
    medium: Any = None  # MediumPtr: what the continuation goes through (with media only, else None)


def mis_weight(pdf_a: Any, pdf_b: Any) -> Any:
    """Power heuristic of Veach, p_a² / (p_a² + p_b²); zero where that is not finite."""
    a2 = dr.square(pdf_a)
    weight = a2 / dr.fma(pdf_b, pdf_b, a2)
    return dr.select(dr.isfinite(weight), weight, 0)


def reciprocal(x: Any) -> Any:
    """1/x where x is not zero, else zero."""
    return dr.select(x != 0, dr.rcp(x), 0)


def is_smooth(bsdf: Any) -> Any:
    """True where next-event estimation can reach a lobe of the BSDF."""
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
