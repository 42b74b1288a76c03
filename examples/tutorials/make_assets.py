"""Write the meshes, the volume and the sky of these examples into examples/tutorials/assets: python make_assets.py

They replace the assets of Mitsuba's tutorials (bunny.ply, volume.vol, suzanne.ply, ico_10k.ply, envmap2.exr).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pathreplay.platform.backend import set_variant

ASSETS = Path(__file__).parent / "assets"


def cloud(size: int = 48) -> np.ndarray:
    """Make a density of overlapping, modulated blobs with values up to 0.5, shape (z, y, x)."""
    z, y, x = np.meshgrid(*3 * ((np.arange(size) + 0.5) / size * 2 - 1,), indexing="ij")
    density = np.full_like(x, -0.25)
    for cx, cy, cz, radius in (
        (0, -0.1, 0, 0.55),
        (0.4, 0.3, 0.2, 0.35),
        (-0.4, 0.25, -0.2, 0.35),
        (0, -0.5, 0.4, 0.3),
    ):
        density += np.exp(-((x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2) / radius**2)
    density *= 1 + 0.3 * np.sin(9 * x) * np.sin(8 * y + 1) * np.sin(7 * z + 2)
    return (0.5 * np.clip(density, 0, 1)).astype(np.float32)


def sky(rows: int = 32) -> np.ndarray:
    """Make a smooth environment map without symmetries, shape (rows, 2 rows, 3)."""
    v, u = np.meshgrid(
        (np.arange(rows) + 0.5) / rows * np.pi, (np.arange(2 * rows) + 0.5) / rows * np.pi, indexing="ij"
    )
    waves = [1.2 + np.cos(v + k) + np.sin(v) * np.sin(u + 2 * k) * 0.8 for k in range(3)]
    return (0.3 * np.maximum(np.stack(waves, axis=-1), 0.05) ** 2).astype(np.float32)


def main() -> None:
    """Write all files, replacing existing ones."""
    set_variant()
    from pathreplay.inverse.images.io import exr_bytes
    from pathreplay.scenes.bodies import ball, knobs, mesh
    from pathreplay.scenes.volume_files import save_vol

    ASSETS.mkdir(exist_ok=True)
    vertices, faces = ball(5)
    white: dict[str, object] = {"type": "diffuse"}
    for name, points in (("body", knobs(vertices)), ("body-large", 2 * knobs(vertices)), ("ball", 0.8 * vertices)):
        mesh(points, faces, white).write_ply(str(ASSETS / f"{name}.ply"))
    save_vol(ASSETS / "cloud.vol", cloud())
    (ASSETS / "sky.exr").write_bytes(exr_bytes(sky()))


if __name__ == "__main__":
    main()
