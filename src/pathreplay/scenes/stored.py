"""Convert parameters between the form that Mitsuba stores and the decoded values that users see.

============================  ======================================  =================================================
parameter                     stored by Mitsuba                       decoded value
============================  ======================================  =================================================
``data`` of an ``envmap``     one more column at each end, a copy of  the columns of the image; in mono variants one
                              the column at the opposite end;         channel
                              in mono variants three equal channels
textures of 16 bits           half precision                          single precision
colours in spectral variants  coefficients of a smooth spectrum S     S at a red, a green and a blue wavelength; in
                              (see `spectra`); in environment maps    environment maps and volumes, the factor times S
                              and volumes also a factor of S
============================  ======================================  =================================================

Jobs optimise, save and compare decoded values. Bounds, learning rates and resolutions refer to decoded values.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pathreplay.errors import PathreplayError
from pathreplay.platform.owned_arrays import with_space
from pathreplay.scenes.parameters import SceneValue
from pathreplay.scenes.spectra import TO_COEFFICIENTS, WAVELENGTHS, coefficient_channels, spectrum

Array = NDArray[np.float32]

# Distance that `Spectra.store` keeps between the values of a spectrum S and their limits 0 and 1. At these limits, the
# polynomial p is infinite (see `spectra`).
_MARGIN = 1e-4


class Form:
    """The form of most parameters, whose decoded values are equal to the stored values. Base class of other forms."""

    @property
    def wraps(self) -> bool:
        """Whether the first and the last column of a texture are neighbours."""
        return False

    def see(self, stored: SceneValue) -> SceneValue:
        """Decode a stored Dr.Jit value, without derivatives."""
        return stored

    def store(self, seen: SceneValue) -> SceneValue:
        """Encode a decoded value for Mitsuba; differentiable in the decoded value."""
        return seen

    def of_colours(self, key: str, colours: Array) -> Array:
        """Convert linear RGB colours or grey values to decoded values of the same shape.

        Raises PathreplayError if the colours cannot be represented.
        """
        return colours


AS_STORED = Form()


class Half(Form):
    """Textures stored in half precision."""

    def see(self, stored: SceneValue) -> SceneValue:
        return mi.TensorXf(dr.detach(stored))

    def store(self, seen: SceneValue) -> SceneValue:
        return mi.TensorXf16(seen)


@dataclass(frozen=True)
class Sky(Form):
    """Environment maps. Mitsuba stores the last column, then all columns, then the first column."""

    mono: bool

    @property
    def wraps(self) -> bool:
        return True

    def see(self, stored: SceneValue) -> SceneValue:
        columns = np.array(dr.detach(stored))[:, 1:-1]
        return mi.TensorXf(with_space(np.ascontiguousarray(columns[..., :1] if self.mono else columns)))

    def store(self, seen: SceneValue) -> SceneValue:
        assert dr.is_tensor_v(seen)
        height, width, channels = seen.shape
        shape = (height, width + 2, 3 if self.mono else channels)
        entry = dr.arange(mi.UInt32, math.prod(shape))
        texel, channel = entry // shape[2], entry % shape[2]
        row, column = texel // shape[1], (texel % shape[1] + width - 1) % width
        values = dr.gather(mi.Float, seen.array, (row * width + column) * channels + channel % channels)
        return mi.TensorXf(values, shape)


@dataclass(frozen=True)
class Spectra(Form):
    """Colours and textures stored as coefficients of smooth spectra, with an optional factor as fourth channel."""

    scaled: bool = False
    inner: Form = AS_STORED

    @property
    def wraps(self) -> bool:
        return self.inner.wraps

    def see(self, stored: SceneValue) -> SceneValue:
        stored = self.inner.see(dr.detach(stored))
        entries = _entries(stored, 4 if self.scaled else 3)
        S = mi.Vector3f(*(spectrum(entries, wavelength) for wavelength in WAVELENGTHS))
        return _like(stored, S * entries[3] if self.scaled else S)

    def store(self, seen: SceneValue) -> SceneValue:
        S = mi.Vector3f(*_entries(seen, 3))
        # As in Mitsuba, a colour with a factor is scaled so that its largest entry is one half, because spectra with
        # moderate values are smooth. Derivatives ignore the clamping. A colour that a bound has set to 0 or 1 therefore
        # still receives a gradient.
        factor = mi.Float(1)
        if self.scaled:
            doubled = 2 * dr.max(S)
            factor = dr.replace_grad(dr.maximum(doubled, 1e-8), doubled)
        share = S / factor
        x = 2 * dr.replace_grad(dr.clip(share, _MARGIN, 1 - _MARGIN), share) - 1
        p = x * dr.rsqrt(1 - dr.square(x))
        c = [sum(float(a) * p[i] for i, a in enumerate(row)) for row in TO_COEFFICIENTS]
        stored = _like(seen, mi.Vector4f(*c, factor) if self.scaled else mi.Vector3f(*c))
        return self.inner.store(stored)

    def of_colours(self, key: str, colours: Array) -> Array:
        if colours.min() < 0 or (not self.scaled and colours.max() > 1):
            most = "" if self.scaled else " to 1"
            raise PathreplayError(
                f"Parameter '{key}' is a spectrum in variant {mi.variant()} and takes colours from 0{most}, not "
                f"{colours.min():g} to {colours.max():g}; change them, or use an rgb variant"
            )
        rows = colours.reshape(-1, 3).astype(np.float64)
        factor = np.maximum(2 * rows.max(axis=1), 1e-8) if self.scaled else np.ones(len(rows))
        fetched = [mi.srgb_model_fetch(mi.ScalarColor3f(*row)) for row in rows / factor[:, None]]
        c = [mi.Float(with_space(np.array(column, np.float32))) for column in zip(*fetched, strict=True)]
        seen = np.stack([np.array(spectrum(c, wavelength)) for wavelength in WAVELENGTHS], axis=-1)
        return (seen * factor[:, None]).reshape(colours.shape).astype(np.float32)


class EmitterColour(Spectra):
    """The colour of an emitter's radiance, whose brightness Mitsuba stores separately from the coefficients."""

    def of_colours(self, key: str, colours: Array) -> Array:
        raise PathreplayError(
            f"Parameter '{key}' holds the colour of an emitter without its brightness in variant {mi.variant()}, so "
            "that it cannot be set; set the colour of the emitter in the scene file, or use an rgb variant"
        )


def form_of(params: mi.SceneParameters, key: str) -> Form:
    """Return the form in which the parameter ``key`` of ``mi.traverse(scene)`` is stored."""
    value, owner = params[key], params.properties[key][2]
    kind, name = str(owner.class_name()), key.rsplit(".", 1)[-1]
    form: Form = Half() if isinstance(value, mi.TensorXf16) else AS_STORED
    if kind == "EnvironmentMapEmitter" and name == "data":
        form = Sky(mono=mi.is_monochromatic)
    if not (channels := coefficient_channels(params, key)):
        return form
    return EmitterColour() if kind == "D65Spectrum" else Spectra(scaled=channels == 4, inner=form)


def _entries(value: SceneValue, channels: int) -> Any:
    """Split a colour or tensor into its channels, one flat array per channel."""
    kind = mi.Vector3f if channels == 3 else mi.Vector4f
    return dr.unravel(kind, value.array) if dr.is_tensor_v(value) else value


def _like(value: SceneValue, entries: mi.Vector3f | mi.Vector4f) -> SceneValue:
    """Combine channels into a colour or tensor like ``value``. The number of channels may differ from ``value``."""
    if not dr.is_tensor_v(value):
        return type(value)(entries)
    return mi.TensorXf(dr.ravel(entries), (*value.shape[:-1], len(entries)))
