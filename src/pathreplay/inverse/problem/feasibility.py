"""Whether the gradient of a job can exist: something is seen, and the loss of its images is finite."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.inverse.images.io import Image
from pathreplay.inverse.losses.pixelwise import Loss, mean_loss


def require_visible(scene: mi.Scene, params: mi.SceneParameters, keys: Iterable[str]) -> None:
    """Raise PathreplayError unless the scene has shapes, or all ``keys`` of ``params`` belong to lights and sensors."""
    if scene.shapes():
        return
    seen = {
        owner[2] for thing in [*scene.emitters(), *scene.sensors()] for owner in mi.traverse(thing).properties.values()
    }
    for key in keys:
        if params.properties[key][2] not in seen:
            raise PathreplayError(
                f"Parameter '{key}' cannot be seen: the scene has no shapes; add some, or name a parameter of a light"
            )


def require_finite_loss(
    loss: Loss, name: str, target: Image, weight: Image | None, picture: Image | None = None
) -> None:
    """Raise PathreplayError unless loss and derivative of ``picture`` (default: black) by ``target`` are finite.

    A loss that does not depend on the picture has no derivative.
    """
    image: Any = mi.TensorXf(np.zeros_like(target) if picture is None else picture)
    dr.enable_grad(image)
    value = mean_loss(loss, image, mi.TensorXf(target), None if weight is None else mi.TensorXf(weight))
    if not dr.grad_enabled(value):
        raise PathreplayError(
            f"{loss} does not depend on the image; compute it with Dr.Jit's functions, without leaving its arrays"
        )
    dr.backward(value)
    if np.isfinite(np.array(value)).all() and np.isfinite(np.array(dr.grad(image))).all():
        return
    what, shown = ("Target", target) if picture is None else ("Start picture", picture)
    extreme = float(shown.flat[int(np.abs(shown).argmax())])
    raise PathreplayError(
        f"{what} of sensor '{name}' holds {extreme:g}: the loss is no finite number in single precision; scale lights "
        "and pictures down, or start elsewhere"
    )
