"""The measured scenes with media: clouds, a sealed room of fog, and sparse grids."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import mitsuba as mi
import numpy as np

from .parts import SceneDict, sensor

#: Keys of what is differentiated.
DENSITY = "cloud.interior_medium.sigma_t.data"
ALBEDO = "cloud.interior_medium.albedo.data"
ASYMMETRY = "cloud.interior_medium.phase_function.g"
EXTINCTION = "cloud.interior_medium.sigma_t.value.value"


def _axes(size: int) -> tuple[np.ndarray, ...]:
    """Coordinates z, y, x of the voxels of a grid over [-1, 1]³."""
    z, y, x = np.mgrid[-1 : 1 : size * 1j, -1 : 1 : size * 1j, -1 : 1 : size * 1j]
    return z, y, x


def _noise(size: int, waves: int, seed: int) -> np.ndarray:
    """Return smooth noise of mean about 0 and deviation 1: a sum of ``waves`` random cosines of wavelength 1 to 3."""
    random = np.random.default_rng(seed)
    z, y, x = _axes(size)
    total = np.zeros_like(x)
    for _ in range(waves):
        k = random.normal(size=3)
        k *= random.uniform(2, 6) / np.linalg.norm(k)
        total += np.cos(k[0] * x + k[1] * y + k[2] * z + random.uniform(0, 2 * np.pi))
    return total / np.sqrt(waves / 2)


def cloud_density(size: int, floor: float, width: float = 0.5) -> np.ndarray:
    """Return the densities of a ragged ball, with maximum 1 and a lower bound of ``floor``."""
    z, y, x = _axes(size)
    ball = np.exp(-(x * x + y * y + z * z) / width**2 + 0.6 * _noise(size, 24, seed=0))
    return floor + (1 - floor) * ball / ball.max()


def blobs(size: int) -> np.ndarray:
    """Return six small dense blobs with a mean density of 1 to 2 % of the maximum and nine tenths empty voxels."""
    z, y, x = _axes(size)
    total = np.zeros_like(x)
    for cx, cy, cz in np.random.default_rng(1).uniform(-0.8, 0.8, (6, 3)):
        distance = np.sqrt((x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2)
        total += np.square(np.clip(1 - (distance / 0.3) ** 2, 0, None))
    return total / total.max()


def _grid(values: np.ndarray) -> SceneDict:
    box = mi.ScalarTransform4f().translate(-1).scale(2)
    grid = mi.VolumeGrid(values[..., None].astype(np.float32))
    return {"type": "gridvolume", "grid": grid, "to_world": box, "raw": True, "filter_type": "trilinear"}


def _medium(density: np.ndarray, depth: float, albedo: float | np.ndarray, g: float, **more: Any) -> SceneDict:
    """A medium in [-1, 1]³ whose densest column along an axis has the optical ``depth``."""
    column = 2 * max(density.mean(axis=axis).max() for axis in range(3))
    if isinstance(albedo, np.ndarray):
        of_albedo: Any = _grid(albedo)
    else:
        of_albedo = {"type": "constvolume", "value": albedo}
    return {
        "type": "heterogeneous",
        "sigma_t": _grid(density),
        "albedo": of_albedo,
        "scale": depth / column,
        "phase": {"type": "hg", "g": g},
    } | more


def _body(medium: SceneDict, **more: Any) -> SceneDict:
    return {"type": "cube", "bsdf": {"type": "null"}, "interior": medium} | more


def _sun_and_sky() -> SceneDict:
    """A dim sky of radiance 0.1 to 0.25, and a sun of 5 degrees and radiance 1000 with three quarters of the light."""
    v, u = np.mgrid[0:128, 0:256].astype(np.float32)
    v, u = (v + 0.5) / 128, (u + 0.5) / 256
    sky = np.where(v < 0.5, 0.15 + 0.2 * v, 0.1)[..., None] * np.array([0.7, 0.85, 1.0])
    off_sun = np.hypot((v - 0.22) * np.pi, (u - 0.7) * 2 * np.pi * np.sin(0.22 * np.pi))
    sun = 1000 * (off_sun < np.radians(2.5))[..., None] * np.array([1.0, 0.9, 0.8])
    upright = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    return {"type": "envmap", "bitmap": mi.Bitmap((sky + sun).astype(np.float32)), "to_world": upright}


def _outdoors(medium: Callable[[], SceneDict], resolution: int) -> SceneDict:
    return {
        "type": "scene",
        "sensor": sensor(resolution, [0.6, -4.5, 1.2], [0, 0, 0], fov=32),
        "cloud": _body(medium()),
        "environment": _sun_and_sky(),
    }


def _cloud(albedo: float = 0.9) -> SceneDict:
    # 2 % of the peak outside the cloud: where a grid is empty most estimators are biased, and no variance tells.
    return _medium(cloud_density(32, floor=0.02), depth=15, albedo=albedo, g=0.3)


def _dense_core() -> SceneDict:
    return _medium(cloud_density(32, floor=0.05, width=0.4), depth=40, albedo=0.99, g=0)


def _cloud_in_empty_voxels() -> SceneDict:
    # Three quarters of the voxels are zero, and no others are close to zero.
    density = cloud_density(32, floor=0)
    return _medium(np.where(density > 0.1, density, 0), depth=15, albedo=0.9, g=0.3)


def _cloud_of_two_albedos() -> SceneDict:
    return _medium(cloud_density(32, floor=0.02), depth=15, albedo=0.85 + 0.04 * np.tanh(_noise(32, 24, 2)), g=0.3)


def _homogeneous() -> SceneDict:
    extinction = {"type": "constvolume", "value": 4.0}
    albedo = {"type": "rgb", "value": [0.95, 0.9, 0.8]}
    return {"type": "homogeneous", "sigma_t": extinction, "albedo": albedo, "phase": {"type": "hg", "g": 0.3}}


def room_with_cloud(resolution: int) -> SceneDict:
    """A cloud over the floor of a room with three walls, lit by a rectangle at the ceiling."""
    T = mi.ScalarTransform4f

    def wall(to_world: Any, colour: list[float]) -> SceneDict:
        bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": colour}}
        return {"type": "rectangle", "to_world": to_world, "bsdf": bsdf}

    grey = [0.7, 0.7, 0.7]
    return {
        "type": "scene",
        "sensor": sensor(resolution, [0, -6, 0.4], [0, 0, 0], fov=36),
        "cloud": _body(_cloud()),
        "floor": wall(T().translate([0, 0, -1.3]).scale(1.7), grey),
        "back": wall(T().translate([0, 1.7, 0]).rotate([1, 0, 0], 90).scale(1.7), grey),
        "left": wall(T().translate([-1.7, 0, 0]).rotate([0, 1, 0], 90).scale(1.7), [0.6, 0.1, 0.1]),
        "right": wall(T().translate([1.7, 0, 0]).rotate([0, 1, 0], -90).scale(1.7), [0.1, 0.5, 0.1]),
        "lamp": {
            "type": "rectangle",
            "to_world": T().translate([0, 0, 1.6]).rotate([1, 0, 0], 180).scale(0.5),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 12.0}},
        },
    }


def sealed_fog(resolution: int) -> SceneDict:
    """A sealed white room filled with fog, except for a gap in front of the sensor. No path ends before ``max_depth``.

    The fog absorbs nothing, and the walls absorb 0.001. The density is not constant, so that null collisions occur.
    """
    T = mi.ScalarTransform4f
    fog = _medium(0.7 + 0.3 * np.tanh(_noise(16, 24, seed=3)), depth=20, albedo=1.0, g=0)
    place = T().translate([0, 0.1, 0]).scale([0.99, 0.89, 0.99])
    fog["sigma_t"]["to_world"] = place @ fog["sigma_t"]["to_world"]
    white = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.999}}
    return {
        "type": "scene",
        "sensor": sensor(resolution, [0, -0.95, 0], [0, 1, 0], fov=60),
        "cloud": _body(fog, to_world=place),
        "room": {"type": "cube", "flip_normals": True, "bsdf": white},
        "lamp": {
            "type": "rectangle",
            "to_world": T().translate([0, 0, 0.995]).rotate([1, 0, 0], 180).scale(0.2),
            "bsdf": {"type": "twosided", "bsdf": white},
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1.0}},
        },
    }


def _counted_fog(resolution: int) -> SceneDict:
    scene = sealed_fog(resolution)
    scene["cloud"]["interior"]["phase"] = {"type": "countingphase"}
    return scene


def _supergrid_medium(density: np.ndarray, depth: float, supergrid: str | bool) -> SceneDict:
    return _medium(density, depth, 0.9, 0, supergrid=supergrid) | {"type": "gridmedium"}


def _sparse(supergrid: str | bool, depth: float = 40) -> SceneDict:
    return _supergrid_medium(blobs(64), depth, supergrid)


def _uniform(supergrid: str | bool) -> SceneDict:
    return _supergrid_medium(0.9 + 0.1 * np.tanh(_noise(64, 24, seed=4)), 10, supergrid)


MEDIA_SCENES: dict[str, Callable[[int], SceneDict]] = {
    "cloud": partial(_outdoors, _cloud),
    "dense-core": partial(_outdoors, _dense_core),
    "room-with-cloud": room_with_cloud,
    "cloud-of-albedos": partial(_outdoors, _cloud_of_two_albedos),
    "empty-voxels": partial(_outdoors, _cloud_in_empty_voxels),
    "dark-cloud": partial(_outdoors, partial(_cloud, albedo=0.05)),
    "homogeneous": partial(_outdoors, _homogeneous),
    "sealed-fog": sealed_fog,
    "sealed-fog, counted": _counted_fog,
    "sparse, one majorant": partial(_outdoors, partial(_sparse, False)),
    "sparse, supergrid": partial(_outdoors, partial(_sparse, True)),
    "sparse, auto": partial(_outdoors, partial(_sparse, "auto")),
    "thin sparse, one majorant": partial(_outdoors, partial(_sparse, False, depth=10)),
    "thin sparse, supergrid": partial(_outdoors, partial(_sparse, True, depth=10)),
    "thin sparse, auto": partial(_outdoors, partial(_sparse, "auto", depth=10)),
    "uniform, one majorant": partial(_outdoors, partial(_uniform, False)),
    "uniform, supergrid": partial(_outdoors, partial(_uniform, True)),
    "uniform, auto": partial(_outdoors, partial(_uniform, "auto")),
}
