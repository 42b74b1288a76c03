"""Slabs and mirrors that cast a caustic: slabs are closed however they are displaced, and light makes the picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import pathreplay
from pathreplay.inverse.config.parameter_options import Displace
from pathreplay.inverse.config.schema import load_config
from pathreplay.inverse.images.io import exr_bytes
from pathreplay.inverse.parameters.displace import displacement_of
from pathreplay.jobs import make_config, optimize
from pathreplay.output.export import export_run
from pathreplay.scenes.caustics import caustic_lens, caustic_mirror, slab
from pathreplay.scenes.loading import load_scene
from pathreplay.scenes.parameters import get_array

KEY = "lens.vertex_positions"
EXAMPLE = Path(__file__).parents[2] / "examples/caustic-lens/config.toml"


def volume_if_closed(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Volume of a mesh, of which each edge, by the positions of its ends, is passed once in each direction."""
    points, places = np.unique(vertices.reshape(-1, 3), axis=0, return_inverse=True)
    corners = places.ravel()[faces.reshape(-1, 3)]
    edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    assert (edges[:, 0] != edges[:, 1]).all()
    there, counts = np.unique(edges, axis=0, return_counts=True)
    assert (counts == 1).all()
    np.testing.assert_array_equal(there, np.unique(edges[:, ::-1], axis=0))
    a, b, c = (points[corners[:, i]].astype(np.float64) for i in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def lens_of(rows: int, columns: int, **options: float) -> tuple[mi.Scene, mi.SceneParameters]:
    scene = mi.load_dict(caustic_lens(columns, columns, rows, **options))
    return scene, mi.traverse(scene)


def put_heights(
    params: mi.SceneParameters, heights: np.ndarray, key: str = KEY, weights: str | None = "vertex_weight"
) -> None:
    place = displacement_of(params, key, Displace(direction=[0, 0, 1], weights=weights))
    params[key] = place(mi.Float(params[key]), mi.TensorXf(heights))
    params.update()


def test_the_slab_is_closed_and_flat_where_it_is_not_displaced() -> None:
    rows, columns, thickness = 5, 8, 0.2
    params = lens_of(rows, columns)[1]
    faces = np.array(params["lens.faces"])
    area = (columns - 1) * (rows - 1) / columns**2  # between the centres of the outer cells
    assert volume_if_closed(get_array(params[KEY]), faces) == pytest.approx(thickness * area, rel=1e-5)
    heights = np.random.default_rng(1).uniform(-0.05, 0.05, (rows, columns, 1)).astype(np.float32)
    rest = get_array(params[KEY]).reshape(-1, 3)
    put_heights(params, heights)
    points = get_array(params[KEY]).reshape(-1, 3)
    normals = get_array(params["lens.vertex_normals"]).reshape(-1, 3)
    low, upper = rest[:, 2] < 0, rows * columns
    np.testing.assert_array_equal(points[low], rest[low])
    assert np.unique(np.round(normals[low], 5), axis=0).shape == (5, 3)  # below and four sides
    np.testing.assert_allclose(points[:upper, 2], heights.ravel(), atol=1e-6)  # a vertex at each cell
    assert normals[:upper, 2].min() > 0.2 and np.ptp(normals[:upper, 2]) > 0.05
    h = heights[..., 0].astype(np.float64)
    corners = h[:-1, :-1], h[1:, 1:], h[:-1, 1:], h[1:, :-1]
    mean = np.mean((2 * corners[0] + 2 * corners[1] + corners[2] + corners[3]) / 6)  # of the two triangles of a cell
    assert volume_if_closed(points.ravel(), faces) == pytest.approx((thickness + mean) * area, rel=1e-4)


def picture(rows: int, columns: int) -> np.ndarray:
    """Another in each corner, so that it shows which way up it is."""
    v, u = np.meshgrid(*((np.arange(n) + 0.5) / n for n in (rows, columns)), indexing="ij")
    image = 0.3 + np.exp(-40 * ((u - 0.3) ** 2 + (v - 0.35) ** 2))
    image[: rows // 4, : columns // 3] = 0.05
    return image + 0.8 * (abs(u - 0.75) < 0.08) * (v > 0.5)


@pytest.mark.parametrize("key", ["vertex_weight", "vertex_entry_weight"])
def test_both_surfaces_of_a_slab_are_displaced(key: str) -> None:
    rows, columns, thickness = 5, 8, 0.2
    params = lens_of(rows, columns, two_surfaces=True)[1]
    faces = np.array(params["lens.faces"])
    rest = get_array(params[KEY]).reshape(-1, 3)
    assert volume_if_closed(rest, faces) == pytest.approx(thickness * (rows - 1) * (columns - 1) / columns**2, rel=1e-5)
    heights = np.random.default_rng(1).uniform(-0.05, 0.05, (rows, columns, 1)).astype(np.float32)
    put_heights(params, heights, weights=key)
    points = get_array(params[KEY]).reshape(-1, 3)
    moved = rest[:, 2] < 0 if key == "vertex_entry_weight" else rest[:, 2] == 0
    np.testing.assert_array_equal(points[~moved], rest[~moved])
    h, change = heights[..., 0], (points - rest)[moved]
    n = h.size  # the grid of the exit surface is the first, and that of the entry surface the last of the mesh
    np.testing.assert_allclose(change[-n:, 2] if key == "vertex_entry_weight" else change[:n, 2], h.ravel(), atol=1e-6)
    normals = get_array(params["lens.vertex_normals"]).reshape(-1, 3)
    smooth = normals[-n:, 2] if key == "vertex_entry_weight" else normals[:n, 2]
    assert np.ptp(smooth) > 0.05 and np.abs(smooth).min() > 0.2
    volume_if_closed(points, faces)


SETUPS: dict[str, tuple[Any, dict[str, float], dict[str, float]]] = {
    "lens": (caustic_lens, {}, {"eta": 1.5}),
    "wide image": (caustic_lens, {"receiver_width": 1.4}, {"eta": 1.5, "receiver_width": 1.4}),
    "point light": (caustic_lens, {"source_distance": 2.0}, {"eta": 1.5, "source_distance": 2.0, "thickness": 0.2}),
    "two surfaces": (caustic_lens, {"two_surfaces": True}, {"eta": 1.5}),
    "mirror": (caustic_mirror, {"angle": 40.0}, {"mirror_angle": 40.0}),
    "mirror and point light": (
        caustic_mirror, {"source_distance": 2.0}, {"mirror_angle": 30.0, "source_distance": 2.0}
    ),
}  # fmt: skip


QUICK = {"lens", "mirror"}


@pytest.mark.parametrize("name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in SETUPS])
def test_light_makes_the_picture(name: str) -> None:
    """By Mitsuba's particle tracer, which sees a caustic of collimated light."""
    rows, columns = 96, 128
    make, options, optics = SETUPS[name]
    scene = mi.load_dict(make(columns, columns, rows, **options))
    params = mi.traverse(scene)
    image = picture(rows, columns)

    def correlation() -> float:
        particles = mi.load_dict({"type": "ptracer", "max_depth": 4})
        found = np.array(mi.render(scene, integrator=particles, spp=96))[..., 0]
        return float(np.corrcoef(found.ravel(), image.ravel())[0, 1])

    flat = correlation()
    heights = pathreplay.caustic_heights(image, pathreplay.Optics(1.0, 1.5, **optics))
    lens = make is caustic_lens
    put_heights(params, heights, KEY if lens else "mirror.vertex_positions", "vertex_weight" if lens else None)
    assert correlation() > 0.95
    assert abs(flat) < 0.5


def test_a_run_of_the_example_exports_a_closed_lens(tmp_path: Path) -> None:
    """With an integrator that computes no caustics, and a coarse map: the start is what is exported."""
    config = load_config(EXAMPLE).model_dump(mode="json", exclude_unset=True)
    rows, columns = 25, 20
    config["scene_parameters"] = {"rows": rows, "columns": columns, "resolution": columns}
    config["parameters"][0]["shape"] = [rows, columns, 1]
    (tmp_path / "picture.exr").write_bytes(exr_bytes(picture(rows, columns)[..., None].astype(np.float32)))
    assert config["target"] == {"images": ["matplotlib:grace_hopper.jpg"]}
    config["target"] = {"images": [str(tmp_path / "picture.exr")]}
    config |= {
        "iterations": 1,
        "warmup_steps": 0,
        "spp": 1,
        "eval_spp": 1,
        "output": str(tmp_path / "run"),
        "loss": "l2",
    }
    config["integrator"] = {"type": "pathreplay", "max_depth": 2, "boundary": "none"}
    result = optimize(make_config(config), progress=False)
    assert result.parameters["heights"].std() > 0.005
    export_run(tmp_path / "run")
    file = tmp_path / "run/export/meshes/lens.ply"
    written = mi.traverse(mi.load_dict({"type": "ply", "filename": str(file)}))
    closed = volume_if_closed(get_array(written["vertex_positions"]), np.array(written["faces"]))
    assert closed == pytest.approx(0.2 * (rows - 1) * (columns - 1) / columns**2, rel=0.02)
    np.testing.assert_allclose(get_array(written["vertex_positions"]), result.parameters[KEY].ravel(), atol=1e-6)
    scene = mi.load_file(str(tmp_path / "run/export/scene.xml"))
    lens = next(shape for shape in scene.shapes() if shape.id() == "lens")
    assert lens.bsdf().class_name() == "SmoothDielectric"
    assert mi.traverse(lens.bsdf())["eta"] == pytest.approx(1.5)


def test_the_index_of_a_built_in_lens_has_a_derivative() -> None:
    """The scene contains a mesh with a loaded `dielectric`, which is replaced like one that a dictionary describes."""
    size = {"resolution": 8, "rows": 8, "columns": 8}
    view = pathreplay.View("camera", target=np.ones((8, 8, 1), np.float32))
    integrator = {"type": "pathreplay_particles", "max_depth": 4, "boundary": "none"}
    problem = pathreplay.Problem(
        "caustic-lens", ["lens.bsdf.eta"], view, scene_parameters=size, integrator=integrator, spp=16
    )
    assert problem.initial["lens.bsdf.eta"] == pytest.approx(1.5)
    gradient = pathreplay.value_and_grad(problem)()[1]["lens.bsdf.eta"]
    assert np.isfinite(gradient).all() and (gradient != 0).all()


def test_a_slab_takes_any_material() -> None:
    made = slab(3, 3, 2.0, 0.5, {"type": "dielectric_ad", "int_ior": 1.4})
    assert "bsdf.eta" in mi.traverse(made)
    assert volume_if_closed(get_array(mi.traverse(made)["vertex_positions"]), np.array(mi.traverse(made)["faces"]))


def test_a_slab_without_area_is_refused_in_one_line() -> None:
    with pytest.raises(pathreplay.PathreplayError, match="has 1 rows and 4 columns; give at least 2"):
        load_scene("caustic-lens", rows=1, columns=4)


@pytest.mark.parametrize(
    ("name", "arguments", "told"),
    [
        (
            "caustic-lens",
            {"distance": 0},
            "Parameter 'distance' of scene 'caustic-lens' is 0; give a number from 0.001",
        ),
        ("caustic-lens", {"eta": True}, "Parameter 'eta' of scene 'caustic-lens' is True; give a number from 0.001"),
        ("caustic-lens", {"source_distance": float("nan")}, "give a number from 0.001 to 1000"),
        ("caustic-lens", {"two_surfaces": 1}, "'two_surfaces' of scene 'caustic-lens' is 1; give true or false"),
        ("caustic-lens", {"rows": 4.0}, "Parameter 'rows' of scene 'caustic-lens' is 4.0; give a whole number above 0"),
        ("caustic-mirror", {"angle": 5}, "The angle of the mirror is 5; give 10 to 80 degrees"),
        ("caustic-mirror", {"rows": 1, "columns": 4}, "has 1 rows and 4 columns; give at least 2 of each"),
    ],
)
def test_wrong_arguments_are_refused_in_one_line(name: str, arguments: dict[str, Any], told: str) -> None:
    with pytest.raises(pathreplay.PathreplayError) as caught:
        load_scene(name, **arguments)
    assert told in str(caught.value) and "\n" not in str(caught.value)


def test_the_frame_lets_only_light_pass_that_reaches_the_exit_surface() -> None:
    """A flat slab: light of the point is on the receiver within the shadow of the exit surface, and fills it."""
    columns, source, distance = 16, 2.0, 1.5
    arguments = {"columns": columns, "rows": columns, "source_distance": source, "distance": distance}
    scene = mi.load_dict(caustic_lens(64, receiver_width=2.5, **arguments))
    found = np.array(mi.render(scene, integrator=mi.load_dict({"type": "ptracer", "max_depth": 4}), spp=256))[..., 0]
    # Behind the slab, light continues in the direction in which it has entered.
    half = (1 - 1 / columns) / 2
    sine = np.linspace(0, 0.5, 5001)
    tangent = sine / np.sqrt(1 - sine**2)
    reach = source * tangent + 0.2 * (sine / 1.5) / np.sqrt(1 - (sine / 1.5) ** 2)
    edge = half + distance * np.interp(half, reach, tangent)
    place = abs((np.arange(64) + 0.5) / 64 - 0.5) * 2.5
    inside, outside = place < edge - 0.08, place > edge + 0.08
    lit = found[np.ix_(inside, inside)]
    assert lit.min() > 0.5 * lit.mean() > 0
    assert found[outside].max() < 1e-3 * lit.mean() and found[:, outside].max() < 1e-3 * lit.mean()
