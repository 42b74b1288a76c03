"""The step and the sweep's way back: repeated is as chosen, modes and lobes reach the BSDF, signatures tell edges."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import driven
from media_scenes import constant, grid
from pathreplay.adjoint.autodiff import NonFiniteCounter, RayDerivative
from pathreplay.adjoint.record import Layout, record_type, room_for
from pathreplay.adjoint.two_passes import PathAdjoint, RecordedPath, record_path, sweep_path
from pathreplay.integrators.lifetimes import careful
from pathreplay.platform import compat
from pathreplay.transport.emitters import redraw_emitter
from pathreplay.transport.meet import meet
from pathreplay.transport.motion import path_moves
from pathreplay.transport.path import PathState
from pathreplay.transport.start import CameraStart
from pathreplay.transport.step import choose_step, repeat_step
from pathreplay.transport.vertex import Arrival, SampledStep, TraceConfig, VertexRecord, VertexSamples
from pathreplay.transport.volume.passage import skip_null


@pytest.fixture(autouse=True)
def _care() -> Iterator[None]:
    """As in a pass; what a test leaves behind must not be met by the next."""
    with careful():
        yield
    gc.collect()


LANES = 256
GLASS = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
GROUP = {"type": "ref", "id": "group"}
MIRROR = {"type": "conductor", "specular_reflectance": {"type": "spectrum", "value": 0.8}}


def scene(bsdf: dict[str, Any], **more: Any) -> mi.Scene:
    """A square at z = 0 under a sky and a point light."""
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [0.4, 0.7, 1.0]}}
    light = {"type": "point", "position": [1, 2, 3], "intensity": {"type": "rgb", "value": 5.0}}
    square = {"type": "rectangle", "bsdf": bsdf}
    return mi.load_dict({"type": "scene", "sky": sky, "light": light, "square": square, **more}, optimize=False)


def fog(bsdf: dict[str, Any]) -> mi.Scene:
    medium = {"type": "heterogeneous", "sigma_t": grid(constant(0.8)), "albedo": 0.7}
    cube = {"type": "cube", "bsdf": {"type": "null"}, "interior": medium}
    return scene(bsdf, cube=cube)


def walk_of(scene: mi.Scene, **properties: Any) -> TraceConfig:
    return mi.load_dict({"type": "pathreplay", **properties})._trace_config(scene, None)


def sampler() -> mi.Sampler:
    made = mi.load_dict({"type": "independent"})
    made.seed(3, LANES)
    return made


def rays(spread: float = 0.9) -> mi.Ray3f:
    """Downwards onto the square, from all over it."""
    rng = np.random.default_rng(0)
    x, y = (mi.Float(rng.uniform(-spread, spread, LANES)) for _ in range(2))
    return mi.Ray3f(mi.Point3f(x, y, 0.5), dr.normalize(mi.Vector3f(0.1 * y, 0.2, -1)))


def first_step(trace: TraceConfig) -> tuple[Arrival, VertexSamples, SampledStep]:
    """An arrival, the numbers, and the step that they choose."""
    on = mi.Bool(True)
    drawn = sampler()
    at = CameraStart(rays(), drawn, on).choose(trace, on)
    if trace.media is not None:
        at.medium = mi.MediumPtr(next(filter(None, (shape.interior_medium() for shape in trace.scene.shapes()))))
    u = VertexSamples.draw(drawn)
    return at, u, choose_step(trace, at, mi.Spectrum(1), u, drawn, on, on)


def replayed(trace: TraceConfig, at: Arrival, u: VertexSamples, chosen: SampledStep) -> VertexRecord:
    hit_next = trace.scene.ray_intersect_preliminary(chosen.ray_next)
    return VertexRecord(at, u, chosen.kept, chosen.active, hit_next, mi.Float(1), mi.Spectrum(1))


@pytest.mark.parametrize("attached", [False, True])
@pytest.mark.parametrize(
    "world",
    [
        lambda: scene({"type": "roughplastic"}),
        lambda: scene(GLASS),
        lambda: fog({"type": "diffuse"}),
        lambda: fog({"type": "mask", "opacity": 0.5, "nested": {"type": "diffuse"}}),
    ],
    ids=["plastic", "glass", "fog", "fog before gauze"],
)
def test_a_repeated_step_is_the_chosen_one(world: Any, attached: bool) -> None:
    trace = walk_of(world())
    with dr.suspend_grad():
        at, u, chosen = first_step(trace)
        again = repeat_step(trace, replayed(trace, at, u, chosen), attached, mi.Bool(True))
    for name in ("e", "w"):
        assert np.allclose(getattr(again, name), getattr(chosen, name), rtol=1e-4, atol=1e-6), name
    goes_on = np.array(chosen.active)
    assert goes_on.any()
    for name in ("o", "d"):
        a, b = (np.array(getattr(step.ray_next, name))[:, goes_on] for step in (again, chosen))
        assert np.allclose(a, b, atol=1e-5), name
    if trace.media is not None:
        assert 0.1 < np.array(chosen.kept.media.flight.event).mean() < 0.9  # both kinds of vertices


def test_a_ray_that_leaves_the_scene_has_met_nothing() -> None:
    ball = {"type": "sphere", "radius": 0.4}
    trace = walk_of(scene({"type": "diffuse"}, ball=ball))
    down = mi.Ray3f(mi.Point3f(mi.Float([0, 0.39, 0.41, 5]), 0, 2), mi.Vector3f(0, 0, -1))
    with dr.suspend_grad():
        drawn, on = mi.load_dict({"type": "independent"}), mi.Bool(True)
        drawn.seed(0, 4)
        at = CameraStart(down, drawn, on).choose(trace, on)
        step = choose_step(trace, at, mi.Spectrum(1), VertexSamples.draw(drawn), drawn, on, on)
    assert list(step.met) == [True, True, True, False]


def test_a_rectangle_light_grows_once() -> None:
    """Mitsuba calls it a mesh, but differentiates its area itself, whether or not the vertices of a mesh light move."""
    T, glow = mi.ScalarTransform4f, {"type": "area", "radiance": 5.0}
    panel = {"type": "rectangle", "to_world": T().translate([0, 0, 2]).rotate([1, 0, 0], 180).scale(0.4)}
    box = {"type": "cube", "to_world": T().translate([3, 0, 2]).scale(0.2)}
    lamps = {name: {**shape, "emitter": glow} for name, shape in (("panel", panel), ("box", box))}
    u = mi.Point2f(np.random.default_rng(1).random((2, LANES), np.float32))
    found = []
    for deforms in (False, True):
        world = scene({"type": "diffuse"}, **lamps)
        params, t = mi.traverse(world), mi.Float(0)
        dr.enable_grad(t)
        params["panel.to_world"] = mi.Transform4f(params["panel.to_world"]) @ mi.Transform4f().scale(1 + t)
        if deforms:
            dr.enable_grad(params[f"box.{compat.positions_name()}"])
        params.update()
        trace = walk_of(world)
        assert trace.traits.lights_deform == deforms
        _, Le = redraw_emitter(trace, dr.zeros(mi.Interaction3f), u, None, True, mi.Bool(True))
        dr.backward(Le)
        found.append(np.array(dr.grad(t))[0])
    assert found[0] > 0 and found[1] == pytest.approx(found[0], rel=1e-5)


@pytest.mark.parametrize("copied", [False, True], ids=["itself", "copied"])
def test_null_boundaries_are_skipped(copied: bool) -> None:
    """The null boundary is that of a box, which may be in an instance."""
    place = mi.ScalarTransform4f().scale(0.4).translate([0, 0, 2])
    cube = {"type": "cube", "to_world": place, "bsdf": {"type": "null"}, "interior": {"type": "homogeneous"}}
    copy = {"group": {"type": "shapegroup", "fog": cube}, "copy": {"type": "instance", "of": GROUP}}
    trace = walk_of(scene({"type": "diffuse"}, **(copy if copied else {"fog": cube})))
    down = mi.Ray3f(mi.Point3f(mi.Float([0.1, 0.7]), 0.1, 2), mi.Vector3f(0, 0, -1))
    with dr.suspend_grad():
        first = meet(trace, down, mi.Bool(True))
        behind = skip_null(trace, down, first, mi.Bool(True))
    assert np.allclose(first.t, [0.8, 2])
    assert np.allclose(behind.t, 2)


def test_roulette_begins_as_in_prb_and_a_vertex_later_than_in_path() -> None:
    room = driven.world()

    def image(plugin: str, rr_depth: int, **more: Any) -> np.ndarray:
        integrator = mi.load_dict({"type": plugin, "max_depth": 8, "rr_depth": rr_depth, **more})
        return np.array(mi.render(room, integrator=integrator, spp=4, seed=3))

    ours = image("pathreplay", 2, sampling="scene")
    assert np.allclose(ours, image("prb", 2), atol=1e-5)
    assert np.allclose(ours, image("path", 3), atol=1e-5)
    assert np.abs(ours - image("path", 2)).max() > 0.01


# ------------------------------ The way back, with something given beyond ------------------------------


def back(scene: mi.Scene, L: float, q: RayDerivative, δL: float) -> mi.Spectrum:
    """Paths onto the square, taken back from the ray that left it, along which comes ``L`` with the adjoint ``q``."""
    trace = walk_of(scene, max_depth=2)
    with dr.suspend_grad():
        ray = mi.Ray3f(rays().o, mi.Vector3f(0, 0, -1))
        start = CameraStart(ray, sampler(), mi.Bool(True))
        path = PathState.begin(trace, start, sustained=True)
        layout = Layout.of(trace, path_moves(trace, start, path.at))
        records = dr.alloc_local(record_type(layout), room_for(trace))
        lost, first = NonFiniteCounter(), mi.UInt32(0)
        records, count, _, _, _ = record_path(trace, start.sampler, path, layout, records, first, lost)
        recorded = RecordedPath(layout, records, first, mi.UInt32(1), count - 1, dr.detach(ray))
        L = sweep_path(trace, recorded, PathAdjoint(mi.Spectrum(δL), mi.Spectrum(L), q), lost).L
        dr.eval(L)
    return L


def test_a_given_radiance_comes_back() -> None:
    """δL ρ L from a mirror: its derivative by ρ is L, and ρ L plus nothing (a mirror glows not) comes back."""
    world = scene(MIRROR)
    params = mi.traverse(world)
    dr.enable_grad(params["square.bsdf.specular_reflectance.value"])
    params.update()
    L = back(world, 2.0, RayDerivative.zero(), 1.0)
    assert np.allclose(L, 1.6, rtol=1e-5)
    found = dr.grad(params["square.bsdf.specular_reflectance.value"])
    assert np.allclose(found, 3 * 2.0 * LANES, rtol=1e-5)


class OwnMirror(mi.BSDF):
    """A BSDF as in Mitsuba's tutorial on plugins: its methods have no defaults, because Mitsuba passes ``active``."""

    def __init__(self, props: mi.Properties) -> None:
        mi.BSDF.__init__(self, props)
        self.tint = mi.Color3f(props["tint"])
        self.m_flags = mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.FrontSide
        self.m_components = [self.m_flags]

    def sample(self, ctx, si, sample1, sample2, active):
        sample = dr.zeros(mi.BSDFSample3f)
        sample.pdf, sample.eta, sample.wo = mi.Float(1), mi.Float(1), mi.reflect(si.wi)
        sample.sampled_type = mi.UInt32(+mi.BSDFFlags.DeltaReflection)
        return sample, self.tint & active

    def eval(self, ctx, si, wo, active):
        return 0.0

    def pdf(self, ctx, si, wo, active):
        return 0.0

    def eval_pdf(self, ctx, si, wo, active):
        return 0.0, 0.0

    def traverse(self, cb):
        cb.put("tint", self.tint, mi.ParamFlags.Differentiable)


def test_a_bsdf_of_python_needs_no_defaults() -> None:
    mi.register_bsdf("own_mirror", OwnMirror)
    world = scene({"type": "own_mirror", "tint": [0.8, 0.8, 0.8]})
    params = mi.traverse(world)
    dr.enable_grad(params["square.bsdf.tint"])
    params.update()
    assert np.allclose(back(world, 2.0, RayDerivative.zero(), 1.0), 1.6, rtol=1e-5)
    assert np.allclose(dr.grad(params["square.bsdf.tint"]), 2.0 * LANES, rtol=1e-5)
    params["square.bsdf.tint"] = dr.detach(params["square.bsdf.tint"])
    params.update()


@pytest.mark.parametrize(
    ("adjoint", "move", "expected"),
    [
        ({"o": [0, 0, 1]}, lambda t: mi.Transform4f().translate(mi.Vector3f(0, 0, t)), 1.0),
        # Turned by t, the mirror turns the ray by 2t about the same axis: d = (sin 2t, 0, cos 2t).
        ({"d": [1, 0, 0]}, lambda t: mi.Transform4f().rotate([0, 1, 0], dr.rad2deg(t)), 2.0),
    ],
    ids=["origin", "direction"],
)
def test_a_given_ray_adjoint_goes_back(adjoint: dict[str, Any], move: Any, expected: float) -> None:
    world = scene(MIRROR)
    params = mi.traverse(world)
    t = mi.Float(0)
    dr.enable_grad(t)
    params["square.to_world"] = move(t)
    params.update()
    q = RayDerivative(mi.Point3f(adjoint.get("o", 0)), mi.Vector3f(adjoint.get("d", 0)), mi.Float(0))
    back(world, 0.0, q, 0.0)
    assert np.allclose(dr.grad(t), expected * LANES, rtol=1e-4)
