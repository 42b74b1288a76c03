"""Error of attached path replay against the sweep, by number of smooth bounces, noise and kind of bookkeeping.

    python benchmarks/noise.py [--quick] [--json FILE]

Two bent sheets face each other under a smooth environment; the gradient is that of an image by the vertices of one
of them. Both drivers see the same paths, so the error, |g_replay - g_sweep| / |g_sweep|, is made of two things only:
the noise ε put into the Jacobians (grows with it, has mean zero, averages out) and rounding that their inverses
magnify (grows as the noise shrinks, does not average out). The sweep inverts nothing; its own rounding is 1e-6.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

from pathreplay.backend import set_variant  # before mitsuba: points Dr.Jit at a libLLVM

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip
import numpy as np

from pathreplay.gradient.ray_jacobian import Recovery

RESOLUTION = 16
SPP = 16
KEY = "low.vertex_positions"

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
        "film": {"type": "hdrfilm", "width": RESOLUTION, "height": RESOLUTION, "rfilter": {"type": "box"}},
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


def gradient(scene: mi.Scene, depth: int, driver: str, recovery: Recovery, seed: int = 1) -> tuple[np.ndarray, float]:
    """Gradient of a weighted image by the vertices of the low sheet, and the seconds of the faster of two runs."""
    params = mi.traverse(scene)
    integrator = mi.load_dict({"type": "pathreplay", "max_depth": depth, "rr_depth": 10_000, "driver": driver})
    integrator.recovery = recovery
    weights = mi.TensorXf(np.random.default_rng(0).uniform(0.5, 1.5, (RESOLUTION, RESOLUTION, 3)).astype(np.float32))
    dr.enable_grad(params[KEY])
    seconds = float("inf")
    for _ in range(3):  # the first compiles the kernels
        dr.set_grad(params[KEY], 0)
        params.update()
        start = time.perf_counter()
        image = mi.render(scene, params, integrator=integrator, spp=SPP, seed=seed)
        dr.backward(dr.sum(image * weights, axis=None))
        result = np.array(dr.grad(params[KEY]), dtype=np.float64)
        seconds = min(seconds, time.perf_counter() - start)
    dr.disable_grad(params[KEY])
    return result, seconds


def measure(scene: mi.Scene, name: str, bounces: int, recoveries: list[Recovery]) -> list[dict[str, Any]]:
    reference, seconds = gradient(scene, bounces + 1, "sweep", Recovery())
    other_seed, _ = gradient(scene, bounces + 1, "sweep", Recovery(), seed=2)
    size = np.linalg.norm(reference)
    monte_carlo = float(np.linalg.norm(other_seed - reference) / size / np.sqrt(2))
    print(f"\n{name}, {bounces} bounces: sweep {seconds:.3f} s, its Monte Carlo error {monte_carlo:.1e}")
    rows = []
    for recovery in recoveries:
        found, replay_seconds = gradient(scene, bounces + 1, "replay", recovery)
        error = float(np.linalg.norm(found - reference) / size)
        books = "float64" if recovery.double else "float32"
        ratio = replay_seconds / seconds
        print(f"  {recovery.place:11s} {books}  noise {recovery.noise:<7g} error {error:8.1e}  time x{ratio:.1f}")
        rows.append(
            {
                "scene": name,
                "bounces": bounces,
                "place": recovery.place,
                "books": books,
                "noise": recovery.noise,
                "error": error,
                "monte_carlo_error": monte_carlo,
                "time_over_sweep": ratio,
            }
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description="error of attached path replay against the sweep")
    parser.add_argument("--quick", action="store_true", help="two numbers of bounces and two levels of noise")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    args = parser.parse_args()

    set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)  # the warning that recommends the sweep
    places = ["directions"] if args.quick else ["everywhere", "smooth", "directions"]
    noises = [0.1, 0.01] if args.quick else [1.0, 0.1, 0.01, 0.001]
    many = [2, 5] if args.quick else [2, 3, 5, 9]
    grid = [Recovery(n, place, double) for place in places for double in (False, True) for n in noises]
    quiet = [Recovery(0.0, double=double) for double in (False, True)]

    rows = measure(panes(16), "glass panes", 15, quiet)
    if not args.quick:
        rows += measure(panes(4, MATERIALS["diffuse"]), "glass before a diffuse wall", 9, grid)
    for name in ["diffuse"] if args.quick else list(MATERIALS):
        scene = corridor(MATERIALS[name])
        for bounces in many:
            rows += measure(scene, name, bounces, grid)
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
