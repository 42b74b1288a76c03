"""Preconditions of a job: its variant is active, its parameters can affect an image, and its loss is finite."""

from __future__ import annotations

from collections.abc import Iterable

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.inverse.images.io import Image
from pathreplay.inverse.losses.pixelwise import Loss, mean_loss
from pathreplay.platform.owned_arrays import with_space


def require_variant(variant: str | None) -> None:
    """Raise PathreplayError if the variant of a problem is not the active variant. None stands for any variant."""
    if variant not in (None, mi.variant()):
        raise PathreplayError(
            f"The problem was created in variant '{variant}', but the active variant is '{mi.variant()}'; call "
            f"mi.set_variant('{variant}'), or create the problem again"
        )


def require_visible(scene: mi.Scene, params: mi.SceneParameters, keys: Iterable[str]) -> None:
    """In a scene without shapes, raise PathreplayError if a key belongs to neither an emitter nor a sensor."""
    if scene.shapes():
        return
    visible = {
        owner[2] for thing in [*scene.emitters(), *scene.sensors()] for owner in mi.traverse(thing).properties.values()
    }
    for key in keys:
        if params.properties[key][2] not in visible:
            raise PathreplayError(
                f"Parameter '{key}' affects no image: the scene has no shapes; add some, or name a parameter of an "
                "emitter"
            )


def require_finite_loss(
    loss: Loss, name: str, target: Image, weight: Image | None, picture: Image | None = None
) -> None:
    """Raise PathreplayError unless a loss and its derivative with respect to the image are finite.

    Args:
        loss: the loss function.
        name: name of the sensor, for messages.
        target: target image.
        weight: weights of the pixels, or None.
        picture: rendered image; None stands for a black image.
    """
    image = mi.TensorXf(with_space(np.zeros_like(target) if picture is None else picture))
    dr.enable_grad(image)
    value = mean_loss(
        loss, image, mi.TensorXf(with_space(target)), None if weight is None else mi.TensorXf(with_space(weight))
    )
    if not dr.grad_enabled(value):
        raise PathreplayError(
            f"{loss} does not depend on the image; compute it with Dr.Jit functions and arrays throughout"
        )
    dr.backward(value)
    if np.isfinite(np.array(value)).all() and np.isfinite(np.array(dr.grad(image))).all():
        return
    what, shown = ("Target", target) if picture is None else ("Initial image", picture)
    extreme = float(shown.flat[int(np.abs(shown).argmax())])
    raise PathreplayError(
        f"{what} of sensor '{name}' has the value {extreme:g}, for which the loss is not finite in single precision; "
        "scale emitters and images down, or change the initial values"
    )
