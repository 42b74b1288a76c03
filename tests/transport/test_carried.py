"""Collisions in a homogeneous medium move with a surface: they are samples of a density with fixed random numbers."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from pathreplay.transport.volume.media import carried
from variant import VARIANT

A, B, STEP = 0.5, 2.0, 1e-4
U = np.linspace(0.01, 0.99, 50)


def samples(κ: float, a: float, b: float) -> tuple[np.ndarray, np.ndarray]:
    """Samples of the density ∝ e^(-κ (t - a)) on [a, b], and the density at the samples."""
    if not κ:
        return a + U * (b - a), np.full_like(U, 1 / (b - a))
    mass = 1 - np.exp(-κ * (b - a))
    return a - np.log(1 - U * mass) / κ, κ * (1 - U * mass) / mass


@pytest.mark.parametrize("κ", [0.0, 0.1, 3.0, 200.0])
@pytest.mark.parametrize("end", ["near", "far"])
def test_a_collision_keeps_its_random_number(end: str, κ: float) -> None:
    mi.set_variant(VARIANT)
    t0, p0 = samples(κ, A, B)
    ends = [(A + h, B) if end == "near" else (A, B + h) for h in (-STEP, STEP)]
    (t_less, p_less), (t_more, p_more) = (samples(κ, *each) for each in ends)

    a, b = mi.Float(A), mi.Float(B)
    moving = a if end == "near" else b
    dr.enable_grad(moving)
    t, stretch = carried(mi.Float(t0), a, b, mi.Bool(True), mi.Float(κ) if κ else None)
    dr.forward(moving)
    assert np.allclose(t.numpy(), t0) and np.all(stretch.numpy() == 1)
    assert np.allclose(dr.grad(t).numpy(), (t_more - t_less) / (2 * STEP), atol=2e-3)
    assert np.allclose(dr.grad(stretch).numpy(), p0 * (1 / p_more - 1 / p_less) / (2 * STEP), atol=2e-3 * max(κ, 1))
