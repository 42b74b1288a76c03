"""Properties of the integrators: their declarations, and validation with one-line errors that name the remedy."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import mitsuba as mi

from pathreplay.adjoint.ray_jacobian import Recovery
from pathreplay.errors import PathreplayError, shown
from pathreplay.platform.properties import Property

T = TypeVar("T")

#: Largest integer that Mitsuba's integrators can store.
LARGEST = 2**31 - 1


MAX_DEPTH = Property(
    "max_depth",
    "integer",
    6,
    "Longest path in segments. 1 sees emitters only. -1 is unbounded.",
)
RR_DEPTH = Property(
    "rr_depth",
    "integer",
    5,
    "Depth from which Russian roulette may end a path. Its probabilities are not differentiated.",
)
HIDE_EMITTERS = Property(
    "hide_emitters",
    "boolean",
    False,
    "The camera does not see emitters directly, nor environments behind surfaces that transmit light unscattered.",
)
ADJOINT = Property(
    "adjoint",
    "string",
    "auto",
    "How reverse mode visits a path again. `recorded` stores its vertices (up to depth 2048; with media 1024). "
    "`replay` traces it again, to any depth. `auto` records where the depth allows it, and traces once if only "
    "emission has gradients. Forward mode ignores this property.",
    ("auto", "recorded", "replay"),
    "gradients.md#emission-alone",
)
ATTACH = Property(
    "attach",
    "string",
    "delta",
    "Which sampled directions depend on parameters: those of mirrors and smooth glass (`delta`), `all`, or `none`.",
    ("delta", "all", "none"),
    "gradients.md#attach",
)
JACOBIAN_NOISE = Property(
    "jacobian_noise",
    "float",
    Recovery.noise,
    "Standard deviation of the perturbed ray Jacobian of `replay`, where paths move.",
    see="replay.md",
)
SAMPLING = Property(
    "sampling",
    "string",
    "sobol",
    "`sobol` replaces an `independent` sampler by Owen-scrambled Sobol samples. `scene` keeps the scene's own sampler.",
    ("scene", "sobol"),
    "gradients.md#low-discrepancy-sampling",
)
NULL_BRANCHING: Property[str | bool] = Property(
    "null_branching",
    "string or boolean",
    "auto",
    "Trace an additional path from one null collision, as if the medium had scattered there. `auto` does so if an "
    "extinction with gradients varies in space or is zero.",
    ("auto", True, False),
    "media.md#what-is-differentiated",
)
BOUNDARY = Property(
    "boundary",
    "string",
    "auto",
    "Boundary terms of visibility: `none`, edges that the camera sees (`primary`), or `all`. `auto` is `all` if "
    "something that can occlude light moves, otherwise `none`.",
    ("auto", "none", "primary", "all"),
    "boundary.md",
)
BOUNDARY_SPP = Property(
    "boundary_spp",
    "integer",
    0,
    "Segments per pixel that are searched for edges. 0 means the samples per pixel of the pass.",
    see="boundary.md#in-use",
)
CAUSTICS = Property(
    "caustics",
    "string",
    "camera",
    "`particles` traces caustics from the emitters, and leaves them out of the camera paths.",
    ("camera", "particles"),
    "particles.md",
)
PATHS: tuple[Property[object], ...] = (MAX_DEPTH, RR_DEPTH, HIDE_EMITTERS)
PATH_REPLAY: tuple[Property[object], ...] = (
    replace(MAX_DEPTH, meaning=f'{MAX_DEPTH.meaning} Such paths are replayed; `adjoint = "recorded"` is refused.'),
    RR_DEPTH,
    HIDE_EMITTERS,
    ADJOINT,
    ATTACH,
    JACOBIAN_NOISE,
    SAMPLING,
    NULL_BRANCHING,
    BOUNDARY,
    BOUNDARY_SPP,
    CAUSTICS,
)

SAMPLES_PER_PASS = Property(
    "samples_per_pass",
    "integer",
    None,
    "Accepted for compatibility with `ptracer`. It has no effect: memory does not depend on the number of light paths.",
)
PARTICLES: tuple[Property[object], ...] = (
    replace(
        MAX_DEPTH,
        meaning="Longest path in segments: 2 is light that was scattered once. -1 is unbounded, which derivatives do "
        "not support.",
    ),
    replace(
        RR_DEPTH,
        meaning="Depth from which Russian roulette may end a path, with a probability that depends on its throughput "
        "since the emitter.",
    ),
    replace(HIDE_EMITTERS, meaning="The sensor does not see emitters, and sees through them."),
    SAMPLES_PER_PASS,
    replace(ATTACH, meaning=f"{ATTACH.meaning} `none` leaves out all motion."),
    replace(
        BOUNDARY,
        meaning="Boundary terms of visibility: `none`, edges of emitters that the sensor sees (`primary`), or also "
        "edges that light meets (`all`). `auto` is `all` if something that can occlude light moves, otherwise `none`.",
        see="particles.md#visibility",
    ),
    BOUNDARY_SPP,
    *(
        replace(one, meaning=f"{one.meaning} It applies to the camera rays only.")
        for one in (ADJOINT, JACOBIAN_NOISE, SAMPLING, NULL_BRANCHING)
    ),
)


def choice(props: mi.Properties, plugin: str, declared: Property[T]) -> T:
    """Read a property. Raises PathreplayError if its value is not one of its choices."""
    value = props.get(declared.name, declared.default)
    # Compare types as well, since 1 == True.
    if not any(type(value) is type(allowed) and value == allowed for allowed in declared.choices):
        listed = ", ".join(map(repr, declared.choices))
        raise PathreplayError(f"{plugin}: {declared.name} = {shown(value)} is unknown: use one of {listed}")
    return value


def whole_number(
    props: mi.Properties,
    plugin: str,
    declared: Property[object],
    lowest: int,
    unbounded: bool = False,
    kind: str = "depth",
) -> int:
    """Read an integer from ``lowest`` to `LARGEST`; if ``unbounded``, -1 is valid as well.

    Raises PathreplayError for any other value; the message calls the value a ``kind``.
    """
    value = props.get(declared.name, declared.default)
    if type(value) is int and (lowest <= value <= LARGEST or (unbounded and value == -1)):
        return value
    besides = "-1 (unbounded) or " if unbounded else ""
    raise PathreplayError(
        f"{plugin}: {declared.name} = {shown(value)}: use {besides}a {kind} >= {lowest}, "
        f"a whole number of at most {LARGEST}"
    )


def deviation(props: mi.Properties, plugin: str, declared: Property[object]) -> float:
    """Read a standard deviation. Raises PathreplayError if the value is not a finite number of at least 0."""
    value = props.get(declared.name, declared.default)
    if type(value) not in (int, float) or not 0 <= value < float("inf"):
        raise PathreplayError(
            f"{plugin}: {declared.name} = {shown(value)}: use a finite standard deviation >= 0 (0 = off)"
        )
    return float(value)


def flag(props: mi.Properties, plugin: str, declared: Property[object]) -> bool:
    """Read a boolean property. Raises PathreplayError if the value is not a boolean."""
    value = props.get(declared.name, declared.default)
    if type(value) is not bool:
        raise PathreplayError(f"{plugin}: {declared.name} = {shown(value)}: use true or false")
    return value
