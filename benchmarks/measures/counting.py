"""A phase function that counts its samples, to measure the number of real events instead of deducing it."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi


def register() -> type:
    """Register the isotropic `countingphase` for the active variant; return its class with the counter ``count``."""

    class CountingPhase(mi.PhaseFunction):  # type: ignore[misc]
        count = dr.zeros(mi.UInt32, 1)  # of all instances

        def sample(self, ctx: Any, mei: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple[Any, Any, Any]:
            dr.scatter_add(CountingPhase.count, mi.UInt32(1), mi.UInt32(0), active)
            return mi.warp.square_to_uniform_sphere(sample2), mi.Spectrum(1), mi.Float(dr.inv_four_pi)

        def eval_pdf(self, ctx: Any, mei: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
            return mi.Spectrum(dr.inv_four_pi), mi.Float(dr.inv_four_pi)

        def to_string(self) -> str:
            return "CountingPhase[]"

    mi.register_phase("countingphase", lambda props: CountingPhase(props))
    return CountingPhase
