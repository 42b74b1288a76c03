"""Random numbers that fill the square evenly: for pixels and for squares of them, and every mean is unbiased."""

from __future__ import annotations

import gc
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from pathreplay.integrators.camera_pass import Pass
from pathreplay.jobs import make_config, optimize
from pathreplay.samplers.owen_sobol import OwenSobolSampler, key_of, morton_index
from pathreplay.samplers.pixel_samples import SETS

METHODS: dict[str, dict[str, Any]] = {
    "sobol": {"type": "pathreplay"},
    "scene": {"type": "pathreplay", "sampling": "scene"},
    "replay": {"type": "pathreplay", "adjoint": "replay"},
    "path": {"type": "path"},
}
POINTS = 256
DRAWS = 4


def points(even: OwenSobolSampler) -> list[np.ndarray]:
    """Pairs that are drawn one after the other, each (2, n)."""
    return [np.array(even.next_2d(), dtype=np.float64) for _ in range(DRAWS)]


def require_net(pairs: np.ndarray) -> None:
    """Each elementary interval of the square, of area 1 / n, has one of the n points."""
    n = pairs.shape[1]
    for k in range(n.bit_length()):
        counts = np.histogram2d(*pairs, bins=(2**k, n >> k), range=((0, 1), (0, 1)))[0]
        assert counts.min() == counts.max() == 1, k


@pytest.mark.parametrize("first", [0, 3 * POINTS, 2**32 - POINTS])
@pytest.mark.parametrize("seed", [0, 1, 2**32 - 1])
def test_points_are_nets(first: int, seed: int) -> None:
    for pairs in points(OwenSobolSampler.of(dr.arange(mi.UInt32, POINTS) + first, key_of(mi.UInt32(seed)))):
        require_net(pairs)


def test_numbers_alone_are_even_too() -> None:
    even = OwenSobolSampler.of(dr.arange(mi.UInt32, POINTS), key_of(mi.UInt32(7)))
    for _ in range(DRAWS):
        assert len(np.unique((np.array(even.next_1d()) * POINTS).astype(int))) == POINTS


def test_numbers_by_chance_of_the_key_are_uniform_and_know_nothing_of_each_other() -> None:
    n = 2**18
    even = OwenSobolSampler.of(dr.full(mi.UInt32, 5, n), key_of(dr.arange(mi.UInt32, n), mi.UInt32(3)))
    drawn = np.concatenate([*points(even), np.array(even.next_1d())[None]])
    assert np.abs((drawn.mean(axis=1) - 0.5) * np.sqrt(12 * n)).max() < 4.5
    assert np.abs((np.square(drawn - 0.5).mean(axis=1) - 1 / 12) * np.sqrt(180 * n)).max() < 4.5
    related = np.corrcoef(drawn) - np.eye(len(drawn))
    assert np.abs(related).max() * np.sqrt(n) < 4.5
    for i in range(len(drawn)):
        for j in range(i):
            counts = np.histogram2d(drawn[i], drawn[j], bins=8, range=((0, 1), (0, 1)))[0]
            assert (np.square(counts - n / 64).sum() / (n / 64) - 63) / np.sqrt(126) < 5


def test_clones_repeat() -> None:
    even = OwenSobolSampler.of(dr.arange(mi.UInt32, 8), key_of(mi.UInt32(1)))
    even.next_2d()
    again = even.clone()
    first = [*points(even), np.array(even.next_1d())]
    assert all(np.array_equal(a, b) for a, b in zip(first, [*points(again), np.array(again.next_1d())], strict=True))
    assert not np.array_equal(first[0], first[1])


def test_mortons_order() -> None:
    x, y = (mi.UInt32(np.array(values, np.uint32)) for values in ((0, 1, 0, 1, 2, 65535), (0, 0, 1, 1, 0, 65535)))
    assert np.array(morton_index(x, y)).tolist() == [0, 1, 2, 3, 4, 2**32 - 1]


def scene(spp: int, sampler: str = "independent", side: int = 16) -> mi.Scene:
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path"},
            "camera": {
                "type": "perspective", "fov": 40,
                "to_world": mi.ScalarTransform4f().look_at([0, 1, 4], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": side, "height": side, "pixel_format": "rgb",
                         "rfilter": {"type": "box"}},
                "sampler": {"type": sampler, "sample_count": spp},
            },
            "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -70).scale(2),
                      "bsdf": {"type": "diffuse", "reflectance": {"type": "checkerboard", "color0": 0.2}}},
            "lamp": {"type": "sphere", "radius": 0.4, "center": [0, 1.2, 0], "emitter": {"type": "area"}},
        }
    )  # fmt: skip


@pytest.mark.parametrize("spp", [1, 4, 16])
def test_squares_of_pixels_share_a_net(spp: int) -> None:
    view = Pass.of(scene(spp), 0, 3, spp)
    i = dr.arange(mi.UInt32, 16 * 16 * spp)
    pairs = points(view.sobol_sampler(i // spp, 16, i % spp, spp))
    pixel = np.arange(16 * 16 * spp) // spp
    row, column = pixel // 16, pixel % 16
    for size in (1, 2, 4, 8, 16):
        inside = (row // size == 16 // size - 1) & (column // size == 0)
        for drawn in pairs:
            require_net(drawn[:, inside])


def test_more_than_32_bits_are_sets_of_their_own() -> None:
    view = Pass.of(scene(4), 0, 3, 2**24)
    drawn = view.sobol_sampler(mi.UInt32([0, 256]), 16, mi.UInt32(5), 2**24).next_2d()
    assert float(np.ptp(np.array(drawn.x))) > 0


def means(method: str, spp: int, seeds: int, sampler: str = "independent") -> np.ndarray:
    made, integrator = scene(spp, sampler), mi.load_dict({**METHODS[method], "max_depth": 3})
    return np.array([np.array(mi.render(made, integrator=integrator, spp=spp, seed=seed)) for seed in range(seeds)])


@pytest.mark.parametrize("spp", [1, 5, 8])
def test_pictures_are_those_of_path_with_less_noise(spp: int) -> None:
    ours, theirs = means("sobol", spp, 64), means("path", spp, 64)
    variances = [pictures.var(axis=0, ddof=1) for pictures in (ours, theirs)]
    error = np.sqrt((variances[0] + variances[1]) / 64)
    z = (ours.mean(axis=0) - theirs.mean(axis=0))[error > 0] / error[error > 0]
    assert abs(np.square(z).mean() - 1) < 0.4
    # Each pixel has less noise from a few samples on, and all of it together even from one.
    whole = [pictures.mean(axis=(1, 2, 3)).var(ddof=1) for pictures in (ours, theirs)]
    assert whole[0] < (0.4 if spp == 8 else 0.8) * whole[1]  # 5 are no net
    assert spp == 1 or variances[0].mean() < 0.6 * variances[1].mean()


@pytest.mark.parametrize("sampler", ["stratified", "multijitter", "ldsampler"])
def test_other_samplers_are_taken_as_they_are(sampler: str) -> None:
    ours, theirs = means("sobol", 16, 1, sampler), means("path", 16, 1, sampler)
    assert ours == pytest.approx(theirs, rel=1e-3, abs=1e-4)


def test_paths_of_one_set_know_of_each_other_and_of_no_other_set() -> None:
    """In the mean over many pixels: the sum of two numbers of one set is less uncertain than that of two sets."""
    n, size = 2**16, 4
    view = Pass.of(scene(16, side=256), 0, 3, SETS * size)
    pixel = dr.arange(mi.UInt32, n)

    def drawn(place: int, number: int) -> np.ndarray:
        return (
            np.array(view.sobol_sampler(pixel, 256, mi.UInt32(place), size, number).next_2d(), dtype=np.float64) - 0.5
        )

    one, other = drawn(0, 0), drawn(0, 1)
    same = sum(np.mean(one * drawn(k, 0)) for k in range(1, size)) * 12
    assert abs(np.mean(one * other) * 12) * np.sqrt(2 * n) < 4
    assert same < -0.7  # -1 where the mean of the set had no noise


COLOUR = "floor.bsdf.reflectance.color0.value"
SEEDS = 48


def gradients(method: str, made: mi.Scene, key: str, seeds: range, spp: int = 16, **options: Any) -> np.ndarray:
    """Of the mean of the picture, by seed."""
    params, integrator = mi.traverse(made), mi.load_dict({"max_depth": 3, **METHODS[method], **options})
    found = []
    for seed in seeds:
        dr.enable_grad(params[key])
        params.update()
        image = mi.render(made, params, integrator=integrator, spp=spp, seed=seed, seed_grad=10_000 + seed)
        dr.backward(dr.mean(image, axis=None))
        found.append(np.array(dr.grad(params[key]), np.float64).ravel())
        dr.disable_grad(params[key])
    return np.array(found)


def require_same_mean(a: np.ndarray, b: np.ndarray) -> None:
    """Of two sets of samples (n, ...): by the sum of the squares of normal deviates."""
    error = np.sqrt(a.var(axis=0, ddof=1) / len(a) + b.var(axis=0, ddof=1) / len(b))
    z = ((a.mean(axis=0) - b.mean(axis=0)) / np.where(error > 0, error, 1))[error > 0]
    assert abs(np.square(z).mean() - 1) < 5 * np.sqrt(2 / z.size), np.square(z).mean()


def test_gradients_have_less_noise() -> None:
    even, plain = (gradients(method, scene(16), COLOUR, range(SEEDS)) for method in ("sobol", "scene"))
    assert even.var(axis=0, ddof=1).max() < 0.4 * plain.var(axis=0, ddof=1).min()
    require_same_mean(even, plain)


def test_both_drivers_and_forward_mode_see_the_same_paths() -> None:
    made = scene(16)
    sweep, replay = (gradients(method, made, COLOUR, range(2)) for method in ("sobol", "replay"))
    assert replay == pytest.approx(sweep, rel=1e-4)
    params, integrator = mi.traverse(made), mi.load_dict({**METHODS["sobol"], "max_depth": 3})
    dr.enable_grad(params[COLOUR])
    dr.set_grad(params[COLOUR], 1)
    params.update()
    tangent = integrator.render_forward(made, params, sensor=0, seed=10_000, spp=16)
    assert float(np.mean(np.array(tangent))) == pytest.approx(sweep[0][0], rel=1e-3)


def judged(method: str, made: mi.Scene, spp: int, seeds: range) -> np.ndarray:
    """Gradients of a quadratic loss by the pixel sweep, which judges paths by others."""
    params, integrator = mi.traverse(made), mi.load_dict({**METHODS[method], "max_depth": 3})
    offset, slope = dr.full(mi.TensorXf, -0.3, (16, 16, 3)), dr.full(mi.TensorXf, 1.0, (16, 16, 3))
    found = []
    for seed in seeds:
        dr.enable_grad(params[COLOUR])
        params.update()
        integrator.render_value_and_grad(made, offset, slope, 0, seed, spp)
        found.append(np.array(dr.grad(params[COLOUR]), np.float64).ravel())
        dr.disable_grad(params[COLOUR])
    return np.array(found)


@pytest.mark.parametrize("spp", [2, pytest.param(7, marks=pytest.mark.slow)])
def test_pixels_that_are_swept_are_judged_by_others(spp: int) -> None:
    """A path that were judged by its own set would count its own noise: with few samples far above that of the mean."""
    made = scene(spp)
    even, plain = judged("sobol", made, spp, range(40)), judged("scene", made, spp, range(40))
    require_same_mean(even, plain)
    assert even.var(axis=0).mean() < 0.7 * plain.var(axis=0).mean()


@pytest.mark.slow
@pytest.mark.parametrize("depth", [4, 32])
def test_media_have_the_same_means(depth: int) -> None:
    made = mi.load_dict(
        {
            "type": "scene",
            "camera": scene(16).sensors()[0],
            "cloud": {
                "type": "cube", "bsdf": {"type": "null"},
                "interior": {"type": "gridmedium", "albedo": 0.8, "sigma_t": {"type": "gridvolume", "grid":
                    mi.VolumeGrid(np.linspace(0.1, 2, 27, dtype=np.float32).reshape(3, 3, 3, 1))}},
            },
            "sky": {"type": "constant"},
            "lamp": {"type": "point", "position": [2, 3, 2], "intensity": 5.0},
        }
    )  # fmt: skip
    key = "cloud.interior_medium.sigma_t.data"
    even, plain = (gradients(m, made, key, range(SEEDS), max_depth=depth) for m in ("sobol", "scene"))
    require_same_mean(even, plain)


def test_jobs_have_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    job = {
        "scene": "cornell-box",
        "scene_parameters": {"resolution": 16},
        "integrator": {"type": "pathreplay", "max_depth": 3},
        "parameters": [{"key": "red.reflectance.value", "initial": 0.5}],
        "target": {"values": {"red.reflectance.value": [0.6, 0.1, 0.1]}, "spp": 256,
                   "integrator": {"type": "path", "max_depth": 3}},
        "iterations": 80, "spp": 8, "learning_rate": 0.05, "final_learning_rate_ratio": 0.1, "eval_spp": 8,
    }  # fmt: skip
    result = optimize(make_config(job), progress=False)
    assert result.parameters["red.reflectance.value"] == pytest.approx([0.6, 0.1, 0.1], abs=0.02)


def test_another_word_is_refused() -> None:
    with pytest.raises(Exception, match="sampling = 'odd' is unknown: use one of 'scene', 'sobol'"):
        mi.load_dict({"type": "pathreplay", "sampling": "odd"})


@pytest.mark.parametrize("seed", [int, mi.UInt32])
def test_another_seed_is_no_other_kernel(seed: type) -> None:
    gc.collect()  # Dr.Jit traces calls through all scenes alive: one that goes between the two makes another kernel
    made, integrator = scene(4), mi.load_dict({**METHODS["sobol"], "max_depth": 3})
    dr.eval(mi.render(made, integrator=integrator, spp=4, seed=seed(1)))
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        dr.eval(mi.render(made, integrator=integrator, spp=4, seed=seed(2)))
        kernels = [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]
    assert kernels and all(entry["cache_hit"] for entry in kernels)
