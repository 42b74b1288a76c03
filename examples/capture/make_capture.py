"""Render 24 views around a ball under a sky, and write them as a capture: transforms.json and EXR files.

    python examples/capture/make_capture.py [FOLDER] [--views 24] [--width 64] [--spp 1024] [--recover]

Only this script has the true texture, roughness and sky; the job and its scene file do not.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path

from pathreplay.jobs import optimize
from pathreplay.platform.backend import set_variant  # before mitsuba: finds a libLLVM

import mitsuba as mi  # isort: skip
import numpy as np  # isort: skip

FOV = 0.75  # radians, along x
FAR = 4.0
ROUGHNESS = 0.25


def paint() -> np.ndarray:
    """Make a texture of coloured bands and spots, 32 x 16."""
    v, u = np.meshgrid((np.arange(16) + 0.5) / 16, (np.arange(32) + 0.5) / 32, indexing="ij")
    band = 0.5 + 0.4 * np.sin(2 * np.pi * (3 * v + 0.15 * np.sin(4 * np.pi * u)))
    spots = (np.sin(8 * np.pi * u) * np.sin(6 * np.pi * v) > 0.55)[:, :, None]
    colours = np.stack([band, 0.35 + 0.3 * np.cos(2 * np.pi * u), 0.8 - 0.6 * band], -1)
    return np.where(spots, [0.9, 0.85, 0.2], colours).astype(np.float32)


def sky() -> np.ndarray:
    """Make an environment map, 32 x 16: bright above, dark below, with a warm and a cold soft light on two sides."""
    v, u = np.meshgrid((np.arange(16) + 0.5) / 16, (np.arange(32) + 0.5) / 32, indexing="ij")
    ground = (0.15 + 0.75 * (1 - v))[:, :, None] * [0.8, 0.9, 1.0]
    for u0, v0, colour in ((0.2, 0.3, [6.0, 4.5, 3.0]), (0.7, 0.45, [1.0, 1.8, 3.0])):
        ground = ground + np.exp(-((u - u0) ** 2 + (v - v0) ** 2 / 4) / 0.006)[:, :, None] * colour
    return ground.astype(np.float32)


def cameras(count: int) -> list[np.ndarray]:
    """Camera to world, as OpenGL has it (x right, y up, looking along -z): evenly around the ball."""
    placed = []
    for k in range(count):
        y = 0.85 * (1 - 2 * (k + 0.5) / count)
        turn, r = k * math.pi * (3 - math.sqrt(5)), math.sqrt(1 - y * y)
        back = np.array([r * math.cos(turn), y, r * math.sin(turn)])
        right = np.cross([0, 1, 0], back)
        right /= np.linalg.norm(right)
        matrix = np.eye(4)
        matrix[:3, 0], matrix[:3, 1], matrix[:3, 2], matrix[:3, 3] = right, np.cross(back, right), back, FAR * back
        placed.append(matrix)
    return placed


def main() -> None:
    """Render and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, default=Path(__file__).parent / "pictures")
    parser.add_argument("--views", type=int, default=24)
    parser.add_argument("--width", type=int, default=64)
    parser.add_argument("--spp", type=int, default=1024)
    parser.add_argument("--recover", action="store_true", help="run the job of config.toml on them, too")
    given = parser.parse_args()
    set_variant()
    given.folder.mkdir(parents=True, exist_ok=True)
    scene = mi.load_dict(
        {
            "type": "scene",
            "ball": {
                "type": "sphere",
                "bsdf": {
                    "type": "principled",
                    "base_color": {"type": "bitmap", "bitmap": mi.Bitmap(paint()), "raw": True},
                    "roughness": ROUGHNESS,
                    "specular": 0.5,
                },
            },
            "sky": {"type": "envmap", "bitmap": mi.Bitmap(sky())},
        }
    )
    film = {"type": "hdrfilm", "width": given.width, "height": given.width, "pixel_format": "rgb"}
    film["rfilter"] = {"type": "box"}
    frames = []
    for k, matrix in enumerate(cameras(given.views)):
        # Mitsuba's cameras look along z, with x to the left.
        place = mi.ScalarTransform4f((matrix @ np.diag([-1.0, 1, -1, 1])).tolist())
        camera = mi.load_dict(
            {"type": "perspective", "fov": math.degrees(FOV), "fov_axis": "x", "to_world": place, "film": film}
        )
        image = mi.render(scene, sensor=camera, integrator=mi.load_dict({"type": "path"}), spp=given.spp, seed=k)
        mi.Bitmap(image).write(str(given.folder / f"{k:02d}.exr"))
        frames.append({"file_path": f"{k:02d}.exr", "transform_matrix": matrix.tolist()})
    table = {"camera_angle_x": FOV, "w": given.width, "h": given.width, "frames": frames}
    (given.folder / "transforms.json").write_text(json.dumps(table, indent=1))
    print(f"{given.views} pictures and transforms.json in {given.folder}", flush=True)
    if given.recover:
        found = (given.folder / "transforms.json").resolve()
        print(optimize(Path(__file__).parent / "config.toml", define=[f"capture.transforms={found}"]).describe())


if __name__ == "__main__":
    main()
