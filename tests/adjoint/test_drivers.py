"""Every driver keeps the promise of its protocol: its arguments, what it says of motion, and a gradient in fog."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from driven import FLOOR, KEYS, conforms, driven, driven_forward, foggy, ray_weights, world
from pathreplay import PathreplayError
from pathreplay.adjoint.driver import Driver, ForwardDriver
from pathreplay.adjoint.forward import forward
from pathreplay.adjoint.replay import replay
from pathreplay.adjoint.sweep import sweep
from pathreplay.integrators.baselines.listing import listing
from pathreplay.integrators.baselines.naive import tape_backward, tape_forward
from pathreplay.integrators.baselines.radiative import radiative
from pathreplay.scenes.parameters import get_array

BACKWARD: dict[str, Driver] = {
    "sweep": sweep,
    "replay": replay,
    "tape_backward": tape_backward,
    "radiative": radiative,
    "listing": listing,
}
FORWARD: dict[str, ForwardDriver] = {"forward": forward, "tape_forward": tape_forward}
#: One estimator: the same numbers, but for rounding.
ALIKE = ("sweep", "replay", "tape_backward")
#: Surfaces that move are followed; `radiative` holds them, and `listing` is for media that stand still.
FOLLOW = ALIKE
TOLERANCE = 1e-4

BLOCK = "block.vertex_positions"


def block() -> dict[str, Any]:
    at = mi.ScalarTransform4f().translate([1.6, -0.4, 0]).rotate([0, 1, 0], 30).scale(0.4)
    return {"type": "cube", "to_world": at, "bsdf": {"type": "conductor"}}


def sound(values: np.ndarray) -> bool:
    return bool(np.isfinite(values).all() and np.abs(values).max() > 0)


def test_conformance_is_looked_at() -> None:
    """What looks at signatures tells a driver from others."""
    assert not conforms(forward, Driver) and not conforms(sweep, ForwardDriver)

    def demanding(trace: Any, start: Any, δL: Any, lost: Any, more: Any) -> bool:
        return False

    assert not conforms(demanding, Driver)


@pytest.mark.parametrize("name", BACKWARD)
def test_a_driver_has_the_signature_of_its_protocol(name: str) -> None:
    assert conforms(BACKWARD[name], Driver)


@pytest.mark.parametrize("name", FORWARD)
def test_a_forward_driver_has_the_signature_of_its_protocol(name: str) -> None:
    assert conforms(FORWARD[name], ForwardDriver)


@pytest.mark.parametrize("name", BACKWARD)
def test_a_driver_differentiates_still_fog(name: str) -> None:
    gradient, moves = driven(BACKWARD[name], foggy(), *KEYS)
    assert moves is False
    assert all(sound(part) for part in (gradient[:1], gradient[1:2], gradient[2:5], gradient[5:]))
    if name in ALIKE:
        expected, _ = driven(sweep, foggy(), *KEYS)
        np.testing.assert_allclose(gradient, expected, rtol=TOLERANCE)


@pytest.mark.slow
@pytest.mark.parametrize("name", FORWARD)
def test_a_forward_driver_differentiates_still_fog(name: str) -> None:
    """Its tangents add up to the gradient of the sweep, by parameters that grow by their own size."""
    scene = foggy()
    params = mi.traverse(scene)
    values = np.concatenate([np.ravel(get_array(params[key])) for key in KEYS])
    tangent, valid, moves = driven_forward(FORWARD[name], scene, *KEYS)
    gradient, _ = driven(sweep, scene, *KEYS)
    assert moves is False and sound(tangent) and valid.any()
    np.testing.assert_allclose(np.vdot(ray_weights(tangent.shape[1]), tangent), gradient @ values, rtol=TOLERANCE)


@pytest.mark.parametrize("name", FOLLOW)
def test_a_driver_tells_that_paths_move(name: str) -> None:
    gradient, moves = driven(BACKWARD[name], world(block=block()), BLOCK, max_depth=3)
    assert moves is True and sound(gradient)


@pytest.mark.parametrize("name", FORWARD)
def test_a_forward_driver_tells_that_paths_move(name: str) -> None:
    tangent, _, moves = driven_forward(FORWARD[name], world(block=block()), BLOCK, max_depth=3)
    assert moves is True and sound(tangent)


def test_what_follows_nothing_says_that_nothing_moves() -> None:
    """Beside the block that moves there is paint, or nothing would reach the paths."""
    gradient, moves = driven(radiative, world(block=block()), FLOOR, BLOCK, max_depth=3)
    assert moves is False and sound(gradient[:3]) and not gradient[3:].any()


@pytest.mark.parametrize(
    ("driver", "message"),
    [(listing, "does not differentiate motion"), (replay, "does not support parameters that move paths")],
    ids=["listing", "replay"],
)
def test_what_cannot_follow_motion_in_fog_refuses(driver: Callable[..., bool], message: str) -> None:
    with pytest.raises((PathreplayError, RuntimeError), match=message):
        driven(driver, foggy(block=block()), BLOCK)
