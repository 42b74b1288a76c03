"""Light paths in use: what is refused, which parameters reach them, warnings, jobs, and many paths."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from typer.testing import CliRunner

import pathreplay
from driven import attached
from particle_scenes import HEIGHT, WIDTH, balls, dome, images, meter, misty, panel, room, sensor, slab
from pathreplay import Parameter, PathreplayError, Problem, View
from pathreplay.cli import app
from pathreplay.inverse.config.schema import make_config
from pathreplay.inverse.loop.loop import new_run, take_step
from pathreplay.inverse.problem.problem import build_problem, notes_on_edges, put_values
from pathreplay.jobs import optimize
from pathreplay.testing.statistics import gap
from pathreplay.testing.verdict import Z_LIMIT
from recorded_steps import steps, times_recorded
from variant import BACKEND, SPECTRAL

PARTICLES = {"type": "pathreplay_particles", "max_depth": 3, "boundary": "none"}
CAUSTICS = {"type": "pathreplay", "max_depth": 4, "boundary": "none", "caustics": "particles"}
BOTH = pytest.mark.parametrize("plugin", [PARTICLES, CAUSTICS], ids=["all", "caustics"])


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    gc.collect()


@pytest.fixture
def log() -> Iterator[list[str]]:
    """The warnings of Mitsuba's log."""
    lines: list[str] = []

    class Kept(mi.Appender):
        def append(self, level: mi.LogLevel, text: str) -> None:
            if level >= mi.LogLevel.Warn:
                lines.append(text.strip())

        def log_progress(self, *_: Any) -> None: ...

    kept = Kept()
    mi.logger().add_appender(kept)
    yield lines
    mi.logger().remove_appender(kept)


def loaded(scene: dict) -> mi.Scene:
    return mi.load_dict(scene, optimize=False)


def gradient(scene: mi.Scene, plugin: dict, key: str, spp: int = 16, seed: int = 2) -> np.ndarray:
    """Gradient of the sum of the image, weighted by a wave."""
    params = mi.traverse(scene)
    value = params[key]
    value = value.matrix if key.endswith("to_world") else value
    dr.enable_grad(value)
    if key.endswith("to_world"):
        params[key] = type(params[key])(value)
    params.update()
    integrator = mi.load_dict(plugin)
    try:
        integrator.render_backward(scene, params, mi.TensorXf(weights(scene)), 0, seed, spp)
        return np.array(dr.grad(value), np.float64)
    finally:
        dr.disable_grad(value)
        params[key] = dr.detach(params[key])
        params.update()


def weights(scene: mi.Scene) -> np.ndarray:
    width, height = scene.sensors()[0].film().crop_size()
    wave = 1 + 0.5 * np.cos(np.arange(int(width) * int(height) * 3))
    return wave.reshape(int(height), int(width), 3).astype(np.float32)


def weighted(scene: mi.Scene, plugin: dict, spp: int = 16, seed: int = 2) -> float:
    return float(np.vdot(weights(scene), images(scene, mi.load_dict(plugin), [seed], spp)[0]))


# ------------------------------ What is refused ------------------------------


SMALL = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
CHECKERS = {"type": "checkerboard"}
REFUSED: dict[str, tuple[Callable[[], dict], str]] = {
    "radiancemeter": (
        lambda: room(eye={"type": "radiancemeter", "id": "eye", "film": SMALL}),
        "light paths cannot be connected to sensor 'eye' of class RadianceMeter: take perspective",
    ),
    "distant": (
        lambda: room(eye={"type": "distant", "id": "eye", "film": SMALL}),
        "light paths cannot be connected to sensor 'eye' of class DistantSensor",
    ),
    "painted in checkers": (
        lambda: room(light="area", lamp=panel(CHECKERS)),
        "no light path can start at emitter",
    ),
    "meter of several pixels": (
        lambda: room(eye={**meter(), "meter": {**meter()["meter"], "film": {**SMALL, "width": 4, "height": 2}}}),
        "has a film of 4 x 2 pixels, which all have the same value: give it a film of one pixel",
    ),
}  # fmt: skip


@BOTH
@pytest.mark.parametrize("case", REFUSED)
def test_what_light_paths_cannot_render_is_refused_in_one_line(case: str, plugin: dict) -> None:
    scene, message = REFUSED[case]
    made = mi.load_dict(scene())
    with pytest.raises(PathreplayError) as caught:
        mi.load_dict(plugin).render(made, spp=1)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_media_that_emit_are_refused_in_one_line() -> None:
    glow = {"type": "gridmedium", "albedo": 0.5, "sigma_t": 1.0, "radiance": 2.0}
    made = mi.load_dict(room(fog={"type": "cube", "bsdf": {"type": "null"}, "interior": glow}))
    with pytest.raises(PathreplayError, match="no light path can start in a medium that emits: set its radiance to 0"):
        mi.load_dict(PARTICLES).render(made, spp=1)
    assert np.isfinite(np.array(mi.load_dict(CAUSTICS).render(made, spp=1))).all()  # camera paths find its light


@pytest.mark.parametrize("light", ["directional", "constant"])
def test_emitters_at_infinity_in_endless_fog_are_refused_in_one_line(light: str) -> None:
    with pytest.raises(PathreplayError, match="it is at infinity, in a medium without bounds") as told:
        mi.load_dict(PARTICLES).render(mi.load_dict(endless(light)), spp=1)
    assert "\n" not in str(told.value)


def endless(light: str) -> dict:
    """Endless fog around everything."""
    scene = misty(light, around="endless")
    del scene["mist"]
    return scene


SPECTRA = """
import sys
from pathreplay.platform.backend import set_variant
set_variant(sys.argv[1])
import mitsuba as mi
band = {"type": "spectrum", "value": [(400, 1.0), (700, 1.0)]}
size = {"width": 4, "height": 4}
of_spectra = {"film": {"type": "specfilm", "band": band, **size}}
responds = {"film": {"type": "hdrfilm", **size}, "srf": {"type": "uniform", "value": 0.5}}
for parts in (of_spectra, responds):
    eye = {"type": "perspective", "fov": 40, "id": "eye", **parts}
    scene = mi.load_dict({"type": "scene", "eye": eye, "lamp": {"type": "point"}})
    try:
        mi.load_dict({"type": "pathreplay_particles"}).render(scene, spp=1)
    except Exception as error:
        print(type(error).__name__, error)
"""


def test_films_of_spectra_and_spectral_responses_are_refused_in_one_line(run_python: Callable[..., Any]) -> None:
    done = run_python(SPECTRA, args=(SPECTRAL,))
    assert done.returncode == 0, done
    film, response = done.stdout.strip().splitlines()[-2:]
    line = "PathreplayError light paths cannot be"
    assert film.startswith(f"{line} added to the film of sensor 'eye': a SpecFilm stores spectra")
    assert response.startswith(f"{line} weighted by the spectral response of sensor 'eye': remove its 'srf'")


PROPERTIES: dict[str, tuple[dict, str]] = {
    "unknown caustics": (
        {**CAUSTICS, "caustics": "photons"},
        "pathreplay: caustics = 'photons' is unknown: use one of 'camera', 'particles'",
    ),
    "caustics of particles": ({**PARTICLES, "caustics": "particles"}, "caustics"),
    "samples_per_pass": (
        {**PARTICLES, "samples_per_pass": -1},
        "pathreplay_particles: samples_per_pass = -1: use a number of samples >= 1",
    ),
    "depth": ({**PARTICLES, "max_depth": -2}, "pathreplay_particles: max_depth = -2: use -1 (unbounded)"),
    "boundary": ({**PARTICLES, "boundary": "some"}, "pathreplay_particles: boundary = 'some' is unknown"),
}


@pytest.mark.parametrize("case", PROPERTIES)
def test_bad_properties_are_named(case: str) -> None:
    plugin, message = PROPERTIES[case]
    with pytest.raises(Exception) as caught:  # Mitsuba wraps what a plugin raises
        mi.load_dict(plugin)
    assert message in str(caught.value), str(caught.value)


@BOTH
def test_derivatives_of_unbounded_paths_are_refused(plugin: dict) -> None:
    scene = loaded(balls("glass"))
    unbounded = {**plugin, "max_depth": -1}
    assert mi.load_dict(unbounded).render(scene, spp=1).shape == (HEIGHT, WIDTH, 3)
    with pytest.raises(PathreplayError) as caught:
        gradient(scene, unbounded, "floor.bsdf.reflectance.value")
    message = "max_depth = -1 (unbounded) is more than the record of a light path can hold: take up to "
    most = "2049 where" if BACKEND == "llvm" else ""  # on a GPU it depends on the memory of the device
    assert str(caught.value).startswith(message + most) and "\n" not in str(caught.value)


# ------------------------------ Which parameters reach them ------------------------------


def linear_error(scene: dict, plugin: dict, key: str, spp: int = 16) -> float:
    """Relative error of a gradient with respect to a parameter that scales the image: d F / d log x is F."""
    made = loaded(scene)
    value = np.array(mi.traverse(made)[key], np.float64)
    return float((gradient(made, plugin, key, spp) * value).sum() / weighted(made, plugin, spp) - 1)


@BOTH
def test_an_intensity_scales_the_image(plugin: dict) -> None:
    """It reaches both light paths and camera paths."""
    assert abs(linear_error(balls("glass", light="point"), plugin, "light.intensity.value")) < 1e-5


def test_a_colour_that_only_light_paths_reach_has_its_gradient() -> None:
    """The camera rays of `pathreplay_particles` see emitters, and end."""
    scene = balls(light="point")
    assert abs(linear_error(scene, {**PARTICLES, "max_depth": 2}, "floor.bsdf.reflectance.value")) < 1e-5


def test_a_sky_that_only_camera_paths_reach_has_its_gradient() -> None:
    scene = loaded(balls("glass", light="constant"))
    key = "light.radiance.value"
    ours, theirs = (gradient(scene, {**CAUSTICS, "caustics": kind}, key) for kind in ("particles", "camera"))
    np.testing.assert_allclose(ours, theirs, rtol=1e-5)
    assert ours.min() > 0
    assert images(scene, mi.load_dict(CAUSTICS), [1], 8) == pytest.approx(
        images(scene, mi.load_dict({**CAUSTICS, "caustics": "camera"}), [1], 8), rel=1e-5
    )


@BOTH
def test_what_reaches_nothing_is_named(plugin: dict) -> None:
    """With attach = 'none', nothing moves."""
    scene = loaded(balls("glass", light="point"))
    with pytest.raises(PathreplayError) as caught:
        gradient(scene, {**plugin, "attach": "none"}, "light.position")
    message = str(caught.value)
    assert "no parameter with gradients reaches the light paths of sensor" in message and "\n" not in message
    assert "'light.position' has gradients" in message


@BOTH
def test_a_scene_without_emitters_is_black(plugin: dict) -> None:
    scene = balls("glass")
    del scene["light"]
    made = loaded(scene)
    integrator = mi.load_dict(plugin)
    assert (images(made, integrator, [1], 4) == 0).all()
    params = mi.traverse(made)
    dr.enable_grad(params["floor.bsdf.reflectance.value"])
    params.update()
    dr.set_grad(params["floor.bsdf.reflectance.value"], 1)
    assert (np.array(integrator.render_forward(made, params, seed=1, spp=4)) == 0).all()
    dr.disable_grad(params["floor.bsdf.reflectance.value"])
    try:
        assert (gradient(made, plugin, "floor.bsdf.reflectance.value", 4) == 0).all()
    except PathreplayError as error:
        assert "no parameter with gradients reaches the light paths" in str(error) and "\n" not in str(error)


def test_a_sky_alone_lights_the_scene() -> None:
    """Light paths start at environments unless they trace caustics only."""
    scene = loaded(balls(light="constant"))
    ours, theirs = (
        images(scene, mi.load_dict({**plugin, "max_depth": 3}), range(8), 256)
        for plugin in (PARTICLES, {"type": "path"})
    )
    assert np.abs(gap(ours.mean((1, 2)), theirs.mean((1, 2))).z).max() < Z_LIMIT


@BOTH
def test_a_frozen_step_may_be_the_first_use(plugin: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    """The integral of the filter is then part of the recording."""
    monkeypatch.setattr("pathreplay.particles.film._LENGTHS", {})
    key, integrator = "floor.bsdf.reflectance.value", mi.load_dict(plugin)

    def step(scene: mi.Scene, params: mi.SceneParameters, seed: mi.UInt32) -> mi.Float:
        image = mi.render(scene, params, integrator=integrator, spp=16, seed=seed)
        dr.backward(dr.mean(image, axis=None))
        return dr.detach(dr.mean(image, axis=None).array)

    def results(function: Any) -> list[tuple[float, float]]:
        scene = loaded(balls("glass", light="point"))
        params, found = mi.traverse(scene), []
        for seed in range(2):
            params[key] = mi.Color3f(0.5)
            dr.enable_grad(params[key])
            params.update()
            found.append((function(scene, params, mi.UInt32(seed))[0], dr.grad(params[key]).x[0]))
        return found

    frozen = results(dr.freeze(step))
    assert frozen == [pytest.approx(plain, rel=1e-4) for plain in results(step)]


def test_light_paths_are_not_told_of_lamps_that_camera_paths_miss(log: list[str]) -> None:
    made = balls(light="point")
    away = mi.ScalarTransform4f().look_at([0, 3, 0], [0, 0, 0], [0, 0, 1])
    made["lamp"] = {"type": "rectangle", "to_world": away, "emitter": {"type": "directionalarea"}}
    gradient(loaded(made), PARTICLES, "floor.bsdf.reflectance.value", 4)
    assert not any("directionalarea" in line for line in log)


@pytest.mark.parametrize("key", ["bulb.intensity.value", "floor.bsdf.reflectance.value"])
def test_lamps_that_camera_paths_do_not_find_leave_gradients_right(key: str, log: list[str]) -> None:
    """A `directionalarea` has no light for them, so that gradients are those without it."""
    made = balls(light="point")
    made["bulb"] = made.pop("light")
    away = mi.ScalarTransform4f().look_at([0, 3, 0], [0, 0, 0], [0, 0, 1])
    lamp = {"type": "rectangle", "to_world": away, "emitter": {"type": "directionalarea"}, "bsdf": {"type": "null"}}
    found = []
    for more in ({}, {"lamp": lamp}):
        scene = loaded({**made, **more})
        found.append(np.array(gradient(scene, {"type": "pathreplay", "max_depth": 3}, key, 512)))
        assert any("directionalarea" in line for line in log) == bool(more)
    assert found[1] == pytest.approx(found[0], rel=0.05)


# ------------------------------ What is said ------------------------------


def test_motion_on_a_film_with_a_box_filter_is_told_once(log: list[str]) -> None:
    for rfilter, count in (("gaussian", 0), ("box", 1)):
        made = slab()
        made["sensor"]["film"]["rfilter"]["type"] = rfilter
        scene, integrator = loaded(made), mi.load_dict({**PARTICLES, "max_depth": 4})
        params = mi.traverse(scene)
        dr.enable_grad(params["top.vertex_positions"])
        params.update()
        for seed in (1, 2):
            integrator.render_backward(scene, params, mi.TensorXf(weights(scene)), 0, seed, 4)
        told = [line for line in log if "box filter" in line]
        assert len(told) == count, log
    assert "\n" not in told[0] and "use a 'tent' or 'gaussian' filter" in told[0]


def test_the_filter_of_a_meter_is_not_told(log: list[str]) -> None:
    """What a meter measures does not depend on the place of a light path in its only pixel."""
    made = {**slab(), "sensor": meter()}
    scene, integrator = loaded(made), mi.load_dict({**PARTICLES, "max_depth": 4})
    params = mi.traverse(scene)
    dr.enable_grad(params["top.vertex_positions"])
    params.update()
    integrator.render_backward(scene, params, dr.ones(mi.TensorXf, (1, 1, 3)), 0, 1, 64)
    assert dr.any(dr.grad(params["top.vertex_positions"]) != 0)
    assert log and not any("box filter" in line for line in log), log


def test_colours_on_a_film_with_a_box_filter_are_told_nothing(log: list[str]) -> None:
    scene = balls(light="point", sensor=sensor(rfilter="box"))
    gradient(loaded(scene), PARTICLES, "floor.bsdf.reflectance.value", 4)
    assert not log


@pytest.mark.usefixtures("without_edge_terms")
@pytest.mark.parametrize(
    ("plugin", "more", "left_out"),
    [
        (PARTICLES, {}, "moving edges"),
        (PARTICLES, {"boundary": "all"}, "edges that light meets after its first rough surface"),
        (PARTICLES, {"boundary": "all", "max_depth": 2}, ""),
        (CAUSTICS, {"boundary": "primary"}, "moving edges"),
        (CAUSTICS, {"boundary": "auto"}, "edges that light meets after its first rough surface"),
    ],
)
def test_edges_that_light_paths_leave_out_are_told(plugin: dict, more: dict, left_out: str, log: list[str]) -> None:
    gradient(loaded(balls("glass", light="point")), {**plugin, **more}, "light.position", 4)
    told = [line for line in log if "the gradient of light paths leaves out" in line]
    assert len(told) == bool(left_out), log
    assert all(f"'light.position' moves, and the gradient of light paths leaves out {left_out}: " in t for t in told)


@pytest.mark.parametrize("plugin", [{**CAUSTICS, "boundary": "none"}, {**CAUSTICS, "boundary": "primary"}])
def test_edges_that_all_paths_leave_out_are_told_in_one_line(plugin: dict, log: list[str]) -> None:
    """With `primary`, light paths and camera paths leave out different edges."""
    gradient(loaded(balls("glass", light="point")), plugin, "light.position", 4)
    told = [line for line in log if "'light.position' moves" in line]
    assert len(told) == (1 if plugin["boundary"] == "none" else 2), log
    assert sum("the gradient leaves out moving edges" in line for line in told) == (plugin["boundary"] == "none")


@BOTH
def test_edges_that_a_problem_tells_of_are_not_told_again(plugin: dict, log: list[str]) -> None:
    scene, integrator = loaded(balls("glass", light="point")), mi.load_dict(plugin)
    params = mi.traverse(scene)
    (note,) = notes_on_edges(params, ["light.position"], integrator)
    assert "'light.position' moves, and the gradient leaves out moving edges" in note
    with attached(scene, "light.position"):
        integrator.render_backward(scene, params, mi.TensorXf(weights(scene)), 0, 2, 4)
    assert not [line for line in log if "moving edges" in line], log


@pytest.mark.usefixtures("without_edge_terms")
@BOTH
def test_edges_that_light_paths_in_media_leave_out_are_told(plugin: dict, log: list[str]) -> None:
    gradient(loaded(misty()), {**plugin, "boundary": "auto"}, "light.position", 4)
    later = "edges that light meets after its first rough surface or collision"
    behind = "edges between the sensor and points of a medium behind a mirror or glass"
    assert any(f"the gradient of light paths leaves out {later} and {behind}: " in line for line in log), log


@pytest.mark.usefixtures("without_edge_terms")
def test_edges_in_the_light_of_a_projector_are_told(log: list[str]) -> None:
    scene = loaded(balls("glass", light="projector"))
    gradient(scene, {**PARTICLES, "boundary": "all", "max_depth": 2}, "light.to_world", 4)
    assert any("leaves out edges in the light of emitter 'light': " in line for line in log), log


@pytest.mark.parametrize(
    ("plugin", "material", "count"), [(PARTICLES, "mirror", 1), (PARTICLES, "diffuse", 0), (CAUSTICS, "mirror", 0)]
)
def test_light_of_mirrors_that_no_light_path_brings_to_a_meter_is_told_once(
    plugin: dict, material: str, count: int, log: list[str]
) -> None:
    """In an image and in a gradient; camera paths from the meter find this light."""
    scene, integrator = loaded(balls(material, sensor=meter())), mi.load_dict(plugin)
    for seed in (1, 2):
        integrator.render(scene, seed=seed, spp=4)
    with attached(scene, FLOOR) as params:
        integrator.render_backward(scene, params, mi.TensorXf(weights(scene)), 0, 3, 4)
    told = [line for line in log if "receives directly from a mirror or smooth glass" in line]
    assert len(told) == count, log
    assert all("irradiance meter 'meter'" in line and "use 'pathreplay'" in line for line in told), log


@pytest.mark.parametrize(("darkest", "count"), [(0.0, 1), (0.01, 0)])
def test_black_texels_of_a_lamp_are_told(darkest: float, count: int, log: list[str]) -> None:
    """No light path starts there."""
    texels = mi.TensorXf(np.repeat(np.float32([darkest, 1, 1, 1]), 3).reshape(2, 2, 3))
    made = balls()
    made["light"]["emitter"]["radiance"] = {"type": "bitmap", "raw": True, "data": texels}
    scene = loaded(made)
    gradient(scene, PARTICLES, "light.emitter.radiance.data", 4)
    told = [line for line in log if "black texels" in line]
    assert len(told) == count, log
    assert all("'radiance.data' of emitter 'light'" in line for line in told)


def test_a_shape_of_distances_has_no_boundary_term(log: list[str]) -> None:
    """As for camera paths: it is left out by default, and refused on request."""
    scene = balls("glass", light="point")
    scene["grid"] = {
        "type": "sdfgrid",
        "grid": mi.TensorXf(np.linspace(-1, 1, 8, dtype=np.float32).reshape(2, 2, 2, 1)),
    }
    made = loaded(scene)
    gradient(made, {**PARTICLES, "boundary": "auto"}, "light.position", 4)
    assert any("edges of shape 'grid' of type 'sdfgrid' cannot be differentiated" in line for line in log), log
    with pytest.raises(PathreplayError, match="edges of shape 'grid' of type 'sdfgrid' cannot be differentiated"):
        gradient(made, {**PARTICLES, "boundary": "all"}, "light.position", 4)


def test_pixel_sweeps_are_refused_with_the_remedy() -> None:
    scene = loaded(balls("glass"))
    caustics, everything = mi.load_dict({**CAUSTICS, "adjoint": "recorded"}), mi.load_dict(PARTICLES)
    assert caustics.why_no_pixel_sweep(scene).endswith("take caustics = 'camera'")
    for adjoint in ("auto", "recorded"):
        everything = mi.load_dict({**PARTICLES, "adjoint": adjoint})
        assert everything.why_no_pixel_sweep(scene).endswith("take the integrator 'pathreplay'")


def test_integrators_name_their_caustics() -> None:
    for plugin, kind in ((CAUSTICS, "particles"), (PARTICLES, "particles"), ({"type": "pathreplay"}, "camera")):
        made = mi.load_dict(plugin)
        assert made.options()["caustics"] == kind and f"caustics = {kind}" in str(made)


# ------------------------------ Options and many paths ------------------------------


def test_samples_per_pass_changes_nothing() -> None:
    scene = loaded(balls(light="point"))
    a, b = (images(scene, mi.load_dict({**PARTICLES, **more}), [5], 16) for more in ({}, {"samples_per_pass": 100}))
    np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6)


def test_lanes_trace_several_paths_each() -> None:
    """More paths than lanes, and not a multiple of them: all are rendered, and all are differentiated."""
    spp = 900
    number = spp * WIDTH * HEIGHT
    assert number > 2**16 and number % 2**16
    scene = balls(light="point")
    assert abs(linear_error(scene, {**PARTICLES, "max_depth": 2}, "light.intensity.value", spp)) < 1e-4
    made = loaded(scene)
    many, few = (images(made, mi.load_dict(PARTICLES), range(n), spp).mean((1, 2)) for n, spp in ((4, spp), (16, 64)))
    assert np.abs(gap(many, few).z).max() < Z_LIMIT


@pytest.mark.slow
@pytest.mark.parametrize("rr_depth", [1, 2, 4])
def test_roulette_keeps_the_mean(rr_depth: int) -> None:
    scene = loaded(dome())
    ours, theirs = (
        images(scene, mi.load_dict({**PARTICLES, "max_depth": 8, "rr_depth": n}), range(first, first + 16), 512)
        for n, first in ((rr_depth, 0), (1000, 100))
    )
    assert np.abs(gap(ours.mean((1, 2)), theirs.mean((1, 2))).z).max() < Z_LIMIT


def test_scenes_do_not_disturb_each_other() -> None:
    """An image and a gradient, before and after those of another scene that stays alive."""
    first = loaded(balls("glass", light="point"))
    key = "light.intensity.value"
    image, g = images(first, mi.load_dict(CAUSTICS), [3], 8), gradient(first, CAUSTICS, key)
    second = loaded(dome("spot"))
    params = mi.traverse(second)
    dr.enable_grad(params["light.intensity.value"])
    params.update()
    assert (images(second, mi.load_dict(PARTICLES), [3], 8) > 0).any()
    np.testing.assert_allclose(images(first, mi.load_dict(CAUSTICS), [3], 8), image, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(gradient(first, CAUSTICS, key), g, rtol=1e-4)


# ------------------------------ Jobs ------------------------------


FLOOR = "floor.bsdf.reflectance.value"


def problem(plugin: dict) -> Problem:
    scene = balls("glass", light="point")
    target = np.full((HEIGHT, WIDTH, 3), 0.3, np.float32)
    return Problem(
        scene, {FLOOR: Parameter(initial=[0.4, 0.4, 0.4], bounds=(0, 1))}, [View("sensor", target)],
        integrator=plugin, spp=8, learning_rate=0.05,
    )  # fmt: skip


@BOTH
def test_minimize_descends(plugin: dict) -> None:
    result = pathreplay.minimize(problem(plugin), steps=4, progress=False)
    losses = [entry.loss for entry in result.history]
    assert losses[-1] < losses[0] and np.isfinite(losses).all()


SCENE = """<scene version="3.0.0">
  {integrator}
  <sensor type="perspective" id="eye">
    <transform name="to_world"><lookat origin="0,2,-3" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="6"/>
      <boolean name="sample_border" value="true"/><string name="pixel_format" value="rgb"/></film></sensor>
  <shape type="rectangle" id="floor">
    <transform name="to_world"><rotate x="1" angle="-90"/><scale value="3"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf></shape>
  <shape type="sphere" id="ball"><point name="center" x="0.2" y="1" z="0"/><float name="radius" value="0.4"/>
    <bsdf type="dielectric"/></shape>
  <emitter type="point" id="lamp"><point name="position" x="0.3" y="3" z="0"/>
    <rgb name="intensity" value="9"/></emitter>
</scene>"""
OWN = """<integrator type="pathreplay"><integer name="max_depth" value="4"/>
    <string name="caustics" value="particles"/></integrator>"""
JOB: dict[str, Any] = {
    "scene": "scene.xml",
    "iterations": 2,
    "spp": 8,
    "eval_spp": 8,
    "parameters": [{"key": "floor.bsdf.reflectance.value", "initial": [0.2, 0.3, 0.4]}],
    "target": {"values": {"floor.bsdf.reflectance.value": [0.6, 0.5, 0.4]}, "spp": 16},
}


def job(integrator: dict | None = CAUSTICS, own: str = "", **more: Any) -> Any:
    Path("scene.xml").write_text(SCENE.format(integrator=own))
    return make_config({**JOB, **({} if integrator is None else {"integrator": integrator}), **more})


@BOTH
def test_jobs_run_light_paths(plugin: dict) -> None:
    result = optimize(job({**plugin, "boundary": "auto"}), progress=False)
    history = (result.folder / "history.jsonl").read_text().splitlines()
    assert len(history) == 2 and (result.folder / "report.html").is_file()


def test_a_job_takes_the_caustics_of_its_scene() -> None:
    built = build_problem(job(None, OWN), Path.cwd())
    assert built.integrator.caustics == "particles" and built.integrator.max_depth == 4


@BOTH
def test_recorded_steps_are_traced_steps(plugin: dict) -> None:
    config = job(plugin, iterations=4)
    made = build_problem(config, Path.cwd())
    np.testing.assert_allclose(steps(made, config, "recorded"), steps(made, config, "traced"), rtol=1e-4)


FOG = """<shape type="cube" id="mist"><bsdf type="null"/>
    <transform name="to_world"><scale value="0.9"/><translate y="1"/></transform>
    <medium name="interior" type="homogeneous">
      <rgb name="sigma_t" value="0.5"/><rgb name="albedo" value="0.7"/></medium></shape>
</scene>"""


@pytest.mark.parametrize("plugin", [pytest.param(PARTICLES, marks=pytest.mark.slow), CAUSTICS], ids=["all", "caustics"])
def test_recorded_steps_in_media_are_traced_steps(plugin: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(globals(), "SCENE", SCENE.replace("</scene>", FOG))
    key = "mist.interior_medium.sigma_t.value.value"
    density = {"parameters": [{"key": key, "initial": 0.2}], "target": {"values": {key: 0.5}, "spp": 16}}
    config = job(plugin, iterations=4, **density)
    made = build_problem(config, Path.cwd())
    np.testing.assert_allclose(steps(made, config, "recorded"), steps(made, config, "traced"), rtol=1e-3)


@pytest.mark.slow  # others hold recorded light paths, and recorded edges
def test_recorded_steps_with_edges_are_traced_steps() -> None:
    """Edges that the camera sees, and edges that the light of the caustic meets."""
    lamp = {
        "parameters": [{"key": "lamp.position", "initial": [0.3, 3, 0]}],
        "target": {"values": {"lamp.position": [0.4, 2.9, 0.1]}, "spp": 16},
    }
    config = job({**CAUSTICS, "boundary": "all"}, iterations=4, **lamp)
    made = build_problem(config, Path.cwd())
    np.testing.assert_allclose(steps(made, config, "recorded"), steps(made, config, "traced"), rtol=1e-3)


INFINITE = {
    "directional": '<vector name="direction" value="0.2,-1,0.1"/><rgb name="irradiance" value="3"/>',
    "constant": '<rgb name="radiance" value="1"/>',
    "envmap": '<string name="filename" value="sky.exr"/>',
}


@pytest.mark.parametrize("light", ["directional", pytest.param("constant", marks=pytest.mark.slow), "envmap"])
def test_recorded_steps_follow_the_bounds_of_the_scene(light: str) -> None:
    """Light paths from infinite emitters start on the bounding sphere of the scene, which the ball changes here."""
    mi.Bitmap(np.random.default_rng(0).random((4, 8, 3), np.float32)).write("sky.exr")
    lamp = SCENE[SCENE.index("  <emitter") : SCENE.index("</scene>")]
    text = SCENE.replace(lamp, f'  <emitter type="{light}" id="lamp">{INFINITE[light]}</emitter>\n').replace(
        "dielectric", "diffuse"
    )
    ball = {"key": "ball.to_world", "pose": "translation", "initial": {"translation": [0, 0.3, 0]}}
    config = job(PARTICLES, iterations=7, parameters=[ball], learning_rate=0.1)
    Path("scene.xml").write_text(text.format(integrator=""))
    made = build_problem(config, Path.cwd())
    histories = []
    for record in (True, False):
        run = new_run(made, made.integrator, record=record)
        for i in range(config.iterations):
            take_step(made, run, i)
        put_values(made, run.values)  # a scene with gradients that stays alive disturbs other scenes
        histories.append([[entry.loss, *entry.gradient_norms.values()] for entry in run.history])
        assert sum(times_recorded(run.executor.evaluate)) < config.iterations - 1  # at least one step is replayed
    # Threads add in varying order, which shows in gradients near the minimum, a thousandth of the first one.
    np.testing.assert_allclose(*histories, rtol=1e-4, atol=1e-5 * histories[0][0][1])


@pytest.mark.slow
@BOTH
def test_deterministic_jobs_repeat_to_the_bit(plugin: dict) -> None:
    runs = [optimize(job(plugin, deterministic=True, output=name), progress=False) for name in ("first", "second")]
    first, second = ((run.folder / "parameters.safetensors").read_bytes() for run in runs)
    assert first == second


@pytest.mark.slow
def test_check_passes_light_paths() -> None:
    scene = SCENE.format(integrator='<integrator type="pathreplay_particles"/>').replace("dielectric", "diffuse")
    Path("scene.xml").write_text(scene)
    command = ["check", "scene.xml", "--param", "floor.bsdf.reflectance.value", "--seeds", "6", "--spp", "64"]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    assert "pathreplay_particles (backward) against finite differences of pathreplay_particles" in done.output, (
        done.output
    )


def test_a_repeated_seed_uses_no_control_variate_of_its_own(log: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pathreplay.integrators.particles.integrator.MOST_RAYS", 1)
    scene, key = loaded(misty("area")), "mist.interior_medium.sigma_t.value.value"
    params = mi.traverse(scene)
    dr.enable_grad(params[key])
    params.update()
    integrator = mi.load_dict(PARTICLES)
    for seed in (5, 5, 6, 6):  # 17 samples per pixel, of which the camera rays take 16
        integrator.render_backward(scene, params, mi.TensorXf(weights(scene)), 0, seed=seed, spp=17)
    assert len([line for line in log if "a seed was used before" in line]) == 1
