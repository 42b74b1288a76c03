"""The bridge to PyTorch: pictures and gradients are Mitsuba's own, calls do not mix, and nothing is left behind."""

from __future__ import annotations

import gc
import runpy
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import psutil
import pytest

from pathreplay.errors import PathreplayError
from pathreplay.scenes.loading import load_scene
from pathreplay.scenes.parameters import get_array
from places import ROOT

torch = pytest.importorskip("torch")

from bridges import PLAIN, SMALL, TEXTURE, WALL, hold, mitsubas  # noqa: E402
from pathreplay.torch import RenderFunction  # noqa: E402


@pytest.fixture
def render() -> Any:
    return RenderFunction("cornell-box-photo", [TEXTURE, WALL], integrator=PLAIN, spp=16, arguments=SMALL)


def test_the_picture_is_that_of_mitsuba(render: Any) -> None:
    scene = load_scene("cornell-box-photo", **SMALL)
    expected = np.array(mi.render(scene, sensor=1, integrator=mi.load_dict(PLAIN), spp=16, seed=4))
    image = render(render.initial_values(), 1, seed=4)
    assert image.shape == (6, 6, 3) and image.dtype == torch.float32
    np.testing.assert_allclose(image.cpu().numpy(), expected, rtol=1e-5, atol=1e-6)


def test_gradients_of_several_calls_are_each_their_own(render: Any) -> None:
    """Two views with different values before one backward: the sum of both gradients, by Mitsuba alone."""
    first, second = render.initial_values(), render.initial_values()
    second = {TEXTURE: second[TEXTURE] * 0.2, WALL: second[WALL] * 0 + 0.9}
    for values in (first, second):
        for tensor in values.values():
            tensor.requires_grad_()
    weights = [np.random.default_rng(i).uniform(0.5, 1, (6, 6, 3)).astype(np.float32) for i in (0, 1)]
    loss = (render(first, 0, seed=1, spp=2048) * torch.tensor(weights[0], device=render.device)).sum()
    loss = loss + (render(second, 1, seed=2, spp=2048) * torch.tensor(weights[1], device=render.device)).sum()
    loss.backward()
    for values, sensor, weight in ((first, 0, weights[0]), (second, 1, weights[1])):
        expected = mitsubas({k: v.detach().cpu().numpy() for k, v in values.items()}, sensor, weight)
        for key, gradient in expected.items():
            found = values[key].grad.cpu().numpy()
            hold(found, gradient)


def test_transforms_vectors_and_numbers_have_gradients() -> None:
    """That of the camera's shift against the same by Mitsuba: x of `camera.to_world` is entry (0, 3)."""
    render = RenderFunction(
        "mirror-camera", ["camera.to_world"], integrator=PLAIN, spp=512, arguments={"resolution": 8}
    )
    values = render.initial_values()
    values["camera.to_world"].requires_grad_()
    assert values["camera.to_world"].shape == (4, 4)
    ramp = np.broadcast_to(np.linspace(-1, 1, 8, dtype=np.float32)[:, None], (8, 8, 3)).copy()  # else shifts cancel
    (render(values, 0, seed=1) * torch.tensor(ramp, device=render.device)).sum().backward()
    found = values["camera.to_world"].grad.cpu().numpy()
    scene = load_scene("mirror-camera", resolution=8)
    params, x = mi.traverse(scene), mi.Float(0)
    dr.enable_grad(x)
    params["camera.to_world"] = mi.Transform4f().translate([x, 0, 0]) @ params["camera.to_world"]
    params.update()
    image = mi.render(scene, params, sensor=0, integrator=mi.load_dict(PLAIN), spp=512, seed=2)
    dr.backward(dr.sum(image * mi.TensorXf(ramp), axis=None))
    assert found[0, 3] == pytest.approx(dr.grad(x)[0], rel=0.1) and abs(found[0, 3]) > 0.5


def test_colours_keep_their_order() -> None:
    render = RenderFunction("cornell-box", WALL, integrator=PLAIN, arguments={"resolution": 4})
    render({WALL: torch.tensor([0.1, 0.2, 0.3])})
    np.testing.assert_allclose(get_array(mi.traverse(render.scene)[WALL]), [0.1, 0.2, 0.3], rtol=1e-6)


def test_a_texture_may_have_another_size(render: Any) -> None:
    values = {**render.initial_values(), TEXTURE: torch.full((5, 7, 3), 0.5, requires_grad=True)}
    render(values).sum().backward()
    assert values[TEXTURE].grad.shape == (5, 7, 3) and values[TEXTURE].grad.abs().sum() > 0


def test_what_does_not_fit_is_told(render: Any) -> None:
    values = render.initial_values()
    with pytest.raises(PathreplayError, match=r"missing or unexpected: 'red\.reflectance\.value'"):
        render({TEXTURE: values[TEXTURE]})
    with pytest.raises(PathreplayError, match="missing or unexpected: 'blue'"):
        render({**values, "blue": values[WALL]})
    with pytest.raises(PathreplayError, match=r"shape \(4,\) given for the parameter 'red.*' of shape \(3,\)"):
        render({**values, WALL: torch.zeros(4)})
    with pytest.raises(PathreplayError, match="Integrator 'path' computes no gradients"):
        RenderFunction("cornell-box", WALL, integrator={"type": "path"})
    with pytest.raises(PathreplayError, match="No parameter 'blue'"):
        RenderFunction("cornell-box", "blue")


@pytest.mark.slow
def test_five_hundred_iterations_leave_nothing_behind() -> None:
    """Neither memory of the process nor variables of Dr.Jit's."""
    render = RenderFunction("cornell-box-photo", [TEXTURE, WALL], integrator=PLAIN, spp=1, arguments=SMALL)
    values = {key: torch.nn.Parameter(value) for key, value in render.initial_values().items()}
    optimiser = torch.optim.Adam(values.values(), lr=1e-3)
    marks = []
    for i in range(500):
        optimiser.zero_grad()
        render(values, i % 2, seed=i).square().mean().backward()
        optimiser.step()
        if i in (99, 499):
            gc.collect()
            marks.append((psutil.Process().memory_info().rss, dr.whos(as_string=True).count("\n")))
    (before, held), (after, still) = marks
    assert still == held
    assert after - before < 20e6


@pytest.mark.slow
def test_the_example_recovers_a_small_texture_by_a_network(tmp_path: Path) -> None:
    example = ROOT / "examples/torch-network/recover.py"
    found = runpy.run_path(str(example))["recover"](resolution=12, texture=8, steps=60, picture=tmp_path / "found.png")
    assert found.error < 0.5 * found.initial_values and (tmp_path / "found.png").is_file()
