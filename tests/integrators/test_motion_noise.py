"""Noise of gradients by motion: finite where surfaces touch, and paid for with no edge that can be afforded.

A z-test passes while a variance is infinite, so these look at tails: the share of the largest of many passes in the
variance, and whether the standard deviation of few passes is that of many.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from pathreplay.integrators.scene_facts import SceneFacts
from pathreplay.transport import velocity
from pathreplay.transport.surface import GRAZES, met
from truth import (
    RES,
    Bench,
    Case,
    add,
    bitmap,
    camera,
    environment,
    hold,
    lit_room,
    measure,
    noise,
    random,
    rgb,
    translate,
    translate_vertices,
    under_sky,
)

PASSES = 48
MANY = 192
# Of 192 normal deviations the largest makes 3 to 8 % of the variance; a distribution without variance, a third or more.
LARGEST = 0.25
# The standard deviation of 48 normal numbers is within a factor of 1.6 of that of 192; rare large ones take it to 2.
FEW, GROWTH = 48, 2.0
INDEPENDENT = {"sampling": "scene"}  # where ways to take a derivative are compared, and nothing else


# ------------------------------ Scenes that people have ------------------------------


def diffuse(*value: float) -> dict:
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": rgb(*value)}}


def cornell_box() -> dict:
    scene = mi.cornell_box()
    del scene["integrator"]
    scene["sensor"]["film"] |= {"width": RES, "height": RES, "rfilter": {"type": "box"}}
    return scene


def bowl(folder: Path) -> dict:
    """A bumpy bowl under the sky: a mesh that sees much of itself, without normals and texture coordinates."""
    axis = np.linspace(-1, 1, 12)
    x, y = np.meshgrid(axis, axis)
    vertices = np.stack([x, y, 0.9 * (x**2 + y**2) + 0.1 * np.sin(5 * x) * np.cos(4 * y)], -1).reshape(-1, 3)
    at = np.arange(144).reshape(12, 12)
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[:-1, 1:], at[1:, :-1], at[1:, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])
    header = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}"]
    header += [f"property float {name}" for name in "xyz"]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    rows = [" ".join(f"{v:.6g}" for v in vertex) for vertex in vertices]
    rows += [" ".join(map(str, (3, *face))) for face in faces]
    path = folder / "bowl.ply"
    path.write_text("\n".join([*header, *rows]) + "\n")
    return {
        "type": "scene",
        "camera": camera((0, 0, 5), fov=24, target=(0, 0, 0.5)),
        "sky": environment(64),
        "object": {"type": "ply", "filename": str(path), "face_normals": True, "bsdf": diffuse(0.7, 0.7, 0.7)},
    }


def turn_vertices(value, t):
    turned = mi.Transform4f().rotate([0, 1, 0], dr.rad2deg(t)) @ dr.unravel(mi.Point3f, value)
    return dr.ravel(turned)


def ball_on_floor() -> dict:
    return lit_room(diffuse(0.5, 0.5, 0.5)["bsdf"])


SCENES = {
    "camera moves sideways in the Cornell box": (lambda _: cornell_box(), "sensor.to_world", translate(1, 0, 0)),
    "box on a floor moves": (lambda _: cornell_box(), "small-box.vertex_positions", translate_vertices(1, 0, 0.3)),
    "mesh turns under a sky": (bowl, "object.vertex_positions", turn_vertices),
    "camera moves, ball on a floor": (lambda _: ball_on_floor(), "camera.to_world", translate(1, 0, 0)),
}


def gradients(folder: Path, name: str, passes: int = PASSES, spp: int = 32, **options: str) -> np.ndarray:
    """Return one gradient per pass."""
    make, key, move = SCENES[name]
    bench = Bench(Case(name, lambda: make(folder), key, move, spp=spp))
    found = bench.backwards(bench.integrator(**options), passes)
    bench.release()
    return found


def tails(g: np.ndarray) -> tuple[float, float]:
    """Share of the largest deviation in the variance, and standard deviation of all passes over that of the first."""
    squares = (g - g.mean()) ** 2
    return squares.max() / squares.sum(), g.std(ddof=1) / g[:FEW].std(ddof=1)


QUICK = {"mesh turns under a sky"}


@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n in QUICK else pytest.mark.slow) for n in SCENES])
def test_tails(name: str, tmp_path: Path) -> None:
    g = gradients(tmp_path, name, MANY, 8 if name in QUICK else 32)  # with fewer samples, large ones show more
    largest, growth = tails(g)
    print(f"{name}: standard deviation {g.std(ddof=1):.4f}, largest of {MANY} {largest:.0%}, growth {growth:.2f}")
    assert largest < LARGEST
    assert 1 / GROWTH < growth < GROWTH


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "least"), [(n, least) for n, least in zip(SCENES, (8.0, 2.5, 2.0, 1.0), strict=True) if least > 1]
)
def test_held_points_alone_are_noisier(
    name: str, least: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the blend is for: the standard deviation without it, over that with it, is at least so much."""
    blended = gradients(tmp_path, name, **INDEPENDENT).std(ddof=1)
    monkeypatch.setattr(velocity, "BLEND", 0.0)
    held = gradients(tmp_path, name, **INDEPENDENT).std(ddof=1)
    print(f"{name}: standard deviation {held:.4f} held, {blended:.4f} blended")
    assert held > least * blended


@pytest.mark.slow
def test_a_longer_blend_is_less_noisy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """How h0 was chosen: noise of a camera that moves, and the gradient that a lamp close to the floor leaves."""
    noise_of = {}
    for blend in (0.003, 0.01, 0.03, 0.1):
        monkeypatch.setattr(velocity, "BLEND", blend)
        noise_of[blend] = gradients(tmp_path, "camera moves sideways in the Cornell box", **INDEPENDENT).std(ddof=1)
        row = measure(replace(EDGES, options=INDEPENDENT))[-1]
        print(f"{blend}: standard deviation {noise_of[blend]:.4f}; lamp close to the floor: {row.gradient:.4f} "
              f"for {row.reference:.4f} ± {row.error:.4f}")  # fmt: skip
    assert noise_of[0.003] > noise_of[0.03]
    assert abs(row.gradient - row.reference) > 5 * row.error, "0.1 gives up the lamp's edge: this scene would show it"


# ------------------------------ The mean does not depend on it ------------------------------


def window(n: int = 64) -> np.ndarray:
    """A glow that ends in black on three sides, so that it has no edge, and is brightest at the floor."""
    y, x = (np.arange(n) + 0.5)[:, None] / n, (np.arange(n) + 0.5)[None] / n
    glow = np.sin(np.pi * x) ** 2 * np.sin(0.5 * np.pi * y) ** 2
    return np.stack([3 * glow, 2 * glow, glow * (1 + np.cos(6 * x)) / 2], -1)


def looking_down() -> dict:
    """A camera that sees nothing but the floor, from the wall (z = -1) on; moving it slides all vertices over it."""
    near = 0.03
    half = 1 - near / 2
    scene = camera((0, 4, near / 2), fov=2 * float(np.degrees(np.arctan(half / 4))), target=(0, 0, near / 2))
    scene["to_world"] = mi.ScalarTransform4f().look_at([0, 4, near / 2], [0, 0, near / 2], [0, 0, -1])
    return {
        "type": "scene",
        "camera": scene,
        "floor": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale([6, 6, 1]),
            "bsdf": {"type": "diffuse", "reflectance": bitmap(noise(32, 3, 0.4, 0.8))},
        },
    }


def glow(values: np.ndarray) -> dict:
    return {"type": "area", "radiance": bitmap(values)}


def glowing_wall() -> dict:
    wall = mi.ScalarTransform4f().translate([0, 2, -1]).scale([3, 2, 1])
    return looking_down() | {"wall": {"type": "rectangle", "to_world": wall, "emitter": glow(window())}}


def glowing_dome() -> dict:
    """The inside of a sphere with a smooth glow all around; the floor meets it close to the picture's corners."""
    n = 64
    θ, φ = np.pi * (np.arange(n) + 0.5)[:, None] / n, 2 * np.pi * (np.arange(n) + 0.5)[None] / n
    waves = [2 + np.sin(θ) * np.cos(φ), 2 + np.sin(θ) * np.sin(φ), 2 + np.cos(θ) + 0 * φ]
    radiance = bitmap(np.stack(waves, -1)) | {"wrap_mode": "repeat"}
    dome = {"type": "sphere", "center": [0, 1, 0], "radius": 1.6, "flip_normals": True}
    scene = looking_down() | {"dome": dome | {"emitter": {"type": "area", "radiance": radiance}}}
    scene["camera"] = camera((0, 2, 0), fov=46, target=(0, 0, 0))
    scene["camera"]["to_world"] = mi.ScalarTransform4f().look_at([0, 2, 0], [0, 0, 0], [0, 0, -1])
    return scene


def room_corner() -> dict:
    """A wall of a bright and a dark half, and a lamp in it, close above the floor; light from a ceiling."""

    def piece(x0: float, x1: float, y0: float, y1: float, *colour: float, **more: object) -> dict:
        place = mi.ScalarTransform4f().translate([(x0 + x1) / 2, (y0 + y1) / 2, -1])
        size = [(x1 - x0) / 2, (y1 - y0) / 2, 1]
        reflectance = {"type": "diffuse", "reflectance": rgb(*colour)}
        return {"type": "rectangle", "to_world": place.scale(size), "bsdf": reflectance, **more}

    ceiling = mi.ScalarTransform4f().translate([0, 6, 5]).rotate([1, 0, 0], 90).scale([6, 6, 1])
    black = {"type": "diffuse", "reflectance": rgb(0, 0, 0)}
    return looking_down() | {
        "bright": piece(-6, -0.3, 0, 6, 0.9, 0.2, 0.1),
        "dark": piece(0.3, 6, 0, 6, 0.05, 0.1, 0.05),
        "below": piece(-0.3, 0.3, 0, 0.05, 0.5, 0.5, 0.5),
        "lamp": piece(-0.3, 0.3, 0.05, 0.4, 0, 0, 0, emitter={"type": "area", "radiance": rgb(3, 2, 1)}),
        "above": piece(-0.3, 0.3, 0.4, 6, 0.5, 0.5, 0.5),
        "ceiling": {"type": "rectangle", "to_world": ceiling, "bsdf": black,
                    "emitter": {"type": "area", "radiance": rgb(1, 1.2, 1.3)}},
    }  # fmt: skip


MOVES = {"key": "camera.to_world", "move": translate(0.6, 0, 1), "depth": 2, "drivers": ("recorded",), "lanes": None}
NO_EDGES = [
    Case("wall without edges", glowing_wall, **MOVES, spp=128),
    Case("dome around the floor", glowing_dome, **MOVES, spp=64),
]
EDGES = Case("lamp and seams close to the floor", room_corner, **{**MOVES, "depth": 3}, spp=1024, reference_spp=8192)


@pytest.mark.parametrize("blend", [1.0, *(pytest.param(blend, marks=pytest.mark.slow) for blend in (0.0, 0.01, 0.1))])
@pytest.mark.parametrize("case", NO_EDGES, ids=lambda case: case.name)
def test_where_there_is_no_edge_any_blend_is_right(case: Case, blend: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(velocity, "BLEND", blend)
    hold(case)


@pytest.mark.slow
def test_edges_near_a_surface_are_kept() -> None:
    hold(EDGES)


# ------------------------------ Narrow lobes ------------------------------


def normal_map(alpha: float) -> dict:
    y, x = np.mgrid[0:8, 0:8] / 8 * 2 * np.pi
    texels = np.stack([0.5 + 0.08 * np.sin(x + 1), 0.5 + 0.08 * np.cos(y - 1), np.full((8, 8), 0.95)], -1)
    metal = {"type": "roughconductor", "alpha": alpha}
    scene = under_sky({"type": "normalmap", "normalmap": bitmap(texels), "nested": metal}, "rectangle")
    scene["object"]["to_world"] = mi.ScalarTransform4f().rotate([1, 1, 0], 15).scale([2, 2, 1])
    return scene


def rough_ball(alpha: float) -> dict:
    return under_sky({"type": "roughdielectric", "alpha": alpha})


ROUGHNESS = (0.05, 0.2, 0.4, 0.8)
LOBES = {
    "metal, normal map": (normal_map, "object.bsdf.normalmap.data", random(1.0, 2)),
    "glass ball, index": (rough_ball, "object.bsdf.eta", add()),
}


def variance(lobe: str, alpha: float, plugin: str, **options: str) -> float:
    make, key, move = LOBES[lobe]
    bench = Bench(Case(lobe, lambda: make(alpha), key, move, spp=64))
    found = bench.backwards(bench.integrator(plugin, **options), PASSES)
    bench.release()
    return float(np.var(found, ddof=1))


@pytest.mark.slow
@pytest.mark.parametrize("lobe", LOBES)
def test_narrow_lobes_follow_their_samples(lobe: str) -> None:
    """Variance over that of prb, which holds the direction: far below 1 for narrow lobes, 1 for wide ones."""
    shares = {a: variance(lobe, a, "pathreplay", **INDEPENDENT) / variance(lobe, a, "prb") for a in ROUGHNESS}
    print(f"{lobe}: variance / prb " + ", ".join(f"{share:.2g} at roughness {a}" for a, share in shares.items()))
    assert shares[0.05] < 0.01
    assert shares[0.2] < 0.3
    assert all(share < 1.5 for share in shares.values())


@pytest.mark.slow
@pytest.mark.parametrize("alpha", [0.05, 0.2])
@pytest.mark.parametrize("lobe", LOBES)
def test_narrow_lobes_are_right(lobe: str, alpha: float) -> None:
    make, key, move = LOBES[lobe]
    hold(Case(f"{lobe}, roughness {alpha}", lambda: make(alpha), key, move, step=3e-3, spp=256, lanes=None,
              drivers=("recorded",)))  # fmt: skip


def outlines(scene: dict) -> bool:
    loaded = mi.load_dict(scene, optimize=False)
    return SceneFacts(loaded).traits().outlines


def test_narrow_lobes_hold_where_something_ends() -> None:
    """A lamp with an edge, another shape, a mesh, or a texture with a seam inside of a sphere."""
    texture = {"type": "diffuse", "reflectance": bitmap(noise(4, 3, 0.2, 0.8))}
    assert not outlines(normal_map(0.1))
    assert not outlines(rough_ball(0.1))
    assert outlines(lit_room({"type": "roughconductor"}, "rectangle"))
    assert outlines(under_sky(texture))
    assert outlines(under_sky({"type": "roughconductor"}, "cube"))
    assert outlines(under_sky({"type": "roughconductor"}, "disk") | {"other": {"type": "sphere"}})


def slopes(height: mi.Float) -> np.ndarray:
    """Derivatives of the depth of the unit ball along rays in z direction by their heights."""
    ball = mi.load_dict({"type": "scene", "ball": {"type": "sphere"}})
    y = mi.Float(height)
    dr.enable_grad(y)
    ray = mi.Ray3f(mi.Point3f(0, y, -3), mi.Vector3f(0, 0, 1))
    hit = ball.ray_intersect_preliminary(dr.detach(ray))
    assert dr.all(hit.is_valid())
    dr.backward(met(hit, ray, mi.Bool(True)).t)
    return np.array(dr.grad(y), np.float64)


def test_rays_on_the_limb_of_a_ball_count_as_much_as_the_mean_asks_for() -> None:
    """A ray along z at height y meets the unit ball at z = -√(1 - y²); the mean slope over its disk is π / 2.

    No ray may hold more than a hundredth of the squares, whose mean has no bounds without `GRAZES`.
    """
    n = 2**20
    area = (dr.arange(mi.Float, n) + 0.5) / n
    slope = slopes(dr.sqrt(area))
    assert slope.mean() == pytest.approx(np.pi / 2, rel=1e-3)
    assert np.abs(slope).max() <= 2 / GRAZES
    assert np.square(slope).max() < 0.01 * np.square(slope).sum()


@pytest.mark.parametrize(("height", "slope"), [(0.9, 0.9 / 0.19**0.5), (float(np.nextafter(np.float32(1), 0)), 0.0)])
def test_what_rounding_has_put_on_the_limb_of_a_ball_does_not_move(height: float, slope: float) -> None:
    """A ray along z at this height meets the unit ball at z = -√(1 - height²)."""
    assert np.isclose(slopes(mi.Float(height))[0], slope, rtol=1e-4)
