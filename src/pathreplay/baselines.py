"""Integrators to compare `pathreplay` with: `naive_ad`, `radiative_backprop` and `prb_volume_listing`.

These three integrators use the same code as `pathreplay` for a step of a path. They show the memory, time and noise of
other ways to differentiate a path tracer. Where they compute the same gradients as `pathreplay`, their cost is higher.
They miss some gradients that `pathreplay` computes.
"""

from __future__ import annotations

from functools import cache

from pathreplay.platform.registration import BASELINES, install


@cache
def register() -> None:
    """Register the integrators with Mitsuba, for the active variant and for each variant that is set later."""
    install(BASELINES)
