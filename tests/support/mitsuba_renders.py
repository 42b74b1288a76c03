"""Mitsuba's own regression test of renderings, with its scenes and its references, for one integrator more.

    python tests/support/mitsuba_renders.py CHECKOUT [--plugin prb] [NAME ...]

takes the scenes of `src/render/tests/test_renders.py` out of a checkout of Mitsuba 3.9.1 with its data, those for
`path`, `direct` and `volpath`, and renders them one after the other in this process. For each it prints the share of
values that differ from the reference, as Mitsuba tells: a z-test at one percent over all of a picture.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.stats import norm

from pathreplay.platform.backend import set_variant
from variant import VARIANT

SCENES = "resources/data/tests/scenes"
SAMPLES = 2_000_000
"""Of a picture."""
SIGNIFICANCE = 0.01
LEAST_VARIANCE = 1e-4
MOST_WRONG = 0.0025
"""Mitsuba lets so many pixels fail."""
DEPTHS = {"direct": 2, "path": None, "volpath": None}
"""Integrators whose scenes are taken, and the depth of ours where theirs is implied."""


def in_xyz(bitmap: mi.Bitmap) -> np.ndarray:
    """Values as Mitsuba compares them; its variances are of these, and stored as if they were colours, too."""
    return np.array(bitmap.convert(mi.Bitmap.PixelFormat.XYZ, mi.Struct.Type.Float32, False), np.float64)


def wrong(path: Path, plugin: str, depth: int | None) -> float:
    """The share of values that differ from the reference of a scene file."""
    stem = path.parent / "refs" / f"{path.stem.rsplit('_', 1)[0]}_ref_rgb"
    reference, variance = (in_xyz(mi.Bitmap(f"{stem}{end}.exr")) for end in ("", "_var"))
    pixels = reference.shape[0] * reference.shape[1]
    spp = SAMPLES // pixels
    scene = mi.load_file(str(path), spp=spp, integrator=plugin)
    # A file says how deep its own integrator goes; `direct` has no such option, and goes to the first light.
    integrator = mi.load_dict({"type": plugin, "max_depth": depth}) if depth else scene.integrator()
    dr.eval(integrator.render(scene, seed=0, spp=spp))
    image = in_xyz(scene.sensors()[0].film().bitmap(raw=False).split()[0][1])
    z = np.abs(image - reference) * np.sqrt(spp / np.maximum(variance, LEAST_VARIANCE))
    each = 1 - (1 - SIGNIFICANCE) ** (1 / pixels)
    return float(np.mean(2 * norm.sf(z) <= each))


def main() -> None:
    """Print a line for each scene; exit with 1 if one fails."""
    parser = argparse.ArgumentParser(description="Mitsuba's own test of renderings, for another integrator.")
    parser.add_argument("checkout", type=Path, help="folder of Mitsuba 3.9.1 with resources/data")
    parser.add_argument("names", nargs="*", metavar="NAME", help="of a scene file, such as 'test_constant_path'")
    parser.add_argument("--plugin", default="pathreplay", help="the integrator")
    given = parser.parse_intermixed_args()
    set_variant(VARIANT)
    mi.set_log_level(mi.LogLevel.Error)
    mi.file_resolver().append(str(given.checkout.resolve()))
    failed = count = 0
    for path in sorted((given.checkout.resolve() / SCENES).glob("*/*.xml")):
        kind = path.stem.rsplit("_", 1)[-1]
        if kind not in DEPTHS or (given.names and path.stem not in given.names):
            continue
        begun = time.time()
        try:
            share = wrong(path, given.plugin, DEPTHS[kind])
        except RuntimeError as error:
            print(f"{path.stem:56s} left out: {str(error).splitlines()[0]}", flush=True)
            continue
        count, failed = count + 1, failed + (share > MOST_WRONG)
        verdict = " fails" if share > MOST_WRONG else ""
        print(f"{path.stem:56s} {share:8.5f}{verdict} ({time.time() - begun:.0f} s)", flush=True)
    print(f"{count} scenes in one process, {failed} failed")
    sys.exit(failed > 0)


if __name__ == "__main__":
    main()
