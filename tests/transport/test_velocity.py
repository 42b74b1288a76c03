"""Velocity of sampled directions: bounded where surfaces touch, and with the divergence that the weight has."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from pathreplay.integrators.scene_facts import facts_of
from pathreplay.transport.scatter import is_seen_through
from pathreplay.transport.velocity import BLEND, blend_length, blend_length_at, moved_direction

Vector = tuple[float, float, float]
UP: Vector = (0, 0, 1)
NONE: Vector = (0, 0, 0)
SIZE = 2 * 2**0.5


def directions(
    x: Vector, hits: list[Vector], move: Callable[[mi.Float], mi.Transform4f], n_x: Vector = UP, turn: Vector = NONE
) -> tuple[np.ndarray, ...]:
    """Derivatives of directions (3 x n) and of log J (n), and the directions from ``x`` to points of the wall x = 1.

    The wall moves, and the normal at ``x`` rotates.
    """
    wall = mi.ScalarTransform4f().translate([1, 0, 0]).rotate([0, 1, 0], -90)
    scene = mi.load_dict({"type": "scene", "wall": {"type": "rectangle", "to_world": wall}})
    params = mi.traverse(scene)
    t = mi.Float(0)
    dr.enable_grad(t)
    params["wall.to_world"] = move(t) @ mi.Transform4f(wall)
    params.update()
    d = dr.normalize(mi.Vector3f(np.array(hits, np.float32).T) - mi.Vector3f(x))
    origin = dr.zeros(mi.Interaction3f, len(hits))
    origin.p = mi.Point3f(x)
    origin.n = mi.Normal3f(n_x) + t * mi.Normal3f(dr.cross(mi.Vector3f(turn), mi.Vector3f(n_x)))
    hit = scene.ray_intersect_preliminary(dr.detach(origin).spawn_ray(d))
    moved, J = moved_direction(facts_of(scene).traits().tables.blend_lengths, origin, d, hit, mi.Bool(True))
    dr.forward(t)
    found = np.array(dr.grad(moved)), np.array(dr.grad(J)), np.array(d)
    params["wall.to_world"] = mi.Transform4f(wall)
    params.update()
    return found


def translated(motion: Vector) -> Callable[[mi.Float], mi.Transform4f]:
    return lambda t: mi.Transform4f().translate(t * mi.Vector3f(motion))


def test_the_weight_of_hits_close_to_the_plane_of_the_vertex_is_bounded() -> None:
    """The cosine at the vertex is proportional to the height k, so its relative derivative grows like 1/k."""
    hits = [(1, 0.2, k) for k in (1e-6, 1e-5, 1e-4, 1e-3)]

    def change(n_x: Vector) -> np.ndarray:
        δd, δlog_J, d = directions((0, 0, 0), hits, translated((0, 0, 1)), n_x)
        return np.abs(δd[2] / d[2] + δlog_J)

    assert change(NONE).max() > 1e5
    assert change(UP).max() < 2 / (BLEND * SIZE)


def test_a_rotation_of_all_changes_no_weight() -> None:
    """The axis is perpendicular to the normal at the vertex: a rotation about the normal itself is not followed."""
    hits, axis = [(1, 0.05, 0.02), (1, -0.3, 0.001), (1, 0.4, -0.1)], (0, 1, 0)

    def turned(t: mi.Float) -> mi.Transform4f:
        return mi.Transform4f().rotate(axis, dr.rad2deg(t))

    δd, δlog_J, d = directions((0, 0, 0), hits, turned, UP, axis)
    np.testing.assert_allclose(δd, np.cross(axis, d.T).T, atol=3e-4)  # rays start a little above the axis
    np.testing.assert_allclose(δlog_J, 0, atol=1e-3)
    assert np.abs(directions((0, 0, 0), hits, turned)[1]).max() > 0.1


@pytest.mark.parametrize("n_x", [UP, (0, 0, -1), NONE])
@pytest.mark.parametrize("turn", [NONE, (0.8, 1.5, 0)])
def test_the_weight_has_the_divergence_of_the_velocity(n_x: Vector, turn: Vector) -> None:
    """Hits above and below the plane of the vertex, which is close to the wall or far from it."""
    ε, motion = 1e-3, (0.4, -0.3, 1.0)
    for h in (1.0, 0.2, 0.04):
        x = np.array([1 - h, 0.0, 0.0])
        for target in ((1, 0.3 * h, 0.02), (1, -0.2, 0.05), (1, 0.1 * h, -0.03), (1, 0.5, 0.6)):
            d = (target - x) / np.linalg.norm(target - x)
            across = np.cross(d, [0, 1, 0])
            axes = [across / np.linalg.norm(across), np.cross(d, across / np.linalg.norm(across))]
            around = [d, *(d + sign * ε * axis for axis in axes for sign in (1, -1))]
            V, δlog_J, _ = directions(
                tuple(x.tolist()), [tuple(x + h / to[0] * to) for to in around], translated(motion), n_x, turn
            )
            divergence = sum(axes[i] @ (V[:, 1 + 2 * i] - V[:, 2 + 2 * i]) / (2 * ε) for i in (0, 1))
            assert δlog_J[0] == pytest.approx(divergence, rel=0.01, abs=0.05), (h, target)


def instanced(bsdf: dict[str, object]) -> tuple[mi.Scene, mi.Ray3f]:
    """An instance of a cube, and rays that hit it."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "cubes": {"type": "shapegroup", "cube": {"type": "cube", "bsdf": bsdf}},
            "instance": {"type": "instance", "group": {"type": "ref", "id": "cubes"}},
        }
    )
    return scene, mi.Ray3f(mi.Point3f(mi.Float([0.1, 0.5]), 0.2, 4), mi.Vector3f(0, 0, -1))


def test_hits_inside_an_instance_have_its_blend_length() -> None:
    """The shape of such a hit is a null pointer."""
    scene, rays = instanced({"type": "diffuse"})
    lengths = facts_of(scene).traits().tables.blend_lengths
    found = blend_length_at(lengths, scene.ray_intersect_preliminary(rays))
    instance = next(shape for shape in scene.shapes() if shape.class_name() == "Instance")
    assert np.array(found) == pytest.approx([blend_length(instance)] * 2) and found[0] > 0


def test_a_mask_inside_an_instance_is_seen_through() -> None:
    scene, rays = instanced({"type": "mask", "opacity": 0.5, "nested": {"type": "diffuse"}})
    trace = mi.load_dict({"type": "pathreplay"})._trace_config(scene, None)
    trace = replace(trace, may_slide=True)
    assert dr.all(is_seen_through(trace, scene.ray_intersect_preliminary(rays), rays))
