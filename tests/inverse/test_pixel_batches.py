"""Batches of pixels: places drawn by a film's filter, gradients by some of the pixels, and jobs that take them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from pathreplay.adjoint.record import MAX_DEPTH
from pathreplay.errors import PathreplayError
from pathreplay.integrators import integrator as integrators
from pathreplay.integrators.film.filter_samples import FilterSamples, is_drawable
from pathreplay.inverse.config.schema import PIXELWISE, make_config
from pathreplay.inverse.loop.loop import new_run
from pathreplay.inverse.losses.pixelwise import LOSSES, QUADRATIC
from pathreplay.inverse.objective.evaluate import Evaluator, Shard
from pathreplay.inverse.objective.pixel_batches import Batch
from pathreplay.inverse.problem.problem import build_problem
from pathreplay.jobs import iterate, optimize
from pathreplay.testing.statistics import gap
from pathreplay.testing.stencil import CENTRAL
from pathreplay.testing.verdict import RESOLUTION, Z_LIMIT
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


def test_an_irradiance_meter_is_swept() -> None:
    """Mitsuba's meter implements `sample_ray_differential` only."""
    T = mi.ScalarTransform4f
    pixel = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    sensor = {"type": "irradiancemeter", "film": pixel, "sampler": {"type": "independent"}}
    grey = {"type": "diffuse", "reflectance": rgb(0.5, 0.5, 0.5)}
    down = T().translate([0, 0, 2]).rotate([1, 0, 0], 180)
    scene = mi.load_dict({
        "type": "scene",
        "plate": {"type": "rectangle", "to_world": down, "meter": sensor},
        "lamp": {"type": "point", "position": [0, 0, 3], "intensity": rgb(9, 9, 9)},
        "floor": {"type": "rectangle", "to_world": T().scale(4), "bsdf": grey},
    })  # fmt: skip
    params, key = mi.traverse(scene), "floor.bsdf.reflectance.value"
    integrator = mi.load_dict({"type": "pathreplay", "max_depth": 3})
    assert integrator.why_no_pixel_sweep(scene, spp=64) == ""
    dr.enable_grad(params[key])
    params.update()
    one = mi.TensorXf(np.ones((1, 1, 3), np.float32))
    image = np.array(integrator.render_value_and_grad(scene, one, 0 * one, spp=64))
    assert image.min() > 0 and np.array(dr.grad(params[key])).ravel() == pytest.approx(image.ravel() / 0.5, rel=1e-3)


def swept(bench: Bench, integrator: mi.Integrator, seed: int, count: int, offset: Any, slope: Any) -> tuple:
    """Of a batch of so many pixels: what they are, which, and what they say of the gradient by the case's t."""
    t = dr.opaque(mi.Float, 0)
    dr.enable_grad(t)
    bench.put(t)
    each = RES**2 / count
    pixels = np.sort(np.random.default_rng(seed).choice(RES**2, count, replace=False))
    loss = (mi.TensorXf((each * term.reshape(-1, 1, 3)[pixels]).astype(np.float32)) for term in (offset, slope))
    rows = integrator.render_value_and_grad(
        bench.scene, *loss, 0, seed, bench.case.spp, mi.UInt32(pixels.astype(np.uint32))
    )
    return np.array(rows)[:, 0], pixels, bench.collect(t)


@pytest.mark.parametrize("film", [pytest.param(n, marks=() if n in QUICK else SLOW) for n in FILMS])
def test_some_pixels_stand_for_all(film: str, opened) -> None:
    """Image and gradient of a quadratic loss, against Mitsuba's images with the same filter, and their differences."""
    bench = opened(Case(film, lambda: room(**FILMS[film]), FLOOR, random(1.0), spp=4, seeds=64))
    plain = bench.integrator("path", rr_depth=bench.case.rr_depth)
    expected = np.mean([bench.image(plain, 5000 + seed, 1024) for seed in range(4)], axis=0)
    slope = 2 * bench.weights
    offset = -slope * 0.8 * expected
    ours = bench.integrator(rr_depth=bench.case.rr_depth)
    assert ours.supports_pixel_sweep(bench.scene, 0, 4, some=True)

    sums, counts, gradients = np.zeros((RES**2, 3)), np.zeros((RES**2, 1)), []
    for seed in range(1, bench.case.seeds + 1):
        rows, pixels, gradient = swept(bench, ours, seed, RES**2 // 4, offset, slope)
        sums[pixels] += rows
        counts[pixels] += 1
        gradients.append(gradient)
    adjoint = offset + slope * expected
    differences = (bench.difference(plain, CENTRAL, bench.case.step, 1000 + seed, 256) for seed in range(8))
    reference = [(image * adjoint).sum() for image in differences]
    wrong = gap(gradients, reference)
    assert wrong.error < RESOLUTION * abs(np.mean(reference))
    assert abs(wrong.z) < Z_LIMIT, wrong

    # Pixel by pixel, at the film's border, too, where the filter is cut off.
    found = sums / counts
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
        low, high = (samples.cdf_at(mi.Float(place)) for place in (begin, end))
        drawn = np.array(samples.draw(u, low, high))
        assert begin - 1e-3 <= drawn.min() and drawn.max() <= end + 1e-3
        a, b = np.interp([begin, end], x, until)
        exact = (np.interp(drawn, x, until) - a) / (b - a)
        assert np.abs(exact - np.array(u)).max() < 2e-3


@pytest.mark.parametrize("name", ["mitchell", "catmullrom", "lanczos", "box", "gaussian", "tent"])
def test_filters_that_are_negative_somewhere_are_no_density(name: str) -> None:
    film = mi.load_dict({"type": "hdrfilm", "rfilter": {"type": name}})
    assert is_drawable(film) == (name in ("box", "gaussian", "tent"))


def test_whole_pictures_are_splatted_unless_the_filter_is_a_box(opened) -> None:
    """Which is much less noisy."""
    bench = opened(Case("gaussian", lambda: room(**FILMS["gaussian"]), FLOOR, random(1.0)))
    ours = bench.integrator()
    assert not ours.supports_pixel_sweep(bench.scene, 0, 4)
    assert not ours.supports_pixel_sweep(bench.scene, 0, 1, some=True)


RED = "red.reflectance.value"
JOB: dict[str, Any] = {
    "scene": "cornell-box",
    "parameters": [{"key": RED}],
    "target": {"values": {RED: 0.7}, "spp": 16},
    "spp": 4,
    "iterations": 3,
    "scene_parameters": {"resolution": 16},
    "integrator": {"type": "pathreplay", "max_depth": 3, "boundary": "none"},
    "pixel_batch_size": 40,
}


def test_batches_take_pixels_that_count() -> None:
    weight = np.zeros((6, 5, 1), np.float32)
    weight[1:4, 2:] = 30 / 9
    batches = [Batch.of(weight, (6, 5), 4, seed) for seed in range(20)]
    assert all(each is not None and len(np.unique(each.pixels)) == 4 and each.share == 9 / 30 for each in batches)
    assert set(np.concatenate([each.pixels for each in batches])) == set(np.flatnonzero(weight))
    assert list(batches[1].pixels) == list(Batch.of(weight, (6, 5), 4, 1).pixels) != list(batches[2].pixels)
    assert list(Batch.of(weight, (6, 5), 25, 1).pixels) == list(np.flatnonzero(weight))  # though fewer than asked for
    assert Batch.of(weight, (6, 5), 30, 1) is None and Batch.of(None, (6, 5), 30, 1) is None
    assert (batches[0].rows(weight) > 0).all()


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


@SLOW
@pytest.mark.parametrize("edges", ["none", "all"])
def test_the_mean_of_batches_is_the_whole_where_all_is_rendered_alike(
    edges: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a box filter: the loss, with its noise, and the gradient, by a colour or by what moves and has edges.

    Of three directions of a move the one that is told best: their sum is near zero.

    Whole pictures of what moves would be followed by the film, which no sweep of pixels does.
    """
    monkeypatch.setattr(integrators, "can_follow", lambda trace, sensor: False)
    pose = {"key": "large-box.vertex_positions", "pose": "translation", "initial": {"translation": [0, 0, 0.3]}}
    colour = {"key": RED, "initial": 0.2}
    boxed = {"scene": "cornell-box-photo", "scene_parameters": {"resolution": 16, "texture": 8}, "sensors": [0]}
    target = {**boxed, "spp": 16}
    del target["sensors"]
    integrator = {"type": "pathreplay", "max_depth": 3, "boundary": edges}
    changed, told = ([pose], 1) if edges == "all" else ([colour], slice(None))
    config = make_config({**JOB, **boxed, "parameters": changed, "target": target, "integrator": integrator})
    problem = build_problem(config, tmp_path)
    evaluate = Evaluator(problem, problem.integrator)
    values = new_run(problem, problem.integrator).values
    some, whole = ([evaluate(values, Shard((0,), 4, (seed,), 0, n), {}) for seed in range(800)] for n in (64, None))
    losses, gradients = [[each.loss for each in found] for found in (some, whole)], []
    for found in (some, whole):
        each_of_all = [np.ravel(each.gradients[problem.variables[0].key])[told] for each in found]
        gradients.append([float(np.sum(one)) for one in each_of_all])
    for a, b in (losses, gradients):
        assert abs(gap(a, b).z) < Z_LIMIT
        assert gap(a, b).error < 0.2 * abs(np.mean(b))


def test_a_job_takes_batches_of_pixels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other pixels in every iteration, the same in every run, also in one that goes on."""
    monkeypatch.chdir(tmp_path)
    job = {**JOB, "deterministic": True, "output": "whole"}
    whole = optimize(make_config(job), progress=False)
    losses = [entry.loss for entry in whole.history]
    assert len(set(losses)) == 3 and losses[-1] < losses[0]
    for state in iterate(make_config({**job, "output": "cut"})):
        if state.number == 1:
            break
    cut = optimize(resume="cut", progress=False)
    assert [entry.loss for entry in cut.history] == losses
    assert cut.parameters[RED].tobytes() == whole.parameters[RED].tobytes()


@SLOW
def test_stages_halves_and_ranges_take_batches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    stages = [
        {"iterations": 3, "downscale": 2, "pixel_batch_size": 16},
        {"iterations": 3, "max_depth": 2, "spp": 8},
        {"iterations": 3, "pixel_batch_size": 400},  # more than there are
    ]
    changes = {"stages": stages, "measure_snr": True, "spp_shards": 2, "iterations": 9, "output": "run"}
    changes["spp"] = 16
    result = optimize(make_config({**JOB, **changes}), progress=False)
    assert len(result.history) == 9 and all(entry.noise_norms[RED] > 0 for entry in result.history)
    assert result.history[-1].loss < result.history[0].loss


def test_pixels_that_are_none_are_refused(opened) -> None:
    bench = opened(Case("gaussian", lambda: room(**FILMS["gaussian"]), FLOOR, random(1.0)))
    rows = mi.TensorXf(np.ones((2, 1, 3), np.float32))
    for pixels in ([3, 3], [3, RES**2]):
        with pytest.raises(PathreplayError, match=f"a repeated index, or one outside the film of {RES} x {RES}"):
            bench.integrator().render_value_and_grad(bench.scene, rows, rows, spp=4, pixels=mi.UInt32(pixels))
    with pytest.raises(PathreplayError, match=r"shape \(2, 1, 3\): use \(3, 1, 3\)"):
        bench.integrator().render_value_and_grad(bench.scene, rows, rows, spp=4, pixels=mi.UInt32([1, 2, 3]))


MOVED = {
    "parameters": [{"key": "sensor.to_world", "pose": "translation", "initial": {"translation": [0.1, 0, 0]}}],
    "target": {"scene": "cornell-box", "scene_parameters": {"resolution": 16}, "spp": 16},
}
PRB = {"type": "prb", "max_depth": 3}
REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "loss": ({"loss": "ssim"}, "loss = 'ssim' needs whole images; use l2 or relative-l2"),
    "loss, in a stage": (
        {"loss": "l1", "pixel_batch_size": None, "stages": [{"iterations": 3, "pixel_batch_size": 4}]},
        "loss = 'l1' needs whole images",
    ),
    "exposure": ({"exposure": {"fix_scale": False}}, "'exposure' needs whole images; remove one of them"),
    "auto": ({"spp": "auto"}, "spp = 'auto' cannot reduce"),
    "integrator": ({"integrator": PRB}, "PRBIntegrator renders whole images only; take the integrator 'pathreplay'"),
    "baseline": ({"baseline": PRB}, "PRBIntegrator renders whole images only"),
    "replay": ({"integrator": {"type": "pathreplay", "adjoint": "replay"}}, "adjoint = 'replay' .*; use 'recorded'"),
    "one sample": (
        {"spp": 1},
        "1 samples per pixel cannot provide independent loss derivatives for each other; take 2 or more",
    ),
    "one sample of a half": ({"spp": 2, "measure_snr": True}, "1 samples per pixel"),
    "too many": (
        {"spp": 1024},
        "1024 samples per pixel of 3 vertices are more than the 682 that a record holds; take fewer",
    ),
    "late": ({"stages": [{"iterations": 2}, {"iterations": 1, "max_depth": 1500}]}, "of 1500 vertices"),
    "camera": (MOVED, "its camera moves; freeze 'sensor.to_world', or leave 'pixel_batch_size' out"),
}


def test_too_long_paths_are_refused_with_a_remedy_that_helps() -> None:
    scene = mi.load_dict(room(**FILMS["box"]))
    integrator = mi.load_dict({"type": "pathreplay", "max_depth": MAX_DEPTH})
    line = f"a record cannot hold two paths of {MAX_DEPTH} vertices; lower max_depth"
    assert [integrator.why_no_pixel_sweep(scene, spp=spp) for spp in (1, 2, 4)] == [line] * 3


@pytest.mark.parametrize("why", REFUSED)
def test_what_cannot_be_taken_apart_is_refused(why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In one line, and nothing is left behind."""
    monkeypatch.chdir(tmp_path)
    changes, message = REFUSED[why]
    with pytest.raises(PathreplayError, match=message) as raised:
        optimize(make_config({**JOB, **changes, "output": "run"}), progress=False)
    assert "\n" not in str(raised.value) and not (tmp_path / "run").exists()
