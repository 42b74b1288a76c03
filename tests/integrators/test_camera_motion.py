"""A camera that moves: its term is right with every film and lens, and the sum of terms the same for every flow."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from edge_ordinary import (
    FEW,
    LENS,
    PAINT,
    UPRIGHT,
    WINDOW,
    Moving,
    T,
    film,
    hold_quiet,
    loaded,
    measured,
    moved_camera,
    panel,
    room,
    sensor,
)
from edge_truth import hold_agreement
from pathreplay.integrators.camera_pass import Pass
from pathreplay.integrators.film import camera_flow as film_flow
from pathreplay.integrators.film import motion as film_motion
from pathreplay.integrators.film.grid import NODES
from pathreplay.integrators.film.motion import FilmMotion
from pathreplay.integrators.term import TermResult
from pathreplay.testing.objective import smooth_weights
from pathreplay.testing.statistics import gap
from pathreplay.testing.stencil import CENTRAL
from pathreplay.testing.verdict import Z_LIMIT
from pathreplay.transport.meet import meet
from truth import add, rotate

Write = Callable[[Path], Moving]
SEEDS = 8
PASSES = 24


def turned(value: Any, t: mi.Float) -> Any:
    """Where it stands; `rotate` takes a camera around the origin."""
    return mi.Transform4f(value) @ mi.Transform4f().rotate([0.3, 1, 0], dr.rad2deg(t))


def of_camera(camera: dict, key: str, move: Any, step: float = 0.02, **more: Any) -> Write:
    return lambda folder: Moving(room(camera, **more), f"camera.{key}", move, step=step)


def filtered(kind: str, **more: Any) -> dict:
    return sensor(film=film(rfilter={"type": kind}, **more))


WIDER = add(10.0)

PLACES: dict[str, Write] = {
    "box": of_camera(filtered("box"), "x_fov", WIDER),
    "tent": of_camera(filtered("tent"), "x_fov", WIDER),
    "gaussian": of_camera(filtered("gaussian"), "x_fov", WIDER),
    "mitchell": of_camera(filtered("mitchell"), "x_fov", WIDER),
    "catmullrom": of_camera(filtered("catmullrom"), "x_fov", WIDER),
    "window": of_camera(filtered("gaussian", **WINDOW), "principal_point_offset_y", add(0.5)),
    "border": of_camera(filtered("gaussian", sample_border=True), "x_fov", WIDER),
    "rgba": of_camera(sensor(film=film(pixel_format="rgba")), "x_fov", WIDER),
    "lens": of_camera(sensor("thinlens", **LENS), "x_fov", WIDER),
    "point": of_camera(sensor(), "principal_point_offset_x", add(0.5)),
}
"""Where only places on the film move, no edge is looked for."""

POSES: dict[str, Write] = {
    "turns": of_camera(sensor(), "to_world", turned),
    "turns, catmullrom": of_camera(filtered("catmullrom"), "to_world", turned),
    "turns, lens": of_camera(sensor("thinlens", **LENS), "to_world", turned),
    "goes around": of_camera(sensor(), "to_world", rotate(0.3, 1, 0)),
    "moves, gaussian": moved_camera(filtered("gaussian")),
    "moves, lens": moved_camera(sensor("thinlens", **LENS)),
    "parallel, moves": moved_camera(sensor("orthographic", UPRIGHT)),
    "parallel, turns": of_camera(sensor("orthographic", UPRIGHT), "to_world", turned, step=0.005),
}


QUICK = "box", "catmullrom", "window"


@pytest.mark.parametrize("name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in PLACES])
def test_places_that_move_agree_with_differences(name: str, tmp_path: Path) -> None:
    hold(name, PLACES[name], tmp_path, 6 if name in QUICK else SEEDS)


@pytest.mark.slow
@pytest.mark.parametrize("name", POSES)
def test_poses_agree_with_differences(name: str, tmp_path: Path) -> None:
    hold(name, POSES[name], tmp_path)


def hold(name: str, write: Write, folder: Path, seeds: int = SEEDS) -> None:
    found = measured(write(folder), folder, seeds)
    hold_agreement(f"camera, {name}", found.gradients, found.differences, found.transpose)


@pytest.mark.parametrize(("pose", "rest"), [("turns", False), ("goes around", True), ("turns, lens", True)])
def test_a_pinhole_that_turns_leaves_no_rest(pose: str, rest: bool, tmp_path: Path) -> None:
    """And then nothing but its film is looked at."""
    objective = loaded(POSES[pose](tmp_path), tmp_path)
    integrator, t = mi.load_dict({"type": "pathreplay"}), mi.Float(0)
    dr.enable_grad(t)
    objective.put(t)
    with dr.suspend_grad():
        *_, terms = integrator._planned(Pass.of(objective.scene, 0, 1, 1), integrator.begin(objective.scene))
    objective.put(dr.opaque(mi.Float, 0))
    assert [type(term).__name__ for term in terms] == ["PathReplay", "Boundary"] * rest + ["FilmMotion"]


@pytest.mark.slow
def test_the_rest_of_a_camera_that_turns_is_rounding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    objective = loaded(POSES["turns"](tmp_path), tmp_path)
    integrator = mi.load_dict({"type": "pathreplay", "max_depth": 3, "boundary": "primary"})
    monkeypatch.setattr(film_flow, "_is_carried", lambda sensor: True)
    whole = objective.backward(integrator, 1, 64)
    monkeypatch.setattr(FilmMotion, "backward", lambda *_: TermResult(moves=True))
    rest = objective.backward(integrator, 1, 64)
    objective.put(dr.opaque(mi.Float, 0))
    assert abs(rest) < 1e-3 * abs(whole), (rest, whole)


@pytest.mark.slow
def test_the_gradient_is_that_of_any_flow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The distance at which nothing moves over the film decides which term tells of the motion, and not what it is.

    It may also be another at every node.
    """
    objective = loaded(moved_camera(sensor())(tmp_path), tmp_path)
    integrator = mi.load_dict({"type": "pathreplay", "max_depth": 3})
    found = []
    for low, high in ((0.5, 0.5), (0.125, 0.125), (0.15, 0.35)):
        nodes = mi.Float(np.random.default_rng(3).uniform(low, high, NODES**2).astype(np.float32))
        monkeypatch.setattr(film_flow, "_closeness", lambda scene, sensor, nodes=nodes: nodes)
        found.append(np.array([objective.backward(integrator, seed, 256) for seed in range(SEEDS)]))
    objective.put(dr.opaque(mi.Float, 0))
    for other in found[1:]:
        hold_agreement("camera, flows at two distances", found[0], other, 0.0)


@pytest.mark.parametrize("name", ["point", pytest.param("gaussian", marks=pytest.mark.slow)])
def test_noise_is_below_that_of_a_difference(name: str, tmp_path: Path) -> None:
    hold_quiet(PLACES[name](tmp_path), tmp_path, **FEW)


def around(light: dict) -> Write:
    """A camera that goes around something small, before nothing or a sky."""
    ball = {"type": "sphere", "to_world": T().translate([0.2, 0.1, 0]).scale(0.5), "bsdf": PAINT}
    scene = {"type": "scene", "camera": sensor(), "ball": ball, "light": light}
    return lambda folder: Moving(scene, "camera.to_world", rotate(0.3, 1, 0))


@pytest.mark.parametrize(
    "light", [panel(), pytest.param({"type": "constant"}, marks=pytest.mark.slow)], ids=["lamp", "sky"]
)
def test_noise_is_low_around_a_thing_before_a_background(light: dict, tmp_path: Path) -> None:
    """The background has no edges, so that only the distance of the thing counts."""
    hold_quiet(around(light)(tmp_path), tmp_path, **({} if light["type"] == "constant" else FEW))


def test_on_a_large_film_neighbours_cancel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pairs within pixels, which are all that is left where no weight is smooth, see little but noise."""
    objective = loaded(of_camera(sensor(film=film(width=64, height=64)), "x_fov", WIDER)(tmp_path), tmp_path)
    objective.weigh(smooth_weights((64, 64, 3), alpha=False))
    ours, found = mi.load_dict({"type": "pathreplay", "max_depth": 2}), []
    for pairs_only in (False, True):
        if pairs_only:
            monkeypatch.setattr(film_motion, "blurred", dr.zeros_like)
        found.append(np.array([objective.backward(ours, seed, 2) for seed in range(PASSES)]))
    objective.put(dr.opaque(mi.Float, 0))
    assert abs(gap(*found).z) < Z_LIMIT
    assert found[0].var() < 0.5 * found[1].var(), [g.std() for g in found]


def test_in_fog_only_the_field_of_view_has_a_gradient(tmp_path: Path) -> None:
    """Nothing else moves, and a medium is not asked."""
    fog = {"type": "homogeneous", "sigma_t": 0.7, "albedo": 0.7}
    cloud = {"type": "cube", "to_world": T().translate([0, 0, 0.5]), "bsdf": {"type": "null"}, "interior": fog}
    objective = loaded(of_camera(sensor(), "x_fov", WIDER, cloud=cloud)(tmp_path), tmp_path)
    ours = mi.load_dict({"type": "pathreplay", "max_depth": 4})
    plain = mi.load_dict({"type": "volpath", "max_depth": 4, "rr_depth": 1000})
    g = np.array([objective.backward(ours, seed, 128) for seed in range(SEEDS)])
    d = [objective.dot(objective.difference(plain, CENTRAL, 0.02, seed, 512)) for seed in range(SEEDS)]
    objective.put(dr.opaque(mi.Float, 0))
    hold_agreement("camera, in fog", g, np.array(d), 0.0)


def test_hits_stay_short_of_the_end_of_a_spline(tmp_path: Path) -> None:
    """There Mitsuba looks for a segment that does not exist: see `meet`. Rays are aimed at the rim of the last one."""
    (tmp_path / "tube.txt").write_text("\n".join(f"{x} 0 0 0.2" for x in range(5)))
    scene = mi.load_dict({"type": "scene", "tube": {"type": "bsplinecurve", "filename": str(tmp_path / "tube.txt")}})
    trace = mi.load_dict({"type": "pathreplay"})._trace_config(scene, None)
    x = 3 + dr.arange(mi.Float, 4096) * np.float32(2**-22) - np.float32(2**-11)
    hit = meet(trace, mi.Ray3f(mi.Point3f(x, 0, 1), mi.Vector3f(0, 0, -1)), mi.Bool(True))
    met = np.array(hit.is_valid())
    assert 1000 < met.sum() < 4096
    v = (np.array(hit.prim_uv.x) + np.array(hit.prim_index).astype(np.float32)) / np.float32(2)
    assert np.floor(v[met] * np.float32(2)).max() == 1


# ------------------------------ Meters ------------------------------


ONE = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}, "pixel_format": "luminance"}


def lamp_above(**parts: Any) -> dict:
    place = T().translate([0.5, 2.5, 1]).rotate([1, 0, 0], 90).scale(0.7)
    return {"type": "scene", "lamp": {"type": "rectangle", "to_world": place, "emitter": {"type": "area"}}, **parts}


UP = (0, 0.9, 0.4)


def slope(made: dict, key: str, plugin: str, seed: int, spp: int, step: float = 0.1) -> float:
    """Derivative of the image of one pixel as a shape moves `UP`: by `pathreplay`, or by a difference of another."""
    scene = mi.load_dict(made)
    params, integrator = mi.traverse(scene), mi.load_dict({"type": plugin, "max_depth": 2})
    first = type(params[key])(params[key])

    def image(t: mi.Float) -> mi.Float:
        up = mi.Vector3f(*UP) * t
        if key.endswith("to_world"):
            params[key] = mi.Transform4f().translate(up) @ first
        else:
            params[key] = dr.ravel(dr.unravel(mi.Point3f, first) + up)
        params.update()
        return mi.render(scene, params, integrator=integrator, spp=spp, seed=seed).array

    if plugin != "pathreplay":
        return float((image(mi.Float(step)) - image(mi.Float(-step)))[0]) / (2 * step)
    t = mi.Float(0)
    dr.enable_grad(t)
    dr.backward(image(t))
    found = float(dr.grad(t)[0])
    image(mi.Float(0))
    return found


@pytest.mark.parametrize("kind", ["rectangle", pytest.param("disk", marks=pytest.mark.slow)])
def test_a_meter_that_moves_sees_the_edges_of_a_lamp(kind: str) -> None:
    """Only the edges of the lamp change the irradiance; `prb` has the gradient 0."""
    place = T().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(0.6)
    made = lamp_above(plate={"type": kind, "to_world": place, "meter": {"type": "irradiancemeter", "film": ONE}})
    ours = [slope(made, "plate.to_world", "pathreplay", seed, 2**16) for seed in range(8)]
    differences = [slope(made, "plate.to_world", "path", 100 + seed, 2**18) for seed in range(8)]
    apart = gap(np.array(ours), np.array(differences))
    assert abs(apart.z) < Z_LIMIT and apart.error < 0.15 * np.mean(differences), apart


def test_a_single_ray_sees_no_outlines() -> None:
    look = T().look_at([0.3, 0.1, 4], [0.3, 0.05, 0], [0, 1, 0])
    cube = {"type": "cube", "to_world": T().scale(0.6)}
    made = lamp_above(cube=cube, eye={"type": "radiancemeter", "to_world": look, "film": ONE})
    ours = [slope(made, "cube.vertex_positions", "pathreplay", seed, 2**12) for seed in range(4)]
    differences = [slope(made, "cube.vertex_positions", "path", seed, 2**16, 0.02) for seed in range(4)]
    apart = gap(np.array(ours), np.array(differences))
    assert abs(apart.z) < Z_LIMIT and apart.error < 0.02 * abs(np.mean(differences)), apart
