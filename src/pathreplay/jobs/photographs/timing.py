"""Measures the speed of this machine on the scene of a job: of images, and of gradients for the poses of all photos."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from pathreplay.inverse.dataset.capture import pinhole_camera
from pathreplay.inverse.problem.problem import notes_on_edges
from pathreplay.jobs.photographs.mesh import COLOUR
from pathreplay.jobs.photographs.pictures import Frame
from pathreplay.jobs.photographs.plan import PASSES, TRACED, Speed
from pathreplay.scenes.loading import load_scene, load_scene_with

TIMED_SPP = 4
SMALL = 8
"""Width and height of the images that show how long tracing takes."""


def measure(scene: Path, frames: Sequence[Frame], near: float) -> Speed:
    """Measure the seconds to trace and to compile an image of a scene, and the samples per second, on this machine."""
    frame, loaded = frames[len(frames) // 2], load_scene(scene)
    large, small = (
        mi.load_dict(pinhole_camera(frame.lens, frame.place, size, near))
        for size in ((frame.width, frame.height), (SMALL, SMALL))
    )

    def seconds(is_large: bool, spp: int, seed: int) -> float:
        begin, sensor = time.perf_counter(), large if is_large else small
        np.array(mi.render(loaded, sensor=sensor, integrator=loaded.integrator(), spp=spp, seed=seed))
        return time.perf_counter() - begin

    return _speed(seconds, frame)


def measure_poses(scene: Path, frames: Sequence[Frame], near: float) -> Speed:
    """Measure a pass with the gradient of all poses, and return the speed of images for which `plan_stages` plans it.

    `plan_stages` multiplies the seconds of an image by `PASSES` per sample, and by `TRACED` for tracing and compiling.
    The measured seconds are divided by these factors, so that the plan contains the measured seconds.
    """
    frame = frames[len(frames) // 2]
    cameras = {each.name: pinhole_camera(each.lens, each.place, (each.width, each.height), near) for each in frames}
    cameras["small"] = pinhole_camera(frame.lens, frame.place, (SMALL, SMALL), near)
    cameras = {name: {**camera, "id": name} for name, camera in cameras.items()}
    loaded, _ = load_scene_with(scene, {}, None, cameras)
    sensors = {sensor.id(): n for n, sensor in enumerate(loaded.sensors())}
    params = mi.traverse(loaded)
    keys = [key for key in params.keys() if key.endswith((".data", COLOUR)) or key.removesuffix(".to_world") in cameras]
    notes_on_edges(params, keys, loaded.integrator())  # suppresses the note, which the run itself shows

    def seconds(is_large: bool, spp: int, seed: int) -> float:
        begin, sensor = time.perf_counter(), sensors[frame.name if is_large else "small"]
        for key in keys:
            dr.enable_grad(params[key])
        params.update()
        image = mi.render(loaded, params, sensor=sensor, integrator=loaded.integrator(), spp=spp, seed=seed)
        dr.backward(dr.mean(image, axis=None))
        dr.eval([dr.grad(params[key]) for key in keys])
        dr.sync_thread()
        for key in keys:
            dr.disable_grad(params[key])
        return time.perf_counter() - begin

    speed = _speed(seconds, frame)
    return Speed(PASSES * speed.samples, speed.tracing / TRACED, speed.compiling / TRACED)


def _speed(seconds: Callable[[bool, int, int], float], frame: Frame) -> Speed:
    """Compute the speed from timed passes. ``seconds`` takes whether the image is large, the spp and a seed."""
    first = seconds(False, 1, 0)
    traced = min(seconds(False, 1, seed) for seed in (1, 2, 3))
    whole = min(seconds(True, TIMED_SPP, seed) for seed in (1, 2, 3))
    samples = frame.width * frame.height * TIMED_SPP / max(whole - traced, 0.1 * whole)
    return Speed(samples, traced, max(first - traced, 0.0))
