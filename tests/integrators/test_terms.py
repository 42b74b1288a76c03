"""Terms of the gradient: each keeps its promise, they add up, and what is known of a scene keeps up with it."""

from __future__ import annotations

import gc
import inspect
import weakref
from collections.abc import Callable
from dataclasses import fields

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from media_scenes import cloud, heterogeneous, smooth
from pathreplay import PathreplayError
from pathreplay.adjoint.baseline import BaselineState, BaselineStats
from pathreplay.integrators.boundary_term import Boundary
from pathreplay.integrators.camera_pass import Pass
from pathreplay.integrators.scene_facts import SceneFacts, facts_of
from pathreplay.integrators.term import Term, TermResult
from truth import bitmap, lit_room, noise, rgb

DIFFUSE = {"type": "diffuse", "reflectance": rgb(0.5, 0.6, 0.7)}
COLOUR, DENSITY = "object.bsdf.reflectance.value", "object.interior_medium.sigma_t.data"
SPP = 4
METHODS = ("forward", "backward", "note")
# Every plugin's terms, in a scene for which all of them are.
PLUGINS = ("pathreplay", "naive_ad", "radiative_backprop", "prb_volume_listing")


def foggy() -> dict:
    return cloud(heterogeneous(smooth(0.5, 3), 0.8))


@pytest.fixture
def load() -> Callable[[dict, str], tuple[mi.Scene, mi.SceneParameters]]:
    """Loads a scene with gradients by a key, which are released in the end."""
    loaded = []

    def open_scene(description: dict, key: str) -> tuple[mi.Scene, mi.SceneParameters]:
        gc.collect()
        scene = mi.load_dict(description, optimize=False)
        params = mi.traverse(scene)
        dr.enable_grad(params[key])
        params.update()
        loaded.append((params, key))
        return scene, params

    yield open_scene
    for params, key in loaded:
        dr.disable_grad(params[key])
        params.update()


@pytest.mark.parametrize(
    "plugin", ["pathreplay", *(pytest.param(p, marks=pytest.mark.slow) for p in PLUGINS if p != "pathreplay")]
)
def test_a_term_has_the_methods_of_the_protocol_and_gives_what_it_says(plugin: str, load) -> None:
    scene, params = load(foggy(), DENSITY)
    integrator = mi.load_dict({"type": plugin, "max_depth": 3})
    view = Pass.of(scene, 0, 1, SPP)
    adjoint = dr.ones(mi.TensorXf, (16, 16, 3))
    with dr.suspend_grad():
        view, trace, terms = integrator._planned(view, integrator.begin(scene))
    for term in terms:
        for name in METHODS:
            promised = list(inspect.signature(getattr(Term, name)).parameters)[1:]
            given = list(inspect.signature(getattr(term, name)).parameters.values())
            assert [p.name for p in given[: len(promised)]] == promised
            assert all(p.default is not p.empty for p in given[len(promised) :])
        with dr.suspend_grad(), dr.isolate_grad():
            found = term.backward(view, trace, adjoint, None)
        assert isinstance(found, TermResult) and found.image is None and found.stats is None
        assert np.abs(np.array(dr.grad(params[DENSITY]))).max() > 0
        dr.set_grad(params[DENSITY], 1)
        with dr.suspend_grad():
            if plugin == "radiative_backprop":
                with pytest.raises(PathreplayError, match="no forward mode"):
                    term.forward(view, trace, None)
            else:
                assert term.forward(view, trace, None).image.shape == (16, 16, 3)


def test_another_term_may_stand_for_the_interior(load) -> None:
    """As the benchmarks of edges have it."""
    scene, params = load(lit_room(DIFFUSE), COLOUR)
    integrator = mi.load_dict({"type": "pathreplay", "max_depth": 3})
    integrator.interior = Boundary(inner=False)
    integrator.render_backward(scene, params, dr.ones(mi.TensorXf, (16, 16, 3)), seed=1, spp=SPP)
    assert dr.all(dr.grad(params[COLOUR]) == 0)


def test_terms_add_up(load, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the interior listed twice, gradient and tangent are twice as large."""
    scene, params = load(lit_room(DIFFUSE), COLOUR)
    adjoint, found = dr.ones(mi.TensorXf, (16, 16, 3)), []
    for times in (1, 2):
        integrator = mi.load_dict({"type": "pathreplay", "max_depth": 3})
        monkeypatch.setattr(type(integrator), "terms", property(lambda self, n=times: n * (self.interior,)))
        dr.clear_grad(params[COLOUR])
        integrator.render_backward(scene, params, adjoint, seed=1, spp=SPP)
        gradient = np.array(dr.grad(params[COLOUR])).ravel()
        dr.set_grad(params[COLOUR], 1)
        params.update()
        tangent = np.array(integrator.render_forward(scene, params, seed=1, spp=SPP))
        found.append((gradient, tangent))
    (once, tangent), (twice, double) = found
    assert np.abs(once).min() > 0 and np.abs(tangent).max() > 0
    np.testing.assert_allclose(twice, 2 * once, rtol=1e-5)
    np.testing.assert_allclose(double, 2 * tangent, rtol=1e-5)


def test_sample_gives_what_it_says(load) -> None:
    """As Mitsuba's `aov` asks for it, it is the radiance of the image; nothing is learned, and it is no pass."""
    scene, _ = load(foggy(), DENSITY)
    integrator = mi.load_dict({"type": "pathreplay", "max_depth": 3, "sampling": "scene"})
    rays = Pass.of(scene, 0, 3, SPP).rays()
    L, _, aovs, _ = integrator.sample(dr.ADMode.Primal, scene, rays.sampler, rays.ray)
    image = np.array(integrator.render(scene, seed=3, spp=SPP))
    np.testing.assert_allclose(np.array(L).T.reshape(16, 16, SPP, 3).mean(2), image, rtol=1e-4, atol=1e-6)
    assert aovs == []
    with pytest.raises(PathreplayError, match=r"use mi\.render, or render_backward"):
        integrator.sample(dr.ADMode.Backward, scene, rays.sampler, rays.ray, δL=mi.Spectrum(1))
    assert integrator.state_dict() == {}


def test_moments_of_samples_have_the_gradients_of_prb(load) -> None:
    """Mitsuba's `moment` differentiates what `sample` returns: colour, and the square of each sample."""
    scene, params = load(lit_room(DIFFUSE), COLOUR)
    found = []
    for plugin in ("pathreplay", "prb"):
        moment = mi.load_dict({"type": "moment", "inner": {"type": plugin, "max_depth": 3}})
        weights = mi.TensorXf(np.random.default_rng(0).random((16, 16, 9), np.float32))
        dr.clear_grad(params[COLOUR])
        moment.render_backward(scene, params, weights, seed=1, spp=SPP)
        gradient = np.array(dr.grad(params[COLOUR])).ravel()
        dr.set_grad(params[COLOUR], 1)
        found.append((gradient, np.array(moment.render_forward(scene, params, seed=1, spp=SPP))))
    (gradient, tangent), (other, others) = found
    assert np.abs(gradient).min() > 0 and all(np.abs(tangent[..., c]).max() > 0 for c in range(9))
    np.testing.assert_allclose(gradient, other, rtol=1e-4)
    np.testing.assert_allclose(tangent, others, rtol=1e-3, atol=1e-5)


def test_moments_reach_what_parameters_are_computed_from(load) -> None:
    scene, params = load(lit_room(DIFFUSE), COLOUR)
    kind, found = type(params[COLOUR]), []
    for plugin in ("pathreplay", "prb"):
        moment, x = mi.load_dict({"type": "moment", "inner": {"type": plugin, "max_depth": 3}}), mi.Float(0.6)
        dr.enable_grad(x)
        params[COLOUR] = kind(dr.square(x))
        params.update()
        image = mi.render(scene, params, integrator=moment, spp=SPP, seed=1)
        dr.backward(dr.mean(dr.square(image), axis=None))
        found.append(dr.grad(x)[0])
    assert found[0] == pytest.approx(found[1], rel=1e-3) and found[0] != 0


def test_added_channels_leave_the_gradient_of_the_colour(load) -> None:
    """Around `pathreplay`, Mitsuba's `aov` adds the gradient of the albedo to that of the image."""
    scene, params = load(lit_room(DIFFUSE), COLOUR)
    inner = {"type": "pathreplay", "max_depth": 3}
    aov = mi.load_dict({"type": "aov", "aovs": "albedo:albedo", "inner": inner})

    def gradient(integrator: mi.Integrator, channels: int, used: slice) -> np.ndarray:
        weights = np.zeros((16, 16, channels), np.float32)
        weights[..., used] = 1
        dr.clear_grad(params[COLOUR])
        integrator.render_backward(scene, params, mi.TensorXf(weights), seed=1, spp=SPP)
        return np.array(dr.grad(params[COLOUR])).ravel()

    colour, albedo = gradient(aov, 6, slice(3)), gradient(aov, 6, slice(3, 6))
    assert np.abs(albedo).min() > 0
    np.testing.assert_allclose(colour, gradient(mi.load_dict(inner), 3, slice(3)), rtol=1e-5)
    np.testing.assert_allclose(gradient(aov, 6, slice(6)), colour + albedo, rtol=1e-5)


def test_what_was_learned_outlives_another_scene_between(load) -> None:
    scene, params = load(foggy(), DENSITY)
    still = mi.load_dict(lit_room({"type": "diffuse"}))
    integrator = mi.load_dict({"type": "pathreplay", "max_depth": 3})
    adjoint = mi.TensorXf(np.ones((16, 16, 3), np.float32))
    known = []
    for seed in range(2):
        integrator.render_backward(scene, params, adjoint, seed=seed, spp=SPP)
        known.append(integrator.state_dict()["sums"].sum())
        integrator.render(still, seed=seed, spp=1)
    assert known[1] > 1.5 * known[0] > 0


def test_what_shards_have_seen_can_be_added(load) -> None:
    scene, _ = load(foggy(), DENSITY)
    integrator = mi.load_dict({"type": "pathreplay", "max_depth": 3, "null_branching": True})
    trace = integrator._trace_config(scene, scene.sensors()[0])
    nothing = BaselineState.fresh(scene.bbox())

    def seen(seed: int) -> BaselineStats:
        with dr.suspend_grad(), dr.isolate_grad():
            term, view = integrator.interior, Pass.of(scene, 0, seed, SPP)
            return term.backward(view, trace, dr.ones(mi.TensorXf, (16, 16, 3)), nothing.guess).stats

    one, other = seen(1), seen(2)
    both = one + other
    assert both.paths == one.paths + other.paths == 2 * 16 * 16 * SPP
    for name in ("sums", "nulls"):
        parts = [np.array(getattr(each, name)) for each in (one, other)]
        assert min(part.max() for part in parts) > 0
        np.testing.assert_allclose(np.array(getattr(both, name)), sum(parts), rtol=1e-6)
    after, again = nothing.after(both), nothing.after(other + one)
    assert after.passes == again.passes and len(after.passes) == 2
    for name, value in after.state_dict().items():
        np.testing.assert_allclose(again.state_dict()[name], value, rtol=1e-5)
    restored = BaselineState.restored(scene.bbox(), after.state_dict())
    np.testing.assert_allclose(np.array(restored.guess.known), np.array(after.guess.known))


def test_facts_are_found_once_and_keep_up_with_the_scene(load) -> None:
    glow = lit_room(DIFFUSE)
    scene, params = load(glow, COLOUR)
    integrator = mi.load_dict({"type": "pathreplay", "max_depth": 3})
    before = integrator._trace_config(scene, None)
    facts = facts_of(scene)
    assert not before.traits.lights_vary
    light = "light.emitter.radiance.value"
    dr.enable_grad(params[light])
    params.update()
    assert integrator._trace_config(scene, None).traits.lights_vary
    dr.disable_grad(params[light])
    params.update()
    after = integrator._trace_config(scene, None).traits
    assert facts_of(scene) is facts
    changed = [f.name for f in fields(after) if getattr(after, f.name) is not getattr(before.traits, f.name)]
    assert changed == []
    # A shape that grows: the distance within which directions are held grows with it.
    key = "object.to_world"
    params[key] = mi.Transform4f().scale(3) @ mi.Transform4f(params[key])
    params.update()
    grown = integrator._trace_config(scene, None).traits.tables.blend_lengths
    assert np.array(grown).max() >= np.array(before.traits.tables.blend_lengths).max()
    assert not np.array_equal(np.array(grown), np.array(before.traits.tables.blend_lengths))
    # Another BSDF on a shape, and another scene.
    scene.shapes()[0].set_bsdf(mi.load_dict({"type": "plastic"}))
    assert integrator._trace_config(scene, None).traits.lobes == 1
    other = mi.load_dict(lit_room({"type": "thindielectric"}))
    assert integrator._trace_config(other, None).traits.lobes == 2
    assert facts_of(other) is not facts_of(scene)


@pytest.mark.parametrize("plugin", ["conductor", "dielectric", "dielectric_ad"])
@pytest.mark.parametrize("nested", [False, True])
def test_lobes_with_exact_weights_are_not_sampled_again(plugin: str, nested: bool) -> None:
    relief = {"type": "bumpmap", "bump": bitmap(noise(4, 1, 0, 1)), "inner": {"type": plugin}}
    scene = mi.load_dict(lit_room(relief if nested else {"type": plugin}))
    traits = mi.load_dict({"type": "pathreplay"})._trace_config(scene, None).traits
    assert traits.mirrors and traits.lobes == 0


def test_facts_keep_up_with_faces_in_another_order() -> None:
    """Two quads that are folded at a seam: as many faces as before, and other smoothing groups."""
    corners = [[0, -1, 0], [0, 1, 0], [-1, 1, 1], [-1, -1, 1], [0, -1, 0], [0, 1, 0], [1, 1, 1], [1, -1, 1]]
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 6, 5], [4, 7, 6]], np.uint32)
    mesh = mi.Mesh("fold", 8, 4, has_vertex_normals=True)
    params = mi.traverse(mesh)
    params["vertex_positions"], params["faces"] = np.ravel(corners).astype(np.float32), faces.ravel()
    params.update()
    scene = mi.load_dict({"type": "scene", "sky": {"type": "constant"}, "fold": mesh})
    facts, params = SceneFacts(scene), mi.traverse(scene)
    assert np.array(facts.tables().groups).tolist() == [0, 0, 0, 1, 1]
    assert facts.tables().groups is facts.tables().groups
    params["fold.faces"] = faces[[0, 2, 1, 3]].ravel()
    params.update()
    assert np.array(facts.tables().groups).tolist() == [0, 0, 1, 0, 1]


def test_facts_tell_of_gradients_and_values_of_media(load) -> None:
    scene, params = load(foggy(), DENSITY)
    sensor = scene.sensors()[0]
    facts = SceneFacts(scene)
    assert facts.has_media and facts.media(sensor).branches
    dr.disable_grad(params[DENSITY])
    params.update()
    assert not facts.media(sensor).branches
    assert not facts.media(sensor).chromatic
    params[DENSITY] = mi.TensorXf(np.ones((4, 4, 4, 3), np.float32))
    params.update()
    assert facts.media(sensor).chromatic


def test_a_scene_is_released_with_an_integrator_of_its_own() -> None:
    """Which knows facts about it."""
    scene = mi.load_dict({**lit_room(DIFFUSE), "integrator": {"type": "pathreplay", "max_depth": 2}})
    dr.eval(scene.integrator().render(scene, spp=1))
    assert facts_of(scene).are_about(scene)
    integrator = weakref.ref(scene.integrator())
    assert integrator() is not None
    del scene
    gc.collect()
    assert integrator() is None
