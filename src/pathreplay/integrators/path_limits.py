"""Limits that determine the image of an integrator: path length, and whether emitters are visible."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import mitsuba as mi

from pathreplay.integrators.path_integrator import UNBOUNDED


@dataclass(frozen=True)
class Limits:
    """Limits of an integrator. ``max_depth`` -1 is unbounded."""

    max_depth: int
    rr_depth: int
    hide_emitters: bool


def read_limits(integrator: mi.Integrator) -> Limits | None:
    """The limits of an integrator of Mitsuba's or ours, or None where it has no path length to read."""
    # Python integrators have attributes; C++ ones only print them.
    printed = dict(re.findall(r"(max_depth|rr_depth) = (-?\d+)", str(integrator)))
    max_depth = getattr(integrator, "max_depth", printed.get("max_depth"))
    rr_depth: Any = getattr(integrator, "rr_depth", printed.get("rr_depth", 5))
    if max_depth is None:
        return None
    depth = int(max_depth)  # Mitsuba's Python integrators keep -1 as UNBOUNDED
    return Limits(-1 if depth >= UNBOUNDED else depth, int(rr_depth), bool(getattr(integrator, "hide_emitters", False)))
