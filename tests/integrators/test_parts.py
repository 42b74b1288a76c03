"""Passes of more samples than one kernel, or single precision, can hold: the mean of parts, and what it is right to."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from pathreplay import PathreplayError
from pathreplay.integrators import parts as module
from pathreplay.integrators.boundary_term import segments_of
from pathreplay.integrators.camera_pass import Pass
from pathreplay.integrators.film.domain import FilmPlaces
from pathreplay.integrators.parts import parts
from pathreplay.scenes.parameters import get_array

KEY, SPP, SEED = "light.radiance.value", 24, 7


def room(side: int = 4, sampler: str = "independent", rfilter: str = "box", moves: bool = False) -> Any:
    """A ball under a sky, or with nothing in it."""
    film = {"type": "hdrfilm", "width": side, "height": side, "rfilter": {"type": rfilter}, "pixel_format": "rgb"}
    look = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    return {
        "type": "scene",
        "light": {"type": "constant", "radiance": {"type": "rgb", "value": 0.3}},
        "sensor": {"type": "perspective", "to_world": look, "film": film, "sampler": {"type": sampler}},
    } | ({"ball": {"type": "sphere"}} if moves else {})


def integrator(**options: Any) -> Any:
    return mi.load_dict({"type": "pathreplay", "max_depth": 3, "boundary": "none", **options})


def gradient(scene: mi.Scene, key: str, seed: Any, spp: int, grad_in: np.ndarray, **options: Any) -> np.ndarray:
    params = mi.traverse(scene)
    dr.disable_grad(params[key])
    dr.enable_grad(params[key])
    params.update()
    try:
        integrator(**options).render_backward(scene, params, mi.TensorXf(grad_in), seed=seed, spp=spp)
        return get_array(dr.grad(params[key])).ravel()
    finally:
        dr.disable_grad(params[key])
        params.update()


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if little went into a pass: eight samples of each of 16 pixels."""
    for name, value in (("MOST_AT_ONCE", 200), ("A_PART", 128), ("LEAST_A_PIXEL", 1)):
        monkeypatch.setattr(module, name, value)


def test_one_pass_stays_one() -> None:
    scene = mi.load_dict(room())
    for spp in (1, SPP, 2**16):
        (only,) = parts(Pass.of(scene, 0, SEED, spp))
        assert (only.seed, only.spp, only.share) == (SEED, spp, 1.0)


@pytest.mark.parametrize("spp", [2**17, 2**29, 2**31 - 1])
@pytest.mark.parametrize("side", [1, 4, 16, 300])
def test_no_part_is_beyond_what_single_precision_holds(spp: int, side: int) -> None:
    scene = mi.load_dict(room(side))
    view = Pass.of(scene, 0, SEED, 8 * module.A_PART * 1024 // side**2 if side == 300 else min(spp, 2**27 // side))
    found = parts(view)
    assert sum(part.spp for part in found) == view.spp and sum(part.share for part in found) == pytest.approx(1)
    assert max(part.spp for part in found) <= module.MOST_A_PIXEL
    assert max(part.spp * side**2 for part in found) <= max(module.A_PART, module.LEAST_A_PIXEL * side**2)


def test_image_and_gradient_of_mi_render_share_no_part(small: None) -> None:
    """A gradient from paths of the image would be biased. `mi.render` derives the seed of the gradient as below."""
    scene = mi.load_dict(room())
    of_gradient = mi.sample_tea_32(mi.UInt32(SEED), mi.UInt32(1))[0]
    found = [part for seed in (SEED, of_gradient) for part in parts(Pass.of(scene, 0, seed, SPP))]
    assert len(found) >= 6 and len({int(mi.UInt32(part.seed)[0]) for part in found}) == len(found)


@pytest.mark.parametrize("sampler", ["independent", "stratified", "multijitter", "orthogonal", "ldsampler"])
@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
def test_parts_are_passes_with_seeds_of_their_own_and_their_mean_is_the_whole(
    small: None, sampler: str, rfilter: str
) -> None:
    """Picture, gradient and tangent, each the mean that the parts have one by one."""
    scene = mi.load_dict(room(sampler=sampler, rfilter=rfilter, moves=True))
    found = parts(Pass.of(scene, 0, SEED, SPP))
    seeds = [part.seed if isinstance(part.seed, int) else int(part.seed[0]) for part in found]
    assert len(found) >= 3 and seeds[0] == SEED and len(set(seeds)) == len(found)
    assert sum(part.share for part in found) == pytest.approx(1)

    ours, grad_in = integrator(), np.linspace(-1, 1, 48, dtype=np.float32).reshape(4, 4, 3)
    with dr.suspend_grad():
        whole = np.array(ours.render(scene, seed=SEED, spp=SPP))
        single = [np.array(ours.render(scene, seed=part.seed, spp=part.spp)) for part in found]
    wanted = sum(part.share * image for part, image in zip(found, single, strict=True))
    np.testing.assert_allclose(whole, wanted, rtol=1e-5, atol=1e-6)
    assert not np.allclose(single[0], single[1])

    whole = gradient(scene, KEY, SEED, SPP, grad_in)
    single = [gradient(scene, KEY, part.seed, part.spp, grad_in) for part in found]
    wanted = sum(part.share * image for part, image in zip(found, single, strict=True))
    np.testing.assert_allclose(whole, wanted, rtol=1e-4, atol=1e-5)


def test_tangents_are_of_all_parts(small: None) -> None:
    scene = mi.load_dict(room(moves=True))
    params = mi.traverse(scene)
    found = parts(Pass.of(scene, 0, SEED, SPP))

    def tangent(seed: Any, spp: int) -> np.ndarray:
        value = mi.Float(0.3)
        dr.enable_grad(value)
        params[KEY] = mi.Color3f(value)
        params.update()
        dr.forward(value, dr.ADFlag.ClearEdges)
        image = np.array(integrator().render_forward(scene, params, seed=seed, spp=spp))
        params[KEY] = mi.Color3f(0.3)
        params.update()
        return image

    wanted = sum(part.share * tangent(part.seed, part.spp) for part in found)
    np.testing.assert_allclose(tangent(SEED, SPP), wanted, rtol=1e-5, atol=1e-6)


def test_edges_are_looked_for_by_as_many_lines_in_all(small: None) -> None:
    view = Pass.of(mi.load_dict(room(moves=True)), 0, SEED, SPP)
    found, places = parts(view), FilmPlaces.of(view)
    assert sum(segments_of(part, places, 0) for part in found) == 16 * SPP
    assert 16 * 64 <= sum(segments_of(part, places, 64) for part in found) <= 16 * (64 + len(found))


def test_gradients_that_were_there_stay(small: None) -> None:
    """And those of what parameters are computed from are the same."""
    scene = mi.load_dict(room(moves=True))
    params, grad_in = mi.traverse(scene), np.ones((4, 4, 3), np.float32)
    alone = gradient(scene, KEY, SEED, SPP, grad_in)
    half = mi.Color3f(0.15)
    dr.enable_grad(half)
    params[KEY] = 2 * half
    params.update()
    dr.set_grad(half, 5)
    integrator().render_backward(scene, params, mi.TensorXf(grad_in), seed=SEED, spp=SPP)
    np.testing.assert_allclose(np.array(dr.grad(half)).ravel(), 2 * alone + 5, rtol=1e-5)
    params[KEY] = mi.Color3f(0.3)
    dr.enable_grad(params[KEY])
    params.update()
    dr.set_grad(params[KEY], 5)
    integrator().render_backward(scene, params, mi.TensorXf(grad_in), seed=SEED, spp=SPP)
    np.testing.assert_allclose(np.array(dr.grad(params[KEY])).ravel(), alone + 5, rtol=1e-5)
    dr.disable_grad(params[KEY])
    params.update()


@pytest.mark.slow
def test_sums_of_many_samples_are_right() -> None:
    """Of one colour everywhere: without parts the pixels are off by 6e-3, and the gradient by 4e-2 of itself."""
    scene = mi.load_dict(room())
    with dr.suspend_grad():
        image = np.array(integrator().render(scene, seed=SEED, spp=2**20))
    found = gradient(scene, KEY, SEED, 2**22, np.full((4, 4, 3), 0.9 / 16, np.float32))
    print(f"pixels off by {np.abs(image / 0.3 - 1).max():.1e}, gradient by {np.abs(found / 0.9 - 1).max():.1e}")
    assert np.abs(image / 0.3 - 1).max() < 1e-3
    assert np.abs(found / 0.9 - 1).max() < 2e-3


def test_what_cannot_be_counted_is_told_before_anything_is_launched() -> None:
    scene = mi.load_dict(room(moves=True))
    params = mi.traverse(scene)
    params["sensor.film.size"] = mi.ScalarVector2u(2**16, 2**16)
    params.update()
    with pytest.raises(
        PathreplayError, match=r"65536 x 65536 pixels, more than the 4294967295 samples.*make it smaller"
    ):
        integrator().render(scene, seed=1, spp=1)
    scene = mi.load_dict(room(moves=True) | {"light": {"type": "point", "position": [0, 0, 6], "intensity": 9.0}})
    for boundary in ("primary", "auto"):
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            with pytest.raises(
                PathreplayError, match=r"boundary_spp = 300000000 .* take boundary_spp up to 268435455, or 0"
            ):
                gradient(
                    scene, "ball.to_world", 1, 1, np.ones((4, 4, 3), np.float32), boundary=boundary,
                    boundary_spp=300_000_000,
                )  # fmt: skip
            launched = [kernel["size"] for kernel in dr.kernel_history() if kernel["type"] == dr.KernelType.JIT]
        assert max(launched) < 16, launched  # 16 pixels; the values of parameters take smaller kernels


def test_what_would_take_hours_is_refused_before_anything_is_launched(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, most = mi.load_dict(room()), module.MOST_IN_ALL // 16
    with pytest.raises(PathreplayError, match=rf"4 x 4 pixels are more samples .* take spp up to {most}, and"):
        integrator().render(scene, seed=1, spp=most + 1)
    # All that is not refused is rendered, as far as parts can be counted in a moment.
    monkeypatch.setattr(module, "MOST_IN_ALL", 2**30)
    assert sum(part.spp for part in parts(Pass.of(scene, 0, SEED, 2**26))) == 2**26
