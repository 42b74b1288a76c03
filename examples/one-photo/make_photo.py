"""Render the photo, an 8-bit PNG of the room with the true materials and light: python make_photo.py

`TRUTH` has the values that the job recovers; it only sees the image. With ``--compare RUN``, print the ratios of the
values that a run has recovered to the true ones.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from pathreplay.platform.backend import set_variant

FOLDER = Path(__file__).parent
TRUTH = {
    "floor.bsdf.reflectance.value": [0.55, 0.35, 0.2],
    "back.bsdf.reflectance.value": [0.75, 0.72, 0.65],
    "side.bsdf.reflectance.value": [0.2, 0.45, 0.6],
    "ball.bsdf.base_color.value": [0.6, 0.12, 0.1],
    "ball.bsdf.roughness.value": [0.3],
    "lamp.emitter.radiance.value": [16.0, 13.0, 9.0],
}


def main(resolution: int = 96, spp: int = 1024, into: Path = FOLDER) -> None:
    """Render the room into ``into``/photo.png."""
    set_variant()
    import mitsuba as mi

    from pathreplay.inverse.images.io import png_bytes
    from pathreplay.scenes.loading import load_scene
    from pathreplay.scenes.parameters import to_value

    scene = load_scene(FOLDER / "scene.xml", res=resolution)
    params = mi.traverse(scene)
    for key, value in TRUTH.items():
        params[key] = to_value(params[key], np.float32(value))
    params.update()
    image = np.array(mi.render(scene, spp=spp, seed=7))
    (into / "photo.png").write_bytes(png_bytes(image))
    print(
        f"{into / 'photo.png'}: {resolution} x {resolution}, {100 * (image > 1).any(axis=2).mean():.1f} % overexposed"
    )


def compare(run: Path) -> None:
    """Print the ratio of each recovered value to the true one."""
    from safetensors.numpy import load_file

    found = load_file(run / "parameters.safetensors")
    for key, value in TRUTH.items():
        print(f"{key:30s}", *(f"{factor:.3f}" for factor in found[key].ravel() / np.float32(value)))


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--resolution", type=int, default=96)
    parser.add_argument("--compare", type=Path, metavar="RUN")
    asked = parser.parse_args()
    if asked.compare is None:
        main(asked.resolution)
    else:
        compare(asked.compare)
