"""Integrators to compare `pathreplay` with: `naive_ad`, `radiative_backprop` and `prb_volume_listing`.

These three integrators use the same light-transport step as `pathreplay`. They show the memory, time and noise of other
ways to differentiate a path tracer. `pathreplay` computes the same gradients at lower cost, or gradients that the three
integrators miss.
"""

from __future__ import annotations

from functools import cache

from pathreplay.platform.registration import BASELINES, install


@cache
def register() -> None:
    """Register the integrators with Mitsuba, for the active variant and for each variant that is set later."""
    install(BASELINES)
