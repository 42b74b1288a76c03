"""Bent sheets and panes under a smooth sky, and the error of a replay's gradient in them: what `noise` measures."""

from __future__ import annotations

import time
from functools import lru_cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.gradient.ray_jacobian import Recovery

from .job import Job
from .noise import RECOVERIES, SWEEP
from .recoveries import OtherRecovery

PICTURE = 16  # pixels, width = height

MATERIALS: dict[str, dict[str, Any]] = {
    "diffuse": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.7, 0.9]}},
    "rough metal": {"type": "roughconductor", "alpha": 0.2},
}


def sheet(z: float, bend: float, half_width: float, up: bool, bsdf: dict[str, Any], n: int = 9) -> mi.Mesh:
    """A bent sheet of n x n vertices with shading normals, about the plane at height z."""
    y, x = np.mgrid[-1 : 1 : n * 1j, -1 : 1 : n * 1j] * half_width
    positions = np.stack([x, y, z + bend * np.sin(1.3 * x + 0.3) * np.cos(1.1 * y)], axis=-1)
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([b, d, c], axis=1)])
    props = mi.Properties()
    props["mesh_bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh("sheet", n * n, len(faces), has_vertex_normals=True, props=props)
    params = mi.traverse(mesh)
    params["vertex_positions"] = positions.astype(np.float32).ravel()
    params["faces"] = (faces if up else faces[:, ::-1]).astype(np.uint32).ravel()
    params.update()
    return mesh


def smooth_environment(height: int = 32) -> dict[str, Any]:
    y, x = np.mgrid[0:height, 0 : 2 * height] * (np.pi / height)
    waves = [np.sin(x) * np.sin(y) / 2, np.cos(x + 1) * np.sin(y) / 2, np.sin(2 * x) * np.sin(y) / 3]
    return {"type": "envmap", "bitmap": mi.Bitmap((1 + np.stack(waves, axis=-1)).astype(np.float32))}


def camera(origin: list[float], target: list[float], fov: float) -> dict[str, Any]:
    return {
        "type": "perspective",
        "fov": fov,
        "to_world": mi.ScalarTransform4f().look_at(origin=origin, target=target, up=[0, 0.1, 1]),
        "film": {"type": "hdrfilm", "width": PICTURE, "height": PICTURE, "rfilter": {"type": "box"}},
    }


def corridor(bsdf: dict[str, Any]) -> mi.Scene:
    """Two sheets, seen from the side: nearly every path bounces to and fro between them."""
    return mi.load_dict(
        {
            "type": "scene",
            "environment": smooth_environment(),
            "camera": camera([0, -5, 0.3], [0, 0, -0.6], fov=30),
            "low": sheet(-1, 0.1, 2, True, bsdf),
            "high": sheet(1, 0.1, 2, False, bsdf),
        },
        optimize=False,
    )


def panes(interfaces: int, wall: dict[str, Any] | None = None) -> mi.Scene:
    """Bent panes of glass, one behind the other, in front of a wall if there is one: chains of delta lobes."""
    glass = {"type": "smoothdielectric", "int_ior": 1.5}
    scene = {"type": "scene", "environment": smooth_environment(), "camera": camera([0.3, -0.2, -5], [0.3, 0, 0], 30)}
    names = ["low"] + [f"pane-{k}" for k in range(1, interfaces)]
    scene |= {name: sheet(0.25 * k, 0.05, 4, k % 2 == 1, glass) for k, name in enumerate(names)}
    if wall is not None:
        scene["wall"] = sheet(0.25 * interfaces + 0.5, 0.1, 4, False, wall)
    return mi.load_dict(scene, optimize=False)


class ReplayError:
    """|g - g_sweep| / |g_sweep| of one seed, for a kind of replay; for the sweep, its own Monte Carlo error."""

    def __init__(self, job: Job) -> None:
        self.job = job
        self.scene = SCENES[job.scene]()
        self.params = mi.traverse(self.scene)
        self.weights = np.random.default_rng(0).uniform(0.5, 1.5, (PICTURE, PICTURE, 3)).astype(np.float32)
        dr.enable_grad(self.params[job.parameters[0]])
        self.params.update()
        mi.set_log_level(mi.LogLevel.Error)  # not the warning that recommends the sweep
        self.swept = lru_cache(maxsize=4)(self._swept)

    def forget(self) -> None:
        """Nothing is learned."""

    def __call__(self, method: str, seed: int) -> tuple[float, np.ndarray]:
        """Seconds of the gradient pass, and the error."""
        right = self.swept(seed)
        if method == SWEEP:
            seconds, found = self._gradient("sweep", Recovery(), self.job.rounds + seed)
            error = np.linalg.norm(found - right) / np.sqrt(2)  # of one pass, from the difference of two
        else:
            seconds, found = self._gradient("replay", OtherRecovery(*RECOVERIES[method]), seed)
            error = np.linalg.norm(found - right)
        return seconds, np.array([error / np.linalg.norm(right)])

    def conclude(self, kept: dict[str, list[np.ndarray]]) -> dict[str, dict[str, Any]]:
        """The errors of all seeds."""
        return {name: {"values": np.concatenate(rows).tolist()} for name, rows in kept.items() if rows}

    def _swept(self, seed: int) -> np.ndarray:
        return self._gradient("sweep", Recovery(), seed)[1]

    def _gradient(self, driver: str, recovery: Recovery, seed: int) -> tuple[float, np.ndarray]:
        job, key = self.job, self.job.parameters[0]
        depths = {"max_depth": job.max_depth, "rr_depth": job.rr_depth}
        integrator = mi.load_dict({"type": "pathreplay", "driver": driver} | depths)
        integrator.recovery = recovery
        dr.clear_grad(self.params[key])
        dr.sync_thread()
        start = time.perf_counter()
        integrator.render_backward(self.scene, self.params, mi.TensorXf(self.weights), seed=seed % 2**32, spp=job.spp)
        result = np.array(dr.grad(self.params[key]), dtype=np.float64)
        return time.perf_counter() - start, result


SCENES = {
    "diffuse sheets": lambda: corridor(MATERIALS["diffuse"]),
    "rough metal sheets": lambda: corridor(MATERIALS["rough metal"]),
    "glass before a diffuse wall": lambda: panes(4, MATERIALS["diffuse"]),
    "glass panes": lambda: panes(16),
}
