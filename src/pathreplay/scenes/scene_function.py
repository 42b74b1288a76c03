"""A scene as a function of the values of some of its parameters: pictures, and gradients of what is linear in them.

A pure function of values, view and seed. The scene holds the values of the call before, on which nothing depends:
pictures of several views may be added up before any gradient is asked for, which sets each call's values again.
(`drjit.wrap` around `mi.render` would give the gradients of all calls to the values of the last one.)
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.errors import PathreplayError
from pathreplay.platform.traversal import traversed
from pathreplay.scenes.descriptions import load_integrator, told
from pathreplay.scenes.loading import load_scene_for
from pathreplay.scenes.parameters import get_array, is_transform, resolve_differentiable
from pathreplay.scenes.stored import form_of


class View(NamedTuple):
    """What is looked at, and by which samples."""

    sensor: int
    seed: int
    spp: int


class SceneFunction:
    """Rendering as a pure function of Dr.Jit tensors, in the order of ``keys``, which PyTorch and JAX functions call.

    Args:
        scene: a scene, or the path of an XML file or the name of a built-in, with ``arguments`` for it.
        keys: parameters by key or glob, those of `mi.traverse(scene)`.
        integrator: what renders and differentiates, as a dictionary of Mitsuba's; `pathreplay` if there is none.
        spp: samples per pixel, for the picture and for its derivative.

    Raises PathreplayError for no such scene or parameter, and for parameters without derivative.
    """

    def __init__(
        self,
        scene: mi.Scene | str | Path,
        keys: str | Iterable[str],
        *,
        integrator: Mapping[str, Any] | None = None,
        spp: int = 16,
        arguments: Mapping[str, Any] | None = None,
    ) -> None:
        patterns = [keys] if isinstance(keys, str) else list(keys)
        if isinstance(scene, (str, Path)):
            scene = load_scene_for(scene, patterns, **(arguments or {}))[0]
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
        # Copies: the scene is about to change.
        self._start = {key: get_array(value).copy() for key, value in seen.items()}

    def require(self, shapes: Mapping[str, tuple[int, ...]]) -> None:
        """Raise PathreplayError if these are not the parameters, or cannot have these shapes.

        Textures and grids may have other sizes.
        """
        for key in (*self.keys, *shapes):
            if key not in shapes or key not in self._forms:
                raise PathreplayError(
                    f"Values of {', '.join(self.keys)} are needed, and there is a difference: '{key}'"
                )
        for key, shape in shapes.items():
            wanted = self._start[key].shape
            resizable = len(wanted) >= 3 and len(shape) == len(wanted) and shape[-1] == wanted[-1] and min(shape) > 0
            if shape != wanted and not resizable:
                raise PathreplayError(f"Value of shape {shape} given for the parameter '{key}' of shape {wanted}")

    def picture(self, values: Sequence[mi.TensorXf], view: View) -> mi.TensorXf:
        """What a sensor sees (height, width, channels; linear)."""
        with dr.suspend_grad(), told("The scene cannot be rendered"):
            self._put(values, grad=False)
            sensor, seed, spp = view
            image = mi.render(self.scene, sensor=sensor, integrator=self.integrator, spp=spp, seed=seed)
            dr.eval(image)
            return image

    def gradient(self, values: Sequence[mi.TensorXf], view: View, weights: mi.TensorXf) -> list[mi.TensorXf]:
        """The derivative of the sum of weights times picture, by samples of its own, which the seed decides, too."""
        sensor, seed, spp = view
        other = int(np.random.SeedSequence([seed, 1]).generate_state(1)[0])
        with dr.resume_grad(), told("The gradient cannot be computed"):
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
            found = [dr.grad(value) for value in seen]
            dr.eval(found)
            self._put(values, grad=False)  # the scene lets go of the graph
        return found

    def _put(self, values: Sequence[mi.TensorXf], grad: bool) -> list[mi.TensorXf]:
        """Give the scene these values; returns them, attached if wanted."""
        one = dr.opaque(mi.Float, 1)  # optimisers change memory in its place: Dr.Jit gets its own
        seen = [dr.detach(value) * one for value in values]
        dr.eval(seen)
        if grad:
            dr.enable_grad(seen)
        for key, tensor in zip(self.keys, seen, strict=True):
            self.params[key] = self._forms[key].store(_typed(self._types[key], tensor))
        self.params.update()
        return seen


def _typed(kind: type, tensor: Any) -> Any:
    """A tensor as a value of that type; derivatives flow."""
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
