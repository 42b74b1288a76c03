"""Black texels of emitters. Mitsuba samples no rays there, and light paths leave out the derivative of these texels."""

from __future__ import annotations

from collections.abc import Iterable

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.transport.facts.nodes import with_gradients

TEXTURES = {"AreaLight": "radiance.data", "EnvironmentMapEmitter": "data", "Projector": "irradiance.data"}
"""Parameter that contains the texels, by class of the emitter."""


class DarkTexels:
    """Emitters that had black texels when these were first seen with gradients.

    Spectral variants store coefficients in place of colours. There, black texels are not recognised.
    """

    def __init__(self, emitters: Iterable[mi.Emitter]) -> None:
        self._unexamined = [emitter for emitter in emitters if emitter.class_name() in TEXTURES]
        self._known: list[str] = []

    def find(self) -> tuple[str, ...]:
        """Examine the emitters whose texels have gradients for the first time. Return all known ones, as text."""
        for emitter in list(self._unexamined):
            name = TEXTURES[emitter.class_name()]
            given = with_gradients(emitter, name)
            if given:
                self._unexamined.remove(emitter)
            if any(np.any(np.all(np.array(dr.detach(texels)) == 0, axis=-1)) for texels in given):
                shape = emitter.get_shape()
                self._known.append(f"'{name}' of emitter '{(emitter if shape is None else shape).id()}'")
        return tuple(self._known)
