"""The bridge to JAX: the same pictures and gradients as Mitsuba's own, compiled or not, and calls do not mix."""

from __future__ import annotations

import gc
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import psutil
import pytest

from pathreplay.errors import PathreplayError
from pathreplay.scenes.loading import load_scene

jax = pytest.importorskip("jax")

import jax.numpy as jnp  # noqa: E402

from bridges import PLAIN, SMALL, TEXTURE, WALL, hold, mitsubas  # noqa: E402
from pathreplay.jax import RenderFunction  # noqa: E402


@pytest.fixture
def render() -> Any:
    return RenderFunction("cornell-box-photo", [TEXTURE, WALL], integrator=PLAIN, spp=16, arguments=SMALL)


def test_the_picture_is_that_of_mitsuba(render: Any) -> None:
    scene = load_scene("cornell-box-photo", **SMALL)
    expected = np.array(mi.render(scene, sensor=1, integrator=mi.load_dict(PLAIN), spp=16, seed=4))
    for function in (render, jax.jit(render, static_argnums=1)):
        image = function(render.initial_values(), 1, seed=4)
        assert image.shape == (6, 6, 3) and image.dtype == jnp.float32
        np.testing.assert_allclose(np.array(image), expected, rtol=1e-5, atol=1e-6)


def test_gradients_of_several_calls_are_each_their_own(render: Any) -> None:
    """Two views with different values in one loss: each gradient is Mitsuba's, compiled or not."""
    first = render.initial_values()
    second = {TEXTURE: first[TEXTURE] * 0.2, WALL: first[WALL] * 0 + 0.9}
    weights = [np.random.default_rng(i).uniform(0.5, 1, (6, 6, 3)).astype(np.float32) for i in (0, 1)]

    def loss(first: Any, second: Any, seed: Any) -> Any:
        one, other = render(first, 0, seed=seed, spp=2048), render(second, 1, seed=seed + 1, spp=2048)
        return (one * weights[0]).sum() + (other * weights[1]).sum()

    slope = jax.grad(loss, argnums=(0, 1))
    plain, compiled = slope(first, second, 1), jax.jit(slope)(first, second, 1)
    for n, (values, weight) in enumerate(((first, weights[0]), (second, weights[1]))):
        for key, gradient in mitsubas({k: np.array(v) for k, v in values.items()}, n, weight).items():
            found = np.array(plain[n][key])
            hold(found, gradient)
            np.testing.assert_allclose(np.array(compiled[n][key]), found, rtol=1e-4, atol=1e-6)


def test_what_jax_compiles_may_choose_the_seed(render: Any) -> None:
    compiled = jax.jit(lambda seed: render(render.initial_values(), seed=seed))
    one, same, other = (np.array(compiled(seed)) for seed in (1, 1, 2))
    np.testing.assert_allclose(one, same, rtol=1e-5, atol=1e-6)
    assert np.abs(one - other).max() > 0.01


def test_batches_are_rendered_one_after_the_other(render: Any) -> None:
    walls = jnp.array([[0.1, 0.2, 0.3], [0.9, 0.8, 0.7]])
    images = jax.vmap(lambda wall: render({**render.initial_values(), WALL: wall}, seed=5))(walls)
    for wall, image in zip(walls, images, strict=True):
        alone = render({**render.initial_values(), WALL: wall}, seed=5)
        np.testing.assert_allclose(np.array(image), np.array(alone), rtol=1e-5, atol=1e-6)
    assert np.abs(images[0] - images[1]).max() > 0.01


def test_a_texture_may_have_another_size(render: Any) -> None:
    values = {**render.initial_values(), TEXTURE: jnp.full((5, 7, 3), 0.5)}
    found = jax.grad(lambda values: render(values).sum())(values)
    assert found[TEXTURE].shape == (5, 7, 3) and np.abs(found[TEXTURE]).sum() > 0


def test_what_does_not_fit_is_told(render: Any) -> None:
    values = render.initial_values()
    with pytest.raises(PathreplayError, match=r"missing or unexpected: 'red\.reflectance\.value'"):
        render({TEXTURE: values[TEXTURE]})
    with pytest.raises(PathreplayError, match=r"shape \(4,\) given for the parameter 'red.*' of shape \(3,\)"):
        render({**values, WALL: jnp.zeros(4)})


@pytest.mark.slow
def test_iterations_leave_nothing_behind() -> None:
    """Neither memory of the process nor variables of Dr.Jit's."""
    render = RenderFunction("cornell-box-photo", [TEXTURE, WALL], integrator=PLAIN, spp=1, arguments=SMALL)
    values = render.initial_values()
    step = jax.jit(jax.grad(lambda values, seed: (render(values, seed=seed) ** 2).mean()))
    marks = []
    for i in range(300):
        jax.block_until_ready(step(values, i))
        if i in (99, 299):
            gc.collect()
            marks.append((psutil.Process().memory_info().rss, dr.whos(as_string=True).count("\n")))
    (before, held), (after, still) = marks
    assert still == held
    assert after - before < 20e6
