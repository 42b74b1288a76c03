"""Absent lobes: parameters at a value at which Mitsuba neither samples nor evaluates a lobe of a BSDF.

The derivative of such a lobe is missing from gradients with respect to the parameter.
"""

from __future__ import annotations

from collections.abc import Iterable

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.transport.facts.nodes import children_of, with_gradients

ENDS: dict[str, dict[str, tuple[float, ...]]] = {
    "MaskBSDF": {"opacity": (0, 1)},
    "BlendBSDF": {"weight": (0, 1)},
    "SmoothPlastic": {"diffuse_reflectance": (0,), "specular_reflectance": (0,)},
    "Principled": {"metallic": (1,), "spec_trans": (0, 1), "clearcoat": (0,), "sheen": (0,)},
    "PrincipledThin": {"spec_trans": (0, 1), "diff_trans": (0, 2), "sheen": (0,)},
}
"""Values at which a lobe is absent, by class of the BSDF and parameter. Zero is the lower end of a range."""
INSIDE = 1e-3
"""Distance from an end that `ranges_of` keeps. A lobe is sampled with a probability of about this distance, so that the
noise of the gradient grows as the distance becomes smaller."""


def ranges_of(bsdfs: Iterable[mi.BSDF]) -> dict[mi.Object, tuple[float, float]]:
    """Return the lower and upper bounds of parameters that exclude `ENDS`, by the texture that has the values."""
    ranges = {}
    for bsdf in bsdfs:
        if (ends_of := ENDS.get(bsdf.class_name())) is None:
            continue
        for name, texture in children_of(bsdf).items():
            ends = ends_of.get(name, ())
            highest = min((end - INSIDE for end in ends if end > 0), default=np.inf)
            ranges[texture] = INSIDE if 0 in ends else -np.inf, highest
    return ranges


class AbsentLobes:
    """Parameters of a scene that have had gradients at one of `ENDS`. Each parameter is examined once."""

    def __init__(self, bsdfs: Iterable[mi.BSDF]) -> None:
        self._unexamined = {bsdf: dict(ENDS[bsdf.class_name()]) for bsdf in bsdfs if bsdf.class_name() in ENDS}
        self._found: dict[str, None] = {}

    def find(self) -> tuple[str, ...]:
        """Examine the parameters that have gradients for the first time. Return all that were found, with value."""
        for bsdf, ends in self._unexamined.items():
            if not ends or not with_gradients(bsdf, *ends):
                continue
            for name in [name for name in ends if with_gradients(bsdf, name)]:
                values = np.concatenate([np.ravel(np.array(dr.detach(x))) for x in with_gradients(bsdf, name)])
                at = [end for end in ends.pop(name) if np.any(values == end)]
                self._found |= {f"{name} = {end:g} of '{bsdf.id()}'": None for end in at}
        return tuple(self._found)
