"""Colours in spectral variants: the coefficients that Mitsuba keeps of them, and numbers that one can step along.

There a colour is a smooth spectrum S(p(λ)) with p(λ) = c_0 λ² + c_1 λ + c_2, λ in nm, S(p) = 1/2 + p / (2 √(1 + p²)).
What is kept are c_0, c_1, c_2 (environment maps and grids: and a scale, as fourth channel): a step of 0.01 in c_0 moves
p by thousands, and one in c_2 by hardly anything. So steps are taken in the values of p at three wavelengths, from
which c follows by a constant matrix; S(p), a reflectance, is nearly linear in p for colours that are not vivid.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

#: Where p is taken (nm): about the middles of blue, green and red.
WAVELENGTHS = (450.0, 550.0, 650.0)
_TO_COEFFICIENTS = np.linalg.inv(np.vander(WAVELENGTHS))

_COLOURS = ("SRGBReflectanceSpectrum", "D65Spectrum")


def holds_coefficients(params: Any, key: str) -> bool:
    """Whether Mitsuba keeps this parameter as coefficients of spectra (`mi.traverse(scene)` and a key of it)."""
    if not mi.is_spectral:
        return False
    owner, name = params.properties[key][2], key.rsplit(".", 1)[-1]
    kind = str(owner.class_name())
    if kind in _COLOURS:
        return name == "value"
    if name != "data":
        return False
    channels = dr.shape(params[key])[-1]
    if kind.startswith("BitmapTexture"):
        return channels == 3 and "raw = 1" not in str(owner)
    return kind in ("EnvironmentMapEmitter", "GridVolume") and channels == 4


def coefficients(p: np.ndarray) -> np.ndarray:
    """Coefficients of the values of p at `WAVELENGTHS` (along the last axis; a fourth channel stays what it is)."""
    return np.concatenate([p[..., :3] @ _TO_COEFFICIENTS.T, p[..., 3:]], axis=-1)


def values_of_p(c: np.ndarray) -> np.ndarray:
    """The inverse of `coefficients`."""
    return np.concatenate([c[..., :3] @ np.vander(WAVELENGTHS).T, c[..., 3:]], axis=-1)
