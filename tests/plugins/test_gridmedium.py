"""`gridmedium`: bounds, flights and transmittances against the grid, renders against Mitsuba's `heterogeneous`.

The medium gets its grid through every layout that a `gridvolume` can have; density and transmittance are then looked
up in the volume, which shares nothing with the bounds. Statistical tests ask for |z| < 4 with independent seeds.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from pathreplay.plugins import grid_traversal
from pathreplay.testing.statistics import gap
from pathreplay.testing.verdict import Z_LIMIT
from variant import MONO, SPECTRAL

RAYS = 1 << 12
T = mi.ScalarTransform4f

#: How a grid may be looked up and where it may lie.
LAYOUTS: dict[str, dict[str, Any]] = {
    "trilinear": {},
    "nearest": {"filter_type": "nearest"},
    "repeat": {"wrap_mode": "repeat"},
    "turned": {"to_world": T().translate([2, -1, 0]).rotate([0.6, 0, 0.8], 40).scale([1, 2, 0.5])},
    "turned, repeat": {"wrap_mode": "repeat", "to_world": T().rotate([0.6, 0, 0.8], 40)},
    "turned, mirror, nearest": {
        "wrap_mode": "mirror",
        "filter_type": "nearest",
        "to_world": T().rotate([0, 0.6, 0.8], 70),
    },
    "flipped, far away": {"to_world": T().translate([1000, 0, 3]).rotate([1, 0, 0], 90).scale([-1, 2, 3])},
}


def smooth(n: int = 16) -> np.ndarray:
    z, y, x = (np.mgrid[0:n, 0:n, 0:n] + 0.5) / n
    r = np.sqrt((x - 0.5) ** 2 + (y - 0.5) ** 2 + (z - 0.5) ** 2)
    return np.clip(1 - r / 0.48, 0, 1) * (1 + 0.4 * np.sin(9 * x + 2 * y) * np.cos(7 * z))


def spikes() -> np.ndarray:
    """Few dense voxels in a grid whose sizes are no multiples of the cell's."""
    values = np.random.default_rng(1).random((26, 18, 31))
    return np.where(values > 0.998, values, 0)


def sparse(n: int = 32) -> np.ndarray:
    grid = np.zeros((n, n, n))
    grid[2:6, 20:25, 9:12] = 1
    grid[20:24, 3:6, 25:30] = 0.5
    return grid


def tensor(values: np.ndarray) -> mi.TensorXf:
    return mi.TensorXf(np.asarray(values if values.ndim == 4 else values[..., None], dtype=np.float32))


def medium_dict(values: np.ndarray, scale: float = 1, kind: str = "gridmedium", **extra: Any) -> dict[str, Any]:
    layout = extra.pop("layout", {})
    volume = {"type": "gridvolume", "data": tensor(values), **layout}
    return {"type": kind, "sigma_t": volume, "scale": scale, **extra}


def medium(values: np.ndarray, scale: float = 1, **extra: Any) -> Any:
    return mi.load_dict(medium_dict(values, scale, **extra))


def at(p: Any) -> Any:
    mei = dr.zeros(mi.MediumInteraction3f)
    mei.p = p
    return mei


def density(grid: Any, p: Any) -> np.ndarray:
    return np.array(grid.get_scattering_coefficients(at(p))[2])


def points_in_box(grid: Any, n: int, seed: int, beyond: float = 0) -> np.ndarray:
    low, high = np.array(grid.box.min).ravel(), np.array(grid.box.max).ravel()
    margin = beyond * (high - low)
    return np.random.default_rng(seed).uniform(low - margin, high + margin, (n, 3)).T.astype(np.float32)


def probe_rays(grid: Any, n: int = RAYS) -> Any:
    """Rays from in and around the medium; one in eight along an axis, some from cell faces, a third with no end."""
    rng = np.random.default_rng(2)
    o, target = points_in_box(grid, n, 3, beyond=0.3), points_in_box(grid, n, 4)
    d = target - o
    axis = rng.integers(0, 3, n // 8)
    d[:, : n // 8] = 0
    d[axis, np.arange(n // 8)] = rng.choice([-1, 1], n // 8)
    o[:, n // 16 : n // 8] = target[:, n // 16 : n // 8]
    cells = grid.flight_cells
    world = np.linalg.inv(np.vstack([cells.to_cell, [0, 0, 0, 1]]))
    nodes = rng.integers(1, np.array(cells.shape)[:, None], (3, n // 8))
    o[:, n // 8 : n // 4] = world[:3, :3] @ nodes + world[:3, 3:]
    length = np.linalg.norm(d, axis=0)
    ray = mi.Ray3f(mi.Point3f(o), mi.Vector3f(d / length))
    ray.maxt = mi.Float(np.where(rng.random(n) < 0.3, np.inf, 1.5 * length * rng.random(n)).astype(np.float32))
    return ray


# ---------------------------------------------- bounds and free flight ----------------------------------------------


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
@pytest.mark.parametrize("channels", [1, 3])
def test_no_density_lies_outside_of_its_cell_bounds(layout: dict[str, Any], channels: int) -> None:
    values = np.stack([spikes(), spikes()[::-1], spikes()[:, ::-1]], axis=-1)[..., :channels]
    grid = medium(values, layout=layout)
    assert len(grid.levels) > 2
    p = points_in_box(grid, 1 << 16, 5)
    found = density(grid, mi.Point3f(p))
    for level in grid.levels:
        cells = grid_traversal.make_cells(level, [level.lowest, level.highest])
        place = mi.Vector3f(np.floor(cells.to_cell[:, :3] @ p + cells.to_cell[:, 3:]))
        low, high = np.array(cells.lookup(mi.Vector2f, place, True))
        assert (found <= high * (1 + 1e-5) + 1e-6).all()
        assert (found >= low * (1 - 1e-5) - 1e-6).all()


def test_bounds_are_tight_where_the_grid_is_empty() -> None:
    finest, *_, single = medium(sparse()).levels
    assert finest.shape == (8, 8, 8) and single.is_single
    highest = np.array(finest.highest).reshape(8, 8, 8)
    # Voxels 2..5 along z, and one more on either side for the interpolation, reach into the cells 0 and 1 of 4 voxels.
    assert highest[:2, 5, 2].tolist() == [1, 1] and highest[2, 5, 2] == 0
    assert highest.mean() < 0.1


def crossed(cells: Any, box: Any, o: np.ndarray, d: np.ndarray, stop: float) -> float:
    """∫ m ds up to a distance, of one ray: all distances at which a face of any cell is crossed, sorted."""
    rates = np.array(cells.table).reshape(cells.shape[::-1])
    low, high = np.array(box.min).ravel(), np.array(box.max).ravel()
    o_cell, d_cell = cells.to_cell[:, :3] @ o + cells.to_cell[:, 3], cells.to_cell[:, :3] @ d
    with np.errstate(divide="ignore", invalid="ignore"):
        faces = [(np.arange(n + 1) - a) / b for n, a, b in zip(cells.shape, o_cell, d_cell, strict=True)]
        faces += [(low - o) / d, (high - o) / d]
    cuts = np.concatenate(faces)
    cuts = np.sort(np.concatenate([[0, min(stop, 1e4)], cuts[np.isfinite(cuts) & (cuts > 0) & (cuts < stop)]]))
    middle = (cuts[1:] + cuts[:-1]) / 2
    where = o[:, None] + d[:, None] * middle
    inside = ((where >= low[:, None]) & (where <= high[:, None])).all(axis=0)
    index = np.floor(cells.to_cell[:, :3] @ where + cells.to_cell[:, 3:]).astype(int)
    index = np.clip(index, 0, np.array(cells.shape)[:, None] - 1)
    return float((np.diff(cuts) * rates[index[2], index[1], index[0]] * inside).sum())


@pytest.mark.parametrize("supergrid", [True, False])
@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
def test_free_flight_covers_the_optical_depth_that_was_drawn(layout: dict[str, Any], supergrid: bool) -> None:
    grid = medium(spikes(), 300, layout=layout, supergrid=supergrid)
    assert grid.flight_cells.is_single != supergrid
    ray = probe_rays(grid)
    u = np.random.default_rng(6).random(RAYS).astype(np.float32)
    u[:4] = [0, 0, np.nextafter(np.float32(1), np.float32(0)), 0.5]
    t, m = grid.free_flight(ray, mi.Float(u), mi.Mask(True))
    t, m, end = np.array(t), np.array(m), np.array(ray.maxt)
    assert not np.isnan(t).any() and not np.isnan(m).any()
    o, d = np.array(ray.o, dtype=np.float64), np.array(ray.d, dtype=np.float64)
    hit = np.isfinite(t)
    assert 0.2 < hit.mean() < 0.95
    assert (m[~hit] == 0).all() and (t[hit] < end[hit]).all()
    # Distances in float32 are as good as the coordinates.
    slack = 4e-7 * np.abs(np.array([grid.box.min, grid.box.max])).max() * np.array(grid.majorant)[0]
    off = 0
    for i in range(0, RAYS, 8):
        drawn = -np.log(1 - np.float64(u[i]))
        depth = crossed(grid.flight_cells, grid.box, o[:, i], d[:, i], t[i] if hit[i] else end[i])
        error = abs(depth - drawn) if hit[i] else max(depth - drawn, 0)
        off += error > 1e-3 * (1 + drawn) + slack
    # A ray that runs in a face between two cells may take either.
    assert off <= RAYS // 8 * 0.01
    here = density(grid, ray(mi.Float(np.where(hit, t, 0))))
    assert (here[:, hit] <= m[hit] * (1 + 1e-5)).all()


def test_cells_are_found_whose_index_exceeds_single_precision() -> None:
    shape = (260, 260, 260)
    marked = 1 + dr.arange(mi.UInt32, 8) + 260 * (258 + 260 * 258)
    table = dr.zeros(mi.Float, 260**3)
    dr.scatter(table, mi.Float(dr.arange(mi.UInt32, 8)), marked)
    cells = grid_traversal.Cells(np.eye(3, 4), shape, table)
    cell = mi.Vector3f(1 + dr.arange(mi.Float, 8), 258, 258)
    assert dr.all(cells.lookup(mi.Float, cell, mi.Bool(True)) == dr.arange(mi.Float, 8))


def test_free_flight_ends_for_any_ray() -> None:
    grid = medium(sparse(), 40, supergrid=True)
    nodes = np.linspace(-0.25, 1.25, 13)
    odd = [0.0, -0.0, 1e-30, -1e-30, 1.0, -1.0, 1e-7]
    o = np.array(np.meshgrid(nodes, nodes, nodes)).reshape(3, -1)
    d = np.array([v for v in np.array(np.meshgrid(odd, odd, odd)).reshape(3, -1).T if np.abs(v).max() == 1]).T
    rays = mi.Ray3f(
        mi.Point3f(np.repeat(o, d.shape[1], axis=1).astype(np.float32)),
        mi.Vector3f(np.tile(d, o.shape[1]).astype(np.float32)),
    )
    t, m = grid.free_flight(rays, mi.Float(0.3), mi.Mask(True))
    t, m = np.array(t), np.array(m)
    assert not np.isnan(t).any() and (t >= 0).all() and np.isfinite(m).all()
    assert np.isfinite(t).any()
    nowhere, none = grid.free_flight(rays, mi.Float(0.3), mi.Mask(False))
    assert np.isinf(np.array(nowhere)).all() and not np.array(none).any()


@dr.syntax
def collide(grid: Any, ray: Any, sampler: Any) -> mi.Bool:
    """Whether delta tracking in a symbolic loop finds a real collision."""
    active, real = mi.Bool(True), mi.Bool(False)
    t = mi.Float(0)
    while dr.hint(active, exclude=[grid]):
        onward = mi.Ray3f(ray.o + t * ray.d, ray.d)
        onward.maxt = ray.maxt - t
        step, bar = grid.free_flight(onward, sampler.next_1d(active), active)
        t += step
        active &= dr.isfinite(t)
        here = grid.get_scattering_coefficients(at(ray.o + t * ray.d), active)[2][0]
        real |= active & (sampler.next_1d(active) * bar < here)
        active &= ~real
    return real


def test_collisions_in_a_loop_are_as_likely_as_the_transmittance_says() -> None:
    grid = medium(smooth(), 10, supergrid=True)
    ray = probe_rays(grid)
    truth = transmittance(grid, ray)[0]
    sampler = mi.load_dict({"type": "independent"})
    z = []
    for seed in range(8):
        sampler.seed(seed, RAYS)
        survived = 1 - np.array(mi.Float(collide(grid, ray, sampler)))
        z.append((survived - truth).sum() / np.sqrt((truth * (1 - truth)).sum()))
    assert 0.2 < truth.mean() < 0.9
    assert abs(np.sum(z)) / np.sqrt(len(z)) < Z_LIMIT


# -------------------------------------------------- transmittance ---------------------------------------------------


def transmittance(grid: Any, ray: Any, points: int = 1000) -> np.ndarray:
    """exp(-∫ σ_t ds) by the midpoint rule between the ends of the bounding box (channels x rays)."""
    a, b = grid_traversal.clip(grid.box, ray)
    h = dr.maximum(b - a, 0) / points

    def body(i: Any, depth: Any) -> tuple[Any, Any]:
        return i + 1, depth + h * grid.get_scattering_coefficients(at(ray(a + h * (i + 0.5))))[2]

    _, depth = dr.while_loop((mi.UInt32(0), mi.UnpolarizedSpectrum(0)), lambda i, _: i < points, body)
    return np.array(dr.exp(-depth))


CHROMATIC = smooth()[..., None] * [1, 0.2, 3]
MEDIA: dict[str, dict[str, Any]] = {
    "smooth": {"values": smooth(), "scale": 10},
    "smooth, dense": {"values": smooth(), "scale": 100},
    "smooth, one cell": {"values": smooth(), "scale": 3, "supergrid": False},
    "sparse": {"values": sparse(), "scale": 30},
    "uniform": {"values": np.ones((8, 8, 8)), "scale": 3},
    "chromatic": {"values": CHROMATIC, "scale": 5},
    "nearest, turned": {"values": spikes(), "scale": 100, "layout": LAYOUTS["turned, mirror, nearest"]},
    "nothing": {"values": np.zeros((8, 8, 8)), "scale": 3},
    "scale 0": {"values": smooth(), "scale": 0},
}


@pytest.mark.parametrize("case", MEDIA.values(), ids=MEDIA)
def test_transmittance_is_unbiased(case: dict[str, Any]) -> None:
    grid = medium(**case)
    check_transmittance(grid)


def test_transmittance_is_unbiased_without_a_grid() -> None:
    grid = mi.load_dict({"type": "gridmedium", "sigma_t": {"type": "rgb", "value": [1, 0.5, 2]}, "scale": 2})
    assert grid.is_chromatic
    check_transmittance(grid)


def check_transmittance(grid: Any) -> None:
    ray = probe_rays(grid)
    truth = transmittance(grid, ray)
    sampler = mi.load_dict({"type": "independent"})
    means = []
    for seed in range(16):
        sampler.seed(seed, RAYS)
        found = np.array(grid.transmittance(ray, sampler, mi.Mask(True)))
        assert np.isfinite(found).all()
        means.append((found - truth).mean(axis=1))
    # Quadrature is good for 1e-4.
    wrong = gap(np.array(means), np.zeros(len(truth)))
    assert ((np.abs(wrong.z) < Z_LIMIT) | (np.abs(wrong.value) < 1e-4)).all(), wrong


def test_transmittance_of_a_uniform_medium_has_no_noise() -> None:
    grid = medium(np.full((8, 8, 8), 2.0), 3)
    ray = probe_rays(grid)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, RAYS)
    np.testing.assert_allclose(np.array(grid.transmittance(ray, sampler)), transmittance(grid, ray), atol=2e-5)


def test_an_edge_in_a_dense_medium_makes_no_outliers() -> None:
    """Rays that graze a dense half inside of cells that hold both: with the mean as control they reach e^50."""
    values = np.zeros((64, 64, 64))
    values[..., :30] = 1
    grid = medium(values, 200)
    x = 31 / 64 + np.random.default_rng(0).random(RAYS) * 0.01
    ray = mi.Ray3f(mi.Point3f(x.astype(np.float32), 0.5, -1), mi.Vector3f(0, 0, 1))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, RAYS)
    found = np.array(grid.transmittance(ray, sampler))[0]
    # The variance is at most exp(RISK · 16 cells) - 1 = 4. With the mean as control nearly all estimates are 0.
    assert found.std() < 2.5
    assert abs(found.mean() - 1) < 0.2


def test_faint_transmittance_is_unbiased() -> None:
    """All of the estimates here are below the threshold from which they go on by chance only."""
    grid = medium(np.random.default_rng(0).random((16, 16, 16)), 14)
    start = np.random.default_rng(1).random((2, RAYS)).astype(np.float32)
    ray = mi.Ray3f(mi.Point3f(start[0], start[1], -1), mi.Vector3f(0, 0, 1))
    truth = transmittance(grid, ray)[0]
    assert truth.mean() < grid_traversal.FAINT / 3
    sampler = mi.load_dict({"type": "independent"})
    means = []
    for seed in range(16):
        sampler.seed(seed, RAYS)
        means.append((np.array(grid.transmittance(ray, sampler))[0] - truth).mean())
    wrong = gap(means)
    assert wrong.error < 0.05 * truth.mean()
    assert abs(wrong.z) < Z_LIMIT


# --------------------------------------- the same as Mitsuba's heterogeneous ----------------------------------------


def cube_scene(*media: dict[str, Any]) -> mi.Scene:
    """One unit cube of medium after the other along x, in constant light and that of a lamp above."""
    scene: dict[str, Any] = {
        "type": "scene",
        "sky": {"type": "constant"},
        "lamp": {"type": "point", "position": [0.5, 0.5, 4], "intensity": 20.0},
        "camera": {
            "type": "perspective",
            "fov": 40,
            "to_world": T().look_at([0.5, -3, 0.8], [0.5 * len(media), 0.5, 0.5], [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}},
        },
    }
    for i, inside in enumerate(media):
        to_world = T().translate([i, 0, 0])
        volume = {**inside["sigma_t"], "to_world": to_world}
        scene[f"cube{i}"] = {
            "type": "cube",
            "to_world": to_world.translate(0.5).scale(0.499),
            "bsdf": {"type": "null"},
            "interior": {**inside, "sigma_t": volume},
        }
    return mi.load_dict(scene, optimize=False)


def render(scene: mi.Scene, integrator: str = "volpath", spp: int = 8, params: Any = None) -> Any:
    method = mi.load_dict({"type": integrator, "max_depth": 8})
    return mi.render(scene, params, integrator=method, spp=spp, seed=1)


@pytest.mark.parametrize("integrator", ["volpath", "volpathmis", "prbvolpath"])
@pytest.mark.parametrize("values", [smooth(), CHROMATIC], ids=["grey", "chromatic"])
def test_mitsuba_renders_it_like_heterogeneous(integrator: str, values: np.ndarray) -> None:
    ours = cube_scene(medium_dict(values, 8, albedo=0.8))
    theirs = cube_scene(medium_dict(values, 8, "heterogeneous", albedo=0.8, has_spectral_extinction=values.ndim == 4))
    image = np.array(render(ours, integrator))
    assert image.std() > 0.01
    np.testing.assert_allclose(image, np.array(render(theirs, integrator)), rtol=1e-5)


def test_it_shares_a_scene_with_other_media() -> None:
    first, second = medium_dict(smooth(), 8, albedo=0.8), medium_dict(smooth(8), 5, albedo=0.5)
    flag = {"has_spectral_extinction": False}
    mixed = cube_scene(first, {**second, "type": "heterogeneous", **flag})
    theirs = cube_scene(*({**m, "type": "heterogeneous", **flag} for m in (first, second)))
    both = cube_scene(first, second)
    reference = np.array(render(theirs, "prbvolpath"))
    for scene in (mixed, both):
        np.testing.assert_allclose(np.array(render(scene, "prbvolpath")), reference, rtol=1e-5)


def test_gradients_of_the_coefficients_are_those_of_heterogeneous() -> None:
    keys = ["cube0.interior_medium.sigma_t.data", "cube0.interior_medium.albedo.value.value"]
    found = {}
    for kind in ("gridmedium", "heterogeneous"):
        extra = {} if kind == "gridmedium" else {"has_spectral_extinction": False}
        scene = cube_scene(medium_dict(smooth(), 8, kind, albedo=0.8, **extra))
        params = mi.traverse(scene)
        wanted = keys + (["cube0.interior_medium.scale"] if kind == "gridmedium" else [])
        for key in wanted:
            dr.enable_grad(params[key])
        params.update()
        dr.backward(dr.mean(render(scene, "prbvolpath", params=params)))
        found[kind] = [np.array(dr.grad(params[key])).ravel() for key in wanted]
        del scene, params
    for ours, theirs in zip(found["gridmedium"], found["heterogeneous"], strict=False):
        assert np.abs(theirs).max() > 0
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-5 * np.abs(theirs).max())
    # σ_t = s V, so that s dL/ds = V · dL/dV.
    by_voxel = (found["gridmedium"][0] * smooth().ravel()).sum()
    np.testing.assert_allclose(8 * found["gridmedium"][2][0], by_voxel, rtol=1e-3)


# ---------------------------------------------------- parameters ----------------------------------------------------


def test_the_scene_hands_out_the_instance_itself() -> None:
    scene = cube_scene(medium_dict(smooth(), 8))
    found = scene.shapes()[0].interior_medium()
    assert type(found).__name__ == "GridMedium" and callable(found.free_flight)


def test_updates_and_new_resolutions_reach_everything() -> None:
    scene = cube_scene(medium_dict(smooth(), 8, albedo=0.8))
    params = mi.traverse(scene)
    grid = scene.shapes()[0].interior_medium()
    params["cube0.interior_medium.sigma_t.data"] = tensor(sparse())
    params["cube0.interior_medium.scale"] = 50.0
    params.update()
    assert np.array(grid.majorant)[0] == 50
    fresh = cube_scene(medium_dict(sparse(), 50, albedo=0.8))
    np.testing.assert_array_equal(np.array(render(scene)), np.array(render(fresh)))
    again = fresh.shapes()[0].interior_medium()
    for ours, theirs in ((grid.flight_cells, again.flight_cells), (grid.shadow_cells, again.shadow_cells)):
        assert ours.shape == theirs.shape
        np.testing.assert_array_equal(np.array(ours.table), np.array(theirs.table))


def test_the_scale_alone_can_be_updated() -> None:
    grid = medium(smooth(), 2, supergrid=True)
    params = mi.traverse(grid)
    params["scale"] = 30.0
    params.update()
    fresh = medium(smooth(), 30, supergrid=True)
    for ours, theirs in ((grid.flight_cells, fresh.flight_cells), (grid.shadow_cells, fresh.shadow_cells)):
        np.testing.assert_array_equal(np.array(ours.table), np.array(theirs.table))
    np.testing.assert_allclose(np.array(grid.majorant), 30 * smooth().max(), rtol=1e-6)


def test_only_the_coefficients_follow_the_parameters() -> None:
    grid = medium(smooth(), 20, supergrid=True, emission=0.5)
    params = mi.traverse(grid)
    for key in ("sigma_t.data", "scale", "emission.value.value"):
        dr.enable_grad(params[key])
    params["sigma_t.data"] = params["sigma_t.data"] * 2
    params.update()
    np.testing.assert_allclose(np.array(grid.majorant), 40 * smooth().max(), rtol=1e-6)
    assert not dr.grad_enabled(grid.majorant, grid.flight_cells.table, grid.shadow_cells.table)
    here = at(mi.Point3f(0.4, 0.5, 0.6))
    assert all(dr.grad_enabled(value) for value in grid.get_scattering_coefficients(here))
    assert dr.grad_enabled(grid.emission_at(here))
    ray = mi.Ray3f([0.1, 0.5, 0.6], [1, 0, 0])
    dr.enable_grad(ray.o)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, 1)
    assert not dr.grad_enabled(grid.free_flight(ray, mi.Float(0.5)), grid.transmittance(ray, sampler))


def test_densities_below_zero_never_collide() -> None:
    grid = medium(smooth(), 20, supergrid=True)
    params = mi.traverse(grid)
    params["sigma_t.data"] = params["sigma_t.data"] - 5
    params.update()
    t, _ = grid.free_flight(probe_rays(grid), mi.Float(0.9))
    assert np.isinf(np.array(t)).all()


def test_emission_is_radiance_per_length_and_not_scaled() -> None:
    assert medium(smooth(), 8).emission is None
    grid = medium(smooth(), 8, emission={"type": "rgb", "value": [0.2, 0.4, 3]})
    np.testing.assert_allclose(np.array(grid.emission_at(at(mi.Point3f(0.5)))).ravel(), [0.2, 0.4, 3], rtol=1e-6)
    assert "emission.value.value" in mi.traverse(grid)


def test_emission_by_extinction() -> None:
    grid = medium(smooth(), 8, radiance={"type": "rgb", "value": [0.2, 0.4, 3]})
    assert grid.emission_per_extinction
    np.testing.assert_allclose(np.array(grid.emission_at(at(mi.Point3f(0.5)))).ravel(), [0.2, 0.4, 3], rtol=1e-6)
    assert "radiance.value.value" in mi.traverse(grid)
    with pytest.raises(Exception, match="PathreplayError: gridmedium: emission and radiance are both given"):
        medium(smooth(), 8, radiance=0.5, emission=0.5)


@pytest.mark.parametrize(
    ("values", "scale", "pays"),
    [
        (sparse(64), 100, True),
        (smooth(64), 100, True),
        (sparse(64), 0.3, False),
        (np.ones((64, 64, 64)), 100, False),
        (np.random.default_rng(0).random((64, 64, 64)), 100, False),
    ],
    ids=["sparse", "cloud", "thin", "uniform", "noise"],
)
def test_the_supergrid_is_used_where_it_pays(values: np.ndarray, scale: float, pays: bool) -> None:
    assert medium(values, scale).flight_cells.is_single != pays


# -------------------------------------------- bad input, other variants ---------------------------------------------


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        ({"scale": -1.0}, "gridmedium: scale is -1.0; give a finite number, at least 0"),
        ({"supergrid": "maybe"}, "gridmedium: supergrid is 'maybe'; use true, false or 'auto'"),
        ({"albedo": "grey"}, "gridmedium: albedo is 'grey'; give a volume, a colour or a number"),
        (
            {"sigma_t": 2.0, "supergrid": True},
            "gridmedium: sigma_t \\(ConstVolume\\) has no accessible voxels; give a gridvolume",
        ),
        ({"values": -smooth()}, "gridmedium: sigma_t is -1\\.\\d+ somewhere; give densities of at least 0"),
        ({"values": np.ones((2, 2, 2, 6))}, "gridmedium: sigma_t has 6 channels; give a grid with 1 or 3"),
        (
            {"phase": {"type": "sggx", "S": {"type": "gridvolume", "data": tensor(np.ones((2, 2, 2, 6)))}}},
            "gridmedium: with the phase function SGGXPhaseFunction the density depends on the direction",
        ),
    ],
    ids=lambda value: "" if isinstance(value, str) else next(iter(value)),
)
def test_mistakes_are_told_in_one_line(extra: dict[str, Any], message: str) -> None:
    with pytest.raises(Exception, match=f"PathreplayError: {message}"):
        mi.load_dict({**medium_dict(extra.pop("values", smooth())), **extra})


OTHER_VARIANT = """
import sys
from pathreplay.platform.backend import set_variant
set_variant(sys.argv[1])
import drjit as dr, mitsuba as mi, numpy as np
values = np.random.default_rng(0).random((9, 9, 9, 3)).astype(np.float32)
def image(kind):
    volume = {"type": "gridvolume", "grid": mi.VolumeGrid(values)}
    cube = {"type": "cube", "to_world": mi.ScalarTransform4f().translate(0.5).scale(0.5), "bsdf": {"type": "null"},
            "interior": {"type": kind, "sigma_t": volume, "scale": 4.0}}
    camera = {"type": "perspective", "to_world": mi.ScalarTransform4f().look_at([0.5, -2, 0.5], [0.5] * 3, [0, 0, 1]),
              "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}}
    scene = mi.load_dict({"type": "scene", "sky": {"type": "constant"}, "cube": cube, "camera": camera})
    return scene, np.array(mi.render(scene, integrator=mi.load_dict({"type": "volpath"}), spp=8, seed=1))
scene, ours = image("gridmedium")
np.testing.assert_allclose(ours, image("heterogeneous")[1], rtol=1e-4)
grid = scene.shapes()[0].interior_medium()
assert grid.is_chromatic == (not mi.is_monochromatic)
n, points = 1 << 12, 100
sampler = mi.load_dict({"type": "independent"})
sampler.seed(0, n)
ray = mi.Ray3f(mi.Point3f(sampler.next_1d(), sampler.next_1d(), -1), mi.Vector3f(0, 0, 1))
if mi.is_spectral:
    ray.wavelengths = type(ray.wavelengths)(450, 500, 550, 600)
at = dr.zeros(mi.MediumInteraction3f, n * points)
along = (dr.arange(mi.UInt32, n * points) % points + 0.5) / points
at.p = mi.Point3f(dr.repeat(ray.o.x, points), dr.repeat(ray.o.y, points), along)
at.wavelengths = dr.repeat(ray.wavelengths, points) if dr.width(ray.wavelengths) > 1 else ray.wavelengths
coefficients = np.array(grid.get_scattering_coefficients(at)[2])
truth = np.exp(-coefficients.reshape(-1, n, points).mean(axis=2))
error = np.array(grid.transmittance(ray, sampler)) - truth
z = error.mean(axis=1) / error.std(axis=1) * np.sqrt(n)
assert (np.abs(z) < 4).all(), z
t, m = grid.free_flight(ray, sampler.next_1d())
assert np.isfinite(np.array(t)).any() and not np.isnan(np.array(m)).any()
print("fine")
"""


@pytest.mark.parametrize("variant", [SPECTRAL, MONO])
def test_other_variants(run_python: Any, variant: str) -> None:
    done = run_python(OTHER_VARIANT, args=(variant,))
    assert "fine" in done.stdout, done.stderr  # Mitsuba colours its log, at either end


COLOUR = """
import sys
from pathreplay.platform.backend import set_variant
set_variant(sys.argv[1])
import drjit as dr, mitsuba as mi, numpy as np
at = dr.zeros(mi.MediumInteraction3f, 471)
at.wavelengths = type(at.wavelengths)(dr.linspace(mi.Float, 360, 830, 471))
for value in ([0.9, 0.02, 0.02], [0.02, 0.9, 0.02], [0.1, 0.2, 0.9], [3, 0.1, 1]):
    medium = mi.load_dict({"type": "gridmedium", "sigma_t": {"type": "rgb", "value": value}, "scale": 2.0})
    largest = np.max(medium.get_scattering_coefficients(at)[2])
    assert largest <= medium.majorant[0] < 1.02 * largest, (value, medium.majorant, largest)
medium = mi.load_dict({"type": "gridmedium", "sigma_t": 0.7})
assert abs(medium.majorant[0] - 0.7) < 1e-6, medium.majorant
print("fine")
"""


def test_the_majorant_of_a_colour_bounds_its_spectrum(run_python: Any) -> None:
    done = run_python(COLOUR, args=(SPECTRAL,))
    assert "fine" in done.stdout, done.stderr
