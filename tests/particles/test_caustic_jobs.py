"""Jobs that design a lens of two surfaces and a mirror: derivatives are those of finite differences, losses fall."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scipy.ndimage

from pathreplay.inverse.config.schema import load_config, make_config
from pathreplay.inverse.images.io import exr_bytes
from pathreplay.inverse.problem.problem import Problem, build_problem, put_values
from pathreplay.jobs import optimize

EXAMPLES = Path(__file__).parents[2] / "examples/caustic-lens"
N = 32  # rows and columns of height maps, and pixels of the image
POINT = {"source_distance": 4.0}
JOBS: dict[str, tuple[str, dict[str, float], dict[str, float]]] = {
    "lens": ("config.toml", {}, {}),
    "lens and point light": ("config.toml", POINT, {**POINT, "thickness": 0.2}),
    "two surfaces": ("two-surfaces.toml", {}, {}),
    "mirror": ("mirror.toml", {}, {}),
    "mirror and point light": ("mirror.toml", POINT, POINT),
}
"""Job file, and changes of its scene and of the optics of the transport."""
RATES = {name: 2.5e-5 if "mirror" in name else 1e-4 for name in JOBS}  # a mirror turns light four times as much


def picture() -> np.ndarray:
    v, u = np.meshgrid(*[(np.arange(N) + 0.5) / N] * 2, indexing="ij")
    image = (
        0.3 + np.exp(-30 * ((u - 0.3) ** 2 + (v - 0.4) ** 2)) + 0.7 * np.exp(-60 * ((u - 0.7) ** 2 + (v - 0.7) ** 2))
    )
    return image[..., None].astype(np.float32)


def job(name: str, folder: Path, **changes: Any) -> dict[str, Any]:
    """The example, with a smooth image of N x N pixels."""
    file, scene, optics = JOBS[name]
    config = load_config(EXAMPLES / file).model_dump(mode="json", exclude_unset=True)
    (folder / "picture.exr").write_bytes(exr_bytes(picture()))
    config["scene_parameters"] |= {"columns": N, "rows": N, "resolution": N, **scene}
    for table in config["parameters"]:
        table["shape"] = [N, N, 1]
        if "initial" in table:
            table["initial"] |= {"transport": str(folder / "picture.exr"), **optics}
    config["target"] = {"images": [str(folder / "picture.exr")]}
    return config | {"output": str(folder / "run"), "eval_spp": 64, **changes}


@pytest.mark.parametrize("file", sorted({file for file, _, _ in JOBS.values()}))
def test_the_examples_start_within_their_bounds_and_in_the_glass(file: str) -> None:
    """As they are: the heights of the transport depend on the photograph."""
    problem = build_problem(load_config(EXAMPLES / file), EXAMPLES)
    assert np.ptp(problem.variables[0].start) > 0.01
    bounds = {table.key: (table.lower, table.upper) for table in problem.config.parameters}
    if "entry" in bounds:  # heights are positive towards the receiver, and the slab is 0.2 thick
        assert bounds["entry"][1] - 0.2 < bounds["exit"][0]


def image_of(problem: Problem, values: dict[str, np.ndarray]) -> np.ndarray:
    put_values(problem, values)
    return np.array(mi.render(problem.scene, integrator=problem.integrator, spp=64, seed=3), np.float64)


@pytest.mark.parametrize("name", JOBS)
def test_derivatives_are_those_of_central_differences(name: str, tmp_path: Path) -> None:
    """With the same light paths, for smooth changes of each map that vanish at its border: no path crosses the rim."""
    problem = build_problem(make_config(job(name, tmp_path)), tmp_path)
    random = np.random.default_rng(4)
    values = {v.key: v.start for v in problem.variables}
    weights = scipy.ndimage.gaussian_filter(random.normal(size=(N, N, 1)), (3, 3, 0))
    put_values(problem, values)
    (entry,) = problem.derived
    positions = mi.Float(problem.params[entry.key])
    dr.enable_grad(positions)
    problem.params[entry.key] = positions
    problem.params.update()
    adjoint = mi.TensorXf(weights.astype(np.float32) / weights.size)
    problem.integrator.render_backward(problem.scene, problem.params, adjoint, seed=3, spp=64)
    tensors = {key: mi.TensorXf(value) for key, value in values.items()}
    dr.enable_grad(list(tensors.values()))
    dr.backward(dr.sum(entry.form.store(entry.value(tensors)) * dr.grad(positions)))
    window = np.outer(*[np.hanning(N - 8)] * 2)
    for key, tensor in tensors.items():
        direction = np.zeros((N, N, 1), np.float32)
        direction[4:-4, 4:-4, 0] = window * scipy.ndimage.gaussian_filter(random.normal(size=(N - 8, N - 8)), 3)
        direction /= np.abs(direction).max()
        h = 2e-4
        ends = [image_of(problem, values | {key: values[key] + sign * h * direction}) for sign in (1, -1)]
        expected = np.mean((ends[0] - ends[1]) * weights) / (2 * h)
        assert np.sum(np.array(dr.grad(tensor)) * direction) == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("name", [n if n == "lens" else pytest.param(n, marks=pytest.mark.slow) for n in JOBS])
def test_the_loss_falls_from_the_transport(name: str, tmp_path: Path) -> None:
    config = job(name, tmp_path, iterations=10, spp=64, learning_rate=RATES[name], warmup_steps=4)
    result = optimize(make_config(config), progress=False)
    assert result.history[-1].loss < 0.5 * result.history[0].loss


@pytest.mark.parametrize("name", ["two surfaces", "mirror"])
def test_the_loss_falls_from_flat_surfaces(name: str, tmp_path: Path) -> None:
    config = job(name, tmp_path, iterations=12, spp=16, learning_rate=4 * RATES[name], warmup_steps=4)
    for table in config["parameters"]:
        table.pop("initial", None)
    result = optimize(make_config(config), progress=False)
    assert result.history[-1].loss < 0.5 * result.history[0].loss
