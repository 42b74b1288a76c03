"""Rendering as a function of PyTorch tensors: pictures out, and gradients back from a loss of PyTorch's."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import mitsuba as mi

from pathreplay.errors import PathreplayError
from pathreplay.platform.device import backend_of
from pathreplay.scenes.scene_function import SceneFunction, View

try:
    import torch
except ImportError:
    raise PathreplayError("PyTorch is not installed: pip install torch, or 'pathreplay[torch]'") from None

Tensors = Mapping[str, torch.Tensor]
"""By key of the parameter: what people see of it, in the shapes of `RenderFunction.initial_values`."""


class RenderFunction(SceneFunction):
    """Pictures of a scene as a function of some of its parameters: see `SceneFunction`.

    Tensors are float32 on ``device``: the CPU, or the GPU in variants with CUDA; others are brought there.
    """

    @cached_property
    def device(self) -> torch.device:
        """Where pictures and gradients are."""
        return torch.device("cuda" if backend_of(mi.variant()) == "cuda" else "cpu")

    def initial_values(self) -> dict[str, torch.Tensor]:
        """The values that the scene had.

        Shapes: textures (height, width, channels), grids (z, y, x, channels), colours (3,), numbers (n,), vertices
        (3 n,), transforms (4, 4).
        """
        return {key: torch.tensor(value, device=self.device) for key, value in self._start.items()}

    def __call__(self, values: Tensors, sensor: int = 0, *, seed: int = 0, spp: int | None = None) -> torch.Tensor:
        """The picture (height, width, channels; linear) that a sensor sees with these values.

        Textures and grids may have other sizes. The picture is an unbiased estimate, and so is the gradient of what is
        linear in it, by samples of its own; take another ``seed`` for every step. Differentiated is what the integrator
        differentiates. Raises PathreplayError for missing values, wrong shapes, and what the integrator cannot do.
        """
        self.require({key: tuple(value.shape) for key, value in values.items()})
        tensors = [values[key].to(self.device, torch.float32) for key in self.keys]
        image: torch.Tensor = _Rendering.apply(self, View(sensor, seed, spp or self.spp), *tensors)
        return image


class _Rendering(torch.autograd.Function):
    """The picture of a `RenderFunction` with some view, and its derivative by the values."""

    @staticmethod
    def forward(ctx: Any, render: RenderFunction, view: View, *tensors: torch.Tensor) -> torch.Tensor:
        ctx.render, ctx.view = render, view
        ctx.save_for_backward(*tensors)
        return _to_torch(render.picture(_to_drjit(tensors), view), render.device)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        weights = mi.TensorXf(grad.contiguous())
        found = ctx.render.gradient(_to_drjit(ctx.saved_tensors), ctx.view, weights)
        return None, None, *(_to_torch(value, ctx.render.device) for value in found)


def _to_drjit(tensors: tuple[torch.Tensor, ...]) -> list[mi.TensorXf]:
    return [mi.TensorXf(tensor.detach().contiguous()) for tensor in tensors]


def _to_torch(tensor: Any, device: torch.device) -> torch.Tensor:
    """A copy in PyTorch's own memory, which Dr.Jit does not take back."""
    made: torch.Tensor = tensor.torch()
    return made.to(device).clone()
