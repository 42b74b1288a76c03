"""The surface of a density grid, and its scene for plain Mitsuba."""

from __future__ import annotations

import json
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from pathreplay.errors import PathreplayError
from pathreplay.jobs import make_config
from pathreplay.output.surface_scene import _cameras, _placed, emitting_mesh, surface_xml
from pathreplay.output.surfaces import surface
from pathreplay.runs.run_folder import Job

N = 24


def ball(radius: float) -> np.ndarray:
    """Radius minus the distance from the middle of the grid, which is not at its centre."""
    z, y, x = np.meshgrid(*(np.arange(n) for n in (N + 4, N + 2, N)), indexing="ij")
    return radius - np.sqrt((x - 11) ** 2 + (y - 12) ** 2 + (z - 14) ** 2)


def test_surface_of_a_ball() -> None:
    points, triangles = surface(ball(8.0) + 20, 20.0)
    distances = np.linalg.norm(points - [11, 12, 14], axis=1)
    assert np.abs(distances - 8).max() < 0.25
    a, b, c = (points[triangles[:, k]] for k in range(3))
    outward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a - [11, 12, 14])
    assert (outward > -1e-9).all()
    volume = np.einsum("ij,ij->i", np.cross(a, b), c).sum() / 6
    assert volume == pytest.approx(4 / 3 * np.pi * 8**3, rel=0.03)


def test_surface_is_closed_where_the_grid_ends() -> None:
    points, triangles = surface(np.ones((2, 3, 4)), 0.5)
    sides = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert (np.unique(sides, axis=0, return_counts=True)[1] == 2).all()
    assert points.min() == pytest.approx(-0.5)


def test_nothing_above_the_level() -> None:
    points, triangles = surface(np.zeros((3, 3, 3)), 0.5)
    assert len(points) == len(triangles) == 0


def test_a_scene_with_two_media_is_told(tmp_path: Path) -> None:
    job = {"scene": "room.xml", "parameters": [{"key": "a"}], "target": {"images": ["a.exr"]}}
    shape = '<shape type="sphere"><medium type="homogeneous" name="interior"/></shape>'
    (tmp_path / "room.xml").write_text(f'<scene version="3.0.0">{2 * shape}</scene>')
    with pytest.raises(PathreplayError, match=r"has 2 shapes .* of exactly one; .* with: pathreplay export 'a run'"):
        _placed(Path("a run"), Job(make_config(job), None, tmp_path))


def test_cameras_have_the_poses_that_the_run_recovered(tmp_path: Path) -> None:
    frames = [
        {"file_path": f"{name}.png", "transform_matrix": np.eye(4).tolist(), "w": 8, "h": 8, "fl_x": 9.0}
        for name in ("left", "right")
    ]
    for frame in frames:
        mi.Bitmap(np.zeros((8, 8, 3), np.uint8)).write(str(tmp_path / str(frame["file_path"])))
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_model": "PINHOLE", "frames": frames}))
    table = {"scene": "room.xml", "parameters": [{"key": "a"}], "capture": {"transforms": "transforms.json"}}
    job = Job(make_config(table), None, tmp_path)
    moved = np.float32([[0, 0, 1, 3], [0, 1, 0, 2], [-1, 0, 0, 1], [0, 0, 0, 1]])
    before, after = (_cameras(job, values) for values in ({}, {"right.to_world": moved}))
    np.testing.assert_array_equal(after[1]["to_world"].matrix, moved)
    np.testing.assert_array_equal(after[0]["to_world"].matrix, before[0]["to_world"].matrix)


def test_mitsuba_renders_the_radiance(tmp_path: Path) -> None:
    """`path` sees the colours of the front of a ball whose radiance depends on x, and black beside it."""
    density = 100 * np.clip(ball(8.0) + 0.5, 0, 1)
    x = np.arange(N) / N
    radiance = np.broadcast_to(np.stack([x, 0.2 + 0 * x, 1 - x], axis=-1), (*density.shape, 3))
    size = np.array([N, N + 2, N + 4]) / N
    mesh = emitting_mesh(density, radiance.astype(np.float32), np.zeros(3), size)
    mesh.write_ply(str(tmp_path / "surface.ply"))
    middle = (np.array([11, 12, 14]) + 0.5) / N
    eye = (middle + np.array([0, 0, 3])).tolist()
    camera = {
        "id": "front", "fov": 30.0, "near_clip": 1e-3, "far_clip": 1e5, "principal_point_offset_x": 0.0,
        "principal_point_offset_y": 0.0, "film": {"width": 33, "height": 33},
        "to_world": mi.ScalarTransform4f().look_at(eye, middle.tolist(), [0, 1, 0]),
    }  # fmt: skip
    (tmp_path / "scene.xml").write_text(surface_xml([camera], False))
    scene = mi.load_file(str(tmp_path / "scene.xml"))
    image = np.array(mi.render(scene, integrator=mi.load_dict({"type": "path", "max_depth": 1}), spp=64))
    np.testing.assert_allclose(image[16, 16], [11 / N, 0.2, 1 - 11 / N], atol=0.03)
    assert image[0, 0].max() == 0
    assert abs(image[16, 20, 0] - image[16, 12, 0]) > 0.1
