"""Extinction at the limits of number formats: majorants of spectral grids, and optical depths beyond exp's range."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from media_scenes import cloud, heterogeneous, homogeneous, smooth
from pathreplay.testing.objective import Objective
from pathreplay.testing.statistics import gap
from pathreplay.testing.stencil import WIDE
from pathreplay.testing.verdict import Z_LIMIT
from places import SUPPORT
from variant import SPECTRAL as SPECTRAL_VARIANT

SEEDS, SPP = 12, 64

# Mitsuba stores colours of a grid as three coefficients of a spectrum and a factor. After an update of the grid, the
# majorant of `heterogeneous` is the largest of all four numbers: for the red grid below, more than 5 times as large as
# before. `gridmedium` has majorants of its own.
SPECTRAL = """
import sys
sys.path.insert(0, sys.argv[1])
from pathreplay.platform.backend import set_variant
set_variant("llvm_ad_spectral")
import mitsuba as mi
import numpy as np
from media_scenes import box_to_world, cloud, smooth
from pathreplay.testing.objective import Objective, smooth_weights
from pathreplay.testing.statistics import gap, mean_and_error

KEY = "object.interior_medium.sigma_t.data"

def red(plugin):
    colours = smooth(0.4, 2.0)[..., :1] * np.array([1, 0.02, 0.02], np.float32)
    grid = {"type": "gridvolume", "grid": mi.VolumeGrid(colours.astype(np.float32)), "to_world": box_to_world()}
    return mi.load_dict(cloud({"type": plugin, "sigma_t": grid, "albedo": 0.8, "scale": 1.5}))

def factor(value, t):
    return value * (1 + t * mi.TensorXf(np.float32([[[[0, 0, 0, 1]]]])))

integrator = mi.load_dict({"type": "pathreplay", "max_depth": 4, "rr_depth": 100})
majorants, gradients, images = {}, {}, {}
for plugin in ("heterogeneous", "gridmedium"):
    scene = red(plugin)
    medium = next(shape.interior_medium() for shape in scene.shapes() if shape.interior_medium())
    objective = Objective(scene, mi.traverse(scene), KEY, factor)
    objective.weigh(smooth_weights((16, 16, 3), alpha=False))
    at = mi.MediumInteraction3f()
    before = float(np.max(np.array(medium.get_majorant(at, True))))
    gradients[plugin] = np.array([objective.backward(integrator, seed, 64) for seed in range(12)])
    images[plugin] = np.array([objective.dot(objective.image(integrator, seed, 64)) for seed in range(12)])
    majorants[plugin] = float(np.max(np.array(medium.get_majorant(at, True)))) / before
print(majorants)
assert majorants["heterogeneous"] > 5 and majorants["gridmedium"] < 1.01
for found in (gradients, images):
    print({plugin: mean_and_error(samples) for plugin, samples in found.items()})
    difference = gap(*found.values())
    assert abs(difference.z) < 4 and difference.error < 0.1 * abs(found["gridmedium"].mean()), difference
"""


@pytest.mark.slow
def test_majorants_of_colours_in_spectral_variants(run_python: Callable[..., Any]) -> None:
    done = run_python(SPECTRAL, args=(str(SUPPORT),))
    print(done.stdout)
    assert done.returncode == 0, done.stdout + done.stderr


TABULATED = """
import sys
from pathreplay.platform.backend import set_variant
set_variant(sys.argv[1])
import mitsuba as mi
from pathreplay.transport.volume.media import scene_media

table = {"type": "irregular", "wavelengths": "400,550,700", "values": "0.05,0.5,4"}
regular = {"type": "regular", "wavelength_min": 400, "wavelength_max": 700, "values": "0.05,0.5,4"}
for kind in ("homogeneous", "heterogeneous"):
    for sigma_t, expected in ((table, True), (regular, True), (0.5, False)):
        volume = {"type": "constvolume", "value": sigma_t}
        found = scene_media([mi.load_dict({"type": kind, "sigma_t": volume})], False, None).chromatic
        assert found == expected, (kind, sigma_t, found)
"""


def test_tabulated_extinction_differs_between_wavelengths(run_python: Callable[..., Any]) -> None:
    done = run_python(TABULATED, args=(SPECTRAL_VARIANT,))
    assert done.returncode == 0, done.stdout + done.stderr


# A coloured mirror makes the throughput small where the extinction is small. For the red spectrum below, Mitsuba's
# majorant is 0.6, and the extinction reaches 1.
COLOURED = """
import sys
from pathreplay.platform.backend import set_variant
set_variant(sys.argv[1])
import mitsuba as mi, numpy as np
T, red = mi.ScalarTransform4f, {"type": "rgb", "value": [0.9, 0.02, 0.02]}

def behind_mirror(kind, sigma_t):
    metal = {"type": "conductor", "material": "none", "specular_reflectance": dict(red)}
    to_mirror = T().translate([0, 0, 4]).scale(0.5).rotate([0, 1, 0], 180)
    film = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}}
    medium = {"type": kind, "sigma_t": sigma_t, "albedo": 0.0}
    to_camera = T().look_at([0, 0, 1.5], [0, 0, 4], [0, 1, 0])
    scene = mi.load_dict({
        "type": "scene",
        "sky": {"type": "constant"},
        "mirror": {"type": "rectangle", "to_world": to_mirror, "bsdf": metal},
        "box": {"type": "cube", "bsdf": {"type": "null"}, "interior": medium},
        "sensor": {"type": "perspective", "fov": 3, "to_world": to_camera, "film": film},
    })
    return np.mean(mi.render(scene, integrator=mi.load_dict({"type": "pathreplay"}), spp=256), axis=(0, 1))

volume = {"type": "constvolume", "value": dict(red), "to_world": T().translate(-1).scale(2)}
found = behind_mirror("heterogeneous", volume)
expected = behind_mirror("homogeneous", dict(red))
assert np.allclose(found, expected, rtol=0.05), (found, expected)
"""


def test_coloured_extinction_may_exceed_the_majorant_of_mitsuba(run_python: Callable[..., Any]) -> None:
    done = run_python(COLOURED, args=(SPECTRAL_VARIANT,))
    assert done.returncode == 0, done.stdout + done.stderr


def deep(kind: str) -> tuple[dict, str]:
    """A cube of side 2 with an optical depth of a hundred and more, whose transmittance is not representable."""
    if kind == "homogeneous":
        return cloud(homogeneous(100.0, 0.9)), "object.interior_medium.sigma_t.value.value"
    return cloud(heterogeneous(smooth(0.4, 2.0), 0.9, scale=100.0, plugin=kind)), "object.interior_medium.sigma_t.data"


@pytest.mark.parametrize(
    "kind", ["homogeneous", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("heterogeneous", "gridmedium"))]
)
def test_optical_depth_beyond_the_exponent_of_single_precision(kind: str) -> None:
    """Image and derivative agree with `volpath`, and no value is infinite or NaN."""
    scene, key = deep(kind)
    loaded = mi.load_dict(scene)
    params = mi.traverse(loaded)
    objective = Objective(loaded, params, key, lambda value, t: value * (1 + t))
    limits = {"max_depth": 3, "rr_depth": 100}
    ours, theirs = (mi.load_dict({"type": name} | limits) for name in ("pathreplay", "volpath"))
    images = [[objective.image(plain, seed, SPP) for seed in range(SEEDS)] for plain in (ours, theirs)]
    assert np.isfinite(images[0]).all() and np.min(images[0]) > 0
    means = (np.array(of).mean(axis=(1, 2, 3)) for of in images)
    assert abs(gap(*means).z) < Z_LIMIT
    objective.weigh(np.ones_like(images[0][0]) / images[0][0].size)
    gradients = np.array([objective.backward(ours, seed, SPP) for seed in range(SEEDS)])
    assert np.isfinite(np.array(dr.grad(params[key]))).all()
    differences = [objective.dot(objective.difference(theirs, WIDE, 0.2, seed, SPP)) for seed in range(SEEDS)]
    assert abs(gap(gradients, np.array(differences)).z) < Z_LIMIT
