"""The objective of a check, F(t): a weighted mean of the image, as a function of one parameter along one line.

F(π) = Σ_k w_k I_k(π) / n is linear in the image, so that the gradient of one noisy image is an unbiased sample of the
gradient of F, and the difference of two noisy images one of its difference.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.check.direction import Line
from pathreplay.errors import PathreplayError
from pathreplay.scenes.loading import innermost, told
from pathreplay.scenes.parameters import displaced

Mode = Literal["backward", "forward"]


@contextmanager
def alone(params: Any, key: str) -> Iterator[Any]:
    """Yield the detached value of ``key`` while no parameter is attached; put everything back at the end."""
    # Copies: the map hands out references to what the scene holds, and the scene is about to change.
    held = {name: _copy(params[name]) for name in params.keys() if name == key or dr.grad_enabled(params[name])}
    # Setting through the map, then update(): objects keep values derived from their parameters.
    for name, value in held.items():
        params[name] = dr.detach(value)
    params.update()
    try:
        yield dr.detach(held[key])
    finally:
        for name, value in held.items():
            params[name] = value
        params.update()


def _copy(value: Any) -> Any:
    """Another handle on the same variable, derivatives and all."""
    return type(value)(value)


class View:
    """The scene on the line value + t · direction, seen by one sensor."""

    def __init__(self, scene: Any, params: Any, key: str, value: Any, line: Line, sensor: Any) -> None:
        self.scene = scene
        self.params = params
        self.key = key
        self.value = value
        self.line = line
        self.sensor = sensor

    def move(self, t: Any) -> None:
        """Set the parameter to value + t · direction; update() evaluates it, so that all t share one kernel."""
        self.params[self.key] = displaced(self.value, self.line.direction, t)
        self.params.update()

    def render(self, integrator: Any, seed: int, spp: int) -> Any:
        with told(f"Integrator '{integrator_name(integrator)}' cannot render the scene"):
            image = integrator.render(self.scene, self.sensor, seed=mi.UInt32(seed), spp=spp)
            return mi.TensorXf(image)

    def weights(self, plain: Any, loss: Any, seed: int, spp: int) -> tuple[Any, float]:
        """The weights w / n as a tensor like the image, and the scale Σ |w_k I_k| / n of the objective."""
        image = self.render(plain, seed, spp)
        if loss is None:
            w = smooth_weights(image.shape, _has_alpha(self.sensor))
        else:
            dr.enable_grad(image)
            value = loss(image)
            if not dr.is_diff_v(value) or not dr.grad_enabled(value):
                raise PathreplayError("loss does not depend on its image, or not through Dr.Jit operations")
            dr.backward(value)
            w = np.array(dr.grad(image), np.float64)
            if not np.isfinite(w).all():
                raise PathreplayError("loss has a derivative that is NaN or infinite; give a function without, or none")
            if _has_alpha(self.sensor):
                w[..., -1] = 0
        return mi.TensorXf(w), float(np.abs(w * np.array(image, np.float64)).sum())

    def objective(self, integrator: Any, weights: Any, t: float, seed: int, spp: int) -> float:
        self.move(dr.opaque(mi.Float, t))
        image = self.render(integrator, seed, spp)
        # Double precision: sums over the image must not round what the difference is made of.
        return float(np.vdot(np.array(weights, np.float64), np.array(image, np.float64)))

    def derivative(self, integrator: Any, mode: Mode, weights: Any, primal: int, seed: int, spp: int) -> float:
        t = dr.opaque(mi.Float, 0)
        dr.enable_grad(t)
        try:
            self.move(t)
            image = mi.render(
                self.scene, self.params, sensor=self.sensor, integrator=integrator,
                seed=mi.UInt32(primal), seed_grad=seed, spp=spp,
            )  # fmt: skip
            if mode == "forward":
                dr.forward(t)
                return float(np.vdot(np.array(weights, np.float64), np.array(dr.grad(image), np.float64)))
            dr.backward(dr.sum(image * weights, axis=None))
            return float(dr.grad(t)[0])
        except (RuntimeError, TypeError, NotImplementedError) as error:
            name = integrator_name(integrator)
            raise PathreplayError(
                f"Integrator '{name}' cannot differentiate '{self.key}' in {mode} mode: {innermost(error)}"
            ) from error


def _has_alpha(sensor: Any) -> bool:
    return bool(mi.has_flag(sensor.film().flags(), mi.FilmFlags.Alpha))


def smooth_weights(shape: tuple[int, ...], alpha: bool) -> np.ndarray:
    """w / n with w = 1 + cos(2π (0.7 x + 0.4 y + c/3)) / 2 for pixel (x, y) in [0, 1]² and channel c.

    Positive and smooth, since random signs would cost resolution as in a direction; a wave across the image
    and out of phase between channels, of which no mirror symmetry of a scene makes a constant.
    """
    height, width, channels = shape
    y, x, c = np.meshgrid(
        (np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, np.arange(channels), indexing="ij"
    )
    w = 1 + 0.5 * np.cos(2 * np.pi * (0.7 * x + 0.4 * y + c / 3))
    if alpha:
        w[..., -1] = 0
    return w / w.size


def integrator_name(integrator: Any) -> str:
    """The integrator as its user writes it, from the name of its class: 'PRBIntegrator' is 'prb'."""
    # For Python plugins Mitsuba's class_name() is that of the C++ base.
    python = isinstance(integrator, mi.CppADIntegrator)
    name = type(integrator).__name__ if python else str(integrator.class_name())
    return name.removesuffix("Integrator").replace("VolumetricPath", "Volpath").lower()
