"""A height map over a mesh: positions follow the definition, gradients are those of finite differences, jobs work."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import safetensors.numpy

import pathreplay
from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.parameter_options import Displace
from pathreplay.inverse.images.io import exr_bytes
from pathreplay.inverse.objective.evaluate import Evaluator, Shard
from pathreplay.inverse.parameters.displace import displacement_of
from pathreplay.inverse.problem.problem import Problem, build_problem, put_values
from pathreplay.jobs import make_config, optimize
from pathreplay.output.export import export_run
from pathreplay.scenes.bodies import ball, mesh

N = 7  # vertices of the sheet along each side
SHEET = "Sheet.vertex_positions"


def sheet(n: int = N) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, faces and texture coordinates of a curved sheet of n x n vertices that faces +z."""
    v, u = np.meshgrid(*[np.linspace(0, 1, n)] * 2, indexing="ij")
    x, y = 2 * u.ravel() - 1, 2 * v.ravel() - 1
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([i, i + 1, i + n + 1], 1), np.stack([i, i + n + 1, i + n], 1)])
    return np.stack([x, y, 0.2 * x * y], 1), faces, np.stack([u.ravel(), v.ravel()], 1)


def write_sheet(path: Path, n: int = N, weights: np.ndarray | None = None, coordinates: bool = True) -> None:
    points, faces, uv = sheet(n)
    made = mi.Mesh("sheet", len(points), len(faces), has_vertex_normals=True, has_vertex_texcoords=coordinates)
    params = mi.traverse(made)
    params["vertex_positions"], params["faces"] = points.ravel().astype(np.float32), faces.ravel().astype(np.uint32)
    if coordinates:
        params["vertex_texcoords"] = uv.ravel().astype(np.float32)
    params.update()
    if weights is not None:
        made.add_attribute("vertex_weight", 1, weights.astype(np.float32))
    made.write_ply(str(path))


# The sheet fills the picture of a camera; a lamp near it shades it, so that the picture depends on slopes and heights.
SCENE = """<scene version="3.0.0">
  <sensor type="perspective" id="camera"><float name="fov" value="30"/>
    <transform name="to_world"><lookat origin="0.1,-0.2,2.2" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="14"/><integer name="height" value="14"/>
      <string name="pixel_format" value="rgb"/><rfilter type="box"/></film></sensor>
  <shape type="ply" id="Sheet"><string name="filename" value="sheet.ply"/>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.8,0.6,0.4"/></bsdf></shape>
  <emitter type="point" id="lamp"><point name="position" x="0.9" y="0.5" z="1"/>
    <rgb name="intensity" value="2"/></emitter>
</scene>"""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.xml").write_text(SCENE)
    write_sheet(tmp_path / "sheet.ply")
    return tmp_path


def job(shape: tuple[int, int], parameter: Any = None, displace: Any = None, **more: Any) -> Any:
    return {
        "scene": "scene.xml",
        "integrator": {"type": "pathreplay", "max_depth": 2, "boundary": "none"},
        "spp": 64,
        "eval_spp": 16,
        "iterations": 4,
        "learning_rate": 0.01,
        "deterministic": True,
        "parameters": [{"key": "heights", "shape": [*shape, 1], **(parameter or {})}],
        "derived": [{"key": SHEET, "displace": displace or {}, "of": ["heights"]}],
        "target": {"scene": "scene.xml", "spp": 256, "integrator": {"type": "path", "max_depth": 2}},
        **more,
    }


def problem_of(*args: Any, **more: Any) -> Problem:
    return build_problem(make_config(job(*args, **more)), Path.cwd())


# ------------------------------ Positions ------------------------------


def linear(grid: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Between centres of cells; constant beyond them."""
    rows, columns = grid.shape
    y, x = np.clip(v * rows - 0.5, 0, rows - 1), np.clip(u * columns - 0.5, 0, columns - 1)
    i, j = np.floor(y).astype(int), np.floor(x).astype(int)
    k, l = np.minimum(i + 1, rows - 1), np.minimum(j + 1, columns - 1)
    a, b = y - i, x - j
    return (1 - a) * ((1 - b) * grid[i, j] + b * grid[i, l]) + a * ((1 - b) * grid[k, j] + b * grid[k, l])


def cubic(grid: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Of uniform cubic B-splines, whose control points are the entries at the centres of cells."""

    def basis(t: np.ndarray) -> np.ndarray:
        t = np.abs(t)
        return np.where(t < 1, 2 / 3 - t**2 + t**3 / 2, np.where(t < 2, (2 - t) ** 3 / 6, 0))

    rows, columns = grid.shape
    y, x = v * rows - 0.5, u * columns - 0.5
    total = np.zeros_like(u)
    for i in range(-2, rows + 2):
        for j in range(-2, columns + 2):
            entry = grid[np.clip(i, 0, rows - 1), np.clip(j, 0, columns - 1)]
            total += entry * basis(y - i) * basis(x - j)
    return total


@pytest.mark.parametrize("shape", [(1, 1), (3, 5), (N, N), (20, 16)], ids=str)
@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_positions_are_those_of_the_map(shape: tuple[int, int], interpolation: str) -> None:
    heights = np.random.default_rng(1).uniform(-0.3, 0.3, (*shape, 1)).astype(np.float32)
    problem = problem_of(shape, displace={"direction": [0, 0, 2], "interpolation": interpolation})
    put_values(problem, {"heights": heights})
    points, _, uv = sheet()
    expected = points.copy()
    expected[:, 2] += {"linear": linear, "cubic": cubic}[interpolation](heights[..., 0], *uv.T)
    found = np.array(problem.params[SHEET]).reshape(-1, 3)
    np.testing.assert_allclose(found, expected, atol=3e-6)


def test_row_0_is_where_it_is_in_a_texture() -> None:
    heights = np.random.default_rng(1).uniform(size=(4, 5, 1)).astype(np.float32)
    uv = sheet()[2]
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(heights), "raw": True, "wrap_mode": "clamp"}
    si = dr.zeros(mi.SurfaceInteraction3f, len(uv))
    si.uv = mi.Point2f(*uv.T.astype(np.float32))
    np.testing.assert_allclose(mi.load_dict(texture).eval_1(si), linear(heights[..., 0], *uv.T), atol=1e-6)


def test_planar_coordinates_span_the_mesh() -> None:
    write_sheet(Path("sheet.ply"), coordinates=False)
    heights = np.random.default_rng(2).uniform(0, 0.2, (4, 6, 1)).astype(np.float32)
    problem = problem_of((4, 6), displace={"direction": [1, 0, 1], "coordinates": "yx"})
    put_values(problem, {"heights": heights})
    points, _, uv = sheet()
    expected = points + linear(heights[..., 0], uv[:, 1], uv[:, 0])[:, None] * np.array([1, 0, 1]) / np.sqrt(2)
    np.testing.assert_allclose(np.array(problem.params[SHEET]).reshape(-1, 3), expected, atol=3e-6)


def test_attributes_of_the_mesh_are_factors() -> None:
    factors = (np.arange(N * N) % 3).astype(np.float32)
    write_sheet(Path("sheet.ply"), weights=factors)
    problem = problem_of((2, 2), displace={"direction": [0, 0, 1], "weights": "vertex_weight"})
    put_values(problem, {"heights": np.full((2, 2, 1), 0.1, np.float32)})
    moved = np.array(problem.params[SHEET]).reshape(-1, 3) - sheet()[0]
    np.testing.assert_allclose(moved[:, 2], 0.1 * factors, atol=1e-6)


def test_several_maps_add_up() -> None:
    """Each by its own attribute, and of its own size."""
    write_sheet(Path("sheet.ply"))
    points, uv = sheet()[0], sheet()[2]
    random = np.random.default_rng(7)
    scene = mi.load_file("scene.xml")
    weights = {f"vertex_{name}": random.uniform(-1, 1, N * N).astype(np.float32) for name in ("first", "second")}
    for name, values in weights.items():
        scene.shapes()[0].add_attribute(name, 1, values)
    params = mi.traverse(scene)
    place = displacement_of(params, SHEET, Displace(direction=[0, 0, 1], weights=list(weights)))
    maps = [random.uniform(0, 0.2, shape).astype(np.float32) for shape in ((4, 3, 1), (5, 6, 1))]
    found = np.array(place(params[SHEET], *map(mi.TensorXf, maps))).reshape(-1, 3)
    expected = points.copy()
    expected[:, 2] += sum(w * linear(h[..., 0], *uv.T) for w, h in zip(weights.values(), maps, strict=True))
    np.testing.assert_allclose(found, expected, atol=1e-6)


def displaced(points: np.ndarray, faces: np.ndarray, heights: np.ndarray, options: dict[str, Any]) -> np.ndarray:
    """Positions of a mesh without texture coordinates whose faces share no vertex."""
    scene = mi.load_dict({"type": "scene", "body": mesh(points, faces, {"type": "diffuse"})})
    params, key = mi.traverse(scene), "body.vertex_positions"
    found = displacement_of(params, key, Displace(**options))(params[key], mi.TensorXf(heights))
    return np.array(found).reshape(-1, 3)


def test_a_mesh_stays_closed_where_vertices_are_doubled() -> None:
    """Each face of a ball has vertices of its own, and its neighbours' normals move them along."""
    vertices, faces = ball(2)
    points, soup = vertices[faces.ravel()], np.arange(faces.size).reshape(-1, 3)
    heights = np.random.default_rng(3).uniform(-0.2, 0.2, (5, 4, 1)).astype(np.float32)
    found = displaced(points, soup, heights, {"coordinates": "xy"}).reshape(-1, 3, 3)
    one_by_vertex = np.zeros_like(vertices)
    one_by_vertex[faces.ravel()] = found.reshape(-1, 3)
    np.testing.assert_array_equal(one_by_vertex[faces], found)
    # Normals of a ball go outwards, and so heights are changes of the radius.
    change = np.linalg.norm(one_by_vertex, axis=1) - 1
    uv = (vertices[:, :2] + 1) / 2
    np.testing.assert_allclose(change, linear(heights[..., 0], *uv.T), atol=2e-3)


def test_doubled_vertices_move_by_the_mean() -> None:
    """As at a seam, where one position has two places on the map."""
    write_sheet(Path("sheet.ply"))
    scene = mi.load_file("scene.xml")
    params = mi.traverse(scene)
    points = sheet()[0].copy()
    points[1] = points[0]
    params[SHEET] = mi.Float(points.ravel().astype(np.float32))
    params.update()
    heights = np.random.default_rng(4).uniform(0, 0.5, (N, 2 * N)).astype(np.float32)
    place = displacement_of(params, SHEET, Displace(direction=[0, 0, 1]))
    grid = mi.TensorXf(heights[..., None])
    dr.enable_grad(grid)
    found = place(params[SHEET], grid)
    moved = np.array(dr.detach(found)).reshape(-1, 3)[:, 2] - points[:, 2]
    expected = linear(heights, *sheet()[2].T)
    np.testing.assert_allclose(moved[:2], expected[:2].mean(), atol=1e-6)
    np.testing.assert_allclose(moved[2:], expected[2:], atol=1e-6)
    by_position = np.random.default_rng(5).normal(size=(N * N, 3)).astype(np.float32)
    dr.backward(dr.sum(found * mi.Float(by_position.ravel())))
    step = np.random.default_rng(6).normal(size=heights.shape)
    along = linear(heights + step, *sheet()[2].T) - expected
    along[:2] = along[:2].mean()
    assert np.sum(np.array(dr.grad(grid))[..., 0] * step) == pytest.approx(np.sum(along * by_position[:, 2]), rel=1e-4)


# ------------------------------ Gradients ------------------------------


def loss_at(scene: mi.Scene, target: np.ndarray, put: Callable[[], None]) -> float:
    """Of two renderings, so that the square of their noise is not in it."""
    put()
    path = mi.load_dict({"type": "path", "max_depth": 2})
    a, b = (np.array(mi.render(scene, integrator=path, spp=2048, seed=seed), np.float64) for seed in (1, 2))
    return float(np.mean((a - target) * (b - target)))


def along(heights: np.ndarray) -> np.ndarray:
    return np.random.default_rng(9).normal(size=heights.shape).astype(np.float32)


COLOUR = "Sheet.bsdf.reflectance.value"
#: Far from what the start looks like, so that the gradient is large.
DARKER = {"scene": "scene.xml", "values": {COLOUR: 0.2}, "spp": 256}
GRADIENTS = {
    "coarse, along normals": ((3, 4), {}),
    "as the mesh": ((N, N), {"direction": [0.2, 0, 1]}),
    "fine": ((20, 24), {"direction": [0, 0, 1]}),
    "cubic": ((3, 3), {"interpolation": "cubic"}),
}


@pytest.mark.parametrize("name", GRADIENTS)
@pytest.mark.parametrize("interface", ["job", "library"])
def test_gradients_are_those_of_finite_differences(name: str, interface: str) -> None:
    """Along one direction: central differences of Mitsuba's path tracer."""
    shape, displace = GRADIENTS[name]
    start = (0.02 * np.random.default_rng(8).normal(size=(*shape, 1))).astype(np.float32)
    if interface == "job":
        Path("start.exr").write_bytes(exr_bytes(start))
        problem = problem_of(shape, {"initial": "start.exr"}, displace, target=DARKER)
        found = [
            Evaluator(problem, problem.integrator, record=False)({"heights": start}, Shard((0,), 64, (s,)), {})
            for s in range(8)
        ]
        gradients = [each.gradients["heights"] for each in found]
    else:
        scene = mi.load_file("scene.xml")
        params = mi.traverse(scene)
        params[COLOUR] = mi.Color3f(0.2)
        params.update()
        path = mi.load_dict({"type": "path", "max_depth": 2})
        target = np.array(mi.render(scene, integrator=path, spp=256), np.float32)
        library = pathreplay.Problem(
            mi.load_file("scene.xml"),
            {"heights": pathreplay.Parameter(initial=start, shape=start.shape)},
            pathreplay.View("camera", target),
            derived={SHEET: pathreplay.Derived(of=["heights"], displace=displace)},
            integrator={"type": "pathreplay", "max_depth": 2, "boundary": "none"},
            spp=64,
        )
        gradients = [pathreplay.value_and_grad(library)(library.initial, seed=s)[1]["heights"] for s in range(8)]
        problem = library.built
    np.testing.assert_array_equal(problem.variables[0].start, start)
    direction, h = along(start), 4e-3
    target = np.asarray(problem.views[0].target, np.float64)
    losses = [
        loss_at(problem.scene, target, lambda s=sign: put_values(problem, {"heights": start + s * h * direction}))
        for sign in (1, -1)
    ]
    expected = (losses[0] - losses[1]) / (2 * h)
    each = [float(np.sum(gradient * direction)) for gradient in gradients]
    error = np.std(each) / np.sqrt(len(each))
    assert error < 0.02 * abs(expected)
    assert np.mean(each) == pytest.approx(expected, abs=4 * error + 0.01 * abs(expected))


# ------------------------------ Runs ------------------------------


def bumps(shape: tuple[int, int]) -> np.ndarray:
    v, u = np.meshgrid(*((np.arange(n) + 0.5) / n for n in shape), indexing="ij")
    return (0.08 * np.sin(5 * u) * np.cos(4 * v))[..., None].astype(np.float32)


def test_a_run_finds_a_map_coarse_to_fine_and_exports_the_mesh() -> None:
    shape = (6, 6)
    problem = problem_of(shape, displace={"direction": [0, 0, 1]})
    put_values(problem, {"heights": bumps(shape)})
    image = np.array(mi.render(problem.scene, integrator=mi.load_dict({"type": "path", "max_depth": 2}), spp=512))
    Path("target.exr").write_bytes(exr_bytes(image.astype(np.float32)))
    levels = {"resolutions": [2, 6], "refine_at": [15], "pyramid": True, "lower": -0.1, "upper": 0.1}
    config = job(shape, levels, {"direction": [0, 0, 1]}, target={"images": ["target.exr"]}, iterations=60)
    config |= {"spp": 32, "deterministic": False, "output": "run"}
    result = optimize(make_config(config), progress=False)
    assert result.parameters["heights"].shape == (*shape, 1)
    assert np.abs(result.parameters["heights"]).max() <= np.float32(0.1)
    assert result.history[-1].loss < 0.02 * result.history[0].loss
    difference = result.parameters["heights"] - bumps(shape)
    assert np.std(difference) < 0.25 * np.std(bumps(shape))
    saved = safetensors.numpy.load_file("run/parameters.safetensors")
    assert {"heights", SHEET} <= set(saved)
    export_run(Path("run"))
    written = mi.load_dict({"type": "ply", "filename": next(map(str, Path("run/export/meshes").glob("*.ply")))})
    np.testing.assert_allclose(mi.traverse(written)["vertex_positions"], saved[SHEET].ravel(), atol=1e-6)
    np.testing.assert_array_equal(np.load("run/export/values/heights.npy"), saved["heights"])
    assert ">heights<" in Path("run/report.html").read_text()


def test_smooth_normals_follow() -> None:
    problem = problem_of((N, N), displace={"direction": [0, 0, 1]})
    params = mi.traverse(problem.scene)
    rest = np.array(params["Sheet.vertex_normals"])
    put_values(problem, {"heights": bumps((N, N))})
    points, faces, _ = sheet()
    points = np.array(problem.params[SHEET]).reshape(-1, 3)
    fresh = mi.traverse(mesh(points, faces, {"type": "diffuse"}))["vertex_normals"]
    now = np.array(mi.traverse(problem.scene)["Sheet.vertex_normals"])
    np.testing.assert_allclose(now, fresh, atol=1e-5)
    assert np.abs(now - rest).max() > 0.05


# ------------------------------ Refused ------------------------------


def of(**displace: Any) -> Callable[[], Any]:
    return lambda: job((3, 3), displace=displace)


def changed(**derived: Any) -> Callable[[], Any]:
    table = {"key": SHEET, "displace": {}, "of": ["heights"], **derived}
    kept = {name: value for name, value in table.items() if value is not None}
    return lambda: {**job((3, 3)), "derived": [kept]}


REFUSED: dict[str, tuple[Callable[[], Any], str]] = {
    "no coordinates": (of(), "has no texture coordinates, which place the height map; set displace.coordinates"),
    "no extent": (of(coordinates="xz"), "but the mesh has no extent along z; name two other axes"),
    "no direction": (of(direction=[0, 0, 0], coordinates="xy"), "give a vector that is not zero, or 'normal'"),
    "half a direction": (of(direction=[0, 1]), "'derived.0.displace.direction' is [0, 1]; write 'normal' or three"),
    "no attribute": (
        of(coordinates="xy", weights="vertex_w"),
        "displace.weights is 'vertex_w', but the mesh has no such attribute (it has: vertex_other); add it",
    ),
    "colours as weights": (of(coordinates="xy", weights="vertex_other"), "which has 147 numbers for 49 vertices"),
    "no mesh": (
        changed(key="Sheet.bsdf.reflectance.value"),
        "'Sheet.bsdf.reflectance.value' is not the vertex positions of a mesh; remove 'displace'",
    ),
    "both": (changed(function="own:f"), "has both 'function' and 'displace'; give one of them"),
    "neither": (changed(displace=None), "has neither 'function' nor 'displace'; give one of them"),
    "two maps": (changed(of=["heights", "more"]), "'of' names 2 height maps, but displace.weights names 1 attr"),
    "a map too few": (of(weights=["vertex_other"] * 2), "'of' names 1 height maps, but displace.weights names 2 a"),
    "no list": (of(weights=[]), "'derived.0.displace.weights'"),
    "no attribute of two": (
        changed(of=["heights", "heights"], displace={"coordinates": "xy", "weights": ["vertex_one", "vertex_w"]}),
        "displace.weights is 'vertex_one', but the mesh has no such attribute",
    ),
    "an unknown key": (of(along=[0, 0, 1]), "unknown key 'derived.0.displace.along'"),
    "no map": (
        lambda: {**job((3, 3), displace={"coordinates": "xy"}), "parameters": [{"key": "heights", "shape": [9]}]},
        "is displaced by 'heights' of shape [9]; give a height map of shape [rows, columns, 1]",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_is_told_in_one_line(name: str) -> None:
    make, told = REFUSED[name]
    points, faces, _ = sheet()
    flat = mesh(points * [1, 1, 0], faces, {"type": "diffuse"})
    flat.add_attribute("vertex_other", 3, np.ones(3 * N * N, np.float32))
    flat.write_ply("sheet.ply")
    with pytest.raises(PathreplayError) as caught:
        build_problem(make_config(make()), Path.cwd())
    line = str(caught.value)
    assert told in line and "\n" not in line, line
