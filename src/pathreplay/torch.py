"""Rendering as a function of PyTorch tensors: images, and gradients of a PyTorch loss."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi

from pathreplay.errors import PathreplayError
from pathreplay.platform.device import backend_of
from pathreplay.platform.owned_arrays import with_space
from pathreplay.scenes.scene_function import SceneFunction, View

try:
    import torch
except ImportError:
    raise PathreplayError("PyTorch is not installed: pip install torch, or 'pathreplay[torch]'") from None

Tensors = Mapping[str, torch.Tensor]
"""Decoded values by parameter key, in the shapes of `RenderFunction.initial_values`."""


class RenderFunction(SceneFunction):
    """Images of a scene as a function of some of its parameters; see `SceneFunction` for the arguments.

    Tensors are float32 on ``device``: the GPU in CUDA variants, otherwise the CPU. Other tensors are converted.
    """

    @cached_property
    def device(self) -> torch.device:
        """The device of images and gradients."""
        return torch.device("cuda" if backend_of(mi.variant()) == "cuda" else "cpu")

    def initial_values(self) -> dict[str, torch.Tensor]:
        """Return the parameter values that the scene had when it was loaded.

        Shapes are (height, width, channels) for textures, (z, y, x, channels) for grids, (3,) for colours, (n,) for n
        numbers, (3n,) for n vertices, and (4, 4) for transforms.
        """
        return {key: torch.tensor(value, device=self.device) for key, value in self._start.items()}

    def __call__(self, values: Tensors, sensor: int = 0, *, seed: int = 0, spp: int | None = None) -> torch.Tensor:
        """Render the image (height, width, channels; linear) of a sensor with these values.

        Textures and grids may have another resolution than in the scene. The image is an unbiased estimate. The
        gradient uses samples that are independent of the image, and is therefore unbiased for losses that are linear or
        quadratic in the image. The integrator determines what is differentiated.

        Args:
            values: tensors by parameter key, in the shapes of `initial_values`.
            sensor: index of the sensor.
            seed: seed of the samples, which should change in every step.
            spp: samples per pixel; default: ``spp`` of this object.

        Raises:
            PathreplayError: a value is missing or has the wrong shape, or the integrator does not support an operation.
        """
        self.require({key: tuple(value.shape) for key, value in values.items()})
        tensors = [values[key].to(self.device, torch.float32) for key in self.keys]
        image: torch.Tensor = _Rendering.apply(self, View(sensor, seed, spp or self.spp), *tensors)
        return image


class _Rendering(torch.autograd.Function):
    """The image of a `RenderFunction` for one view, with its vector-Jacobian product."""

    @staticmethod
    def forward(ctx: Any, render: RenderFunction, view: View, *tensors: torch.Tensor) -> torch.Tensor:
        ctx.render, ctx.view = render, view
        ctx.save_for_backward(*tensors)
        return _to_torch(render.picture(_to_drjit(tensors), view), render.device)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        (weights,) = _to_drjit((grad,))
        gradients = ctx.render.gradient(_to_drjit(ctx.saved_tensors), ctx.view, weights)
        return None, None, *(_to_torch(value, ctx.render.device) for value in gradients)


def _to_drjit(tensors: tuple[torch.Tensor, ...]) -> list[mi.TensorXf]:
    """Convert tensors of PyTorch. On the CPU, Dr.Jit uses their memory in place (see `with_space`)."""
    detached = [tensor.detach().contiguous() for tensor in tensors]
    return [mi.TensorXf(tensor if tensor.is_cuda else with_space(tensor.numpy())) for tensor in detached]


def _to_torch(tensor: dr.ArrayBase, device: torch.device) -> torch.Tensor:
    """Copy a tensor to memory that PyTorch owns, so that Dr.Jit cannot reuse this memory."""
    result: torch.Tensor = tensor.torch()
    return result.to(device).clone()
