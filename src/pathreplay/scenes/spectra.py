"""Colours in spectral variants: the coefficients that Mitsuba keeps of them, and numbers that people can handle.

There a colour is a smooth spectrum S(p(λ)) with p(λ) = c_0 λ² + c_1 λ + c_2, λ in nm, S(p) = 1/2 + p / (2 √(1 + p²)).
What is kept are c_0, c_1, c_2 (environment maps and grids: and a factor, as fourth channel): a step of 0.01 in c_0
moves p by thousands, and one in c_2 by hardly anything. So steps are taken in the values of p or S at three
wavelengths. The former follow from c by a constant matrix; S, a reflectance, is nearly linear in them for colours that
are not vivid.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

WAVELENGTHS = (610.0, 545.0, 460.0)
"""Where p and S are taken (nm): what Mitsuba makes of a moderate red, green or blue is nearly S there."""

TO_COEFFICIENTS = np.linalg.inv(np.vander(WAVELENGTHS))
"""c is this matrix times the values of p at `WAVELENGTHS`."""

_COLOURS = ("SRGBReflectanceSpectrum", "D65Spectrum")


def coefficient_channels(params: Any, key: str) -> int:
    """Channels of a parameter of ``mi.traverse(scene)`` that holds coefficients: 3, or 4 with a factor; else 0."""
    if not mi.is_spectral:
        return 0
    owner, name = params.properties[key][2], key.rsplit(".", 1)[-1]
    kind = str(owner.class_name())
    if kind in _COLOURS:
        return 3 if name == "value" else 0
    if name != "data":
        return 0
    channels = int(dr.shape(params[key])[-1])
    if kind.startswith("BitmapTexture"):
        return 3 if channels == 3 and "raw = 0" in str(owner) else 0
    return 4 if kind in ("EnvironmentMapEmitter", "GridVolume") and channels == 4 else 0


def coefficients(p: np.ndarray) -> np.ndarray:
    """Coefficients of the values of p at `WAVELENGTHS` (along the last axis; a fourth channel stays what it is)."""
    return np.concatenate([p[..., :3] @ TO_COEFFICIENTS.T, p[..., 3:]], axis=-1)


def values_of_p(c: np.ndarray) -> np.ndarray:
    """The inverse of `coefficients`."""
    return np.concatenate([c[..., :3] @ np.vander(WAVELENGTHS).T, c[..., 3:]], axis=-1)


def spectrum(c: Any, wavelength: float) -> Any:
    """S at a wavelength (nm), of Dr.Jit coefficients."""
    p = (c[0] * wavelength + c[1]) * wavelength + c[2]
    return 0.5 + 0.5 * p * dr.rsqrt(1 + dr.square(p))
