"""Absent lobes: parameters at a value at which Mitsuba never samples a lobe of a BSDF, or does not even evaluate it.

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
    "RoughPlastic": {"diffuse_reflectance": (0,), "specular_reflectance": (0,)},
    "Principled": {"metallic": (1,), "spec_trans": (0, 1), "clearcoat": (0,), "sheen": (0,)},
    "PrincipledThin": {"spec_trans": (0, 1), "diff_trans": (0, 2), "sheen": (0,)},
}
"""Values at which a lobe is absent, by class of the BSDF and parameter. Zero is the lower end of a range."""
BY_MEAN = frozenset({"SmoothPlastic", "RoughPlastic"})
"""BSDFs that sample lobes by the mean of a parameter. A lobe is absent only if all values are at the end."""
INSIDE = 1e-3
"""Distance from an end that `ranges_of` keeps. A lobe is sampled with a probability of about this distance, so that the
noise of the gradient grows as the distance becomes smaller."""


def ranges_of(bsdfs: Iterable[mi.BSDF]) -> dict[mi.Object, tuple[float, float]]:
    """Return lower and upper bounds that exclude `ENDS`, by the texture whose values they bound, without `BY_MEAN`."""
    ranges: dict[mi.Object, tuple[float, float]] = {}
    for bsdf in bsdfs:
        names = {} if bsdf.class_name() in BY_MEAN else ENDS.get(bsdf.class_name(), {})
        textures = children_of(bsdf) if names else {}
        for name in names.keys() & textures.keys():
            lower, upper = ranges.get(textures[name], (-np.inf, np.inf))  # the texture may have several uses
            for end in names[name]:
                lower, upper = (max(lower, INSIDE), upper) if end == 0 else (lower, min(upper, end - INSIDE))
            ranges[textures[name]] = lower, upper
    return ranges


class AbsentLobes:
    """Parameters of a scene that were at one of `ENDS` when they were first seen with gradients."""

    def __init__(self, bsdfs: Iterable[mi.BSDF]) -> None:
        self._unexamined = {bsdf: list(ENDS[bsdf.class_name()]) for bsdf in bsdfs if bsdf.class_name() in ENDS}
        self._known: list[str] = []

    def find(self) -> tuple[str, ...]:
        """Examine the parameters that have gradients for the first time. Return all known ones, as text."""
        for bsdf, names in self._unexamined.items():
            if not names or not with_gradients(bsdf, *names):
                continue
            kind = str(bsdf.class_name())
            at_end = np.all if kind in BY_MEAN else np.any
            for name in list(names):
                if given := with_gradients(bsdf, f"{name}.value", f"{name}.data"):
                    names.remove(name)
                    values = np.concatenate([np.ravel(np.array(dr.detach(value))) for value in given])
                    ends = [end for end in ENDS[kind][name] if at_end(values == end)]
                    owner = f"'{bsdf.id()}'" if bsdf.id() else f"a {kind} without id"
                    self._known += [f"{name} = {end:g} of {owner}" for end in ends]
        return tuple(self._known)
