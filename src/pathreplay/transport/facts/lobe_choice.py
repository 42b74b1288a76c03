"""Lobe choice: BSDFs of the user, written in Python, that ignore ``BSDFContext.component``.

The derivatives of their delta lobes are those of the weights that they return: see `scatter._delta_weight`.
"""

from __future__ import annotations

from collections.abc import Iterable

import drjit as dr
import mitsuba as mi

from pathreplay.transport.facts.nodes import with_gradients

PROBES = 64
"""Number of random directions and random numbers with which each delta lobe is sampled."""


class LobeChoice:
    """BSDFs of a scene that ignored `BSDFContext.component` when they were first seen with gradients."""

    def __init__(self, bsdfs: Iterable[mi.BSDF]) -> None:
        own = (b for b in bsdfs if hasattr(b, "__dict__") and not type(b).__module__.startswith("pathreplay."))
        self._unexamined = [bsdf for bsdf in own if bsdf.component_count() > 1]
        self._known: list[str] = []

    def find(self) -> tuple[str, ...]:
        """Examine the BSDFs that have gradients for the first time. Return all known ones, as text."""
        for bsdf in [bsdf for bsdf in self._unexamined if with_gradients(bsdf)]:
            self._unexamined.remove(bsdf)
            delta = (k for k in range(bsdf.component_count()) if mi.has_flag(bsdf.flags(k), mi.BSDFFlags.Delta))
            if not all(_samples_alone(bsdf, k) for k in delta):
                kind = type(bsdf).__name__
                self._known.append(f"{kind} '{bsdf.id()}'" if bsdf.id() else f"a {kind} without id")
        return tuple(self._known)


def _samples_alone(bsdf: mi.BSDF, component: int) -> bool:
    """Return whether a BSDF samples no other lobe if `BSDFContext.component` asks for one lobe.

    The interaction is not on a shape. The result is True if the BSDF raises an error for it.
    """
    random = mi.PCG32(PROBES)
    u, v, w, x, y = (mi.Float(random.next_float32()) for _ in range(5))
    si = dr.zeros(mi.SurfaceInteraction3f, PROBES)
    si.wi, si.uv = mi.warp.square_to_uniform_sphere(mi.Point2f(u, v)), mi.Point2f(x, y)
    si.n, si.sh_frame = mi.Normal3f(0, 0, 1), mi.Frame3f(mi.Vector3f(0, 0, 1))
    if mi.is_spectral:
        si.wavelengths = mi.Spectrum(550)
    ctx = mi.BSDFContext()
    ctx.component = component
    with dr.suspend_grad():
        try:
            sample, weight = bsdf.sample(ctx, si, w, mi.Point2f(x, y), mi.Bool(True))
        except Exception:  # the user's code may need a shape, which this probe lacks
            return True
        alone = (sample.sampled_component == component) & ((sample.sampled_type & bsdf.flags(component)) != 0)
        return bool(dr.all(alone | dr.all(weight == 0)))
