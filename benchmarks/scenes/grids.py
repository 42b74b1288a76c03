"""Density grids for flights and shadow rays: 64³ voxels in the unit cube, with a maximum of 1."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

VOXELS = 64
GRIDS = ("sparse", "cloud", "wall", "noise", "uniform")


def grid_medium(name: str, supergrid: str | bool) -> Any:
    """Return the `gridmedium` with the name 'GRID x SCALE'."""
    grid, scale = name.split(" x ")
    data = mi.TensorXf(grid_values(grid).astype(np.float32)[..., None])
    density = {"type": "gridvolume", "data": data}
    return mi.load_dict({"type": "gridmedium", "sigma_t": density, "scale": float(scale), "supergrid": supergrid})


def grid_values(grid: str) -> np.ndarray:
    """Return densities: six small blobs, a textured cloud, a sharply bounded half, random 0 or 1, or a constant."""
    z, y, x = (np.mgrid[0:VOXELS, 0:VOXELS, 0:VOXELS] + 0.5) / VOXELS
    random = np.random.default_rng(0)
    match grid:
        case "sparse":
            values = np.zeros_like(x)
            for cx, cy, cz in random.uniform(0.15, 0.85, (6, 3)):
                r = np.sqrt((x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2)
                values = np.maximum(values, np.clip(1 - r / 0.1, 0, 1))
        case "cloud":
            r = np.sqrt((x - 0.5) ** 2 + (y - 0.5) ** 2 + (z - 0.5) ** 2)
            values = np.clip(1 - r / 0.48, 0, 1) * (1 + 0.4 * np.sin(20 * x + 3 * np.sin(9 * y)) * np.cos(17 * z + y))
        case "wall":
            values = (x < 0.45).astype(float)
        case "noise":
            random.uniform(0.15, 0.85, (6, 3))  # those of the blobs: the noise is what it always was
            values = random.integers(0, 2, x.shape).astype(float)
        case _:
            values = np.ones_like(x)
    return values / values.max()
