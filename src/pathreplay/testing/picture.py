"""Derivative images: the derivative of every pixel in forward mode, beside finite differences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from pathreplay.platform.traversal import traversed
from pathreplay.testing.gradient import line_of, require_arguments, require_types
from pathreplay.testing.objective import Objective, alone, integrator_name
from pathreplay.testing.reference import Spec, integrator_under_test, reference_integrator


@dataclass(frozen=True)
class DerivativeImages:
    """The derivative of an image with respect to one parameter along a direction, estimated in two ways."""

    key: str
    integrator: str
    reference_integrator: str
    gradient: np.ndarray
    """Mean of forward passes, height x width x channels."""
    reference: np.ndarray
    """Mean of finite differences with common random numbers, height x width x channels."""


def derivative_images(  # noqa: PLR0913 (all but two are keyword-only)
    scene: mi.Scene,
    key: str,
    *,
    integrator: Spec = None,
    reference: Spec = None,
    max_depth: int | None = None,
    sensor: int = 0,
    seeds: int = 16,
    spp: int = 16,
    fd_spp: int | None = None,
    step: float | None = None,
    direction: Sequence[float] | np.ndarray | None = None,
    seed: int = 0,
) -> DerivativeImages:
    """Compute the derivative of the image with respect to a parameter, by forward mode and by finite differences.

    Args:
        scene: a scene of an AD variant; its parameters and gradients are restored in any case.
        key: a differentiable parameter of ``mi.traverse(scene)``.
        integrator: the integrator under test: see :func:`check_gradient`.
        reference: the integrator whose images are differenced: see :func:`check_gradient`.
        max_depth: path length, if ``integrator`` is None or a name.
        sensor: index of the sensor.
        seeds: number of forward passes in the mean, and number of finite differences in the mean.
        spp: samples per pixel of a forward pass.
        fd_spp: samples per pixel of each image from which differences are computed (None: ``spp``).
        step: step of the differences: see :func:`check_gradient`.
        direction: direction of the parameter: see :func:`check_gradient`.
        seed: determines all random numbers and the direction.

    Returns:
        The mean derivative image of the forward passes, and the mean image of the finite differences.

    The forward derivative lacks the terms that the integrator omits. The integrator must support forward mode, which
    some integrators of Mitsuba do not.

    Raises:
        PathreplayError: a bad argument, a parameter without derivative, or an integrator that cannot differentiate it
            in forward mode.
    """
    fd_spp = spp if fd_spp is None else fd_spp
    require_types(key, sensor=sensor, seeds=seeds, spp=spp, fd_spp=fd_spp, seed=seed)
    require_arguments(scene, sensor, seeds, spp, fd_spp, seed)
    params = traversed(scene)
    tested = integrator_under_test(integrator, scene, max_depth)
    line = line_of(params, key, tested, step, direction, seed)
    plain = reference_integrator(reference, scene, tested)
    words = [int(word) for word in np.random.SeedSequence(seed).generate_state(2 * seeds)]
    with alone(params, key):
        objective = Objective(scene, params, key, line.move, sensor)
        gradient = np.mean([objective.forward(tested, word, spp) for word in words[:seeds]], axis=0)
        differences = [objective.difference(plain, line.stencil, line.step, word, fd_spp) for word in words[seeds:]]
    return DerivativeImages(
        key, integrator_name(tested), integrator_name(plain), gradient, np.mean(differences, axis=0)
    )
