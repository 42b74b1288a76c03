"""Exposures: scale factors on the rendered image of each view, recovered as one additional variable.

The loss f compares the product of a factor e and the image I with the target T. The derivative of the loss with respect
to e is f'(e I, T) I. If both occurrences of I were the same rendering, their noise would be correlated and bias e
towards small values. The estimator f'(e A, T) B therefore uses two independent renderings A and B.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.inverse.images.io import Image, colours_of
from pathreplay.inverse.losses.pixelwise import Loss, mean_loss
from pathreplay.inverse.parameters.reparameterization import Transform
from pathreplay.inverse.parameters.response import linearized, stored
from pathreplay.inverse.parameters.values import Array, Arrays

EXPOSURE = "exposure"
"""Key of the variable, of shape (views, 1), or (views, colours) with white balance."""


class Factors(Transform):
    """Logarithmic coordinates of the factors. The common scale of the factors can be fixed.

    The argument ``fixed`` contains indices of views. After each step, the mean logarithm of the factors of these views
    is subtracted from all logarithms, separately for each colour. The geometric mean of these views' factors therefore
    stays 1. If ``fixed`` is empty, nothing is subtracted and the common scale is free.
    """

    def __init__(self, fixed: Sequence[int]) -> None:
        super().__init__("log")
        self.fixed = list(fixed)

    def gradient(self, values: Array, by_values: Array) -> Array:
        """See `Coordinates`.

        `values` subtracts the mean of the logarithms in ``fixed``. The gradient includes the derivative of this mean.
        """
        by_latent = super().gradient(values, by_values)
        if self.fixed:
            by_latent[self.fixed] -= by_latent.sum(axis=0) / len(self.fixed)
        return by_latent

    def values(self, latent: Array) -> Array:
        return super().values(latent - latent[self.fixed].mean(axis=0) if self.fixed else latent)


def start(views: int, channels: int, white_balance: bool) -> Array:
    """Return initial factors of 1. Raises PathreplayError for white balance of images with one colour channel."""
    colours = colours_of(channels)
    if white_balance and colours == 1:
        raise PathreplayError("exposure: 'white_balance' needs colour images, but these have one channel; remove it")
    return np.ones((views, colours if white_balance else 1), np.float32)


def factor_of(values: Arrays, view: int, channels: int) -> Image | None:
    """Return the factors on the channels of a view's image, shape (1, 1, channels). The factor on alpha is 1.

    Returns None if ``values`` contain no exposures.
    """
    if EXPOSURE not in values:
        return None
    row = values[EXPOSURE][view]
    factor = np.ones((1, 1, channels), np.float32)
    factor[:, :, : colours_of(channels)] = row
    return factor


def exposed(values: Arrays, view: int, picture: Image) -> Image:
    """Multiply the image of a view by its factor, and apply the response of the camera."""
    factor = factor_of(values, view, picture.shape[2])
    return stored(values, picture if factor is None else picture * factor)


def derivative(
    loss: Loss, a: mi.TensorXf, b: mi.TensorXf, factor: mi.TensorXf, target: mi.TensorXf, weight: mi.TensorXf | None
) -> mi.TensorXf:
    """Estimate the derivative of the mean loss with respect to the logarithm of each channel's factor.

    Args:
        loss: the loss function.
        a: a rendering of the view, without exposure.
        b: a second, independent rendering.
        factor: factor on the image, shape (1, 1, channels).
        target: target image.
        weight: weights of the pixels, or None.

    Returns:
        One derivative per channel.
    """
    image = dr.detach(a) * factor
    dr.enable_grad(image)
    dr.backward(mean_loss(loss, image, target, weight))
    return dr.sum(dr.grad(image) * dr.detach(b) * factor, axis=(0, 1))


def gradient(values: Arrays, view: int, by_log: Array) -> Array:
    """Convert the result of `derivative` for one view to a gradient with respect to the factors of all views."""
    rows = values[EXPOSURE]
    by_factors = np.zeros_like(rows)
    colours = by_log[: colours_of(len(by_log))]
    by_factors[view] = (colours if rows.shape[1] > 1 else colours.sum()) / rows[view]
    return by_factors


def derivatives_by_factors(values: Arrays, view: int, picture: Image) -> Array:
    """Return the derivatives of a view's image, times its factor, with respect to each factor of all views."""
    rows = values[EXPOSURE]
    found = np.zeros((*rows.shape, *picture.shape), np.float32)
    colours = colours_of(picture.shape[2])
    for channel in range(colours):
        found[view, channel if rows.shape[1] > 1 else 0, :, :, channel] = picture[:, :, channel]
    return found.reshape(-1, *picture.shape)


def fitted(picture: Image, target: Image, weight: Image | None, each: bool) -> Array:
    """Fit factors on an image to its target by least squares: one per colour if ``each``, or one for all colours."""
    colours = colours_of(picture.shape[2])
    w = np.ones((1, 1, 1)) if weight is None else weight.astype(np.float64)
    a, t = (image[:, :, :colours].astype(np.float64) for image in (picture, target))
    axes = (0, 1) if each else (0, 1, 2)
    above, below = (w * a * t).sum(axis=axes), (w * a * a).sum(axis=axes)
    best = np.divide(above, below, out=np.ones_like(above), where=(above > 0) & (below > 0))
    return np.atleast_1d(best).astype(np.float32)


def with_held_out(values: Mapping[str, Array], pictures: Mapping[int, tuple[Image, Image, Image | None]]) -> Arrays:
    """Return the values with fitted factors for the test views, which are not part of the loss.

    Args:
        values: values by key.
        pictures: rendering at exposure 1, target and weight of each test view, by index of the view.
    """
    rows = values[EXPOSURE].copy()
    for view, (picture, target, weight) in pictures.items():
        rows[view] = fitted(picture, linearized(values, target), weight, rows.shape[1] > 1)
    return {**values, EXPOSURE: rows}
