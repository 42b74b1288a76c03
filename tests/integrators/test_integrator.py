"""The plugin as Mitsuba sees it: properties, refusals, warnings, threads, seeds, and equal images."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from pathreplay import PathreplayError, check_gradient
from pathreplay.scenes.descriptions import load_integrator
from pathreplay.scenes.substitute import load_dict_with
from pathreplay.testing.statistics import gap
from pathreplay.testing.verdict import Z_LIMIT
from truth import bitmap, camera, lit_room, noise, random, rgb, translate, under_sky

DIFFUSE = {"type": "diffuse", "reflectance": rgb(0.5, 0.6, 0.7)}


def plugin(**properties):
    return mi.load_dict({"type": "pathreplay", **properties})


@pytest.mark.parametrize(
    ("properties", "words"),
    [
        ({"max_depth": -2}, ["max_depth = -2", "-1"]),
        ({"rr_depth": 0}, ["rr_depth = 0"]),
        ({"adjoint": "recordedd"}, ["adjoint = 'recordedd'", "'recorded'"]),
        ({"driver": "replay"}, ["'driver'", "it is called 'adjoint' now"]),
        ({"edges": "film"}, ["'edges'", "it is called 'boundary' now"]),
        ({"attach": "some"}, ["attach = 'some'", "'delta'"]),
        ({"adjoint": "recorded", "max_depth": 5000}, ["max_depth = 5000", "2048", "'replay'"]),
        ({"adjoint": "recorded", "max_depth": -1}, ["unbounded", "'replay'"]),
        ({"jacobian_noise": -1.0}, ["jacobian_noise = -1"]),
        ({"jacobian_noise": math.nan}, ["jacobian_noise = nan", "finite"]),
        ({"jacobian_noise": "0.1"}, ["jacobian_noise = '0.1'", ">= 0"]),
        ({"jacobian_noise": True}, ["jacobian_noise = True", ">= 0"]),
        ({"hide_emitters": 1}, ["hide_emitters = 1", "true or false"]),
        ({"hide_emitters": "yes"}, ["hide_emitters = 'yes'", "true or false"]),
        ({"null_branching": 1}, ["null_branching = 1", "'auto'"]),
        *(
            ({name: value}, [f"pathreplay: {name} = {shown}: use ", "whole number"])
            for name in ("max_depth", "rr_depth")
            for value, shown in (
                ("6", "'6'"),
                (math.nan, "nan"),
                (1.5, "1.5"),
                (10**12, "1000000000000"),
                (10**20, "1e+20"),
                (True, "True"),
            )
        ),
    ],
)
def test_bad_properties_are_named_with_the_way_out(properties, words) -> None:
    with pytest.raises(Exception) as error:  # Mitsuba wraps what a plugin raises
        plugin(**properties)
    assert all(word in str(error.value) for word in words), str(error.value)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ('<string name="max_depth" value="6"/>', "max_depth = '6': use -1 (unbounded) or a depth >= 0"),
        ('<float name="max_depth" value="6"/>', "max_depth = 6.0: use -1 (unbounded) or a depth >= 0"),
        ('<boolean name="rr_depth" value="true"/>', "rr_depth = True: use a depth >= 1"),
        ('<string name="hide_emitters" value="no"/>', "hide_emitters = 'no': use true or false"),
        ('<rgb name="jacobian_noise" value="1, 2, 3"/>', "jacobian_noise = "),
    ],
)
def test_properties_of_wrong_types_in_a_file_are_named(line: str, words: str) -> None:
    xml = f'<scene version="3.0.0"><integrator type="pathreplay">{line}</integrator></scene>'
    with pytest.raises(RuntimeError) as error:
        mi.load_string(xml)
    assert f"pathreplay: {words}" in str(error.value)


def test_none_is_told_where_mitsuba_would_die() -> None:
    scene = mi.load_dict(lit_room(DIFFUSE, "rectangle"))
    expected = "'max_depth' of 'pathreplay' is None; give it a value, or leave it out"
    with pytest.raises(PathreplayError, match=expected):
        check_gradient(scene, "light.emitter.radiance.value", integrator={"type": "pathreplay", "max_depth": None})
    with pytest.raises(PathreplayError, match=expected):
        load_integrator({"type": "pathreplay", "max_depth": None})
    with pytest.raises(PathreplayError, match="'reflectance' of 'diffuse' is None"):
        load_dict_with({"type": "scene", "paint": {"type": "diffuse", "reflectance": None}}, {})


def test_auto_sweeps_where_the_record_fits() -> None:
    assert plugin().adjoint == "recorded"
    assert plugin(max_depth=2048).adjoint == "recorded"
    assert plugin(max_depth=2049).adjoint == "replay"
    assert plugin(max_depth=-1).adjoint == "replay"


def lamp_in_view(shape: str, near_clip: float = 0.01) -> mi.Scene:
    """A lamp between the camera and an object, two units before it."""
    scene = lit_room(DIFFUSE, shape)
    scene["camera"]["film"]["pixel_format"] = "rgba"
    scene["camera"]["near_clip"] = near_clip
    scene["light"]["to_world"] = mi.ScalarTransform4f().translate([0.5, 0, 2]).scale(0.3)
    scene["light"]["bsdf"] = {"type": "diffuse"}
    return mi.load_dict(scene)


def means(scene: mi.Scene, **integrator) -> np.ndarray:
    """Mean of each channel, for twelve seeds."""
    integrator = mi.load_dict({"rr_depth": 2, **integrator})
    images = [np.array(mi.render(scene, integrator=integrator, spp=64, seed=seed)) for seed in range(12)]
    return np.stack(images).astype(np.float64).mean((1, 2))


def assert_equal_means(a: np.ndarray, b: np.ndarray) -> None:
    """The means over seeds agree, but for rounding, within what four standard errors are of very many seeds."""
    difference = gap(a, b)
    assert np.all((np.abs(difference.z) < Z_LIMIT) | (np.abs(difference.value) < 4e-6)), difference


@pytest.mark.parametrize("max_depth", [0, 1, 2, 5])
@pytest.mark.parametrize("hide_emitters", [False, True])
def test_images_are_those_of_path(max_depth: int, hide_emitters: bool) -> None:
    """In colour and alpha, with a light in view."""
    scene = lamp_in_view("cube")
    ours = means(scene, type="pathreplay", max_depth=max_depth, hide_emitters=hide_emitters)
    assert_equal_means(ours, means(scene, type="path", max_depth=max_depth, hide_emitters=hide_emitters))
    assert (ours.mean() > 0) == (max_depth > 0)


def test_a_ray_through_a_hidden_lamp_meets_what_is_behind_it() -> None:
    """A ball: the place on it follows from the distance. Mitsuba's integrators measure it from the lamp's far side."""
    lamp = {"type": "area", "radiance": {"type": "rgb", "value": 0.0}, "sampling_weight": 0.0}
    behind = {"type": "sphere", "center": [0, 0, -2], "bsdf": DIFFUSE}
    sun = {"type": "directional", "direction": [-1, 0, -0.3], "irradiance": {"type": "rgb", "value": 2.0}}
    scene = {"type": "scene", "camera": camera(fov=30), "behind": behind, "sun": sun}
    hidden = {**scene, "lamp": {"type": "sphere", "center": [0, 0, 2], "radius": 0.4, "emitter": lamp}}
    integrator = mi.load_dict({"type": "pathreplay", "max_depth": 2, "hide_emitters": True})
    images = [np.array(mi.render(mi.load_dict(made), integrator=integrator, seed=1, spp=4)) for made in (scene, hidden)]
    assert images[0].max() > 0.1 and images[1] == pytest.approx(images[0], abs=1e-4)


@pytest.mark.parametrize("max_depth", [0, 1, 3])
@pytest.mark.parametrize("hide_emitters", [False, True])
@pytest.mark.parametrize("light", ["sky", "sky and lamp", "lamp"])
def test_what_is_around_the_scene_is_that_of_path(light: str, hide_emitters: bool, max_depth: int) -> None:
    """In colour and alpha, where rays leave the scene at once and later."""
    scene = lit_room(DIFFUSE)
    scene["camera"] = {**camera(fov=60), "film": {**camera()["film"], "pixel_format": "rgba"}}
    del scene["floor"]
    for name, plugin in (("sky", "sky"), ("lamp", "light")):
        if name not in light:
            del scene[plugin]
    made = mi.load_dict(scene)
    options = {"max_depth": max_depth, "hide_emitters": hide_emitters}
    ours = means(made, type="pathreplay", **options)
    assert_equal_means(ours, means(made, type="path", **options))
    covered = 0 < max_depth and "sky" in light and not hide_emitters
    assert ours[:, 3] == pytest.approx(1) if covered else (ours[:, 3] < 0.9).all()


def behind(bsdf: dict) -> mi.Scene:
    """A sheet that fills the picture, before a white sky."""
    view = camera() | {"film": camera()["film"] | {"pixel_format": "rgba"}}
    sheet = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(100), "bsdf": bsdf}
    return mi.load_dict({"type": "scene", "camera": view, "sheet": sheet, "sky": {"type": "constant"}})


@pytest.mark.parametrize("bsdf", [{"type": "null"}, {"type": "thindielectric"}])
def test_a_hidden_sky_stays_hidden_behind_a_sheet(bsdf: dict) -> None:
    """As with `path`, in colour and alpha."""
    scene = behind(bsdf)
    ours, theirs = (means(scene, type=kind, max_depth=4, hide_emitters=True) for kind in ("pathreplay", "path"))
    assert_equal_means(ours, theirs)


def test_a_hidden_sky_lights_a_mask() -> None:
    """A white sky and grey paint: the radiance is that of the paint alone. `path` loses half of the emitter samples."""
    paint = {"type": "mask", "opacity": 0.3, "nested": {"type": "diffuse", "reflectance": 0.5}}
    ours = means(behind(paint), type="pathreplay", max_depth=4, hide_emitters=True)
    assert ours.mean(0) == pytest.approx([0.15, 0.15, 0.15, 0.3], abs=2e-3)


def test_a_sphere_behind_a_hidden_lamp_is_where_it_is() -> None:
    """Mitsuba's path and prb misplace it: they lose the distance to the lamp. A camera beyond the lamp is right."""
    ours = means(lamp_in_view("sphere"), type="pathreplay", hide_emitters=True)
    assert_equal_means(ours, means(lamp_in_view("sphere", near_clip=3.05), type="path", hide_emitters=True))


def _textured():
    scene = mi.load_dict(lit_room({"type": "diffuse", "reflectance": bitmap(noise(16, 3, 0.2, 0.8))}))
    params = mi.traverse(scene)
    key = next(k for k in params.keys() if k.endswith("reflectance.data"))
    return scene, params, key


def _gradient(scene, params, key, integrator, seed=3):
    dr.enable_grad(params[key])
    params.update()
    dr.set_grad(params[key], 0)
    integrator.render_backward(scene, params, dr.ones(mi.TensorXf, (16, 16, 3)), seed=seed, spp=64)
    gradient = np.array(dr.grad(params[key]))
    dr.disable_grad(params[key])
    params.update()
    return gradient


# Sums of some thousand float32 terms in whatever order the threads come.
ROUNDING = 1e-5


@pytest.mark.parametrize("adjoint", ["recorded", "replay"])
def test_one_thread_and_many_agree_and_a_seed_repeats(adjoint: str) -> None:
    scene, params, key = _textured()
    integrator = plugin(adjoint=adjoint)
    threads = dr.thread_count()
    try:
        dr.set_thread_count(max(2, threads))
        many = _gradient(scene, params, key, integrator)
        again = _gradient(scene, params, key, integrator)
        other = _gradient(scene, params, key, integrator, seed=4)
        dr.set_thread_count(1)
        one = _gradient(scene, params, key, integrator)
    finally:
        dr.set_thread_count(threads)
    largest = np.abs(many).max()
    assert np.abs(many - again).max() < ROUNDING * largest
    assert np.abs(many - one).max() < ROUNDING * largest
    assert np.abs(many - other).max() > 10 * ROUNDING * largest


def test_render_and_dr_backward_and_forward() -> None:
    """`mi.render` with `dr.backward` and `dr.forward` gives what the methods give."""
    scene, params, key = _textured()
    integrator = plugin()
    direct = _gradient(scene, params, key, integrator, seed=5)
    dr.enable_grad(params[key])
    params.update()
    image = mi.render(scene, params, integrator=integrator, spp=64, seed=1, seed_grad=5)
    dr.backward(dr.sum(image, axis=None))
    assert np.allclose(np.array(dr.grad(params[key])), direct, rtol=1e-3, atol=ROUNDING * np.abs(direct).max())

    value = mi.TensorXf(dr.detach(params[key]))
    t = mi.Float(0)
    dr.enable_grad(t)
    params[key] = random(1.0)(value, t)
    params.update()
    image = mi.render(scene, params, integrator=integrator, spp=64, seed=1, seed_grad=5)
    dr.forward(t)
    tangent = np.array(dr.grad(image)).sum()
    assert tangent == pytest.approx((direct * np.array(random(1.0)(0 * value, 1.0))).sum(), rel=1e-3)
    params[key] = value
    params.update()


def test_alpha_has_no_derivative_in_either_mode() -> None:
    scene = under_sky(DIFFUSE)
    scene["camera"]["film"]["pixel_format"] = "rgba"
    loaded = mi.load_dict(scene)
    params, key = mi.traverse(loaded), "object.bsdf.reflectance.value"
    for forward in (True, False):
        x = mi.Float(0.5)
        dr.enable_grad(x)
        params[key] = mi.Color3f(x)
        params.update()
        image = mi.render(loaded, params, integrator=plugin(max_depth=3, hide_emitters=True), spp=4)
        if forward:
            dr.forward(x)
            tangent = np.array(dr.grad(image))
            assert tangent[..., :3].max() > 0 and not tangent[..., 3].any()
        else:
            dr.backward(dr.sum(image[:, :, 3], axis=None))
            assert dr.grad(x)[0] == 0


def test_it_loads_from_xml() -> None:
    scene = mi.load_string(
        """<scene version="3.0.0"><integrator type="pathreplay"><integer name="max_depth" value="3"/>
        <string name="adjoint" value="replay"/></integrator></scene>"""
    )
    assert scene.integrator().max_depth == 3
    assert scene.integrator().adjoint == "replay"


def test_a_gradient_that_nothing_reaches_is_an_error() -> None:
    """With attach='none' a moving shape would silently get the gradient zero."""
    scene = mi.load_dict(under_sky(DIFFUSE))
    params = mi.traverse(scene)
    t = mi.Float(0)
    dr.enable_grad(t)
    still = mi.Transform4f(params["object.to_world"])
    params["object.to_world"] = translate(1, 0, 0)(still, t)
    params.update()
    with pytest.raises(PathreplayError, match="attach"):
        plugin(attach="none").render_backward(scene, params, dr.ones(mi.TensorXf, (16, 16, 3)), spp=4)
    params["object.to_world"] = still  # Dr.Jit trips over attached parameters of scenes that are alive
    params.update()


def test_attach_all_is_refused_where_it_would_do_nothing() -> None:
    scene = mi.load_dict(under_sky({"type": "principled"}))
    with pytest.raises(PathreplayError, match="attach = 'delta'"):
        plugin(attach="all").render_backward(scene, mi.traverse(scene), dr.ones(mi.TensorXf, (16, 16, 3)), spp=1)


@pytest.mark.parametrize("sampler", ["independent", "stratified", "multijitter", "orthogonal", "ldsampler"])
@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
def test_samplers_filters_and_crops(sampler: str, rfilter: str) -> None:
    """Forward against reverse with every sampler, and a film with a filter that spreads and a crop window."""
    description = lit_room(DIFFUSE)
    description["camera"]["sampler"] = {"type": sampler}
    description["camera"]["film"] |= {
        "rfilter": {"type": rfilter}, "crop_width": 9, "crop_height": 7, "crop_offset_x": 3, "crop_offset_y": 4
    }  # fmt: skip
    scene = mi.load_dict(description, optimize=False)
    params = mi.traverse(scene)
    key, integrator = "object.bsdf.reflectance.value", plugin()
    dr.enable_grad(params[key])
    params.update()
    dr.set_grad(params[key], 1)
    weights = np.random.default_rng(1).uniform(0, 1, (7, 9, 3)).astype(np.float32)
    tangent = float((np.array(integrator.render_forward(scene, params, seed=2, spp=16)) * weights).sum())
    dr.set_grad(params[key], 0)
    integrator.render_backward(scene, params, mi.TensorXf(weights), seed=2, spp=16)
    adjoint = float(np.array(dr.grad(params[key])).sum())
    dr.disable_grad(params[key])
    params.update()
    assert tangent == pytest.approx(adjoint, rel=1e-5)
    assert tangent > 0


@pytest.mark.parametrize("variant", [pytest.param("llvm_ad_mono", marks=pytest.mark.slow), "llvm_ad_spectral"])
def test_other_variants_agree_forward_and_reverse(variant: str, run_python) -> None:
    code = f"""
import pathreplay, mitsuba as mi, drjit as dr, numpy as np
mi.set_variant({variant!r})
scene = mi.load_dict(mi.cornell_box()); params = mi.traverse(scene)
key = next(k for k in params.keys() if k.startswith("red.reflectance"))
for adjoint in ("recorded", "replay"):
    integrator = mi.load_dict({{"type": "pathreplay", "adjoint": adjoint}})
    sensor = scene.sensors()[0]
    dr.enable_grad(params[key]); params.update(); dr.set_grad(params[key], 1)
    f = np.array(integrator.render_forward(scene, params, seed=1, spp=1)).sum()
    dr.set_grad(params[key], 0)
    shape = mi.render(scene, integrator=integrator, spp=1).shape
    integrator.render_backward(scene, params, dr.ones(mi.TensorXf, shape), seed=1, spp=1)
    b = np.array(dr.grad(params[key])).sum()
    assert abs(f - b) < 1e-4 * abs(f) and f > 0, (f, b)
print("agree")
"""
    result = run_python(code)
    assert result.returncode == 0, result.stderr[-2000:]
    assert "agree" in result.stdout


def test_polarised_variants_are_refused(run_python) -> None:
    result = run_python(
        "import pathreplay, mitsuba as mi\nmi.set_variant('llvm_ad_spectral_polarized')\n"
        "mi.load_dict({'type': 'pathreplay'})"
    )
    assert "llvm_ad_spectral'" in result.stderr and "polarisation" in result.stderr


@pytest.fixture
def log():
    """What is written to Mitsuba's log during a test."""
    lines = []

    class Appender(mi.Appender):
        def append(self, level, text):
            lines.append(text)

        def log_progress(self, *args):
            pass

    logger, appender = mi.logger(), Appender()
    logger.add_appender(appender)
    yield lines
    logger.remove_appender(appender)


def _differentiate(scene, key, integrator, forward=False):
    params = mi.traverse(scene)
    dr.enable_grad(params[key])
    params.update()
    if forward:
        dr.set_grad(params[key], 1)
        dr.enqueue(dr.ADMode.Forward, params[key])
        dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges)
        integrator.render_forward(scene, params, spp=1)
    else:
        integrator.render_backward(scene, params, dr.ones(mi.TensorXf, (16, 16, 3)), spp=1)
    dr.disable_grad(params[key])
    params.update()


@pytest.mark.parametrize("forward", [False, True])
def test_edges_behind_mirrors_are_told_once(log, forward: bool) -> None:
    scene = mi.load_dict(lit_room({"type": "dielectric_ad"}), optimize=False)
    for key, words in (("object.bsdf.eta", "glass or mirrors"), ("object.to_world", "moving edges")):
        integrator = plugin(boundary="none")
        log.clear()
        for _ in range(2):
            _differentiate(scene, key, integrator, forward)
        assert [words in line for line in log if "edge" in line] == [True]


def test_moments_of_samples_move_with_the_camera_but_without_edges(log) -> None:
    """Reverse and forward mode agree, and one line names what is left out."""
    scene = mi.load_dict(lit_room(DIFFUSE))
    params = mi.traverse(scene)
    dr.enable_grad(params["camera.to_world"])
    params.update()
    moment = mi.load_dict({"type": "moment", "inner": {"type": "pathreplay", "max_depth": 2}})
    moment.render_backward(scene, params, dr.ones(mi.TensorXf, (16, 16, 9)), seed=1, spp=4)
    gradient = np.array(dr.grad(params["camera.to_world"]).matrix)[..., 0]
    direction = np.zeros((4, 4), np.float32)
    direction[:3, 3] = 0.5, -0.3, 1
    dr.set_grad(params["camera.to_world"], mi.Transform4f(direction))
    tangent = np.array(moment.render_forward(scene, params, seed=1, spp=4))
    assert abs(tangent.sum()) > 1e-3
    assert np.vdot(gradient, direction) == pytest.approx(tangent.sum(), rel=1e-3)
    assert len([line for line in log if "'camera.to_world' moves" in line and "'moment'" in line]) == 1


def test_moments_seen_by_one_camera_have_no_gradient_in_another() -> None:
    room = lit_room(DIFFUSE)
    scene = mi.load_dict({**room, "other": dict(room["camera"])}, optimize=False)
    params = mi.traverse(scene)
    dr.enable_grad(params["other.to_world"])
    params.update()
    moment = mi.load_dict({"type": "moment", "inner": {"type": "pathreplay", "max_depth": 2}})
    moment.render_backward(scene, params, dr.ones(mi.TensorXf, (16, 16, 9)), sensor=0, seed=1, spp=4)
    assert not np.any(np.array(dr.grad(params["other.to_world"]).matrix))


def test_moments_without_the_light_paths_are_told(log) -> None:
    scene = mi.load_dict(lit_room(DIFFUSE))
    params = mi.traverse(scene)
    dr.enable_grad(params["light.emitter.radiance.value"])
    params.update()
    moment = mi.load_dict({"type": "moment", "inner": {"type": "pathreplay_particles"}})
    moment.render_backward(scene, params, dr.ones(mi.TensorXf, (16, 16, 9)), seed=1, spp=4)
    assert len([line for line in log if "lack the light paths" in line]) == 1


def test_lost_adjoints_are_told_with_their_share(log, monkeypatch) -> None:
    """A direction held at a hit that is made infinite: its adjoint cannot be finite."""
    from pathreplay.transport import scatter

    held = scatter.moved_direction

    def broken(*args):
        d, J = held(*args)
        return d, J * dr.replace_grad(mi.Float(1), dr.sum(d) * dr.opaque(mi.Float, np.inf))

    monkeypatch.setattr(scatter, "moved_direction", broken)
    scene = mi.load_dict(lit_room(DIFFUSE), optimize=False)
    _differentiate(scene, "object.to_world", plugin())
    assert any("% of the paths lost a part of their gradient: a ray adjoint was not finite" in line for line in log)


def test_bsdfs_that_stay_detached_are_named(log) -> None:
    scene = lit_room({"type": "principled"})
    _differentiate(mi.load_dict(scene, optimize=False), "floor.bsdf.reflectance.value", plugin(attach="all"))
    assert any("keeps the directions of Principled fixed" in line for line in log)


def test_a_default_bsdf_of_a_lamp_does_not_make_attach_all_do_something() -> None:
    scene = lit_room({"type": "principled"})
    scene["floor"]["bsdf"] = {"type": "principled"}
    with pytest.raises(PathreplayError, match="attach = 'delta'"):
        _differentiate(mi.load_dict(scene, optimize=False), "sky.radiance.value", plugin(attach="all"))


def test_a_moving_instance_is_refused() -> None:
    scene = under_sky({"type": "conductor"})
    scene["group"] = {"type": "shapegroup", "ball": scene.pop("object")}
    scene["object"] = {"type": "instance", "group": {"type": "ref", "id": "group"}}
    with pytest.raises(PathreplayError, match="vertex_positions"):
        _differentiate(mi.load_dict(scene, optimize=False), "object.to_world", plugin())


def test_nothing_moves_when_only_a_smooth_lobe_changes() -> None:
    """Roughness must not make the path move because another thing is a mirror, and relief not because of a mask."""
    from pathreplay.transport.motion import path_moves
    from pathreplay.transport.start import CameraStart

    description = lit_room({"type": "roughconductor", "alpha": 0.2})
    bumps = {"type": "normalmap", "normalmap": bitmap(noise(4, 3, 0.4, 0.6)), "bsdf": {"type": "conductor"}}
    description["mirror"] = {"type": "sphere", "center": [0, 0, -5], "bsdf": bumps}
    veins = {"type": "normalmap", "normalmap": bitmap(noise(4, 3, 0.4, 0.6)), "bsdf": {"type": "roughconductor"}}
    description["leaf"] = {"type": "sphere", "bsdf": {"type": "mask", "opacity": 0.5, "bsdf": veins}}
    scene = mi.load_dict(description, optimize=False)
    params = mi.traverse(scene)
    ray, _ = scene.sensors()[0].sample_ray(0, 0.5, mi.Point2f(0.5), mi.Point2f(0.5))
    expected = {
        "object.bsdf.alpha.value": False,
        "object.to_world": True,
        "sky.radiance.value": False,
        "mirror.bsdf.normalmap.data": True,
        "leaf.bsdf.nested_bsdf.normalmap.data": False,
    }
    for key, moves in expected.items():
        dr.enable_grad(params[key])
        params.update()
        trace = plugin()._trace_config(scene, None)
        with dr.suspend_grad():
            start = CameraStart(ray, None, mi.Bool(True))
            assert path_moves(trace, start, start.choose(trace, mi.Bool(True))) == moves, key
        dr.disable_grad(params[key])
        params.update()
