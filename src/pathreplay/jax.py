"""Rendering as a function of JAX arrays: images, and gradients of a JAX loss.

Images and gradients are computed by Python callbacks (`jax.pure_callback`). The transformations `jax.jit`, `jax.grad`
and `jax.vmap` can be applied. With `jax.vmap`, the images are rendered one after the other.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property, partial

import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.platform.owned_arrays import with_space
from pathreplay.scenes.scene_function import SceneFunction, View

try:
    import jax
    import jax.numpy as jnp
except ImportError:
    raise PathreplayError("JAX is not installed: pip install jax, or 'pathreplay[jax]'") from None

Arrays = Mapping[str, jax.Array]
"""Decoded values by parameter key, in the shapes of `RenderFunction.initial_values`."""
Kept = tuple[jax.Array, tuple[jax.Array, ...]]
"""Seed and values, which the forward pass saves for the backward pass."""


class RenderFunction(SceneFunction):
    """Images of a scene as a function of some of its parameters; see `SceneFunction` for the arguments.

    Arrays are float32 and are copied through host memory.
    """

    @cached_property
    def _functions(self) -> dict[tuple[int, int], Callable[..., jax.Array]]:
        """Differentiable JAX functions by sensor and samples per pixel."""
        return {}

    def initial_values(self) -> dict[str, jax.Array]:
        """Return the parameter values that the scene had when it was loaded.

        Shapes are (height, width, channels) for textures, (z, y, x, channels) for grids, (3,) for colours, (n,) for n
        numbers, (3n,) for n vertices, and (4, 4) for transforms.
        """
        return {key: jnp.asarray(value) for key, value in self._start.items()}

    def __call__(
        self, values: Arrays, sensor: int = 0, *, seed: int | jax.Array = 0, spp: int | None = None
    ) -> jax.Array:
        """Render the image (height, width, channels; linear) of a sensor with these values.

        Textures and grids may have another resolution than in the scene. The image is an unbiased estimate. The
        gradient uses samples that are independent of the image, and is therefore unbiased for losses that are linear or
        quadratic in the image. The integrator determines what is differentiated; there are no second derivatives.

        Args:
            values: arrays by parameter key, in the shapes of `initial_values`.
            sensor: index of the sensor.
            seed: seed of the samples, which should change in every step; may be an array in compiled functions.
            spp: samples per pixel; default: ``spp`` of this object.

        Raises:
            PathreplayError: a value is missing or has the wrong shape. JAX reports errors of the integrator as callback
                errors.
        """
        self.require({key: tuple(np.shape(value)) for key, value in values.items()})
        arrays = tuple(jnp.asarray(values[key], jnp.float32) for key in self.keys)
        which = sensor, spp or self.spp
        if which not in self._functions:
            self._functions[which] = _function(self, *which)
        image: jax.Array = self._functions[which](jnp.asarray(seed, jnp.uint32), arrays)
        return image


def _function(render: RenderFunction, sensor: int, spp: int) -> Callable[..., jax.Array]:
    """Return the image as a differentiable function of seed and values, with its vector-Jacobian product."""
    size = _size(render, sensor)

    def picture(seed: np.ndarray, *values: np.ndarray) -> np.ndarray:
        return np.array(render.picture(_to_drjit(values), View(sensor, int(seed), spp)), np.float32)

    def gradient(seed: np.ndarray, weights: np.ndarray, *values: np.ndarray) -> tuple[np.ndarray, ...]:
        gradients = render.gradient(_to_drjit(values), View(sensor, int(seed), spp), _to_drjit((weights,))[0])
        return tuple(np.array(value, np.float32) for value in gradients)

    call = partial(jax.pure_callback, vmap_method="sequential")

    @jax.custom_vjp
    def function(seed: jax.Array, values: tuple[jax.Array, ...]) -> jax.Array:
        return call(picture, jax.ShapeDtypeStruct(size, jnp.float32), seed, *values)

    def forward(seed: jax.Array, values: tuple[jax.Array, ...]) -> tuple[jax.Array, Kept]:
        return function(seed, values), (seed, values)

    def backward(kept: Kept, weights: jax.Array) -> tuple[None, tuple[jax.Array, ...]]:
        seed, values = kept
        like = tuple(jax.ShapeDtypeStruct(value.shape, jnp.float32) for value in values)
        return None, call(gradient, like, seed, weights, *values)

    function.defvjp(forward, backward)
    return function


def _size(render: RenderFunction, sensor: int) -> tuple[int, ...]:
    """Return height, width and channels of a sensor's images, from a rendering with one sample per pixel."""
    start = _to_drjit(tuple(render._start[key] for key in render.keys))
    return tuple(render.picture(start, View(sensor, 0, 1)).shape)


def _to_drjit(values: tuple[np.ndarray, ...]) -> list[mi.TensorXf]:
    return [mi.TensorXf(with_space(np.array(value, np.float32))) for value in values]
