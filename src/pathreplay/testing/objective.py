"""The objective of a check, F(t): a weighted mean of the image, as a function of one parameter along one curve.

F(π) = Σ_k w_k I_k(π) / n is linear in the image, so that the gradient of one noisy image is an unbiased sample of the
gradient of F, and the difference of two noisy images one of its difference.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.integrators.stateful import stateful
from pathreplay.scenes.descriptions import told
from pathreplay.scenes.parameters import get_array
from pathreplay.testing.direction import Line
from pathreplay.testing.stencil import Stencil
from pathreplay.testing.verdict import NEGLIGIBLE, Judgement, judge

Mode = Literal["backward", "forward"]
Move = Callable[[Any, "mi.Float"], Any]
Loss = Callable[["mi.TensorXf"], "mi.Float"]


@contextmanager
def alone(params: mi.SceneParameters, key: str) -> Iterator[None]:
    """Detach all parameters, so that only ``key`` will be attached; put everything back at the end."""
    # Copies: the map hands out references to what the scene holds, and the scene is about to change.
    held = {name: dr.copy(params[name]) for name in params.keys() if name == key or dr.grad_enabled(params[name])}
    # Setting through the map, then update(): objects keep values derived from their parameters.
    for name, value in held.items():
        params[name] = dr.detach(value)
    params.update()
    try:
        yield
    finally:
        for name, value in held.items():
            params[name] = value
        params.update()


class Objective:
    """The scene on the curve move(value, t) through the value of one parameter, seen by one sensor, under weights.

    ``move(value, t)`` is the parameter at t, the value itself at t = 0. Unless it says otherwise, all of a method's
    pictures have the same seed: common random numbers.
    """

    def __init__(self, scene: mi.Scene, params: mi.SceneParameters, key: str, move: Move, sensor: int = 0) -> None:
        assert key in params, f"{key} is not among {list(params.keys())}"
        self.scene = scene
        self.params = params
        self.key = key
        self.value = dr.copy(dr.detach(params[key]))
        self.move = move
        self.sensor = scene.sensors()[sensor]

    def put(self, t: mi.Float) -> None:
        """Set the parameter to its value at t; update() evaluates it, so that all t share one kernel."""
        self.params[self.key] = self.move(self.value, t)
        self.params.update()

    def weigh(self, weights: np.ndarray) -> None:
        """Set the weights w / n, of the shape of the picture."""
        self.adjoint = mi.TensorXf(weights)
        self.weights = np.array(self.adjoint, np.float64)

    def weigh_by(self, loss: Loss | None, plain: mi.Integrator, seed: int, spp: int) -> None:
        """Set smooth weights, or the derivative of a loss at a picture; and the scale Σ |w_k I_k| / n of F."""
        image = self._render(plain, seed, spp)
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
        self.weigh(w)
        self.scale = float(np.abs(w * np.array(image, np.float64)).sum())

    def dot(self, image: np.ndarray) -> float:
        """The weighted sum; in double precision, since it must not round what a difference is made of."""
        return float(np.vdot(self.weights, image))

    def image(self, integrator: mi.Integrator, seed: int, spp: int, t: float = 0.0) -> np.ndarray:
        """The picture at t (height x width x channels)."""
        self.put(dr.opaque(mi.Float, t))
        return np.array(self._render(integrator, seed, spp), np.float64)

    def difference(self, integrator: mi.Integrator, stencil: Stencil, h: float, seed: int, spp: int) -> np.ndarray:
        """Finite difference of the picture."""
        return stencil(lambda t: self.image(integrator, seed, spp, t), h)

    def derivative(self, integrator: mi.Integrator, mode: Mode, primal: int, seed: int, spp: int) -> float:
        """dF/dt at 0, through ``mi.render`` and with seeds for picture and derivative, as users have it."""
        name = integrator_name(integrator)
        with told(f"Integrator '{name}' cannot differentiate '{self.key}' in {mode} mode", (RuntimeError, TypeError)):
            t = self._attached()
            image = mi.render(
                self.scene, self.params, sensor=self.sensor, integrator=integrator,
                seed=mi.UInt32(primal), seed_grad=seed, spp=spp,
            )  # fmt: skip
            if mode == "forward":
                dr.forward(t)
                return self.dot(np.array(dr.grad(image), np.float64))
            dr.backward(dr.sum(image * self.adjoint, axis=None))
            return float(dr.grad(t)[0])

    def forward(self, integrator: mi.Integrator, seed: int, spp: int) -> np.ndarray:
        """The derivative of the picture, by the integrator's forward pass alone."""
        dr.forward(self._attached(), dr.ADFlag.ClearEdges)
        image = integrator.render_forward(self.scene, self.params, self.sensor, seed=seed, spp=spp)
        return np.array(image, np.float64)

    def backward(self, integrator: mi.Integrator, seed: int, spp: int) -> float:
        """dF/dt, by the integrator's reverse pass alone."""
        t = self._attached()
        integrator.render_backward(self.scene, self.params, self.adjoint, self.sensor, seed=seed, spp=spp)
        return self.collect(t)

    def transpose_error(self, ahead: mi.Integrator, back: mi.Integrator, seed: int, spp: int) -> float:
        """|<W, J v> - <J^T W, v>| / Σ |W J v|: a forward pass against a reverse pass with the same random numbers."""
        tangent = self.forward(ahead, seed, spp)
        return abs(self.dot(tangent) - self.backward(back, seed, spp)) / self.dot(np.abs(tangent))

    def collect(self, t: mi.Float) -> float:
        """Bring what a reverse pass left at the parameter back to t."""
        dr.enqueue(dr.ADMode.Backward, self.params[self.key])
        dr.traverse(dr.ADMode.Backward)
        return float(dr.grad(t)[0])

    def judge(self, line: Line, gradients: np.ndarray, full: np.ndarray, half: np.ndarray) -> Judgement:
        """The verdict on gradients, from differences along the line with its stencil and with this halved."""
        # A rounding error of one half unit in the last place of every image, all of one sign, at worst.
        unit = np.finfo(get_array(self.value).dtype).eps / 2
        rounding = line.stencil.rounding() * unit * self.scale / line.step
        return judge(gradients, full, half, rounding=rounding, negligible=NEGLIGIBLE * self.scale / line.size)

    def _attached(self) -> mi.Float:
        """t = 0 with gradients, which the parameter's value at t now passes on."""
        t = dr.opaque(mi.Float, 0)
        dr.enable_grad(t)
        self.put(t)
        return t

    def _render(self, integrator: mi.Integrator, seed: int, spp: int) -> mi.TensorXf:
        with told(f"Integrator '{integrator_name(integrator)}' cannot render the scene"):
            return mi.TensorXf(integrator.render(self.scene, self.sensor, seed=mi.UInt32(seed), spp=spp))


def _has_alpha(sensor: mi.Sensor) -> bool:
    return bool(mi.has_flag(sensor.film().flags(), mi.FilmFlags.Alpha))


def smooth_weights(shape: tuple[int, ...], alpha: bool) -> np.ndarray:
    """w / n with w = 1 + cos(2π (0.7 x + 0.4 y + c/3)) / 2 for pixel (x, y) in [0, 1]² and channel c.

    Positive and smooth, since random signs would cost resolution as in a direction; a wave across the image
    and out of phase between channels, of which no mirror symmetry of a scene makes a constant.
    """
    height, width, channels = shape
    y, x, c = np.ogrid[:height, :width, :channels]
    w = 1 + 0.5 * np.cos(2 * np.pi * (0.7 * ((x + 0.5) / width) + 0.4 * ((y + 0.5) / height) + c / 3))
    if alpha:
        w[..., -1] = 0
    return w / w.size


def integrator_name(integrator: mi.Integrator) -> str:
    """Name of the integrator as a user writes it, and its boundary terms; a PRBIntegrator is called 'prb'."""
    # For Python plugins Mitsuba's class_name() is that of the C++ base.
    name = type(integrator).__name__ if isinstance(integrator, mi.CppADIntegrator) else str(integrator.class_name())
    name = name.removesuffix("Integrator").replace("VolumetricPath", "Volpath").lower()
    edges = stateful(integrator).options().get("boundary", "auto")
    return name if edges == "auto" else f"{name}, boundary {edges}"
