"""Media: gradients of density, albedo, phase functions and of what surrounds them, against finite differences."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from media_scenes import (
    FORWARD,
    behind_glass,
    checkers,
    cloud,
    constant,
    grid,
    heterogeneous,
    homogeneous,
    in_the_mirror,
    inside,
    lit_floor,
    nested,
    overlapping,
    smooth,
    sparse,
    sunlit,
)
from mitsuba_configs import square
from pathreplay.adjoint.baseline import BaselineCells
from pathreplay.testing.objective import Move
from pathreplay.testing.statistics import gap
from pathreplay.testing.stencil import UPWARD, WIDE
from pathreplay.testing.verdict import RESOLUTION, Z_LIMIT
from places import SUPPORT
from truth import Case, add, bitmap, hold, random, rgb, translate

MEDIUM = "object.interior_medium."
DENSITY, ALBEDO, G = MEDIUM + "sigma_t.data", MEDIUM + "albedo.data", MEDIUM + "phase_function.g"


def where(mask: np.ndarray, scale: float = 1.0) -> Move:
    """tensor + t · (random positive numbers up to ``scale``) where the mask is one."""
    direction = np.random.default_rng(7).uniform(0.2 * scale, scale, mask.shape).astype(np.float32) * mask
    return lambda value, t: value + t * mi.TensorXf(direction.astype(np.float32))


def grid_and_camera(value: Any, t: float) -> Any:
    """Move a grid or the camera."""
    return (random(1.0) if dr.is_tensor_v(value) else translate(0.5, 0.2, 1))(value, t)


QUICK = {
    "constant density", "binary density, empty voxels", "black albedo", "phase g",
    "homogeneous chromatic density", "fog on a lit floor, density", "in a mirror, its index", "gridmedium emission",
}  # fmt: skip


def cell(name: str, scene: Callable[[], dict], key: str, move: Move, **options: Any) -> Case:
    common = {
        "reference": "volpath",
        "stencil": WIDE,
        "step": 0.15,
        "depth": 8,
        "spp": 32,
        "reference_spp": 64 if name in QUICK else 128,  # those of a quick cell leave its error far below the limit
        "seeds": 6 if name in QUICK else 12,
        "same_seed_spp": 32 if name in QUICK else 16,  # in media there is a kernel for each number of lanes
        "lanes": None,
    }
    return Case(name, scene, key, move, **{**common, **options})


def smooth_cloud(**props: Any) -> dict:
    return cloud(heterogeneous(smooth(0.4, 2.0), smooth(0.3, 0.9), **props))


def glowing(emission: float = 1.0) -> dict:
    """A cloud under the sky that emits, too; volpath knows no emission."""
    return smooth_cloud(plugin="gridmedium", emission=grid(emission * smooth(0.1, 0.6, 3)))


def thick(density: np.ndarray | None = None) -> dict:
    """A cloud that scatters little and has a radiance of its own."""
    density = smooth(0.4, 2.0) if density is None else density
    radiance = grid(smooth(0.2, 3.0, 3))
    return cloud(heterogeneous(density, constant(0.3), plugin="gridmedium", radiance=radiance))


def rainbow() -> dict:
    return homogeneous(rgb(0.7, 0.5, 0.35), rgb(0.8, 0.6, 0.4), scale=2.0)


def dense() -> dict:
    """From the middle, light has been scattered some hundred times when it leaves: τ = 12, and τ²/2 + τ times."""
    return heterogeneous(smooth(8.0, 16.0), constant(0.99))


def uniform(**props: Any) -> dict:
    return heterogeneous(constant(1.2), constant(0.6), **props)


GLASS = {"type": "dielectric_ad"}
ROUGH = {"type": "roughdielectric", "alpha": 0.3}
ETA = "object.bsdf.eta"
DENSE = {"depth": 512, "rr_depth": 1000, "spp": 4, "reference_spp": 8, "step": 0.4}
MOVES = {"step": 0.08, "drivers": ("recorded",)}  # the replay driver refuses paths that move through media
GLASSY = {**MOVES, "step": 0.04, "spp": 768, "reference_spp": 1024}  # dF has no bound near the critical angle
BLACK = {"stencil": UPWARD, "step": 0.1, "drivers": ("recorded",)}  # the replay driver divides by the weight
UP = {"stencil": UPWARD, "step": 0.1}

GRIDS = [
    cell("smooth density", smooth_cloud, DENSITY, random(1.0)),
    # Like the binary one but for its values: they share their kernels.
    cell("constant density", lambda: cloud(heterogeneous(constant(0.6), constant(0.6), scale=2.0)), DENSITY,
         random(0.5)),
    cell("binary density, full voxels", lambda: cloud(heterogeneous(checkers(), constant(0.6), scale=2.0)), DENSITY,
         where(checkers())),
    cell("binary density, empty voxels", lambda: cloud(heterogeneous(checkers(), constant(0.6), scale=2.0)), DENSITY,
         where(1 - checkers()), **UP),
    cell("albedo", smooth_cloud, ALBEDO, random(0.5)),
    cell("black albedo", lambda: cloud(heterogeneous(smooth(0.4, 2.0), constant(0.0))), ALBEDO, random(1.0), **BLACK),
    cell("black albedo, density", lambda: cloud(heterogeneous(smooth(0.4, 2.0), constant(0.0))), DENSITY, random(1.0)),
    cell("one black channel of the albedo", lambda: cloud(heterogeneous(smooth(0.4, 2.0), constant((0.8, 0.5, 0.0)))),
         ALBEDO, where(constant((0.0, 0.0, 1.0))), **BLACK),
    cell("chromatic density", lambda: cloud(heterogeneous(smooth(0.4, 2.0, 3), smooth(0.3, 0.9, 3))), DENSITY,
         random(1.0)),
    cell("chromatic density, one channel", lambda: cloud(heterogeneous(smooth(0.4, 2.0, 3), smooth(0.3, 0.9, 3))),
         DENSITY, where(constant((1.0, 0.0, 0.0)))),
    cell("chromatic albedo", lambda: cloud(heterogeneous(smooth(0.4, 2.0, 3), smooth(0.3, 0.9, 3))), ALBEDO,
         random(0.5)),
    cell("phase g", lambda: sunlit(heterogeneous(smooth(0.4, 2.0), smooth(0.3, 0.9), FORWARD)), G, add()),
    cell("dense, high albedo, density", lambda: inside(dense()), "fog.sigma_t.data", random(4.0), **DENSE),
    cell("dense, high albedo, albedo", lambda: inside(dense()), "fog.albedo.data", random(0.01), **DENSE),
]  # fmt: skip

HOMOGENEOUS = [
    cell("homogeneous density", lambda: cloud(homogeneous(1.0)), MEDIUM + "sigma_t.value.value", add()),
    cell("homogeneous albedo", lambda: cloud(homogeneous(1.0)), MEDIUM + "albedo.value.value", add()),
    cell("homogeneous chromatic density", lambda: cloud(rainbow()), MEDIUM + "sigma_t.value.value",
         add([0.5, 0.4, 0.3])),
    cell("homogeneous chromatic albedo", lambda: cloud(rainbow()), MEDIUM + "albedo.value.value",
         add([1.0, 0.8, 0.6]), step=0.1),
    cell("homogeneous density zero", lambda: cloud(homogeneous(0.0)), MEDIUM + "sigma_t.value.value", add(), **UP),
    cell("homogeneous black albedo", lambda: cloud(homogeneous(1.0, 0.0)), MEDIUM + "albedo.value.value", add(),
         **BLACK),
    cell("homogeneous phase g", lambda: sunlit(homogeneous(1.0, 0.8, FORWARD)), G, add()),
]  # fmt: skip

PLACES = [
    cell("fog on a lit floor, density", lambda: lit_floor(heterogeneous(smooth(0.4, 2.0), constant(0.4))), DENSITY,
         random(1.0), same_seed_spp=16),
    cell("fog on a lit floor, albedo", lambda: lit_floor(heterogeneous(smooth(0.4, 2.0), constant(0.4))), ALBEDO,
         random(0.5)),
    cell("floor beside fog", lambda: lit_floor(heterogeneous(smooth(0.4, 2.0), constant(0.4))),
         "floor.bsdf.reflectance.value", add()),
    cell("light above fog", lambda: lit_floor(heterogeneous(smooth(0.4, 2.0), constant(0.4))),
         "light.emitter.radiance.value", add()),
    cell("sky around fog", smooth_cloud, "sky.data", random(1.0)),
    cell("sensor inside, density", lambda: inside(heterogeneous(smooth(0.4, 2.0), constant(0.8))), "fog.sigma_t.data",
         random(1.0)),
    cell("sensor inside, homogeneous density", lambda: inside(homogeneous(1.0)), "fog.sigma_t.value.value", add()),
    cell("in glass, density", lambda: cloud(heterogeneous(smooth(0.4, 2.0), constant(0.8)), "sphere", GLASS), DENSITY,
         random(1.0)),
    cell("in glass, albedo", lambda: cloud(heterogeneous(smooth(0.4, 2.0), constant(0.8)), "sphere", GLASS), ALBEDO,
         random(0.5)),
    cell("in glass, index", lambda: cloud(heterogeneous(smooth(0.4, 2.0), constant(0.8)), "sphere", GLASS), ETA, add(),
         **GLASSY),
    cell("in glass, index, homogeneous", lambda: cloud(homogeneous(1.0), "sphere", GLASS), ETA, add(),
         **{**GLASSY, "spp": 1536}),
    # Where a sample of the rough glass fails, the replay driver ends the path, and its branch draws other numbers.
    cell("in rough glass, density", lambda: cloud(heterogeneous(smooth(0.4, 2.0), constant(0.8)), "sphere", ROUGH),
         DENSITY, random(1.0), drivers=("recorded",)),
    cell("in rough glass, homogeneous density", lambda: cloud(homogeneous(1.0), "sphere", ROUGH),
         MEDIUM + "sigma_t.value.value", add()),
    cell("behind a pane, its index", lambda: behind_glass(GLASS, uniform()), "pane.bsdf.eta", add(), **MOVES),
    cell("in a mirror, its index", lambda: in_the_mirror(GLASS, uniform()), "pane.bsdf.eta", add(), **MOVES),
    cell("moving camera", smooth_cloud, "camera.to_world", translate(0.5, 0.2, 1), **{**MOVES, "step": 0.12}),
    cell("nested, outer density", lambda: nested(heterogeneous(smooth(0.4, 2.0)), homogeneous(2.0)),
         "outer.sigma_t.data", random(1.0)),
    cell("nested, inner density", lambda: nested(heterogeneous(smooth(0.4, 2.0)), homogeneous(2.0)),
         "inner.sigma_t.value.value", add()),
    cell("overlapping, density", lambda: overlapping(homogeneous(1.0), homogeneous(2.0)), MEDIUM +
         "sigma_t.value.value", add()),
]  # fmt: skip

PLUGIN, GRIDMEDIUM = {"plugin": "gridmedium"}, {"type": "gridmedium"}
EMISSION = [
    cell("gridmedium density", lambda: smooth_cloud(**PLUGIN), DENSITY, random(1.0)),
    cell("gridmedium albedo", lambda: smooth_cloud(**PLUGIN), ALBEDO, random(0.5)),
    cell("gridmedium scale", lambda: smooth_cloud(**PLUGIN), MEDIUM + "scale", add()),
    cell("gridmedium density, empty cells",
         lambda: cloud(heterogeneous(sparse(), constant(0.6), scale=3.0, supergrid=True, **PLUGIN)), DENSITY,
         where(sparse() == 0, 0.05), **UP),
    cell("gridmedium scale, chromatic", lambda: cloud({**rainbow(), **GRIDMEDIUM}), MEDIUM + "scale", add()),
    cell("gridmedium emission", glowing, MEDIUM + "emission.data", random(1.0), reference="pathreplay"),
    cell("gridmedium emission zero", lambda: glowing(0.0), MEDIUM + "emission.data", random(1.0),
         reference="pathreplay"),
    cell("gridmedium density, glowing", lambda: glowing(3.0), DENSITY, random(1.0), reference="pathreplay"),
    cell("gridmedium scale, glowing", lambda: glowing(3.0), MEDIUM + "scale", add(), reference="pathreplay"),
    cell("gridmedium albedo, glowing", lambda: glowing(3.0), ALBEDO, random(0.5), reference="pathreplay"),
    cell("gridmedium radiance", thick, MEDIUM + "radiance.data", random(1.0), reference="pathreplay"),
    cell("gridmedium density, radiance", thick, DENSITY, random(1.0), reference="pathreplay"),
    cell("gridmedium scale, radiance", thick, MEDIUM + "scale", add(), reference="pathreplay"),
    cell("gridmedium density, radiance, empty voxels", lambda: thick(checkers()), DENSITY, where(1 - checkers()),
         reference="pathreplay", **UP),
    cell("gridmedium density, radiance, no branch", thick, DENSITY, random(1.0), reference="pathreplay",
         options={"null_branching": False}),
    cell("gridmedium density, radiance, coloured", lambda: thick(smooth(0.4, 2.0, 3)), DENSITY, random(1.0),
         reference="pathreplay", options={"null_branching": False}),
    cell("gridmedium density, radiance, moving", thick, (DENSITY, "camera.to_world"),
         grid_and_camera, reference="pathreplay", options={"null_branching": False}, **{**MOVES, "step": 0.12}),
    cell("gridmedium radiance, camera", thick, "camera.to_world", translate(0.5, 0.2, 1), reference="pathreplay",
         **{**MOVES, "step": 0.12}),
]  # fmt: skip

CASES = GRIDS + HOMOGENEOUS + PLACES + EMISSION


@pytest.mark.parametrize(
    "case", [pytest.param(c, id=c.name, marks=() if c.name in QUICK else pytest.mark.slow) for c in CASES]
)
def test_gradient_against_finite_differences(case: Case) -> None:
    hold(case)


@pytest.mark.slow
def test_density_beside_a_moving_camera() -> None:
    """Null collisions take their share of the derivative by the density, not of that by the place of a collision."""
    scene = mi.load_dict(cloud(heterogeneous(checkers(), constant(0.6), scale=2.0)), optimize=False)
    params = mi.traverse(scene)
    adjoint = dr.full(mi.TensorXf, 1 / 1024, (16, 16, 3))
    found = []
    for keys in ((DENSITY,), (DENSITY, "camera.to_world")):
        for key in keys:
            dr.enable_grad(params[key])
        params.update()
        integrator = mi.load_dict({"type": "pathreplay", "max_depth": 8})
        sums = []
        for seed in range(1, 25):
            dr.clear_grad(params[DENSITY])
            integrator.render_backward(scene, params, adjoint, seed=seed, spp=64)
            g = np.array(dr.grad(params[DENSITY]))
            sums.append([g[checkers() == 1].sum(), g[checkers() == 0].sum()])
        found.append(np.array(sums))
    still, moving = found
    difference = gap(still, moving)
    assert (difference.error < RESOLUTION * np.abs(still.mean(0))).all()
    assert (np.abs(difference.z) < Z_LIMIT).all()


class Fixed:
    """A guess that knows nothing, and says so loudly."""

    def __init__(self, scene: mi.Scene, b: float) -> None:
        self.b, self.branching = dr.opaque(mi.Float, b), dr.opaque(mi.Float, 0.2)
        self.cells = BaselineCells.of(scene.bbox())

    def lookup(self, *_: Any) -> Any:
        return mi.Spectrum(self.b)


@pytest.mark.slow
@pytest.mark.parametrize("name, σ_t", [
    ("grey", checkers()), ("one channel", smooth(0.2, 1.0) * np.array([2.0, 1.0, 0.5])),
])  # fmt: skip
@pytest.mark.parametrize("keys", [
    pytest.param((DENSITY,), id="still"),
    pytest.param((DENSITY, "camera.to_world"), id="moving"),
])  # fmt: skip
def test_any_baseline_leaves_the_mean_alone(name: str, σ_t: np.ndarray, keys: tuple[str, ...]) -> None:
    scene = mi.load_dict(cloud(heterogeneous(σ_t, constant(0.6), scale=2.0)), optimize=False)
    params = mi.traverse(scene)
    for key in keys:
        dr.enable_grad(params[key])
    params.update()
    adjoint = dr.full(mi.TensorXf, 1 / 1024, (16, 16, 3))
    found = []
    for b in (0.0, 2.0):
        integrator = mi.load_dict({"type": "pathreplay", "max_depth": 4, "null_branching": True})
        integrator._learned = lambda view, trace, state, b=b: Fixed(scene, b)
        sums = []
        for seed in range(1, 17):
            dr.clear_grad(params[DENSITY])
            integrator.render_backward(scene, params, adjoint, seed=seed, spp=256)
            sums.append(np.array(dr.grad(params[DENSITY]))[..., 0].sum())
        found.append(np.array(sums))
    difference = gap(*found)
    assert not (found[0] == found[1]).any()
    assert difference.error < RESOLUTION * abs(found[0].mean())
    assert abs(difference.z) < Z_LIMIT


@pytest.mark.parametrize("channels", [pytest.param(1, marks=pytest.mark.slow), 3])
def test_one_thread_and_many_agree(channels: int) -> None:
    """Sums into grids, and into what is learned, lose nothing when threads meet: two passes, one with a baseline."""
    scene = mi.load_dict(cloud(heterogeneous(smooth(0.4, 2.0, channels), smooth(0.3, 0.9, channels))), optimize=False)
    params = mi.traverse(scene)
    for key in (DENSITY, ALBEDO):
        dr.enable_grad(params[key])
    params.update()
    adjoint = dr.full(mi.TensorXf, 1 / 1024, (16, 16, 3))
    threads, found = dr.thread_count(), []
    try:
        for count in (1, *2 * [max(2, threads)]):
            dr.set_thread_count(count)
            integrator = mi.load_dict({"type": "pathreplay", "max_depth": 8})
            for seed in (1, 2):
                for key in (DENSITY, ALBEDO):
                    dr.clear_grad(params[key])
                integrator.render_backward(scene, params, adjoint, seed=seed, spp=256)
            found.append(np.concatenate([np.ravel(np.array(dr.grad(params[key]))) for key in (DENSITY, ALBEDO)]))
    finally:
        dr.set_thread_count(threads)
    one, many, again = found
    assert np.abs(many - again).max() < 1e-4 * np.abs(one).max()
    assert np.abs(many - one).max() < 1e-4 * np.abs(one).max()


@pytest.mark.parametrize("painted", [False, True])
def test_light_of_a_mesh_grows_with_it_behind_a_boundary(painted: bool) -> None:
    """A small lamp above fog that is hardly there, and above a sheet that lets half of the light through."""
    T = mi.ScalarTransform4f
    glow = bitmap(np.full((4, 4, 3), 9)) if painted else rgb(9, 9, 9)
    place = T().translate([0, 2, 0]).rotate([1, 0, 0], 90).scale(0.05)
    half = {"type": "mask", "opacity": 0.5, "bsdf": {"type": "diffuse"}}
    sheet = {"type": "rectangle", "to_world": T().translate([0, 1.5, 0]).rotate([1, 0, 0], 90).scale(2), "bsdf": half}
    lamp = square(place, emitter={"type": "area", "radiance": glow})
    scene = mi.load_dict(lit_floor(homogeneous(1e-3, 0.0)) | {"light": lamp, "sheet": sheet}, optimize=False)
    params = mi.traverse(scene)
    key = next(key for key in params.keys() if key.startswith("light.") and key.endswith("vertex_positions"))
    still, growth = mi.Float(params[key]), mi.Float(0)
    centre = np.tile(np.array([0, 2, 0], np.float32), dr.width(still) // 3)
    dr.enable_grad(growth)
    params[key] = still + growth * (still - mi.Float(centre))
    params.update()
    integrator = mi.load_dict({"type": "pathreplay", "max_depth": 2, "boundary": "none"})
    image = mi.render(scene, params, integrator=integrator, spp=64)
    dr.backward(dr.mean(image, axis=None))
    params[key] = still
    params.update()
    assert dr.grad(growth)[0] == pytest.approx(2 * dr.mean(image, axis=None).array[0], rel=0.05)


SPECTRAL = """
import sys
sys.path[:0] = sys.argv[1:3]
from pathreplay.platform.backend import set_variant
set_variant("llvm_ad_spectral")
import test_truth_media, truth
try:
    truth.hold(next(c for c in test_truth_media.CASES if c.name == sys.argv[3]))
finally:
    print(truth.table())
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["smooth density", "homogeneous phase g", "gridmedium scale, chromatic"])
def test_spectral_variant(run_python: Callable[..., Any], name: str) -> None:
    done = run_python(SPECTRAL, args=(str(Path(__file__).parent), str(SUPPORT), name))
    print(done.stdout)
    assert done.returncode == 0, done.stdout + done.stderr
