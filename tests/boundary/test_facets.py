"""Facts about the triangles of smooth meshes, on which the search for edges depends."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from pathreplay.integrators.scene_facts import facts_of
from pathreplay.testing.objective import Objective
from pathreplay.testing.stencil import CENTRAL
from truth import bitmap, camera, noise
from variant import VARIANT

SUN = {"type": "directional", "direction": [-1, 0.3, -1], "irradiance": 3.0}


def mesh(positions: np.ndarray, faces: np.ndarray, texcoords: np.ndarray, bsdf: dict) -> mi.Mesh:
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf)
    made = mi.Mesh("sheet", len(positions), len(faces), props, True, True)
    params = mi.traverse(made)
    params["vertex_positions"], params["faces"] = mi.Float(positions.ravel()), mi.UInt32(faces.ravel())
    params["vertex_texcoords"] = mi.Float(texcoords.ravel())
    params.update()
    return made


@pytest.mark.parametrize("boundary", ["primary", "auto"])
def test_tangents_that_jump_between_triangles_are_edges(boundary: str) -> None:
    """A normal map on a flat square, whose two triangles map texture coordinates differently."""
    mi.set_variant(VARIANT)
    square = np.array([[-3, -3, 0], [3, -3, 0], [3, 3, 0], [-3, 3, 0]])
    uv = np.array([[0, 0], [1, 0], [1, 1], [-0.5, 0.5]])
    normals = {"type": "bitmap", "data": mi.TensorXf(np.tile([0.95, 0.5, 0.85], (2, 2, 1))), "raw": True}
    relief = {"type": "normalmap", "normalmap": normals, "nested": {"type": "diffuse", "reflectance": 0.8}}
    sheet = mesh(square, np.array([[0, 1, 2], [0, 2, 3]]), uv, relief)
    scene = mi.load_dict({"type": "scene", "camera": camera(), "sheet": sheet, "sun": SUN}, optimize=False)
    params = mi.traverse(scene)
    key = next(key for key in params.keys() if key.endswith("vertex_positions"))
    slide = lambda value, t: value + t * dr.tile(mi.Float(1, 0, 0), 4)  # noqa: E731
    objective = Objective(scene, params, key, slide)
    plain = mi.load_dict({"type": "path", "max_depth": 2})
    image = mi.render(scene, integrator=plain, spp=1).numpy()
    objective.weigh(np.broadcast_to(np.linspace(0, 1, image.shape[1])[:, None], image.shape))
    ours = mi.load_dict({"type": "pathreplay", "max_depth": 2, "boundary": boundary})
    found = np.array([objective.backward(ours, seed, 64) for seed in range(6)])
    expected = objective.dot(objective.difference(plain, CENTRAL, 0.06, 1, 4096))
    objective.put(dr.opaque(mi.Float, 0))
    assert abs(expected) > 1e-3 and np.mean(found) == pytest.approx(expected, rel=0.05)


def test_tangents_that_turn_slowly_are_no_edges() -> None:
    """A normal map on a fine cylinder: the search would find all sides of its triangles, and little else."""
    mi.set_variant(VARIANT)
    n = 400
    angle, height = (axis.ravel() for axis in np.meshgrid(np.linspace(0, 2, n), np.linspace(0, 1, 3), indexing="ij"))
    i = np.array([3 * k + j for k in range(n - 1) for j in range(2)])
    faces = np.concatenate([np.stack([i, i + 3, i + 4], 1), np.stack([i, i + 4, i + 1], 1)])
    relief = {"type": "bumpmap", "arbitrary": bitmap(noise(4, 1, 0, 1)), "bsdf": {"type": "diffuse"}}
    positions = np.stack([np.cos(angle), np.sin(angle), height], 1)
    fine = mesh(positions, faces, np.stack([angle, height], 1), relief)
    scene = mi.load_dict({"type": "scene", "sheet": fine, "sun": SUN}, optimize=False)
    traits = facts_of(scene).traits()
    assert not traits.brushed_meshes and not traits.coarse_meshes


def test_a_flat_mesh_that_becomes_bumpy_is_coarse() -> None:
    mi.set_variant(VARIANT)
    n = 10
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n)))
    i = np.array([k * n + j for k in range(n - 1) for j in range(n - 1)])
    faces = np.concatenate([np.stack([i, i + 1, i + n + 1], 1), np.stack([i, i + n + 1, i + n], 1)])
    flat = mesh(np.stack([x, y, 0 * x], 1), faces, np.stack([x, y], 1), {"type": "diffuse"})
    scene = mi.load_dict({"type": "scene", "sheet": flat, "sun": SUN}, optimize=False)
    constants = facts_of(scene).constants()
    assert not facts_of(scene).traits().coarse_meshes
    params = mi.traverse(scene)
    key = next(key for key in params.keys() if key.endswith("vertex_positions"))
    heights = 0.3 * np.sin(4 * x) * np.sin(4 * y)
    for z, coarse in ((heights, True), (0 * x, False)):
        params[key] = mi.Float(np.stack([x, y, z], 1).ravel())
        params.update()
        assert facts_of(scene).traits().coarse_meshes == coarse
        assert (facts_of(scene).constants() == constants) == (not coarse)
