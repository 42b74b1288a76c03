"""Rendering as a function of PyTorch tensors: pictures out, and gradients back from a loss of PyTorch's.

A pure function of values, view and seed. The scene holds the values of the call before, on which nothing depends:
pictures of several views may be added up before `backward`, which sets each call's values again. (`drjit.wrap` around
`mi.render` would give the gradients of all calls to the values of the last one.)
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.device import backend_of
from pathreplay.errors import PathreplayError
from pathreplay.scenes.descriptions import load_integrator, told
from pathreplay.scenes.loading import load_scene_for
from pathreplay.scenes.parameters import get_array, is_transform, resolve_differentiable
from pathreplay.scenes.stored import form_of

try:
    import torch
except ImportError:
    raise PathreplayError("PyTorch is not installed: pip install torch, or 'pathreplay[torch]'") from None

Tensors = Mapping[str, torch.Tensor]
"""By key of the parameter: what people see of it, in the shapes of `Render.start`."""


class Render:
    """Pictures of a scene as a function of some of its parameters.

    Args:
        scene: a scene, or the path of an XML file or the name of a built-in, with ``arguments`` for it.
        keys: parameters by key or glob, those of `mi.traverse(scene)`.
        integrator: what renders and differentiates, as a dictionary of Mitsuba's.
        spp: samples per pixel, for the picture and for its derivative.

    Tensors are float32 on ``device``: the CPU, or the GPU in variants with CUDA; others are brought there.

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
        self.scene, self.spp, self.params = scene, spp, mi.traverse(scene)
        self.keys = tuple(resolve_differentiable(self.params, patterns, self.integrator))
        self.device = torch.device("cuda" if backend_of(mi.variant()) == "cuda" else "cpu")
        self._forms = {key: form_of(self.params, key) for key in self.keys}
        seen = {key: self._forms[key].see(self.params[key]) for key in self.keys}
        self._types = {key: type(value) for key, value in seen.items()}
        # Copies: the scene is about to change.
        self._start = {key: get_array(value).copy() for key, value in seen.items()}

    def start(self) -> dict[str, torch.Tensor]:
        """The values that the scene had: textures (height, width, channels), grids (z, y, x, channels), colours (3,),
        numbers (n,), vertices (3 n,), transforms (4, 4)."""
        return {key: torch.tensor(value, device=self.device) for key, value in self._start.items()}

    def __call__(self, values: Tensors, sensor: int = 0, *, seed: int = 0, spp: int | None = None) -> torch.Tensor:
        """The picture (height, width, channels; linear) that a sensor sees with these values.

        Textures and grids may have other sizes. The picture is an unbiased estimate, and so is the gradient of what is
        linear in it, by samples of its own; take another ``seed`` for every step. Differentiated is what the integrator
        differentiates. Raises PathreplayError for missing values, wrong shapes, and what the integrator cannot do.
        """
        for key in (*self.keys, *values):
            if key not in values or key not in self._forms:
                raise PathreplayError(
                    f"Values of {', '.join(self.keys)} are needed, and there is a difference: '{key}'"
                )
        tensors = [self._fit(key, values[key]) for key in self.keys]
        image: torch.Tensor = _Rendering.apply(self, (sensor, seed, spp or self.spp), *tensors)
        return image

    def _fit(self, key: str, tensor: torch.Tensor) -> torch.Tensor:
        shape, wanted = tuple(tensor.shape), self._start[key].shape
        resizable = len(wanted) >= 3 and len(shape) == len(wanted) and shape[-1] == wanted[-1] and min(shape) > 0
        if shape != wanted and not resizable:
            raise PathreplayError(f"Value of shape {shape} given for the parameter '{key}' of shape {wanted}")
        return tensor.to(self.device, torch.float32)

    def put(self, tensors: Sequence[torch.Tensor], grad: bool) -> list[Any]:
        """Give the scene these values (in the order of ``keys``); returns them as Dr.Jit's, attached if wanted."""
        one = dr.opaque(mi.Float, 1)  # PyTorch's optimisers change memory in its place: Dr.Jit gets its own
        seen = [mi.TensorXf(tensor.detach().contiguous()) * one for tensor in tensors]
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


class _Rendering(torch.autograd.Function):
    """The picture of a `Render` with some view (sensor, seed, samples per pixel), and its derivative by the values."""

    @staticmethod
    def forward(ctx: Any, render: Render, view: tuple[int, int, int], *tensors: torch.Tensor) -> torch.Tensor:
        ctx.render, ctx.view = render, view
        ctx.save_for_backward(*tensors)
        sensor, seed, spp = view
        with dr.suspend_grad(), told("The scene cannot be rendered"):
            render.put(tensors, grad=False)
            image = mi.render(render.scene, sensor=sensor, integrator=render.integrator, spp=spp, seed=seed)
            return _to_torch(image, render.device)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        render, (sensor, seed, spp) = ctx.render, ctx.view
        other = int(np.random.SeedSequence([seed, 1]).generate_state(1)[0])
        with dr.resume_grad(), told("The gradient cannot be computed"):
            seen = render.put(ctx.saved_tensors, grad=True)
            image = mi.render(
                render.scene,
                render.params,
                sensor=sensor,
                integrator=render.integrator,
                spp=spp,
                seed=seed,
                seed_grad=other,
            )
            dr.backward_from(dr.sum(image * mi.TensorXf(grad.contiguous()), axis=None))
            found = [_to_torch(dr.grad(value), render.device) for value in seen]
            render.put(ctx.saved_tensors, grad=False)  # the scene lets go of the graph
        return None, None, *found


def _to_torch(tensor: Any, device: torch.device) -> torch.Tensor:
    """A copy in PyTorch's own memory, which Dr.Jit does not take back."""
    dr.eval(tensor)
    made: torch.Tensor = tensor.torch()
    return made.to(device).clone()
