"""A scene as a pure function of some of its parameters, with images and vector-Jacobian products.

The results depend only on parameter values, view and seed. Between calls, the scene contains the values of the previous
call, but every call sets all values again. A caller may therefore render several views with different values before it
computes a gradient. (With `drjit.wrap` around `mi.render`, the gradients of all calls would be computed at the values
of the last call.)
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.platform.traversal import traversed
from pathreplay.scenes.descriptions import errors_as, load_integrator
from pathreplay.scenes.loading import load_scene_for
from pathreplay.scenes.parameters import SceneValue, get_array, is_transform, resolve_differentiable
from pathreplay.scenes.stored import form_of


class View(NamedTuple):
    """A sensor, with the seed and the number of samples of its image."""

    sensor: int
    seed: int
    spp: int


class SceneFunction:
    """Rendering as a pure function of Dr.Jit tensors, one per key; the basis of the PyTorch and JAX functions.

    Args:
        scene: a scene, the path of an XML file, or the name of a built-in scene.
        keys: parameters as keys or globs, see `mi.traverse(scene)`.
        integrator: the integrator as a Mitsuba dictionary; `pathreplay` by default.
        spp: samples per pixel, for the image and for its derivative.
        arguments: parameters of the XML file or the built-in scene.

    Raises PathreplayError if the scene or a parameter does not exist, or a parameter is not differentiable.
    """

    def __init__(
        self,
        scene: mi.Scene | str | Path,
        keys: str | Iterable[str],
        *,
        integrator: Mapping[str, object] | None = None,
        spp: int = 16,
        arguments: Mapping[str, object] | None = None,
    ) -> None:
        patterns = [keys] if isinstance(keys, str) else list(keys)
        if isinstance(scene, (str, Path)):
            scene = load_scene_for(scene, patterns, **(arguments or {}))[0]
        elif arguments:
            raise PathreplayError(
                f"arguments ({', '.join(arguments)}) cannot be given for a loaded scene; leave them out"
            )
        self.integrator = load_integrator(integrator or {"type": "pathreplay"})
        if not isinstance(self.integrator, mi.CppADIntegrator):
            raise PathreplayError(
                f"Integrator '{(integrator or {}).get('type')}' computes no gradients; use 'pathreplay'"
            )
        self.scene, self.spp, self.params = scene, spp, traversed(scene)
        self.keys = tuple(resolve_differentiable(self.params, patterns, self.integrator))
        self._forms = {key: form_of(self.params, key) for key in self.keys}
        seen = {key: self._forms[key].see(self.params[key]) for key in self.keys}
        self._types = {key: type(value) for key, value in seen.items()}
        # The values are copied, because calls of this object change the scene.
        self._start = {key: get_array(value).copy() for key, value in seen.items()}

    def require(self, shapes: Mapping[str, tuple[int, ...]]) -> None:
        """Raise PathreplayError unless ``shapes`` has the keys of this function and a valid shape for each parameter.

        Textures and grids may have any size, with the original number of channels.
        """
        for key in (*self.keys, *shapes):
            if key not in shapes or key not in self._forms:
                raise PathreplayError(f"Values of {', '.join(self.keys)} are needed; missing or unexpected: '{key}'")
        for key, shape in shapes.items():
            wanted = self._start[key].shape
            resizable = len(wanted) >= 3 and len(shape) == len(wanted) and shape[-1] == wanted[-1] and min(shape) > 0
            if shape != wanted and not resizable:
                raise PathreplayError(f"Value of shape {shape} given for the parameter '{key}' of shape {wanted}")

    def picture(self, values: Sequence[mi.TensorXf], view: View) -> mi.TensorXf:
        """Render the image of a sensor (height, width, channels; linear)."""
        with dr.suspend_grad(), errors_as("The scene cannot be rendered"):
            self._put(values, grad=False)
            sensor, seed, spp = view
            image = mi.render(self.scene, sensor=sensor, integrator=self.integrator, spp=spp, seed=seed)
            dr.eval(image)
            return image

    def gradient(self, values: Sequence[mi.TensorXf], view: View, weights: mi.TensorXf) -> list[mi.TensorXf]:
        """Compute the gradient of sum(image * weights), from samples that are independent of those of `picture`."""
        sensor, seed, spp = view
        other = int(np.random.SeedSequence([seed, 1]).generate_state(1)[0])
        with dr.resume_grad(), errors_as("The gradient cannot be computed"):
            try:
                seen = self._put(values, grad=True)
                image = mi.render(
                    self.scene,
                    self.params,
                    sensor=sensor,
                    integrator=self.integrator,
                    spp=spp,
                    seed=seed,
                    seed_grad=other,
                )
                dr.backward_from(dr.sum(image * weights, axis=None))
                gradients = [dr.grad(value) for value in seen]
                dr.eval(gradients)
            finally:
                self._put(values, grad=False)  # frees the AD graph to which the scene refers
        return gradients

    def _put(self, values: Sequence[mi.TensorXf], grad: bool) -> list[mi.TensorXf]:
        """Set the parameters of the scene; return the values, attached if ``grad``."""
        one = dr.opaque(mi.Float, 1)  # copies the values by multiplication: optimisers may modify the original memory
        seen = [dr.detach(value) * one for value in values]
        dr.eval(seen)
        if grad:
            dr.enable_grad(seen)
        for key, tensor in zip(self.keys, seen, strict=True):
            self.params[key] = self._forms[key].store(_typed(self._types[key], tensor))
        self.params.update()
        return seen


def _typed(kind: type, tensor: mi.TensorXf) -> SceneValue:
    """Convert a tensor to a value of the given type, differentiably."""
    if dr.is_tensor_v(kind):
        return tensor
    flat = tensor.array
    if is_transform(kind()):
        entries = [[dr.gather(mi.Float, flat, mi.UInt32(4 * i + j)) for j in range(4)] for i in range(4)]
        return kind(mi.Matrix4f(entries))
    if dr.depth_v(kind) == 1:
        return kind(flat)
    count = dr.size_v(kind)
    return kind(*(dr.gather(mi.Float, flat, dr.arange(mi.UInt32, dr.width(flat) // count) + dr.width(flat) // count * i)
                  for i in range(count)))  # fmt: skip
