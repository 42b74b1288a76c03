"""The inverse g of the camera response: a monotone curve, shared by all views, that maps stored values to radiance.

A camera stores a value T for the product e I of exposure and radiance. The loss compares e I with g(T). Images are
decoded from sRGB when they are read, so g is the identity for an sRGB camera. Because g is applied to the target, the
loss stays quadratic in the rendered image, and its gradient stays unbiased.

Two forms of g are supported, both with g(0) = 0 and g(1) = 1:

    gamma    g(T) = T^γ
    curve    g(T) = s⁻¹(y(s(T))), where s is the sRGB encoding, and y is monotone and linear between its knots

A relative loss divides by the target g(T). If the derivative with respect to g included this divisor, a curve g that
brightens the target would reduce the loss. The divisor is therefore treated as a constant.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pathreplay.inverse.images.io import Image, colours_of, encoded
from pathreplay.inverse.parameters.reparameterization import Coordinates
from pathreplay.inverse.parameters.values import Array, Arrays

RESPONSE = "response"
"""Key of the variable: the exponent γ (one entry), or the knots y_0 to y_n of a curve, evenly spaced in s(T)."""
SMALLEST = 1e-6
"""Smallest value whose logarithm is taken."""


class Increments(Coordinates):
    """Coordinates (`Coordinates`) of a monotone curve: logarithms of the differences between neighbouring knots.

    The values at the knots ``held`` are fixed, among them the first and the last knot. The differences between two
    consecutive fixed knots are scaled so that they add up to the difference of the fixed values.
    """

    def __init__(self, held: Sequence[int], values: Array) -> None:
        self.held = list(held)
        self._fixed = [float(values[k]) for k in held]

    def latent(self, values: Array) -> Array:
        return np.log(np.maximum(np.diff(values.astype(np.float64)), SMALLEST)).astype(np.float32)

    def values(self, latent: Array) -> Array:
        knots = np.zeros(len(latent) + 1)
        for (a, b), (low, high) in self._spans():
            rises = np.exp(latent[a:b].astype(np.float64) - float(latent[a:b].max()))
            knots[a + 1 : b + 1] = low + (high - low) * np.cumsum(rises) / rises.sum()
            knots[a], knots[b] = low, high
        return knots.astype(np.float32)

    def gradient(self, values: Array, by_values: Array) -> Array:
        rises, found = np.diff(values.astype(np.float64)), np.zeros(len(values) - 1)
        for (a, b), (low, high) in self._spans():
            above = np.cumsum(by_values[a + 1 : b][::-1].astype(np.float64))[::-1]
            slope = np.append(above, 0.0)  # derivative with respect to each difference of neighbouring knots
            found[a:b] = rises[a:b] * (slope - (rises[a:b] * slope).sum() / (high - low))
        return found.astype(np.float32)

    def _spans(self) -> list[tuple[tuple[int, int], tuple[float, float]]]:
        return [
            ((self.held[i], self.held[i + 1]), (self._fixed[i], self._fixed[i + 1])) for i in range(len(self.held) - 1)
        ]


def start(segments: int | None) -> Array:
    """Return the identity, which is the curve g of an sRGB camera, as initial value.

    The value contains the knots of a curve with ``segments`` segments, or the exponent 1 if ``segments`` is None.
    """
    return np.ones(1, np.float32) if segments is None else np.linspace(0, 1, segments + 1, dtype=np.float32)


def coordinates(values: Array, fix_exponent: bool) -> Increments:
    """Return the coordinates of a curve, which is also fixed at its middle knot if ``fix_exponent``."""
    last = len(values) - 1
    return Increments([0, last // 2, last] if fix_exponent else [0, last], values)


def decoded(image: Image) -> Image:
    """Decode sRGB values in [0, 1] to linear values. This function is the inverse of `encoded`."""
    low = image / 12.92
    return np.where(image <= 0.04045, low, ((np.maximum(image, 0.04045) + 0.055) / 1.055) ** 2.4)


def linearized(values: Mapping[str, Array], target: Image) -> Image:
    """Apply g to the colours of a target. A curve does not change colours above 1.

    Returns the target itself if ``values`` contain no response.
    """
    return _applied(values.get(RESPONSE), target)


def stored(values: Mapping[str, Array], image: Image) -> Image:
    """Apply the inverse of `linearized`: the image that the camera would have stored."""
    return _applied(values.get(RESPONSE), image, inverse=True)


def _applied(curve: Array | None, image: Image, inverse: bool = False) -> Image:
    if curve is None:
        return image
    colours, rest = _split(image)
    if len(curve) == 1:
        changed = np.maximum(colours, 0) ** np.float64(1 / curve[0] if inverse else curve[0])
    else:
        knots = np.linspace(0, 1, len(curve)), curve
        x = encoded(np.clip(colours, 0, 1))
        changed = np.where(colours > 1, colours, decoded(np.interp(x, *(knots[::-1] if inverse else knots))))
    return np.concatenate([changed.astype(np.float32), rest], axis=2)


def gradient(values: Arrays, target: Image, by_target: Image) -> Array:
    """Convert the derivative with respect to g(T) of each pixel to the gradient with respect to the variable.

    Args:
        values: values of all variables.
        target: stored values T, shape (height, width, channels).
        by_target: derivative of the loss with respect to g(T), in the shape of ``target``.

    Returns:
        The gradient, in the shape of the variable.
    """
    curve = values[RESPONSE].astype(np.float64)
    colours, slope = (_split(image)[0].astype(np.float64) for image in (target, by_target))
    if len(curve) == 1:
        logs = np.log(np.maximum(colours, SMALLEST))
        return np.array([(slope * logs * np.maximum(colours, 0) ** curve[0]).sum()], np.float32)
    last = len(curve) - 1
    x = encoded(np.clip(colours, 0, 1)) * last
    k = np.minimum(x.astype(int), last - 1)
    f = x - k
    y = curve[k] * (1 - f) + curve[k + 1] * f
    by_y = np.where(colours > 1, 0.0, slope * _decoding_slope(y))
    found = np.bincount(k.ravel(), (by_y * (1 - f)).ravel(), last + 1)
    found += np.bincount(k.ravel() + 1, (by_y * f).ravel(), last + 1)
    return found.astype(np.float32)


def _decoding_slope(y: np.ndarray) -> np.ndarray:
    return np.where(y <= 0.04045, 1 / 12.92, 2.4 / 1.055 * ((np.maximum(y, 0.04045) + 0.055) / 1.055) ** 1.4)


def _split(image: Image) -> tuple[Image, Image]:
    """Split an image into its colours and its alpha channel, which may be absent."""
    colours = colours_of(image.shape[2])
    return image[:, :, :colours], image[:, :, colours:]
