"""Integrators to compare `pathreplay` with: `naive_ad`, `radiative_backprop` and `prb_volume_listing`.

They show the memory, time and noise of other ways to differentiate a path tracer, on the same light-transport step.
`pathreplay` gives the same gradients for less, or gradients that these miss.
"""

from __future__ import annotations

from functools import cache

from pathreplay.platform.registration import BASELINES, install


@cache
def register() -> None:
    """Register the integrators with Mitsuba, for the active variant and for each variant that is set later."""
    install(BASELINES)
