"""The film follows what is seen: the gradient is that of any flow, its noise is less, and not all scenes allow it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from edge_ordinary import FEW, PAINT, Moving, T, film, grey, hold_quiet, loaded, measured, painted, panel, sensor
from edge_truth import hold_agreement
from pathreplay.integrators import integrator as integrators
from pathreplay.integrators.camera_pass import Pass
from pathreplay.integrators.film import surface_flow
from pathreplay.integrators.film.grid import NODES
from pathreplay.integrators.film.sample import Sample
from pathreplay.integrators.film.surface_flow import SurfaceFlow
from pathreplay.testing.objective import Objective
from pathreplay.testing.statistics import gap
from pathreplay.testing.stencil import CENTRAL
from pathreplay.testing.verdict import Z_LIMIT
from pathreplay.transport.facts.nodes import nodes_of
from pathreplay.transport.facts.seams import has_seams
from truth import bitmap, noise, translate, turn_vertices
from variant import VARIANT

Write = Callable[[Path], Moving]
SEEDS, PASSES = 8, 24
SKY = {"type": "constant", "radiance": 0.8}
MIRROR = {"type": "conductor"}


def texture(**more: Any) -> dict:
    """Made anew for each scene, which takes its texels away."""
    return {**bitmap(noise(8, 3, 0.1, 0.9)), **more}


def floor(bsdf: dict) -> dict:
    place = T().translate([0, -0.5, 0]).rotate([1, 0, 0], -90).scale(3)
    return {"type": "rectangle", "to_world": place, "bsdf": bsdf}


def wall(bsdf: dict) -> dict:
    return {"type": "rectangle", "to_world": T().translate([0, 0, -1]).scale(3), "bsdf": bsdf}


def ball(bsdf: dict) -> dict:
    return {"type": "sphere", "to_world": T().scale(0.5), "bsdf": bsdf}


def box(bsdf: dict) -> dict:
    return {
        "type": "cube",
        "to_world": T().translate([-0.3, 0.1, 0.4]).rotate([1, 0.4, 0], 30).scale(0.3),
        "bsdf": bsdf,
    }


def moving(key: str, move: Any, camera: dict | None = None, depth: int = 3, **parts: Any) -> Write:
    """Parts that are functions are made anew for each scene."""

    def write(folder: Path) -> Moving:
        made = {name: part() if callable(part) else part for name, part in parts.items()}
        reference = "volpath" if any("interior" in part for part in made.values()) else "path"
        return Moving({"type": "scene", **made, "camera": camera or sensor()}, key, move, depth, reference=reference)

    return write


def fog(σ_t: float, scale: float = 0.5) -> dict:
    """A ball of fog around the origin."""
    inside = {"type": "homogeneous", "sigma_t": float(σ_t), "albedo": 0.8}
    return {"type": "sphere", "to_world": T().scale(scale), "bsdf": {"type": "null"}, "interior": inside}


def cloud(filter: str) -> dict:
    """A grid of densities in a cube behind the ball."""
    place, grid = T().translate([0.5, 0, -0.6]).scale(0.5), noise(8, 1, 0, 6)[..., None].repeat(8, 2)
    σ_t = {"type": "gridvolume", "grid": mi.VolumeGrid(grid.astype(np.float32)), "filter_type": filter}
    σ_t["to_world"] = place.translate([-1, -1, -1]).scale(2)
    inside = {"type": "heterogeneous", "sigma_t": σ_t, "albedo": 0.8}
    return {"type": "cube", "to_world": place, "bsdf": {"type": "null"}, "interior": inside}


def on_a_floor(move: Any, camera: dict, **more: Any) -> Write:
    """A ball that moves over a floor, and its shadow."""
    parts = {"ball": ball(PAINT), "floor": floor(PAINT), "lamp": panel(), **more}
    return moving("ball.to_world", move, camera, **parts)


def in_a_fog(**more: Any) -> Write:
    """The camera, the ball and its floor are in it."""
    haze = {"type": "homogeneous", "sigma_t": 0.15, "albedo": 0.8, "id": "haze"}
    same = {"type": "ref", "id": "haze"}
    around = {**fog(0, 8), "interior": same}
    return on_a_floor(translate(1, 0.3, 0), sensor(medium=same), **{"haze": haze, "around": around, **more})


def test_the_divergence_is_that_of_the_velocity_beyond_the_grid_as_well() -> None:
    """On a film of few pixels, a sampled border extends beyond the grid."""
    nodes = mi.Vector2f(np.random.default_rng(0).uniform(-1, 1, (2, NODES**2)))
    flow = SurfaceFlow(mi.load_dict({"type": "perspective"}), nodes, mi.Bool(True))

    def at(x: mi.Float, y: mi.Float) -> Sample:
        return Sample(0.0, mi.Float(0.5), mi.Point2f(x, y), mi.Point2f(0.5))

    x, y = mi.Float(0.52, -0.24, 0.52, 1.24, -0.24), mi.Float(0.27, 0.27, 1.24, 0.52, -0.24)
    h = 1e-3
    slopes = flow.velocity(at(x + h, y)).x - flow.velocity(at(x - h, y)).x
    slopes += flow.velocity(at(x, y + h)).y - flow.velocity(at(x, y - h)).y
    assert np.array(flow.divergence(at(x, y))) == pytest.approx(np.array(slopes / (2 * h)), abs=1e-2)


CELLS: dict[str, Write] = {
    "painted ball before a sky": moving(
        "ball.to_world", translate(1, 0.3, 0), ball=lambda: ball(painted(texture())), sky=SKY
    ),
    "box before a painted floor": moving(
        "box.vertex_positions",
        turn_vertices(0.3, 1, 0),
        box=box(PAINT),
        floor=lambda: floor(painted(texture())),
        lamp=panel(),
    ),
    "ball before a shadow": on_a_floor(
        translate(1, 0, 0.3), sensor(place=T().look_at([0, 1.2, 3.5], [0, -0.2, 0], [0, 1, 0])), box=box(PAINT)
    ),
    "gaussian": on_a_floor(translate(0, 1, 0), sensor(film=film(rfilter={"type": "gaussian"})), sky=SKY),
    "lens": on_a_floor(translate(1, 0.3, 0), sensor("thinlens", aperture_radius=0.1, focus_distance=3.0)),
    "before a mirror": on_a_floor(
        translate(1, 0.3, 0), sensor(place=T().look_at([0, 1, 4], [0, 0, 0], [0, 1, 0])), mirror=wall(MIRROR), sky=SKY
    ),
    "beside glass": on_a_floor(
        translate(1, 0.3, 0),
        sensor(place=T().look_at([0, 1, 4], [0, 0, 0], [0, 1, 0])),
        glass={"type": "sphere", "to_world": T().translate([-1, 0, -0.3]).scale(0.45), "bsdf": {"type": "dielectric"}},
    ),
    "glass": moving(
        "ball.to_world", translate(1, 0.3, 0), depth=4, ball=ball({"type": "dielectric"}), floor=floor(PAINT), sky=SKY
    ),
    "in a fog": in_a_fog(),
    "in a beam": in_a_fog(lamp={"type": "point", "position": [1, 1, 2], "intensity": 4.0}),
    "before a cloud": on_a_floor(translate(1, 0.3, 0), sensor(), cloud=lambda: cloud("trilinear")),
    "fog": moving("fog.to_world", translate(1, 0.3, 0), fog=fog(3), floor=floor(PAINT), lamp=panel()),
    "parallel": on_a_floor(
        translate(1, 0.3, 0),
        sensor("orthographic", T().look_at([0, 0.6, 4], [0, 0, 0], [0, 1, 0]).scale([1.3, 1.3, 1])),
    ),
}
QUICK = "painted ball before a sky"
BULB = {
    "type": "sphere",
    "to_world": T().translate([0.3, 0.5, 0.6]).scale(0.15),
    "emitter": {"type": "area", "radiance": 8.0},
}
LIT: dict[str, Write] = {
    "painted wall behind a lamp": moving(
        "wall.to_world", translate(1, 0.3, 0), wall=lambda: wall(painted(texture())), bulb=BULB
    ),
    "ball behind a lamp": moving("ball.to_world", translate(1, 0.3, 0), ball=ball(PAINT), bulb=BULB),
    "room around a lamp": moving(
        "room.to_world",
        translate(1, 0.3, 0.2),
        sensor(place=T().look_at([0, 0, 0.7], [0, 0, 0], [0, 1, 0])),
        room={"type": "sphere", "to_world": T().scale(1), "flip_normals": True, "bsdf": PAINT},
        bulb={**BULB, "to_world": T().translate([0.3, 0.1, -0.2]).scale(0.1)},
    ),
}
"""A static light that is seen before something that moves."""
QUICK_LIT = "painted wall behind a lamp"


@pytest.mark.parametrize("name", [n if n == QUICK else pytest.param(n, marks=pytest.mark.slow) for n in CELLS])
def test_gradients_agree_with_differences(name: str, tmp_path: Path) -> None:
    found = measured(CELLS[name](tmp_path), tmp_path, SEEDS)
    hold_agreement(f"flow, {name}", found.gradients, found.differences, found.transpose)


@pytest.mark.slow
@pytest.mark.parametrize("name", CELLS)
def test_the_gradient_is_that_without_a_flow(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    objective = loaded(CELLS[name](tmp_path), tmp_path)
    ours = mi.load_dict({"type": "pathreplay", "max_depth": 3})
    found = []
    for follows in (True, False):
        if not follows:
            monkeypatch.setattr(integrators, "can_follow", lambda trace, sensor: False)
        found.append(np.array([objective.backward(ours, seed, 64) for seed in range(PASSES)]))
    objective.put(dr.opaque(mi.Float, 0))
    assert abs(gap(*found).z) < Z_LIMIT, gap(*found)


def test_noise_of_a_fog_that_moves_falls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At the outline of a ball of fog, the ends of a fixed ray in the fog move without bounds."""
    objective = loaded(CELLS["fog"](tmp_path), tmp_path)
    ours, spread = mi.load_dict({"type": "pathreplay", "max_depth": 3}), []
    for follows in (True, False):
        if not follows:
            monkeypatch.setattr(integrators, "can_follow", lambda trace, sensor: False)
        spread.append(np.std([objective.backward(ours, seed, 16) for seed in range(10)]))
    objective.put(dr.opaque(mi.Float, 0))
    assert spread[0] < 0.7 * spread[1], spread


def test_noise_of_a_rough_metal_falls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The floor around it is diffuse, and may slide."""
    above = sensor(place=T().look_at([0, 1, 3.2], [0, -0.1, 0], [0, 1, 0]))
    metal = {"type": "roughconductor", "alpha": 0.15}
    write = moving("ball.to_world", translate(1, 0, 0), above, ball=ball(metal), floor=floor(PAINT), sky=SKY)
    objective = loaded(write(tmp_path), tmp_path)
    ours, spread = mi.load_dict({"type": "pathreplay", "max_depth": 3}), []
    for weight in (surface_flow.SHINY, 1.0):
        monkeypatch.setattr(surface_flow, "SHINY", weight)
        spread.append(np.std([objective.backward(ours, seed, 16) for seed in range(16)]))
    objective.put(dr.opaque(mi.Float, 0))
    assert spread[0] < 0.6 * spread[1], spread


@pytest.mark.parametrize(("name", "passes"), [(QUICK, FEW), ("glass", {})])
def test_noise_is_below_that_of_a_difference(name: str, passes: dict[str, Any], tmp_path: Path) -> None:
    hold_quiet(CELLS[name](tmp_path), tmp_path, **passes)


@pytest.mark.parametrize("name", [n if n == QUICK_LIT else pytest.param(n, marks=pytest.mark.slow) for n in LIT])
def test_a_static_light_in_the_view_makes_no_noise(name: str, tmp_path: Path) -> None:
    """If film positions moved across the light, two large terms would cancel only on average."""
    hold_quiet(LIT[name](tmp_path), tmp_path, **(FEW if name == QUICK_LIT else {}))


def test_gradients_of_a_light_bring_no_noise_back(tmp_path: Path) -> None:
    """The search for edges then treats all shapes as moving."""
    objective = loaded(LIT["ball behind a lamp"](tmp_path), tmp_path)
    integrator, spread = mi.load_dict({"type": "pathreplay", "max_depth": 2}), []
    for key in (None, "bulb.emitter.radiance.value"):
        if key:
            dr.enable_grad(objective.params[key])
        spread.append(np.std([objective.backward(integrator, seed, 32) for seed in range(12)]))
    objective.put(dr.opaque(mi.Float, 0))
    assert spread[1] < 2 * spread[0]


@pytest.mark.parametrize(("mover", "scale"), [("camera", 1.0), ("ball", 1.0), ("camera", 1e4)])
def test_a_sun_in_the_view_does_not_move_with_what_is_near(mover: str, scale: float) -> None:
    """The derivative is zero. It is as large as the image if film positions move across the sun."""
    sky = {"type": "sunsky", "sun_direction": [0, 1, 0.3], "sky_scale": 0.0, "sun_scale": 1e-3, "sun_aperture": 20.0}
    camera = sensor(place=T().look_at([0, 0, 0], [0, 1, 0.3], [0, 0, 1]))
    black = {"type": "sphere", "center": [0, 3 * scale, -0.6 * scale], "radius": 0.4 * scale, "bsdf": grey(0, 0, 0)}
    camera["far_clip"] = 100 * scale
    scene = mi.load_dict({"type": "scene", "camera": camera, "sky": sky, "ball": black}, optimize=False)
    objective = Objective(scene, mi.traverse(scene), f"{mover}.to_world", translate(scale, 0, 0))
    integrator = mi.load_dict({"type": "pathreplay", "max_depth": 2})
    image = mi.render(scene, integrator=integrator, spp=16).numpy()
    objective.weigh(np.broadcast_to(np.linspace(0, 1, image.shape[1])[:, None], image.shape))
    found = np.mean([objective.backward(integrator, seed, 64) for seed in range(6)])
    objective.put(dr.opaque(mi.Float, 0))
    assert abs(found) < 0.2 * image.mean()


HORIZON = {"type": "sunsky", "to_world": T().rotate([1, 0, 0], -90), "sun_scale": 0.0}


#: Below the far edge of it, a narrow band of the film is black.
GROUND = {
    "type": "rectangle",
    "to_world": T().translate([0, -1.5, -10]).rotate([1, 0, 0], -90).scale(90),
    "bsdf": grey(0, 0, 0),
}


BULB = {"type": "point", "position": [1, 1, 2], "intensity": 2.0}
HAZE = {
    "type": "cube",
    "to_world": T().scale(8),
    "bsdf": {"type": "null"},
    "interior": {"type": "homogeneous", "sigma_t": 0.05, "albedo": 0.8},
}


def under(sky: dict, bsdf: dict, mover: str, **more: dict) -> Objective:
    camera = sensor(place=T().look_at([0, 0, 3.2], [0, 0, 0], [0, 1, 0]), film=film(width=20, height=20))
    body = {"type": "sphere", "radius": 0.5, "bsdf": bsdf}
    scene = mi.load_dict({"type": "scene", "camera": camera, "sky": sky, "body": body, **more}, optimize=False)
    objective = Objective(scene, mi.traverse(scene), f"{mover}.to_world", translate(0.5, 1, 0))
    objective.weigh(np.full((20, 20, 3), 1 / 1200) * np.linspace(0.5, 1.5, 20)[:, None, None])
    return objective


@pytest.mark.parametrize(
    ("bsdf", "mover", "tilt", "more", "depth", "passes"),
    [
        (PAINT, "body", 0, {}, 2, 8),
        (PAINT, "camera", 25, {}, 2, 8),
        ({"type": "roughconductor", "alpha": 0.1}, "body", 0, {}, 2, 8),
        (PAINT, "body", 0, {"ground": GROUND}, 2, 8),
        ({"type": "conductor"}, "body", 25, {"ground": GROUND}, 2, 8),
        pytest.param({"type": "conductor"}, "camera", 0, {}, 2, 8, marks=pytest.mark.slow),
        pytest.param({"type": "conductor"}, "body", 0, {"bulb": BULB}, 3, 16, marks=pytest.mark.slow),
        pytest.param({"type": "conductor"}, "body", 0, {"fog": HAZE}, 3, 32, marks=pytest.mark.slow),
        pytest.param({"type": "dielectric"}, "body", 0, {}, 3, 32, marks=pytest.mark.slow),
    ],
    ids=["ball", "camera", "glossy", "ground", "mirror", "camera before a mirror", "bulb", "fog", "glass"],
)
def test_a_horizon_is_an_edge(bsdf: dict, mover: str, tilt: float, more: dict, depth: int, passes: int) -> None:
    """A sunsky is black below its horizon, which is seen directly, in a mirror or in glass. No surface ends there."""
    place = T().rotate([0, 0, 1], tilt) @ HORIZON["to_world"]
    objective = under({**HORIZON, "to_world": place}, bsdf, mover, **more)
    reference = "volpath" if "fog" in more else "path"
    ours, plain = (mi.load_dict({"type": name, "max_depth": depth}) for name in ("pathreplay", reference))
    g = np.array([objective.backward(ours, seed, 64) for seed in range(passes)])
    d = np.array([objective.dot(objective.difference(plain, CENTRAL, 0.02, 100 + s, 512)) for s in range(8)])
    objective.put(dr.opaque(mi.Float, 0))
    found = gap(g, d)
    assert abs(found.z) < Z_LIMIT and found.error < 0.1 * abs(d.mean()), found


def test_a_small_sun_in_the_view_makes_no_rare_large_passes() -> None:
    """One path in some thousands meets it, and must not determine the radiance that is subtracted from all paths."""
    objective = under({**HORIZON, "sun_scale": 1.0, "sky_scale": 0.0, "sun_direction": [0.12, 0.35, -1]}, PAINT, "body")
    ours = mi.load_dict({"type": "pathreplay", "max_depth": 2})
    g = np.array([objective.backward(ours, seed, 32) for seed in range(32)])
    plain = mi.load_dict({"type": "path", "max_depth": 2})
    d = np.array([objective.dot(objective.difference(plain, CENTRAL, 0.02, 100 + s, 128)) for s in range(8)])
    objective.put(dr.opaque(mi.Float, 0))
    off = np.abs(g - np.median(g))
    assert off.max() < 20 * np.median(off), np.sort(g)
    assert abs(gap(g, d).z) < Z_LIMIT, gap(g, d)


def test_noise_inside_one_colour_falls_with_the_size_of_the_film(monkeypatch: pytest.MonkeyPatch) -> None:
    """A wall under a constant sky translates. Inside its outline the image stays, and the flow brings noise alone.

    With a mean over a fixed number of pixels that noise grows with the film, as the velocity in pixels does.
    """

    monkeypatch.setattr(
        surface_flow, "_near_silhouettes", lambda *_: mi.Float(1)
    )  # of itself, the film does not follow walls

    def noise_of(size: int) -> float:
        wall = {"type": "rectangle", "to_world": T().scale(0.8), "bsdf": PAINT}
        camera = sensor(film=film(width=size, height=size))
        scene = mi.load_dict({"type": "scene", "camera": camera, "wall": wall, "sky": SKY}, optimize=False)
        objective = Objective(scene, mi.traverse(scene), "wall.to_world", translate(1, 0, 0))
        integrator = mi.load_dict({"type": "pathreplay", "max_depth": 2})
        inside = slice(3 * size // 8, 5 * size // 8)
        images = [objective.forward(integrator, seed, 16)[inside, inside] for seed in range(4)]
        return float(np.std(images))

    small, large = noise_of(32), noise_of(128)
    assert 0 < large < small


FLOORS: dict[str, tuple[Callable[[], dict], Callable[[], dict], bool]] = {
    "painted": (lambda: painted(texture()), lambda: {}, True),
    "checks": (lambda: painted({"type": "checkerboard"}), lambda: {}, False),
    "texels": (lambda: painted(texture(filter_type="nearest")), lambda: {}, False),
    "mirror": (lambda: MIRROR, lambda: {}, True),
    "mirror under a sun": (lambda: MIRROR, lambda: {"sky": {"type": "sunsky"}}, False),
    "mirror in a fog": (lambda: MIRROR, lambda: {"fog": fog(0.1, 8)}, False),
    "projector in a fog": (lambda: PAINT, lambda: {"fog": fog(0.1, 8), "light": {"type": "projector"}}, False),
    "spot in a fog": (lambda: PAINT, lambda: {"fog": fog(0.1, 8), "light": {"type": "spot"}}, False),
    "spot": (lambda: PAINT, lambda: {"light": {"type": "spot"}}, True),
    "cloud": (lambda: PAINT, lambda: {"cloud": cloud("trilinear")}, True),
    "cloud of voxels": (lambda: PAINT, lambda: {"cloud": cloud("nearest")}, False),
    "veil": (lambda: {"type": "mask", "opacity": 0.5, "nested": grey(0.5, 0.5, 0.5)}, lambda: {}, False),
}


@pytest.mark.parametrize("name", FLOORS)
def test_nothing_slides_whose_edges_are_not_found(name: str) -> None:
    bsdf, more, follows = FLOORS[name]
    parts = {"ball": ball(PAINT), "floor": floor(bsdf()), "sky": SKY, **more()}
    scene = mi.load_dict({"type": "scene", "camera": sensor(), **parts})
    params, integrator = mi.traverse(scene), mi.load_dict({"type": "pathreplay"})
    dr.enable_grad(params["ball.to_world"])
    params.update()
    with dr.suspend_grad():
        view, _, terms = integrator._planned(Pass.of(scene, 0, 1, 1), integrator.begin(scene))
    assert (view.flow is not None) is follows
    assert [type(term).__name__ for term in terms] == ["PathReplay", "Boundary"] + ["FilmMotion"] * follows


@pytest.mark.parametrize("filter", ["bilinear", "nearest"])
@pytest.mark.parametrize("shape", [(4, 4, 3), (1, 8, 1), (8, 1, 3), (64, 32, 1)])
@pytest.mark.parametrize(
    "more", [{}, {"wrap_mode": "mirror"}, {"to_uv": mi.ScalarTransform3f().rotate(30).scale([3, 2])}]
)
def test_bitmaps_without_interpolation_are_found(filter: str, shape: tuple[int, ...], more: dict) -> None:
    texels = np.random.default_rng(1).random(shape).astype(np.float32)
    painting = {"type": "bitmap", "raw": True, "data": mi.TensorXf(texels), "filter_type": filter, **more}
    body = mi.load_dict({"type": "rectangle", "bsdf": painted(painting)})
    assert has_seams(node for node in nodes_of(body) if isinstance(node, mi.Texture)) is (filter == "nearest")


STEPS = """
import sys
import pathreplay
import mitsuba as mi
import numpy as np
from pathreplay.transport.facts.seams import has_steps

mi.set_variant(sys.argv[1])
for raw, channels in ((True, 1), (True, 3), (True, 6), (False, 1), (False, 3)):
    for filter in ("nearest", "trilinear"):
        grid = mi.VolumeGrid(np.full((4, 4, 4, channels), 0.5, np.float32))
        volume = mi.load_dict({"type": "gridvolume", "grid": grid, "raw": raw, "filter_type": filter})
        assert has_steps([volume]) is (filter == "nearest"), (raw, channels, filter)
"""


@pytest.mark.parametrize("variant", [VARIANT, VARIANT.replace("_rgb", "_spectral")])
def test_grids_without_interpolation_are_found(variant: str, run_python: Any) -> None:
    done = run_python(STEPS, args=(variant,))
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("filter", ["bilinear", "nearest"])
@pytest.mark.parametrize("kind", ["grey", "rows", "columns"])
def test_bitmaps_without_interpolation_are_found_before_their_texels_differ(filter: str, kind: str) -> None:
    """Facts about a scene are found at the first pass, when an optimised texture may still be constant."""
    steps = np.arange(8, dtype=np.float32)[:, None, None] / 8
    texels = {"grey": np.full((8, 8, 3), 0.5, np.float32), "rows": steps + np.zeros((8, 8, 3), np.float32)}
    texels["columns"] = np.ascontiguousarray(texels["rows"].transpose(1, 0, 2))
    painting = {"type": "bitmap", "raw": True, "data": mi.TensorXf(texels[kind]), "filter_type": filter}
    assert has_seams([mi.load_dict(painting)]) is (filter == "nearest")


@pytest.mark.parametrize("filter", ["bilinear", "nearest"])
@pytest.mark.parametrize("channels", [1, 3])
def test_bitmaps_without_interpolation_are_found_where_their_texels_have_gradients(filter: str, channels: int) -> None:
    painting = {"type": "bitmap", "raw": True, "data": dr.full(mi.TensorXf, 0.5, (8, 8, channels))}
    texture = mi.load_dict({**painting, "filter_type": filter})
    params = mi.traverse(texture)
    dr.enable_grad(params["data"])
    params.update()
    for suspended in (False, True):
        with dr.suspend_grad(when=suspended):
            assert has_seams([texture]) is (filter == "nearest")


def test_attributes_of_faces_have_seams_and_those_of_vertices_none() -> None:
    for name, seams in (("face_color", True), ("vertex_color", False)):
        assert has_seams([mi.load_dict({"type": "mesh_attribute", "name": name})]) is seams
