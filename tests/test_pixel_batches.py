"""Batches of pixels: places drawn by a film's filter, gradients by some of the pixels, and jobs that take them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from pathreplay.check.statistics import gap
from pathreplay.check.stencil import CENTRAL
from pathreplay.check.verdict import RESOLUTION, Z_LIMIT
from pathreplay.errors import PathreplayError
from pathreplay.inverse import optimize
from pathreplay.inverse.config import PIXELWISE, make_config
from pathreplay.inverse.evaluate import Evaluator, Shard
from pathreplay.inverse.loop import new_run
from pathreplay.inverse.losses import LOSSES, QUADRATIC
from pathreplay.inverse.problem import build_problem
from pathreplay.inverse.recorded import Batch
from pathreplay.render.filter_samples import FilterSamples, is_drawable
from truth import RES, Bench, Case, bitmap, camera, lit_room, noise, random, rgb

SLOW = pytest.mark.slow
FLOOR = "floor.bsdf.reflectance.data"
CROP = {"width": RES + 8, "height": RES + 9, "crop_width": RES, "crop_height": RES, "crop_offset_x": 5,
        "crop_offset_y": 3}  # fmt: skip
FILMS: dict[str, dict[str, Any]] = {
    "box": {"rfilter": {"type": "box"}},
    "gaussian": {"rfilter": {"type": "gaussian"}},
    "wide gaussian": {"rfilter": {"type": "gaussian", "stddev": 1.5}},
    "tent": {"rfilter": {"type": "tent", "radius": 1.3}},
    "border": {"rfilter": {"type": "gaussian"}, "sample_border": True},
    "crop": {"rfilter": {"type": "gaussian"}, **CROP},
}
QUICK = {"gaussian", "border"}


def room(**film: Any) -> dict:
    found = lit_room({"type": "diffuse", "reflectance": rgb(0.6, 0.5, 0.4)})
    found["floor"]["bsdf"]["reflectance"] = bitmap(noise(8, 3, 0.2, 0.9))
    found["camera"] = camera(fov=22)
    found["camera"]["film"] |= film
    return found


@pytest.fixture
def opened() -> Iterator:
    """Opens cases, and releases them at the end."""
    benches: list[Bench] = []

    def open_case(case: Case) -> Bench:
        benches.append(Bench(case))
        return benches[-1]

    yield open_case
    for bench in benches:
        bench.release()


def swept(bench: Bench, integrator: mi.Integrator, seed: int, count: int, offset: Any, slope: Any) -> tuple:
    """Of a batch of so many pixels: its image, its pixels, and what it says of the gradient by the case's t."""
    t = dr.opaque(mi.Float, 0)
    dr.enable_grad(t)
    bench.put(t)
    each = RES**2 / count
    loss = (mi.TensorXf((each * term).astype(np.float32)) for term in (offset, slope))
    pixels = np.sort(np.random.default_rng(seed).choice(RES**2, count, replace=False))
    image = integrator.render_and_backward(
        bench.scene, *loss, 0, mi.UInt32(seed), bench.case.spp, mi.UInt32(pixels.astype(np.uint32))
    )
    return np.array(image), pixels, bench.collect(t)


@pytest.mark.parametrize("film", [pytest.param(n, marks=() if n in QUICK else SLOW) for n in FILMS])
def test_some_pixels_stand_for_all(film: str, opened) -> None:
    """Image and gradient of a quadratic loss, against Mitsuba's images with the same filter, and their differences."""
    bench = opened(Case(film, lambda: room(**FILMS[film]), FLOOR, random(1.0), spp=4, seeds=160))
    plain = bench.integrator("path", rr_depth=bench.case.rr_depth)
    expected = np.mean([bench.image(plain, 5000 + seed, 1024) for seed in range(4)], axis=0)
    slope = 2 * bench.weights
    offset = -slope * 0.8 * expected
    ours = bench.integrator(rr_depth=bench.case.rr_depth)
    assert ours.sweeps_pixels(bench.scene, 0, 4, some=True)

    images, counts, gradients = np.zeros_like(expected), np.zeros((RES**2, 1)), []
    for seed in range(1, bench.case.seeds + 1):
        image, pixels, gradient = swept(bench, ours, seed, RES**2 // 4, offset, slope)
        assert (np.delete(image.reshape(-1, 3), pixels, axis=0) == 0).all()
        images += image
        counts[pixels] += 1
        gradients.append(gradient)
    adjoint = offset + slope * expected
    differences = (bench.difference(plain, CENTRAL, bench.case.step, 1000 + seed, 1024) for seed in range(8))
    reference = [(image * adjoint).sum() for image in differences]
    wrong = gap(gradients, reference)
    assert wrong.error < RESOLUTION * abs(np.mean(reference))
    assert abs(wrong.z) < Z_LIMIT, wrong

    # Pixel by pixel, at the film's border, too, where the filter is cut off.
    found = images.reshape(-1, 3) / counts
    error = np.abs(found - expected.reshape(-1, 3)).mean() / expected.mean()
    assert error < 0.12, error
    rim = np.ones((RES, RES), bool)
    rim[1:-1, 1:-1] = False
    assert found[rim.ravel()].mean() == pytest.approx(expected[rim].mean(), rel=0.02)


@pytest.mark.parametrize("filter", ["gaussian", "tent"])
def test_places_are_drawn_by_the_filter(filter: str) -> None:
    """Their distribution is the filter's, whole and cut off: Kolmogorov's distance is that of a staircase."""
    film = mi.load_dict({"type": "hdrfilm", "rfilter": {"type": filter}})
    samples, n = FilterSamples.of(film), 1 << 16
    x = np.linspace(-samples.radius, samples.radius, 4001)
    density = np.array(film.rfilter().eval(mi.Float(x)))
    until = np.concatenate([[0], np.cumsum((density[1:] + density[:-1]) / 2)])
    until /= until[-1]
    u = (dr.arange(mi.Float, n) + 0.5) / n
    for begin, end in ((-samples.radius, samples.radius), (-0.5, samples.radius), (-0.3, 0.5)):
        low, high = (samples.share(mi.Float(place)) for place in (begin, end))
        drawn = np.array(samples.draw(u, low, high))
        assert begin - 1e-3 <= drawn.min() and drawn.max() <= end + 1e-3
        a, b = np.interp([begin, end], x, until)
        exact = (np.interp(drawn, x, until) - a) / (b - a)
        assert np.abs(exact - np.array(u)).max() < 2e-3


@pytest.mark.parametrize("name", ["mitchell", "catmullrom", "lanczos", "box"])
def test_filters_that_are_negative_somewhere_are_no_density(name: str) -> None:
    """And the box needs none."""
    assert not is_drawable(mi.load_dict({"type": "hdrfilm", "rfilter": {"type": name}}))


def test_whole_pictures_are_splatted_unless_the_filter_is_a_box(opened) -> None:
    """Which is much less noisy."""
    bench = opened(Case("gaussian", lambda: room(**FILMS["gaussian"]), FLOOR, random(1.0)))
    ours = bench.integrator()
    assert not ours.sweeps_pixels(bench.scene, 0, 4)
    assert not ours.sweeps_pixels(bench.scene, 0, 1, some=True)


JOB = {
    "scene": "cornell-box",
    "parameters": [{"key": "red.reflectance.value"}],
    "target": {"values": {"red.reflectance.value": 0.7}, "spp": 16},
    "spp": 4,
    "iterations": 3,
    "scene_parameters": {"resolution": 16},
    "integrator": {"type": "pathreplay", "max_depth": 3},
    "pixels_per_step": 40,
}


def test_batches_take_pixels_that_count() -> None:
    target, weight = np.zeros((6, 5, 3), np.float32), np.zeros((6, 5, 1), np.float32)
    weight[1:4, 2:] = 30 / 9
    batch = Batch.of(target, weight, 4, 1)
    assert batch is not None and batch.each == 9 / 4
    numbers = [np.array(Batch.of(target, weight, 4, seed).pixels) for seed in range(20)]
    assert all(len(np.unique(each)) == 4 for each in numbers)
    assert set(np.concatenate(numbers)) == set(np.flatnonzero(weight))
    assert Batch.of(target, weight, 9, 1) is None and Batch.of(target, None, 30, 1) is None
    assert list(batch.pixels) == list(Batch.of(target, weight, 4, 1).pixels)


def test_losses_that_take_single_pixels_have_names() -> None:
    assert {LOSSES[name] for name in PIXELWISE} == QUADRATIC


@SLOW
@pytest.mark.parametrize("masked", [False, True])
def test_loss_and_gradient_are_those_of_whole_pictures(masked: bool, tmp_path: Path) -> None:
    """In the mean over seeds, recorded and traced."""
    problem = build_problem(make_config(JOB), tmp_path)
    if masked:
        weight = np.zeros((16, 16, 1), np.float32)
        weight[4:9, 3:12] = 256 / 45
        object.__setattr__(problem.views[0], "weight", weight)
    values, n = new_run(problem, problem.integrator).values, 300
    found = {}
    for record in (False, True):
        evaluate = Evaluator(problem, problem.integrator, record=record)
        found[record] = [evaluate(values, Shard((0,), 4, (seed,), 0, 40), {}) for seed in range(n)]
    key = problem.variables[0].key
    for traced, recorded in zip(*found.values(), strict=True):
        assert recorded.loss == pytest.approx(traced.loss, rel=1e-4)
        np.testing.assert_allclose(recorded.gradients[key], traced.gradients[key], rtol=1e-3, atol=1e-6)
    whole = Evaluator(problem, problem.integrator)
    exact = [whole(values, Shard((0,), 256, (5000 + seed,)), {}) for seed in range(4)]
    sums = [[each.gradients[key].sum() for each in some] for some in (found[False], exact)]
    assert abs(gap(*sums).z) < Z_LIMIT
    # Of a pixel's noise the loss has the variance on top, here that of four samples.
    assert np.mean([each.loss for each in found[False]]) > np.mean([each.loss for each in exact])


def test_a_job_takes_batches_of_pixels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other pixels in every iteration, the same in every run."""
    monkeypatch.chdir(tmp_path)
    one, two = (optimize(make_config({**JOB, "output": name}), progress=False) for name in "ab")
    losses = [[entry.loss for entry in result.history] for result in (one, two)]
    assert losses[0] == pytest.approx(losses[1], rel=1e-4) and len(set(losses[0])) == 3
    assert one.history[-1].loss < one.history[0].loss


MOVED = {
    "parameters": [{"key": "sensor.to_world", "pose": "translation", "start": {"translation": [0.1, 0, 0]}}],
    "target": {"scene": "cornell-box", "scene_parameters": {"resolution": 16}, "spp": 16},
}
REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "loss": ({"loss": "ssim"}, "loss = 'ssim' wants whole pictures; take l2 or relative-l2"),
    "loss, in a stage": (
        {"loss": "l1", "pixels_per_step": None, "stages": [{"iterations": 3, "pixels_per_step": 4}]},
        "loss = 'l1' wants whole pictures",
    ),
    "exposure": ({"exposure": {"free": True}}, "'exposure' wants whole pictures; leave one of them out"),
    "integrator": ({"integrator": {"type": "prb", "max_depth": 3}}, "the integrator 'pathreplay'"),
    "replay": ({"integrator": {"type": "pathreplay", "driver": "replay"}}, "its sweep driver"),
    "one sample": ({"spp": 1}, "2 samples per pixel or more"),
    "camera": (MOVED, "a camera that stands still"),
}


@pytest.mark.parametrize("why", REFUSED)
def test_what_cannot_be_taken_apart_is_refused(why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In one line, and nothing is left behind."""
    monkeypatch.chdir(tmp_path)
    changes, message = REFUSED[why]
    with pytest.raises(PathreplayError, match=message) as raised:
        optimize(make_config({**JOB, **changes, "output": "run"}), progress=False)
    assert "\n" not in str(raised.value) and not (tmp_path / "run").exists()
