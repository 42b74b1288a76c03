"""The objective of a check: a weighted mean F of the image, as a function of one scalar t that moves a parameter.

Let I_k be the n values of the image, and w_k their weights. The objective F(t) = Σ_k w_k I_k(t) / n is linear in the
image. The gradient of one noisy image is therefore an unbiased sample of the gradient of F, and the difference of two
noisy images is an unbiased sample of a difference of F.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Literal, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.integrators.scene_facts import facts_of
from pathreplay.integrators.stateful import light_path_plugin, stateful
from pathreplay.platform.owned_arrays import with_space
from pathreplay.scenes.descriptions import errors_as
from pathreplay.scenes.parameters import SceneValue, get_array
from pathreplay.testing.direction import Line
from pathreplay.testing.stencil import Stencil
from pathreplay.testing.verdict import NEGLIGIBLE, Judgement, judge

Mode = Literal["backward", "forward"]
Move: TypeAlias = "Callable[[SceneValue, mi.Float], SceneValue]"
Loss = Callable[["mi.TensorXf"], "mi.Float"]


@contextmanager
def alone(params: mi.SceneParameters, key: str) -> Iterator[None]:
    """Detach all parameters, so that the caller can attach ``key`` alone. Restore all parameters at the end."""
    # Copy the values, because `params` returns references into the scene, whose values are about to change.
    held = {name: dr.copy(params[name]) for name in params.keys() if name == key or dr.grad_enabled(params[name])}
    # Set values through `params`, followed by update(), because objects cache values derived from their parameters.
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
    """The objective F(t) for a scene whose parameter ``key`` moves along a curve, seen by one sensor.

    ``move(value, t)`` is the parameter's value at t; at t = 0 it is ``value``, the value in the scene. Unless stated
    otherwise, all images that one call of a method renders have the same seed, i.e. common random numbers.
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
        """Set the parameter to its value at t. update() evaluates the value, so that all t share one kernel."""
        self.params[self.key] = self.move(self.value, t)
        self.params.update()

    def weigh(self, weights: np.ndarray) -> None:
        """Set the weights w_k / n of the n values of the image. ``weights`` has the shape of the image."""
        self.adjoint = mi.TensorXf(with_space(weights))
        self.weights = np.array(self.adjoint, np.float64)

    def weigh_by(self, loss: Loss | None, plain: mi.Integrator, seed: int, spp: int) -> None:
        """Set the weights, and compute the scale Σ |w_k I_k| / n of F from a rendered image.

        The weights are the derivative of ``loss`` at the image, or `smooth_weights` without a loss.
        """
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
                raise PathreplayError(
                    "loss has a derivative that is NaN or infinite; give another function, or leave it out"
                )
            if _has_alpha(self.sensor):
                w[..., -1] = 0
        self.weigh(w)
        self.scale = float(np.abs(w * np.array(image, np.float64)).sum())

    def dot(self, image: np.ndarray) -> float:
        """Return the weighted sum of an image, in double precision because differences of sums are taken."""
        return float(np.vdot(self.weights, image))

    def image(self, integrator: mi.Integrator, seed: int, spp: int, t: float = 0.0) -> np.ndarray:
        """Render the image at t (height x width x channels)."""
        self.put(dr.opaque(mi.Float, t))
        facts_of(self.scene).enclose(self.scene)
        return np.array(self._render(integrator, seed, spp), np.float64)

    def difference(self, integrator: mi.Integrator, stencil: Stencil, h: float, seed: int, spp: int) -> np.ndarray:
        """Compute the stencil's finite difference of the image with step h."""
        return stencil(lambda t: self.image(integrator, seed, spp, t), h)

    def derivative(self, integrator: mi.Integrator, mode: Mode, primal: int, seed: int, spp: int) -> float:
        """Compute dF/dt at 0 through ``mi.render``, with separate seeds for image and derivative, as in user code."""
        with self._explained(integrator, mode):
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
        """Compute the derivative of the image at t = 0 by ``render_forward``, without rendering the primal image."""
        with self._explained(integrator, "forward"):
            dr.forward(self._attached(), dr.ADFlag.ClearEdges)
            image = integrator.render_forward(self.scene, self.params, self.sensor, seed=seed, spp=spp)
        return np.array(image, np.float64)

    def backward(self, integrator: mi.Integrator, seed: int, spp: int) -> float:
        """Compute dF/dt at 0 by ``render_backward``, without rendering the primal image."""
        t = self._attached()
        integrator.render_backward(self.scene, self.params, self.adjoint, self.sensor, seed=seed, spp=spp)
        return self.collect(t)

    def transpose_error(self, ahead: mi.Integrator, back: mi.Integrator, seed: int, spp: int) -> float:
        """Compute |<W, J v> - <J^T W, v>| / Σ |W J v| from a forward and a reverse pass with equal random numbers.

        W contains the weights, J is the Jacobian of the image, and v the direction of the parameter.
        """
        tangent = self.forward(ahead, seed, spp)
        return abs(self.dot(tangent) - self.backward(back, seed, spp)) / self.dot(np.abs(tangent))

    def collect(self, t: mi.Float) -> float:
        """Propagate the gradient that a reverse pass accumulated at the parameter back to t. Return dF/dt."""
        dr.enqueue(dr.ADMode.Backward, self.params[self.key])
        dr.traverse(dr.ADMode.Backward)
        return float(dr.grad(t)[0])

    def judge(self, line: Line, gradients: np.ndarray, full: np.ndarray, half: np.ndarray) -> Judgement:
        """Judge gradients by finite differences: ``full`` with the step of the line, ``half`` with half of the step."""
        # Worst case: every value of every image has a rounding error of half a unit in the last place, and all these
        # errors have the same sign.
        unit = np.finfo(get_array(self.value).dtype).eps / 2
        rounding = line.stencil.rounding() * unit * self.scale / line.step
        return judge(gradients, full, half, rounding=rounding, negligible=NEGLIGIBLE * self.scale / line.size)

    def _explained(self, integrator: mi.Integrator, mode: Mode) -> AbstractContextManager[None]:
        """Context that converts errors of the integrator's derivative into a PathreplayError."""
        what = f"Integrator '{integrator_name(integrator)}' cannot differentiate '{self.key}' in {mode} mode"
        return errors_as(what, (RuntimeError, TypeError))

    def _attached(self) -> mi.Float:
        """Return t = 0 with gradients enabled, after setting the parameter to its value at t."""
        t = dr.opaque(mi.Float, 0)
        dr.enable_grad(t)
        self.put(t)
        return t

    def _render(self, integrator: mi.Integrator, seed: int, spp: int) -> mi.TensorXf:
        # Virtual function calls reach the objects of all scenes in the process. Without suspend_grad(), attached
        # parameters of another scene would attach this image.
        with errors_as(f"Integrator '{integrator_name(integrator)}' cannot render the scene"), dr.suspend_grad():
            return mi.TensorXf(integrator.render(self.scene, self.sensor, seed=mi.UInt32(seed), spp=spp))


def _has_alpha(sensor: mi.Sensor) -> bool:
    return bool(mi.has_flag(sensor.film().flags(), mi.FilmFlags.Alpha))


def smooth_weights(shape: tuple[int, ...], alpha: bool) -> np.ndarray:
    """Return the weights w / n, with n the number of values of the image.

    At the pixel (x, y) in [0, 1]², channel c has the weight w = 1 + cos(2π (0.7 x + 0.4 y + c/3)) / 2. The weights
    are positive and smooth, because random signs would reduce the signal (see `direction`). The wave runs obliquely
    across the image and is out of phase between channels. Otherwise, a mirror symmetry of the scene could make the
    weighted mean constant.
    """
    height, width, channels = shape
    y, x, c = np.ogrid[:height, :width, :channels]
    w = 1 + 0.5 * np.cos(2 * np.pi * (0.7 * ((x + 0.5) / width) + 0.4 * ((y + 0.5) / height) + c / 3))
    if alpha:
        w[..., -1] = 0
    return w / w.size


def integrator_name(integrator: mi.Integrator) -> str:
    """Return the integrator's name in scene files ('prb' for PRBIntegrator), and its ``boundary`` if not 'auto'."""
    # For Python plugins Mitsuba's class_name() returns the name of the C++ base class.
    name = type(integrator).__name__ if isinstance(integrator, mi.CppADIntegrator) else str(integrator.class_name())
    name = name.removesuffix("Integrator").replace("VolumetricPath", "Volpath").lower()
    name = light_path_plugin(integrator) or name
    edges = stateful(integrator).options().get("boundary", "auto")
    return name if edges == "auto" else f"{name}, boundary {edges}"
