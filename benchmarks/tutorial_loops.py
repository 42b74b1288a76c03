"""The optimization loops of Mitsuba's tutorials with their settings, for the scenes in examples/tutorials.

Each function loads a scene, renders the targets, calls ``ready`` to start the clock, optimises, and returns the final
values by key. ``few`` replaces the number of iterations, for trials.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

Ready = Callable[[], None]
Found = dict[str, np.ndarray]
Parameters = Mapping[str, str]


def colour(
    scene_file: str, parameters: Parameters, key: str, start: list[float], ready: Ready, few: int | None
) -> Found:
    """`gradient_based_opt`, with the parameter and its initial value as arguments."""
    scene = mi.load_file(scene_file, **parameters)
    integrator = mi.load_dict({"type": "prb", "max_depth": 6})
    reference = mi.render(scene, spp=512)
    params = mi.traverse(scene)
    params[key] = mi.Color3f(start)
    params.update()
    optimizer = mi.ad.Adam(lr=0.05)
    optimizer[key] = params[key]
    params.update(optimizer)
    ready()
    for i in range(few or 50):
        image = mi.render(scene, params, integrator=integrator, spp=4, seed=i)
        loss = dr.mean(dr.square(image - reference))
        dr.backward(loss)
        optimizer.step()
        optimizer[key] = dr.clip(optimizer[key], 0.0, 1.0)
        params.update(optimizer)
        print(f"iteration {i}: loss {loss}", end="\r")
    return {key: np.array(params[key])[:, 0]}


def volume(scene_file: str, parameters: Parameters, ready: Ready, few: int | None) -> Found:
    """`volume_optimization`: a step per view with 16^3 voxels, then with 64^3 voxels and eight times the samples."""
    key = "object.interior_medium.sigma_t.data"
    scene = mi.load_file(scene_file, **parameters)
    integrator = mi.load_dict({"type": "prbvolpath", "max_depth": 6})
    views = range(len(scene.sensors()))
    references = [mi.render(scene, sensor=v, integrator=integrator, spp=512) for v in views]
    params = mi.traverse(scene)
    params[key] = dr.full(mi.TensorXf, 0.002, (16, 16, 16, 1))
    params.update()
    optimizer = mi.ad.Adam(lr=0.02)
    optimizer[key] = params[key]
    params.update(optimizer)
    ready()
    for size, spp in ((16, 8), (64, 64)):
        if size != 16:
            optimizer[key] = dr.resample(optimizer[key], shape=(size, size, size, 1), filter="linear")
            params.update(optimizer)
        for i in range(few or 20):
            total = 0.0
            for v in views:
                image = mi.render(scene, params, sensor=v, integrator=integrator, spp=spp, seed=i)
                loss = dr.mean(dr.square(image - references[v]))
                dr.backward(loss)
                optimizer.step()
                optimizer[key] = dr.clip(optimizer[key], 1e-6, 1.0)
                params.update(optimizer)
                total += loss
            print(f"{size} voxels, iteration {i}: loss {total}", end="\r")
    return {key: np.array(params[key])}


def pose(scene_file: str, parameters: Parameters, ready: Ready, few: int | None) -> Found:
    """`object_pose_estimation`: two translations and an angle about y, by boundary terms of `direct_projective`."""
    key = "body.vertex_positions"
    scene = mi.load_file(scene_file, **parameters)
    integrator = mi.load_dict({"type": "direct_projective"})
    reference = mi.render(scene, integrator=integrator, seed=0, spp=1024)
    params = mi.traverse(scene)
    initial = dr.unravel(mi.Point3f, params[key])
    optimizer = mi.ad.Adam(lr=0.025)
    optimizer["angle"] = mi.Float(0.25)
    optimizer["shift"] = mi.Point2f(0.1, -0.25)

    def apply() -> None:
        optimizer["shift"] = dr.clip(optimizer["shift"], -0.5, 0.5)
        optimizer["angle"] = dr.clip(optimizer["angle"], -0.5, 0.5)
        x, y = optimizer["shift"]
        motion = mi.Transform4f().translate([x, y, 0.0]).rotate([0, 1, 0], optimizer["angle"] * 100.0)
        params[key] = dr.ravel(motion @ initial)
        params.update()

    ready()
    for i in range(few or 100):
        apply()
        image = mi.render(scene, params, integrator=integrator, seed=i, spp=16)
        loss = dr.mean(dr.square(image - reference))
        dr.backward(loss)
        optimizer.step()
        print(f"iteration {i}: loss {loss}", end="\r")
    apply()
    return {key: np.array(dr.detach(params[key]))}


def shape(scene_file: str, parameters: Parameters, target: str, spp: int, ready: Ready, few: int | None) -> Found:
    """`shape_optimization` before remeshing: Large Steps from a ball, with a step per view."""
    key = "shape.vertex_positions"
    integrator = mi.load_dict({"type": "direct_projective", "sppi": 0})
    truth = mi.load_file(scene_file, **{**parameters, "mesh": target})
    views = range(len(truth.sensors()))
    references = [mi.render(truth, sensor=v, integrator=integrator, spp=256) for v in views]
    del truth
    scene = mi.load_file(scene_file, **parameters)
    params = mi.traverse(scene)
    steps = mi.ad.LargeSteps(params[key], params["shape.faces"], 25)
    optimizer = mi.ad.Adam(lr=1e-1, uniform=True)
    optimizer["u"] = steps.to_differential(params[key])
    ready()
    for i in range(few or 100):
        total = 0.0
        for v in views:
            params[key] = steps.from_differential(optimizer["u"])
            params.update()
            image = mi.render(scene, params, sensor=v, integrator=integrator, spp=spp, seed=i)
            loss = dr.mean(dr.abs(image - references[v]))
            dr.backward(loss)
            optimizer.step()
            total += loss
        print(f"iteration {i}: loss {total}", end="\r")
    params[key] = steps.from_differential(optimizer["u"])
    params.update()
    return {key: np.array(dr.detach(params[key]))}


LOOPS: dict[str, tuple[Callable[..., Found], dict[str, Any]]] = {
    "gradient_based_opt": (colour, {"key": "red.reflectance.value", "start": [0.01, 0.2, 0.9]}),
    "volume_optimization": (volume, {}),
    "object_pose_estimation": (pose, {}),
    "shape_optimization": (shape, {"spp": 16}),
    "forward_inverse_rendering": (colour, {"key": "green.reflectance.value", "start": [0.1, 0.25, 0.4]}),
}
"""Loop of each tutorial and its arguments; the last tutorial has no loop of its own, since it recovers nothing."""
