"""Gradients of light paths against finite differences, with equal random numbers and in expectation.

Apart from the cells of `EDGES`, nothing that moves in these scenes has an outline or a crease in the light, so that the
derivative at fixed visibility is the whole derivative. With equal random numbers, the gradient of every image equals a
central difference, where no random choice depends on the parameter. Run with -s to see the figures as tables.
"""

from __future__ import annotations

import gc
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from particle_scenes import ROUGH, dome, milky, mirror, misty, plane, rgb, round_mesh, sensor, slab
from pathreplay.platform import compat
from pathreplay.testing.objective import Move, Objective, smooth_weights
from pathreplay.testing.statistics import gap
from pathreplay.testing.stencil import CENTRAL
from pathreplay.testing.verdict import RESOLUTION, Z_LIMIT
from places import ROOT, SUPPORT
from truth import TRANSPOSE_MAX, add, random, rotate, translate
from variant import MONO, SPECTRAL

PLUGIN = "pathreplay_particles"
SAME_SEED_MAX = 1e-3
"""Largest error of a gradient relative to the central difference with equal random numbers."""


def waves(value: Any, t: Any) -> Any:
    """Heights of a surface along z, which change its normals, too."""
    points = np.array(value).reshape(-1, 3)
    direction = np.zeros_like(points)
    direction[:, 2] = 0.1 * np.cos(2 * points[:, 0] + points[:, 1])
    return value + t * mi.Float(direction.ravel())


def scale(value: Any, t: Any) -> Any:
    """A multiple of the value, which leaves the distribution of random places on it unchanged."""
    return value * (1 + t)


def both_ways(first: Move, second: Move) -> Move:
    """One move after the other."""
    return lambda value, t: second(first(value, t), t)


POSE = both_ways(translate(0.3, 0.5, 0.7), rotate(0.2, 0.4, 0.1))


@dataclass(frozen=True)
class Cell:
    """A parameter of a scene, and how it moves."""

    name: str
    scene: Callable[[], dict]
    key: str
    move: Move
    step: float = 2e-3  # of the central difference
    depth: int = 3
    spp: int = 512
    options: dict[str, Any] = field(default_factory=dict)


def cell(name: str, scene: Callable[[], dict], key: str, move: Move, **more: Any) -> Cell:
    return Cell(name, scene, key, move, **more)


SLOW, SLAB = {"step": 1e-3}, {"depth": 4, "step": 1e-3}
ONCE = {"depth": 2, "step": 1e-3}
"""Of what moves a vertex from which a smooth lobe continues: random directions there are fixed differently."""
CELLS = (
    cell("heights, mirror", mirror, "mirror.vertex_positions", waves, step=1e-2),
    cell("heights, slab", slab, "top.vertex_positions", waves, depth=4, step=1e-2),
    cell("receiver, mirror", mirror, "ceiling.to_world", POSE, **SLOW),
    cell("receiver, slab", slab, "floor.to_world", POSE, **SLAB),
    cell("camera, slab", slab, "sensor.to_world", POSE, **SLAB),
    cell("receiver", dome, "dome.to_world", POSE, **ONCE),
    cell("receiver, rough", partial(dome, bsdf=ROUGH), "dome.to_world", translate(0.3, 0.5, 0.7), **ONCE),
    cell("perspective", dome, "sensor.to_world", POSE, **SLOW),
    cell("thin lens", partial(dome, eye="thinlens"), "sensor.to_world", POSE, **SLOW),
    cell("orthographic", partial(dome, eye="orthographic"), "sensor.to_world", POSE, **SLOW),
    cell("meter", partial(plane, "spot", "meter"), "probe.to_world", POSE, spp=2**17, step=1e-2, depth=2),
    cell("x_fov", dome, "sensor.x_fov", add(), step=0.1),
    cell("x_fov, cropped", partial(dome, eye="cropped"), "sensor.x_fov", add(), step=0.1),
    cell("x_fov, thin lens", partial(dome, eye="thinlens"), "sensor.x_fov", add(), step=0.1),
    cell("principal point", partial(dome, eye="cropped"), "sensor.principal_point_offset_x", add(), **SLOW),
    cell("focus_distance", partial(dome, eye="thinlens"), "sensor.focus_distance", add(), step=1e-2),
    cell("aperture_radius", partial(dome, eye="thinlens"), "sensor.aperture_radius", add(), **SLOW),
    cell("point", dome, "light.position", add([0.3, 0.5, 0.7]), depth=2, step=3e-4),
    cell("point, rough", partial(dome, bsdf=ROUGH), "light.position", add([0.3, 0.5, 0.7]), **ONCE),
    cell("spot", partial(dome, "spot"), "light.to_world", POSE, depth=2, step=3e-3),
    cell("area", partial(dome, "area"), "light.to_world", POSE, **ONCE),
    cell("sphere", partial(dome, "sphere"), "light.to_world", POSE, **ONCE),
    cell("projector", partial(dome, "projector"), "light.to_world", translate(0.3, 0.5, 0.7), **ONCE),
    cell("directional", partial(plane, "directional", bsdf=ROUGH), "light.to_world", rotate(0.3, 0.5, 0.7), **ONCE),
    cell("beam", partial(plane, "directionalarea"), "light.to_world", POSE, depth=2, step=3e-3),
    cell("intensity", dome, "light.intensity.value", add([0.5, 1.0, 0.2]), step=0.1),
    cell("power", partial(dome, "white"), "light.intensity.value", scale, step=0.1),
    cell("radiance", partial(dome, "area"), "light.emitter.radiance.value", scale, step=0.1, depth=2),
    cell("painted radiance", partial(dome, "painted area"), "light.emitter.radiance.data", scale, step=0.1, depth=2),
    cell("reflectance", dome, "dome.bsdf.brdf_0.reflectance.data", random(0.5), step=1e-2),
)
BY_NAME = {c.name: c for c in CELLS}
QUICK = ("heights, mirror", "thin lens", "receiver", "sphere")


@contextmanager
def opened(cell: Cell) -> Iterator[Objective]:
    """The objective of a cell, a weighted mean of the image. It is detached at the end."""
    gc.collect()
    scene = mi.load_dict(cell.scene(), optimize=False)
    params = mi.traverse(scene)
    objective = Objective(scene, params, cell.key, cell.move)
    width, height = scene.sensors()[0].film().crop_size()
    channels = 1 if mi.is_monochromatic else 3
    objective.weigh(smooth_weights((int(height), int(width), channels), alpha=False))
    try:
        yield objective
    finally:
        params[cell.key] = objective.value
        params.update()


def integrator(cell: Cell, plugin: str = PLUGIN, **options: Any) -> mi.Integrator:
    own = {"boundary": "none", **cell.options} if plugin.startswith("pathreplay") else {}
    return mi.load_dict({"type": plugin, "max_depth": cell.depth, **own, **options})


# ------------------------------ Equal random numbers ------------------------------


def same_seed(cell: Cell, spp: int) -> tuple[float, float]:
    """Return the errors of a gradient against the central difference, and of forward against reverse mode.

    Both are relative to the sum of the magnitudes that the pixels contribute.
    """
    with opened(cell) as objective:
        steady = integrator(cell, rr_depth=1000)  # probabilities of survival would move
        difference = objective.difference(steady, CENTRAL, cell.step, 1, spp)
        gradient = objective.backward(steady, 1, spp)
        transpose = objective.transpose_error(steady, steady, 1, spp)
    size = objective.dot(np.abs(difference))
    error = abs(gradient - objective.dot(difference)) / size
    print(f"{cell.name:20s} depth {cell.depth:2d} {gradient:+12.5e} of {size:11.5e} {error:9.1e} {transpose:9.1e}")
    return error, transpose


@pytest.mark.parametrize("name", QUICK)
def test_gradients_are_differences_with_equal_numbers(name: str) -> None:
    error, transpose = same_seed(BY_NAME[name], 128)
    assert error < SAME_SEED_MAX and transpose < TRANSPOSE_MAX


@pytest.mark.slow
@pytest.mark.parametrize("cell", CELLS, ids=lambda c: c.name)
def test_all_gradients_are_differences_with_equal_numbers(cell: Cell) -> None:
    error, transpose = same_seed(cell, cell.spp)
    assert error < SAME_SEED_MAX and transpose < TRANSPOSE_MAX


@pytest.mark.slow
@pytest.mark.parametrize("rr_depth", [1, 2])
def test_reverse_is_the_transpose_of_forward_under_roulette(rr_depth: int) -> None:
    for name in ("receiver, rough", "reflectance", "spot"):
        cell = BY_NAME[name]
        with opened(cell) as objective:
            same = integrator(cell, rr_depth=rr_depth)
            assert objective.transpose_error(same, same, 1, 64) < TRANSPOSE_MAX


# ------------------------------ In expectation ------------------------------


ALPHA = "dome.bsdf.brdf_0.alpha.value"
OWN = {"reference": PLUGIN}
"""Differences of our own images, where `path` finds no light."""


@dataclass(frozen=True)
class Mean(Cell):
    """A cell whose random choices may depend on the parameter."""

    reference: str = "path"
    rr_depth: int = 5
    seeds: int = 12
    peer: str = "ptracer"  # the integrator whose gradient is printed beside ours


def mean(name: str, scene: Callable[[], dict], key: str, move: Move, **more: Any) -> Mean:
    return Mean(name, scene, key, move, **{"step": 1e-2, "spp": 256, **more})


SMALLER = {"step": 3e-3, **OWN}
MEANS = (
    mean("heights, slab", slab, "top.vertex_positions", waves, depth=6, **SMALLER),
    mean("heights, slab, beam", partial(slab, "beam"), "top.vertex_positions", waves, depth=6, **OWN),
    mean("heights, lens", partial(slab, both=True), "bottom.vertex_positions", waves, depth=6, **OWN),
    mean("heights, lens, beam", partial(slab, "beam", both=True), "top.vertex_positions", waves, depth=6, **OWN),
    mean("index, slab", slab, "top.bsdf.eta", add(), step=2e-2, depth=6, **OWN),
    mean("spot, lens", partial(slab, both=True), "light.to_world", translate(0.3, 0, 0.1), depth=6, **OWN),
    mean("spot, mirror", mirror, "light.to_world", translate(0.3, 0, 0.1), depth=4, **OWN),
    mean("receiver, slab", slab, "floor.to_world", POSE, depth=6, **OWN),
    mean("receiver", dome, "dome.to_world", POSE, depth=4),
    mean("thin lens", partial(dome, eye="thinlens"), "sensor.to_world", translate(0, 1, 0), depth=4),
    mean("point", dome, "light.position", add([0.3, 0.5, 0.7]), depth=4),
    mean("point, rough", partial(dome, bsdf=ROUGH), "light.position", add([0.3, 0.5, 0.7]), depth=4),
    mean("spot", partial(dome, "spot"), "light.to_world", POSE, depth=4),
    mean("roughness", partial(dome, bsdf=ROUGH), ALPHA, add(), depth=4),
    mean("area", partial(dome, "area"), "light.to_world", POSE, depth=2),
    mean("sky", partial(plane, "sky"), "light.to_world", rotate(1, 0, 0), depth=2, spp=8192, seeds=24),
    mean("painted radiance", partial(dome, "painted area"), "light.emitter.radiance.data", random(), step=0.1, depth=2),
    mean("reflectance, roulette", dome, "dome.bsdf.brdf_0.reflectance.data", random(0.5), depth=8, rr_depth=2),
)
MEANS_BY_NAME = {c.name: c for c in MEANS}


def in_expectation(cell: Mean, plugin: str = PLUGIN) -> tuple[float, float]:
    """Print a row of the table with a peer beside us; return our z, and our standard error over the gradient."""
    plugins = (plugin,) if cell.peer == plugin else (plugin, cell.peer)
    with opened(cell) as objective:
        plain = integrator(cell, cell.reference, rr_depth=1000)
        differences, gradients, *others = np.array([
            [
                objective.dot(objective.difference(plain, CENTRAL, cell.step, 1000 + seed, cell.spp)),
                *(objective.backward(integrator(cell, each, rr_depth=cell.rr_depth), seed, cell.spp)
                  for each in plugins),
            ]
            for seed in range(1, cell.seeds + 1)
        ]).T  # fmt: skip
    (theirs,) = others or (gradients,)
    ours, other = gap(gradients, differences), gap(theirs, differences)
    print(
        f"{cell.name:22s} {differences.mean():+11.4e}  ours {gradients.mean():+11.4e} ± {ours.error:7.1e}"
        f" z {ours.z:+6.2f}  {cell.peer} {theirs.mean():+11.4e} ± {other.error:7.1e} z {other.z:+7.2f}",
        flush=True,
    )
    return float(ours.z), float(ours.error / max(abs(differences.mean()), abs(gradients.mean())))


def hold_both_modes(cell: Mean, spp: int) -> None:
    """Assert that the mean gradient is the difference, and that forward mode with ``spp`` samples is its transpose."""
    z, error = in_expectation(cell)
    assert abs(z) < Z_LIMIT and error < RESOLUTION
    with opened(cell) as objective:
        same = integrator(cell)
        assert objective.transpose_error(same, same, 1, spp) < TRANSPOSE_MAX


@pytest.mark.slow
@pytest.mark.parametrize("cell", MEANS, ids=lambda c: c.name)
def test_mean_gradients_are_mean_differences(cell: Mean) -> None:
    z, error = in_expectation(cell)
    assert abs(z) < Z_LIMIT and error < RESOLUTION


# ------------------------------ Media ------------------------------


def alone(light: str = "spot", kind: str = "grey") -> dict:
    """A box of fog without floor and ball: nothing in it has an outline."""
    scene = misty(light, kind)
    del scene["floor"], scene["ball"]
    return scene


IN_FOG = {"reference": "volpath", "peer": "prbvolpath", "depth": 4, "step": 3e-2, "spp": 512}
MOVES = {**IN_FOG, "peer": "pathreplay", "depth": 3}  # `prbvolpath` ends the process where a boundary moves
MIST = "mist.interior_medium"
SPOT, COLOURED, GRID = (partial(misty, "spot", kind) for kind in ("grey", "coloured", "grid"))
MEDIA = (
    mean("density", SPOT, f"{MIST}.sigma_t.value.value", add([1, 1, 1]), **IN_FOG),
    mean("density, coloured", COLOURED, f"{MIST}.sigma_t.value.value", add([1, 0.5, 0.2]), **IN_FOG),
    mean("density, grid", GRID, f"{MIST}.sigma_t.data", random(), **IN_FOG),
    mean(
        "density, hall",
        partial(misty, around="box"),
        "sensor.medium.sigma_t.value.value",
        add([1, 1, 1]),
        **{**IN_FOG, "spp": 2048},
    ),
    mean("albedo", SPOT, f"{MIST}.albedo.value.value", add([1, 0.5, 0.2]), **IN_FOG),
    mean("phase", COLOURED, f"{MIST}.phase_function.g", add(), **IN_FOG),
    mean("box grows", alone, "mist.vertex_positions", scale, **MOVES),
    mean("point moves", partial(alone, "point", "coloured"), "light.position", add([0.3, 0.5, 0.7]), **MOVES),
    mean("spot moves", partial(alone, "spot", "grid"), "light.to_world", translate(0.3, 0.5, 0.7), **MOVES),
    mean("camera moves", partial(alone, kind="coloured"), "sensor.to_world", translate(0.3, 0.5, 0.7), **MOVES),
)
SPLIT = (
    mean("milk", milky, "ball.interior_medium.sigma_t.value.value", add([1, 1, 1]), **IN_FOG),
    mean("air", milky, "mist.interior_medium.sigma_t.value.value", add([1, 1, 1]), **IN_FOG),
)


def test_the_density_of_fog_is_in_the_gradient() -> None:
    z, error = in_expectation(replace(MEDIA[0], peer=PLUGIN, seeds=4, spp=256))  # no kernels of a peer
    assert abs(z) < Z_LIMIT and error < RESOLUTION


@pytest.mark.slow
@pytest.mark.parametrize("cell", MEDIA, ids=lambda c: c.name)
def test_gradients_in_media_are_differences_of_volpath(cell: Mean) -> None:
    hold_both_modes(cell, 16)


@pytest.mark.slow
@pytest.mark.parametrize("cell", SPLIT, ids=lambda c: c.name)
def test_gradients_of_caustics_in_media_are_differences_of_volpath(cell: Mean) -> None:
    z, error = in_expectation(replace(cell, options={"caustics": "particles"}), "pathreplay")
    assert abs(z) < Z_LIMIT and error < RESOLUTION


# ------------------------------ Edges ------------------------------


def with_ball(center: list[float], radius: float, bsdf: dict, **parts: dict) -> dict:
    """The slab that casts a caustic, and a ball."""
    ball = {"type": "sphere", "center": center, "radius": radius, "bsdf": bsdf}
    return {**slab(), **parts, "ball": ball}


def lens() -> dict:
    """A ball of glass in the light, in place of the slab."""
    scene = with_ball([0, 0, 0], 0.3, {"type": "dielectric"})
    del scene["top"], scene["bottom"]
    return scene


def lit_by(light: str, center: list[float] = [0.1, 0.1, -1.0], **more: dict) -> dict:  # noqa: B006 (only read)
    """The floor and a black ball under a light, without the slab."""
    T = mi.ScalarTransform4f
    look = T().look_at([0.3, 0.2, 1.2], [0, 0, -2], [0, 1, 0])
    lights = {
        "point": {"type": "point", "position": [0.3, 0.2, 0.5], "intensity": rgb(9, 7, 5)},
        "spot": {"type": "spot", "to_world": look, "cutoff_angle": 30.0, "intensity": rgb(30, 25, 20)},
        "area": {
            "type": "rectangle", "to_world": look @ T().scale(0.3),
            "emitter": {"type": "area", "radiance": rgb(14, 11, 8)},
        },
        "directional": {"type": "directional", "direction": [0.2, 0.1, -1], "irradiance": rgb(3, 2, 1)},
        "beam": {
            "type": "rectangle", "to_world": look @ T().scale(0.8),
            "emitter": {"type": "directionalarea", "radiance": rgb(3, 2, 1)},
        },
    }  # fmt: skip
    scene = with_ball(center, 0.25, BLACK, light=lights[light], **more)
    del scene["top"], scene["bottom"]
    return scene


def sideways_eye(kind: str) -> dict:
    """The camera of `slab`, of another kind."""
    return sensor(kind, look=mi.ScalarTransform4f().look_at([2.4, 0, -0.8], [0, 0, -2], [0, 0, 1]))


def sideways_meter() -> dict:
    """An irradiance meter above the floor, from which the ball hides a part of the floor."""
    T = mi.ScalarTransform4f
    place = T().look_at([1.2, 0, -0.6], [0, 0, -2], [0, 1, 0]) @ T().scale(0.2)
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    return {"type": "rectangle", "to_world": place, "meter": {"type": "irradiancemeter", "film": film}}


def floor_of_plastic() -> dict:
    """The floor of `slab`, of plastic so dark that nearly half of the samples are reflected."""
    return {**slab()["floor"], "bsdf": {"type": "plastic", "diffuse_reflectance": rgb(0.05, 0.06, 0.04)}}


def small_floor() -> dict:
    """The slab, and a floor whose border the light meets."""
    T = mi.ScalarTransform4f
    scene = slab()
    scene["floor"]["to_world"] = T().translate([0, 0, -2]) @ T().scale(0.5)
    return scene


def cube_in_light() -> dict:
    """A turned cube in the light of a lamp."""
    T = mi.ScalarTransform4f
    turned = T().translate([0.1, 0.1, -1]) @ T().rotate([1, 1, 0], 40) @ T().scale(0.18)
    return {**lit_by("point"), "ball": {"type": "cube", "to_world": turned, "bsdf": BLACK}}


def shift(value: Any, t: Any) -> Any:
    """All vertices of a mesh, moved sideways."""
    sideways = np.tile(np.float32([0.3, 0.7, 0]), len(np.array(value)) // 3)
    return value + t * mi.Float(sideways)


BLACK = {"type": "diffuse", "reflectance": 0.0}
SIDEWAYS = translate(0.3, 0.7, 0)
BEFORE_EYE = [1.2, 0.05, -1.35]
in_caustic, before_eye = (partial(with_ball, center, 0.12, BLACK) for center in ([0.1, 0.1, -1.2], BEFORE_EYE))
edge: Callable[..., Mean] = partial(mean, spp=1024, step=2e-2, options={"boundary": "all"})
ball: Callable[..., Mean] = partial(edge, key="ball.to_world", move=SIDEWAYS, depth=6, **OWN)
behind: Callable[..., Mean] = partial(edge, depth=4, step=1e-2, **OWN)  # the slab
once: Callable[..., Mean] = partial(edge, key="ball.to_world", move=SIDEWAYS, depth=2)
BLOCKERS = (
    ball("blocker in the caustic", in_caustic),
    ball("blocker before the slab", partial(with_ball, [0.1, 0.1, 1.2], 0.12, BLACK), step=1e-2),
    ball("blocker before the camera", before_eye),
)
EDGES = (
    *BLOCKERS,
    behind("index, blocker", in_caustic, "top.bsdf.eta", add(), step=2e-2),
    behind("heights, blocker", in_caustic, "top.vertex_positions", waves),
    behind("spot, blocker", in_caustic, "light.to_world", translate(0.3, 0, 0.1)),
    behind("camera, blocker", before_eye, "sensor.to_world", translate(0.3, 0.7, 0.2)),
    behind("border of the floor", small_floor, "floor.to_world", SIDEWAYS),
    once("ball, point", partial(lit_by, "point")),
    once("ball, spot", partial(lit_by, "spot")),
    once("ball, area", partial(lit_by, "area")),
    once("ball, directional", partial(lit_by, "directional")),
    once("ball, beam", partial(lit_by, "beam"), **OWN),
    once("cube, point", cube_in_light, key="ball.vertex_positions", move=shift),
    once(
        "ball, orthographic",
        partial(lit_by, "spot", BEFORE_EYE, sensor=sideways_eye("orthographic")),
        peer="prb",
        **OWN,
    ),
    once("ball, thin lens", partial(lit_by, "spot", BEFORE_EYE, sensor=sideways_eye("thinlens")), spp=4096),
    once("ball, two lamps", partial(lit_by, "point", lamp=lit_by("area")["light"])),
    once("ball, meter", partial(lit_by, "point", sensor=sideways_meter()), spp=2**17, **OWN),
    once("ball, point, plastic", partial(lit_by, "point", floor=floor_of_plastic()), **OWN),
    once("area moves", partial(lit_by, "area"), key="light.to_world", move=translate(0.3, 0.5, 0.2)),
    once("floor moves", partial(lit_by, "point", [0.1, 0.1, -1.9]), key="floor.to_world", move=translate(0, 0, 0.5)),
)
GRAZED = ball("outline of a glass ball", lens)


def foggy(light: str = "point", kind: str = "grey", center: tuple[float, float, float] = (-0.3, 1.0, 0.1)) -> dict:
    """`misty` with a small black ball as an occluder, in place of the rough one."""
    scene = misty(light, kind)
    scene["ball"] = round_mesh(80, 0.2, center, BLACK)
    return scene


def in_smoke(make: Callable[[], dict]) -> dict:
    """A scene in endless smoke, which does not scatter."""
    scene = make()
    scene["smoke"] = {"type": "homogeneous", "sigma_t": rgb(0.1, 0.2, 0.3), "albedo": 0.0}
    scene["sensor"]["medium"] = {"type": "ref", "id": "smoke"}
    return scene


BETWEEN = (0.0, 1.9, -0.9)
"""A place between the box of fog and the camera."""
in_fog: Callable[..., Mean] = partial(
    mean, key="ball.vertex_positions", move=shift, depth=2, reference="volpath", peer="pathreplay", spp=2048,
    step=2e-2, options={"boundary": "all"},
)  # fmt: skip
FOG_EDGES = (
    in_fog("ball, point", foggy),
    in_fog("ball, spot, coloured", partial(foggy, "spot", "coloured")),
    in_fog("ball, area, grid", partial(foggy, "area", "grid")),
    in_fog("ball, directional", partial(foggy, "directional")),
    in_fog("ball before the camera", partial(foggy, center=BETWEEN)),
    in_fog("light moves", foggy, key="light.position", move=add([0.3, 0.5, 0.7])),
    in_fog("camera moves", foggy, key="sensor.to_world", move=translate(0.3, 0.5, 0.7)),
)
IN_SMOKE = (
    ball("blocker in the caustic", partial(in_smoke, in_caustic), peer="pathreplay"),
    ball("blocker before the camera", partial(in_smoke, before_eye), peer="pathreplay"),
)


def test_a_shadow_in_the_light_is_in_the_gradient() -> None:
    (cell,) = (c for c in EDGES if c.name == "floor moves")
    z, error = in_expectation(replace(cell, peer=PLUGIN, seeds=4, spp=128))
    assert abs(z) < Z_LIMIT and error < RESOLUTION


@pytest.mark.slow
@pytest.mark.parametrize("cell", EDGES, ids=lambda c: c.name)
def test_edges_that_light_meets_are_in_the_gradient(cell: Mean) -> None:
    hold_both_modes(cell, cell.spp // 16)


@pytest.mark.slow
@pytest.mark.parametrize("cell", (*FOG_EDGES, *IN_SMOKE), ids=lambda c: c.name)
def test_edges_in_fog_are_in_the_gradient(cell: Mean) -> None:
    hold_both_modes(cell, cell.spp // 16)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "largest"), [("ball, point", 0.03), ("ball, directional", RESOLUTION), ("light moves", RESOLUTION)]
)
def test_beams_that_vertices_see_in_fog_are_in_the_gradient(name: str, largest: float) -> None:
    """Of camera paths with up to four segments. The first gradient resolves the beams, which are 12 % of it."""
    (cell,) = (c for c in FOG_EDGES if c.name == name)
    z, error = in_expectation(replace(cell, depth=4, peer=PLUGIN), "pathreplay")
    assert abs(z) < Z_LIMIT and error < largest


def test_an_occluder_before_fog_is_in_the_gradient() -> None:
    (cell,) = (c for c in FOG_EDGES if c.name == "ball before the camera")
    z, error = in_expectation(replace(cell, peer=PLUGIN, seeds=4, spp=1024))  # no kernels of a peer
    assert abs(z) < Z_LIMIT and error < RESOLUTION


@pytest.mark.slow
@pytest.mark.parametrize("cell", BLOCKERS, ids=lambda c: c.name)
def test_edges_of_caustics_and_of_all_other_light_add_up(cell: Mean) -> None:
    """Camera paths see the blocker before the floor, and light paths see it in the caustic."""
    split = replace(cell, reference="pathreplay", options={"boundary": "all", "caustics": "particles"})
    z, error = in_expectation(split, "pathreplay")
    assert abs(z) < Z_LIMIT and error < RESOLUTION


@pytest.mark.slow
def test_the_outline_of_smooth_glass_is_no_edge() -> None:
    """Light that grazes glass is reflected forwards, so that it continues as if it had missed the glass."""
    z, _ = in_expectation(GRAZED)
    assert abs(z) < Z_LIMIT


# ------------------------------ Other variants ------------------------------


VARIANTS = """
import json, sys
sys.path[:0] = sys.argv[2:]
from pathreplay.platform.backend import set_variant
set_variant(sys.argv[1])
from test_particle_gradients import BY_NAME, EDGES, MEANS_BY_NAME, in_expectation, same_seed
print()
print(json.dumps({
    "same": [same_seed(BY_NAME[name], BY_NAME[name].spp) for name in
             ("heights, mirror", "receiver", "thin lens", "x_fov", "point", "area", "power")],
    "mean": [in_expectation(MEANS_BY_NAME[name]) for name in ("index, slab", "roughness")] + [
        in_expectation(cell) for cell in EDGES if cell.name in ("floor moves", "heights, blocker")],
}))
"""


@pytest.mark.slow
@pytest.mark.parametrize("variant", [MONO, SPECTRAL])
def test_other_variants_have_the_same_gradients(run_python: Callable[..., Any], variant: str) -> None:
    folders = [str(ROOT / "tests" / "particles"), str(SUPPORT), str(ROOT / "tests")]
    done = run_python(VARIANTS, args=(variant, *folders))
    assert done.returncode == 0, done.stderr[-3000:]
    print(done.stdout)
    values = json.loads(next(line for line in done.stdout.splitlines() if line.startswith("{")))  # log lines may follow
    assert len(values["same"]) == 7 and len(values["mean"]) == 4
    for error, transpose in values["same"]:
        assert error < SAME_SEED_MAX and transpose < TRANSPOSE_MAX, values
    for z, error in values["mean"]:
        assert abs(z) < Z_LIMIT and error < RESOLUTION, values


def test_a_rectangle_light_grows_once() -> None:
    """Whether or not a mesh light deforms: Mitsuba calls a rectangle a mesh, but differentiates its area."""
    T, glow = mi.ScalarTransform4f(), {"type": "area", "radiance": 5.0}
    scene = mi.load_dict(
        {
            "type": "scene",
            "floor": {"type": "rectangle", "to_world": T.scale(2)},
            "panel": {
                "type": "rectangle",
                "to_world": T.translate([0, 0, 2]).rotate([1, 0, 0], 180).scale(0.4),
                "emitter": glow,
            },
            "box": {"type": "cube", "to_world": T.translate([3, 0, 2]).scale(0.2), "emitter": glow},
            "eye": {
                "type": "perspective",
                "to_world": T.look_at([0, -4, 3], [0, 0, 0], [0, 0, 1]),
                "film": {"type": "hdrfilm", "width": 8, "height": 8, "pixel_format": "rgb"},
            },
        },
        optimize=False,
    )
    params, found = mi.traverse(scene), []
    first = mi.Transform4f(params["panel.to_world"])
    integrator = mi.load_dict({"type": "pathreplay_particles", "max_depth": 2, "boundary": "none"})
    for deforms in (False, True):
        t = mi.Float(0)
        dr.enable_grad(t)
        params["panel.to_world"] = first @ mi.Transform4f().scale(1 + t)
        if deforms:
            dr.enable_grad(params[f"box.{compat.positions_name()}"])
        params.update()
        dr.backward(dr.mean(mi.render(scene, params, integrator=integrator, spp=64, seed=1), axis=None))
        found.append(np.array(dr.grad(t))[0])
    assert found[0] > 0 and found[1] == pytest.approx(found[0], rel=1e-3)
    dr.disable_grad(dict(params))  # a scene with gradients that stays alive disturbs other scenes
    params["panel.to_world"] = first
    params.set_dirty(f"box.{compat.positions_name()}")
    params.update()
