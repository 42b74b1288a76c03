"""Read the path limits of any integrator, and describe the integrator that renders its image for comparison."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from pathreplay.integrators.path_integrator import UNBOUNDED
from pathreplay.integrators.scene_facts import facts_of
from pathreplay.integrators.stateful import PTRACER, light_path_plugin, stateful
from pathreplay.transport.facts.nodes import children_of
from pathreplay.types import Json

DIRECT, DIRECT_DEPTH = "DirectIntegrator", 2
"""Class of an integrator without the property ``max_depth``, and the length of its paths."""


@dataclass(frozen=True)
class Limits:
    """Limits on the paths of an integrator. A ``max_depth`` of -1 means that the path length is unbounded."""

    max_depth: int
    rr_depth: int
    hide_emitters: bool


def nested_in(integrator: mi.Integrator) -> list[mi.Integrator]:
    """Return the integrators that an integrator contains (Mitsuba's ``aov``, ``moment``)."""
    return [child for child in children_of(integrator).values() if isinstance(child, mi.Integrator)]


def without_channels(integrator: mi.Integrator) -> mi.Integrator:
    """Return the innermost integrator, as long as each integrator adds channels to the image of a single other one."""
    inner = nested_in(integrator)
    return without_channels(inner[0]) if len(inner) == 1 and integrator.aov_names() else integrator


def read_limits(integrator: mi.Integrator) -> Limits | None:
    """Read the limits of any integrator; None if its path length cannot be read.

    The limits of an integrator that contains another one (Mitsuba's ``aov``, ``moment``) are those of the other one.
    """
    known = isinstance(integrator, mi.Integrator)  # callers may not have checked what a user has given
    if known:
        integrator = without_channels(integrator)
        inner = nested_in(integrator)
        if inner:
            return read_limits(inner[0]) if len(inner) == 1 else None
    # Python integrators have attributes; C++ integrators only print the values.
    printed = dict(re.findall(r"(max_depth|rr_depth) = (-?\d+)", str(integrator)))
    if known and integrator.class_name() == DIRECT:
        printed["max_depth"] = str(DIRECT_DEPTH)
    max_depth = getattr(integrator, "max_depth", printed.get("max_depth"))
    rr_depth: Any = getattr(integrator, "rr_depth", printed.get("rr_depth", 5))
    if max_depth is None:
        return None
    depth = _whole(max_depth)  # Mitsuba's Python integrators store -1 as UNBOUNDED
    hides = bool(getattr(integrator, "hide_emitters", False))
    return Limits(-1 if depth >= UNBOUNDED else depth, _whole(rr_depth), hides)


def counterpart(integrator: mi.Integrator, scene: mi.Scene) -> Json | None:
    """Describe the integrator whose images have the same expectation; None if the path length cannot be read.

    It is Mitsuba's `path`, or `volpath` with media. These find no caustic of a light without extent, and `ptracer`
    leaves out media, and light at the border of the film. Integrators with light paths are therefore their own
    counterparts. An integrator that contains another one (``aov``, ``moment``) has the counterpart of the other one.
    """
    limits = read_limits(integrator)
    if limits is None:
        return None
    integrator = without_channels(integrator)
    if stateful(integrator).options().get("caustics") != "particles":
        return {"type": "volpath" if facts_of(scene).has_media else "path", **vars(limits)}
    name = light_path_plugin(integrator)
    return {"type": name, **vars(limits)} if name else {"type": "pathreplay", "caustics": "particles", **vars(limits)}


def notes_on_visibility(integrator: mi.Integrator, scene: mi.Scene) -> tuple[str, ...]:
    """Return a note if emitters could be seen, but the scene's integrator does not tell whether it hides them."""
    extended = any(not mi.has_flag(light.flags(), mi.EmitterFlags.Delta) for light in scene.emitters())
    if light_path_plugin(without_channels(integrator)) != PTRACER or not extended:
        return ()
    return (
        "the scene's 'ptracer' does not expose its hide_emitters, so emitters are taken as visible; to hide them, give "
        "the integrator 'pathreplay' with caustics = 'particles', the max_depth of the scene, and hide_emitters = true",
    )


def copied_limits(integrator: mi.Integrator) -> Json:
    """Return the limits that our plugins take over from a scene's integrator, by name; empty if they are unknown.

    A ``max_depth`` of -1 is the default of Mitsuba's integrators, and is copied only from our own. With unbounded
    paths, `pathreplay` would trace each path twice.
    """
    limits = read_limits(integrator)
    if limits is None:
        return {}
    ours = "adjoint" in stateful(without_channels(integrator)).options()
    return {name: value for name, value in vars(limits).items() if ours or name != "max_depth" or value >= 0}


def _whole(number: Any) -> int:
    """Convert a depth to an integer. `volprim_rf_basic` stores depths in Dr.Jit arrays."""
    return int(number[0] if isinstance(number, dr.ArrayBase) else number)
