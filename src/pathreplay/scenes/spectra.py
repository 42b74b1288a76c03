"""Colours in spectral variants: the coefficients that Mitsuba stores, and better-scaled values for optimisation steps.

In spectral variants, a colour is a smooth spectrum S(p(λ)), with S(p) = 1/2 + p / (2 √(1 + p²)), p(λ) = c_0 λ² + c_1 λ
+ c_2, and λ in nm. Mitsuba stores c_0, c_1 and c_2. For environment maps and grids, the fourth channel is a factor. A
step of 0.01 in c_0 changes p by thousands, and a step of 0.01 in c_2 changes p by almost nothing. Optimisers therefore
take steps in the values of p or S at three wavelengths. These three values of p are a constant matrix times the vector
c = (c_0, c_1, c_2). For colours of low saturation, the reflectance S is nearly linear in the values of p.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

WAVELENGTHS = (610.0, 545.0, 460.0)
"""Wavelengths (nm) at which p and S are evaluated. There, S is close to the red, green and blue of moderate colours."""

TO_COEFFICIENTS = np.linalg.inv(np.vander(WAVELENGTHS))
"""Matrix that maps the values of p at `WAVELENGTHS` to c."""

_COLOURS = ("SRGBReflectanceSpectrum", "D65Spectrum")


def coefficient_channels(params: mi.SceneParameters, key: str) -> int:
    """Return the number of channels of a parameter that stores the coefficients c_0, c_1, c_2; 0 for other parameters.

    The number is 3, or 4 for environment maps and grid volumes, whose fourth channel is a factor of the spectrum.
    """
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
    """Compute the coefficients from the values of p at `WAVELENGTHS` (last axis); a fourth channel is copied."""
    return np.concatenate([p[..., :3] @ TO_COEFFICIENTS.T, p[..., 3:]], axis=-1)


def values_of_p(c: np.ndarray) -> np.ndarray:
    """Compute the values of p at `WAVELENGTHS` from the coefficients. Inverse of the function `coefficients`."""
    return np.concatenate([c[..., :3] @ np.vander(WAVELENGTHS).T, c[..., 3:]], axis=-1)


def spectrum(c: Sequence[mi.Float] | mi.Vector3f, wavelength: float) -> mi.Float:
    """Evaluate S at a wavelength (nm) from Dr.Jit coefficients."""
    p = (c[0] * wavelength + c[1]) * wavelength + c[2]
    return 0.5 + 0.5 * p * dr.rsqrt(1 + dr.square(p))
