"""Recover the photograph on a wall of the Cornell box from one image, as the output of a PyTorch network.

    python examples/torch-network/recover.py

The network maps the Fourier-encoded position of a texel to its colour. Mitsuba's path tracer renders the target.
The script prints the root mean square error of the texture, and writes an image of the recovered and the true texture.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

import pathreplay  # before mitsuba: it brings a libLLVM that works
from pathreplay.platform.backend import set_variant

set_variant()

import mitsuba as mi  # noqa: E402
import torch  # noqa: E402

from pathreplay.inverse.images.io import find_image, png_bytes, read_image, resized  # noqa: E402
from pathreplay.scenes.loading import load_scene  # noqa: E402
from pathreplay.torch import RenderFunction  # noqa: E402

SCENE, TEXTURE, CLOSEUP = "cornell-box-photo", "back.bsdf.reflectance.data", 1
DEPTH = 4
WAVES = 6


class TermResult(NamedTuple):
    start: float
    error: float
    """Root mean square errors of the texture, before and after."""


def waves(size: int) -> torch.Tensor:
    """Encode the centres of the texels by sin and cos of 2^k π x and 2^k π y, shape (size², 4 WAVES)."""
    at = (torch.arange(size) + 0.5) / size
    y, x = torch.meshgrid(at, at, indexing="ij")
    angles = torch.stack([x, y], -1).reshape(-1, 2, 1) * torch.pi * 2.0 ** torch.arange(WAVES)
    return torch.cat([angles.sin(), angles.cos()], -1).flatten(1)


def recover(
    resolution: int = 96, texture: int = 64, steps: int = 300, picture: Path = Path("network.png")
) -> TermResult:
    """Train the network on one view; write the recovered and the true texture side by side to ``picture``."""
    torch.manual_seed(0)
    arguments = {"resolution": resolution, "texture": texture}
    truth = resized(read_image(find_image("matplotlib:grace_hopper.jpg", Path())), texture, texture, crop=True)
    scene = load_scene(SCENE, **arguments)
    params = mi.traverse(scene)
    params[TEXTURE] = mi.TensorXf(truth)
    params.update()
    path = mi.load_dict({"type": "path", "max_depth": DEPTH})
    target = torch.tensor(np.array(mi.render(scene, sensor=CLOSEUP, integrator=path, spp=1024)))

    render = RenderFunction(SCENE, TEXTURE, integrator={"type": "pathreplay", "max_depth": DEPTH}, arguments=arguments)
    network = torch.nn.Sequential(
        torch.nn.Linear(4 * WAVES, 64), torch.nn.ReLU(), torch.nn.Linear(64, 64), torch.nn.ReLU(),
        torch.nn.Linear(64, 3), torch.nn.Sigmoid(),
    )  # fmt: skip
    places = waves(texture)
    optimiser = torch.optim.Adam(network.parameters(), lr=5e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    errors = []
    for step in range(steps):
        predicted = network(places).reshape(texture, texture, 3)
        image = render({TEXTURE: predicted}, CLOSEUP, seed=step, spp=16)
        loss = (image - target).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        errors.append(float((predicted.detach() - torch.tensor(truth)).square().mean().sqrt()))
        if step % 50 == 0:
            print(f"step {step}: loss {loss.item():.3g}, texture error {errors[-1]:.3g}", file=sys.stderr)
    with torch.no_grad():
        predicted = network(places).reshape(texture, texture, 3).numpy()
    picture.write_bytes(png_bytes(np.concatenate([predicted, truth], axis=1)))
    return TermResult(errors[0], float(np.sqrt(np.mean((predicted - truth) ** 2))))


if __name__ == "__main__":
    found = recover()
    print(f"pathreplay {pathreplay.__version__}: texture error {found.start:.3g} -> {found.error:.3g}; see network.png")
