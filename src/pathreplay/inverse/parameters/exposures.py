"""The exposure of each view: factors on its rendered picture that are recovered with the rest, as one more variable.

With a factor e, what is compared with the target T is e I. The derivative of a loss f by e is f'(e I, T) I, in which
the noise of I would meet itself and make every e too small. Two independent renderings A and B are taken: f'(e A, T) B.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import drjit as dr
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.inverse.images.io import Image
from pathreplay.inverse.losses.pixelwise import Loss, mean_loss
from pathreplay.inverse.parameters.reparameterization import Transform
from pathreplay.inverse.parameters.values import Array, Arrays

EXPOSURE = "exposure"
"""Key of the variable: views x 1, or with white balance views x colours."""


class Factors:
    """Steps are taken in the logarithm of the factors; those of one view stay 1, or their geometric mean does.

    ``fixed`` are the rows whose mean logarithm (of each colour) is taken off after each step; none: nothing is.
    """

    uniform = False

    def __init__(self, fixed: Sequence[int]) -> None:
        self.fixed = list(fixed)
        self._log = Transform("log")

    def latent(self, values: Array) -> Array:
        """See `Coordinates`."""
        return self._log.latent(values)

    def gradient(self, values: Array, by_values: Array) -> Array:
        """See `Coordinates`; also of what `values` takes off all factors."""
        found = self._log.gradient(values, by_values)
        if self.fixed:
            found[self.fixed] -= found.sum(axis=0) / len(self.fixed)
        return found

    def values(self, latent: Array) -> Array:
        """See `Coordinates`."""
        return self._log.values(latent - latent[self.fixed].mean(axis=0) if self.fixed else latent)


def start(views: int, channels: int, white_balance: bool) -> Array:
    """Factors of one. Raises PathreplayError where there is one colour only to be balanced."""
    colours = channels - (channels in (2, 4))
    if white_balance and colours == 1:
        raise PathreplayError("exposure: pictures of one channel have no white to balance; leave 'white_balance' out")
    return np.ones((views, colours if white_balance else 1), np.float32)


def factor_of(values: Arrays, view: int, channels: int) -> Image | None:
    """What the picture of a view is multiplied with: 1 x 1 x channels, 1 for alpha; None without exposures."""
    if EXPOSURE not in values:
        return None
    row = values[EXPOSURE][view]
    factor = np.ones((1, 1, channels), np.float32)
    factor[:, :, : channels - (channels in (2, 4))] = row
    return factor


def exposed(values: Arrays, view: int, picture: Image) -> Image:
    """The picture of a view at its exposure."""
    factor = factor_of(values, view, picture.shape[2])
    return picture if factor is None else picture * factor


def derivative(loss: Loss, a: Any, b: Any, factor: Any, target: Any, weight: Any) -> Any:
    """Of the mean loss by the logarithm of the factor, for each channel, from two independent renderings."""
    image = dr.detach(a) * factor
    dr.enable_grad(image)
    dr.backward(mean_loss(loss, image, target, weight))
    return dr.sum(dr.grad(image) * dr.detach(b) * factor, axis=(0, 1))


def gradient(values: Arrays, view: int, by_log: Array) -> Array:
    """That of the variable, from the derivative by the logarithms of one view's factors, for each channel."""
    rows = values[EXPOSURE]
    found = np.zeros_like(rows)
    colours = by_log[: len(by_log) - (len(by_log) in (2, 4))]
    found[view] = (colours if rows.shape[1] > 1 else colours.sum()) / rows[view]
    return found


def fitted(picture: Image, target: Image, weight: Image | None, each: bool) -> Array:
    """The factors at which a picture comes closest to its target: least squares, over all colours or for each."""
    colours = picture.shape[2] - (picture.shape[2] in (2, 4))
    w = np.ones((1, 1, 1)) if weight is None else weight.astype(np.float64)
    a, t = (image[:, :, :colours].astype(np.float64) for image in (picture, target))
    axes = (0, 1) if each else (0, 1, 2)
    above, below = (w * a * t).sum(axis=axes), (w * a * a).sum(axis=axes)
    best = np.divide(above, below, out=np.ones_like(above), where=(above > 0) & (below > 0))
    return np.atleast_1d(best).astype(np.float32)


def with_held_out(values: Mapping[str, Array], pictures: Mapping[int, tuple[Image, Image, Image | None]]) -> Arrays:
    """The values with factors for views that nothing was learned from.

    ``pictures`` are rendering (at exposure 1), target and weight of such views, by place.
    """
    rows = values[EXPOSURE].copy()
    for view, (picture, target, weight) in pictures.items():
        rows[view] = fitted(picture, target, weight, rows.shape[1] > 1)
    return {**values, EXPOSURE: rows}


def fixed_rows(names: Iterable[str], trained: Iterable[int], reference: str | None, free: bool) -> list[int]:
    """The rows that `Factors` holds: that of the ``reference``, those that are learned from, or none."""
    if free:
        return []
    return list(trained) if reference is None else [list(names).index(reference)]
