"""The line in parameter space along which a gradient is checked.

A gradient with respect to a thousand texels is checked through one number, its dot product with a direction. The
direction is random, so that no specific error can remain hidden. All entries of the direction have the same sign, so
that their contributions add up. Random signs would divide the derivative by the square root of the number of entries,
without reducing the noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from pathreplay.errors import PathreplayError
from pathreplay.platform import compat
from pathreplay.scenes.parameters import SceneValue, displaced
from pathreplay.scenes.spectra import coefficients, values_of_p
from pathreplay.testing.stencil import BACKWARD, CENTRAL, FORWARD, Stencil

RELATIVE_STEP = 1e-2
"""Step h relative to the size of the parameter. The relative error of finite differences is then about 1e-4 from
truncation (proportional to h²), and about 1e-5 from the float32 rounding of images."""

# Parameters that may be negative. All other parameters are treated as non-negative if they have no negative entry.
_SIGNED = (*compat.POSITIONS, *compat.NORMALS, *compat.TEXCOORDS, "to_world", "to_uv", "position", "direction")


@dataclass(frozen=True)
class Line:
    """The points value + t * direction of a parameter, and the step h of finite differences along it."""

    value: np.ndarray
    direction: np.ndarray
    description: str
    size: float
    """Size of the parameter: its largest absolute entry along the direction, but at least 1."""
    step: float
    stencil: Stencil

    def move(self, value: SceneValue, t: mi.Float) -> SceneValue:
        """Return ``value`` + t * direction, as an object of the type of ``value``."""
        return displaced(value, self.direction, t)


def choose_line(
    key: str,
    value: np.ndarray,
    direction: ArrayLike | None = None,
    step: float | None = None,
    seed: int = 0,
    *,
    far: bool = False,
    spectra: bool = False,
) -> Line:
    """Choose the line through ``value`` along ``direction``, or along a random direction whose largest entry is 1.

    By default, the step is a hundredth of the parameter's size (see `Line`). The differences are one-sided if a step
    would make an entry of a non-negative parameter negative. This happens, for example, at a black texel. A negative
    roughness or density would be invalid.

    The random direction of a transform is a translation. If ``far``, the transform belongs to an infinitely distant
    emitter (sun, sky), which translation does not change. The random direction is then a rotation about a random axis.
    If ``spectra``, the parameter consists of coefficients of spectra. The default step then changes the values of the
    polynomial p by at most a hundredth: see :mod:`pathreplay.scenes.spectra`.

    Raises PathreplayError for a direction that has another shape, is zero or not finite, and for a step that is not a
    positive number, or is too long or too short for the parameter.
    """
    if value.size == 0:
        raise PathreplayError(f"Parameter '{key}' is empty; there is nothing to check")
    transform = key.rsplit(".", 1)[-1] == "to_world"
    if direction is not None:
        v, description = np.asarray(direction, np.float64), "given"
        if v.size == value.size == 1:
            v = v.reshape(value.shape)
        if v.shape != value.shape:
            raise PathreplayError(f"Direction of shape {v.shape} given for '{key}', whose shape is {value.shape}")
        if not np.isfinite(v).all() or not v.any():
            raise PathreplayError(f"Direction for '{key}' is zero, NaN or infinite; give finite numbers, not all zero")
    else:
        v, description = _random_direction(value, transform, far, spectra, seed)
    # Spectral coefficients have no typical size: a black texel has p = -8192, which would give all texels a huge step.
    size = 1.0 if spectra else max(1.0, float(np.abs(value[v != 0]).max()))
    if step is None:
        step = RELATIVE_STEP * size / ((float(np.abs(values_of_p(v)[..., :3]).max()) if spectra else 0) or 1)
    elif not (np.isfinite(step) and step > 0):
        raise PathreplayError(
            f"Step {step} for '{key}' is not a positive number; leave it out, or give one, for example 0.01"
        )
    else:
        _require_seen(key, value, v, step, size)
    return Line(value, v, description, size, float(step), _choose_stencil(key, value, v * step))


# Largest step relative to the size of the parameter. A longer step would change the scene entirely.
_LONGEST_STEP = 1e6


def _require_seen(key: str, value: np.ndarray, direction: np.ndarray, step: float, size: float) -> None:
    """Raise PathreplayError for a step that is far larger than the parameter, or too small to change it in float32."""
    remedy = f"leave it out, or give one near {RELATIVE_STEP * size:g}"
    if step * float(np.abs(direction).max()) > _LONGEST_STEP * size:
        raise PathreplayError(f"Step {step} for '{key}' is too long for values up to {size:g}; {remedy}")
    if (np.float32(value + step / 2 * direction) == np.float32(value)).all():
        raise PathreplayError(f"Step {step} for '{key}' is lost in the rounding of single precision; {remedy}")


def _random_direction(
    value: np.ndarray, transform: bool, far: bool, spectra: bool, seed: int
) -> tuple[np.ndarray, str]:
    """Draw a direction of the shape of ``value``; return it and a description: see `choose_line`."""
    if value.size == 1:
        return np.ones(value.shape), "scalar"
    v = np.zeros(value.shape)
    if transform and far:
        v[:3, :3] = np.cross(_random_entries((3,), seed), value[:3, :3], axisb=0, axisc=0)
        return v, f"random rotation, seed {seed}"
    if transform:
        v[:3, 3] = _random_entries((3,), seed)
        return v, f"random translation, seed {seed}"
    v = _random_entries(value.shape, seed)
    if spectra:
        v[..., 3:] *= max(1.0, float(np.abs(value[..., 3:]).max(initial=0)))
        v = coefficients(v)
    return v, f"random, seed {seed}"


def _random_entries(shape: tuple[int, ...], seed: int) -> np.ndarray:
    entries = np.random.default_rng(seed).uniform(0.5, 1.0, shape)
    return entries / entries.max()


def _choose_stencil(key: str, value: np.ndarray, move: np.ndarray) -> Stencil:
    bounded = key.rsplit(".", 1)[-1] not in _SIGNED and (value >= 0).all()
    if bounded and not (value >= np.abs(move)).all():
        if (value + 2 * move >= 0).all():
            return FORWARD
        if (value - 2 * move >= 0).all():
            return BACKWARD
    # Both one-sided stencils may also reach negative values, for example if the parameter has zeros and a given
    # direction has mixed signs. Central differences are then used. Negative values are harmless if the image is linear
    # in the parameter near zero.
    return CENTRAL
