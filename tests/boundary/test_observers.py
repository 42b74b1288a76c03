"""Which vertex of a path sees edges: no selection changes a mean, and the pilot pass finds which are worth it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from pathreplay.adjoint.record import Layout, record_type, room_for
from pathreplay.boundary.importance import EVENLY, VERTICES, Importance, Importances
from pathreplay.boundary.observer import choose_vertex
from pathreplay.integrators.camera_pass import Pass
from pathreplay.integrators.film.domain import FilmPlaces
from pathreplay.samplers.counter_sampler import CounterSampler, key_of
from pathreplay.testing.statistics import gap
from pathreplay.testing.verdict import Z_LIMIT

BATCHES, LANES = 32, 1 << 11


def throughput_by_vertex(shares: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Throughput of selected vertices, and how many there are, by batch and by number of preceding vertices."""
    room = mi.load_dict(mi.cornell_box())
    ours = mi.load_dict({"type": "pathreplay", "max_depth": 5, "rr_depth": 3})
    with dr.suspend_grad():
        view = Pass.of(room, 0, 0, 1)
        trace, places = ours._trace_config(room, view.sensor), FilmPlaces.of(view)
        i = dr.arange(mi.UInt32, BATCHES * LANES)
        key = key_of(i, mi.UInt32(7))
        s = mi.Point2f(*CounterSampler.of(key ^ 0x5BD1E995).next_2d()) * mi.Point2f(*places.size)
        ray, _ = places.ray(s, key)
        weights = mi.Float(shares + [1.0] * (VERTICES - len(shares)))
        _, x = choose_vertex(trace, CounterSampler.of(key), ray, mi.Bool(False), weights, None, None)
    k, β = np.array(x.k), np.where(np.array(x.active), np.array(dr.mean(x.β)), 0)
    found = [(np.where(k == j, β, 0), (k == j) & (β > 0)) for j in range(4)]
    means, counts = (np.stack(each, -1).reshape(BATCHES, LANES, 4).mean(1) for each in zip(*found, strict=True))
    return means, counts


@pytest.mark.parametrize("shares", [[0.25, 1.0, 0.5], [1.0, 0.3, 0.25, 1.0]], ids=["second", "first and fourth"])
def test_no_selection_changes_the_mean(shares: list[float]) -> None:
    plain, evenly = throughput_by_vertex([])
    means, counts = throughput_by_vertex(shares)
    assert np.abs(gap(means, plain).z).max() < Z_LIMIT
    largest = int(np.argmax(shares))
    assert counts[:, largest].mean() > 1.2 * evenly[:, largest].mean()


def test_paths_end_where_null_boundaries_fill_the_record() -> None:
    """24 shells around the camera, and a wall: a path crosses more of them than its record holds."""
    fog = {"type": "homogeneous", "sigma_t": 1e-3}
    shells = {
        f"shell {k}": {"type": "sphere", "radius": 1 + 0.1 * k, "bsdf": {"type": "null"}, "interior": fog}
        for k in range(24)
    }
    wall = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 0, 9]).rotate([0, 1, 0], 180).scale(9),
    }
    scene = mi.load_dict({"type": "scene", "sensor": {"type": "perspective"}, "wall": wall, **shells})
    trace = mi.load_dict({"type": "pathreplay", "max_depth": 2})._trace_config(scene, scene.sensors()[0])
    ray = mi.Ray3f(mi.Point3f(0), mi.Vector3f(mi.Float(np.linspace(-0.1, 0.1, 64)), 0, 1))
    room = room_for(trace)
    assert room < len(shells)
    with dr.suspend_grad():
        key = key_of(dr.arange(mi.UInt32, 64), mi.UInt32(7))
        layout = Layout.of(trace, True)
        records = dr.alloc_local(record_type(layout), room)
        shares = mi.Float([1.0] * VERTICES)
        _, x = choose_vertex(trace, CounterSampler.of(key), ray, mi.Bool(False), shares, layout, records)
    assert not (np.array(x.active) & (np.array(x.k) >= room)).any()


def importances() -> Importances:
    """Three paths, whose observers are the first, the second and the second vertex, with two arcs each."""
    squares = Importance(mi.Float(0, 0, 0), mi.Float(1, 2, 3), mi.Float(2, 4, 0))
    arcs = Importance(mi.Float([0] * 6), mi.Float(1, 1, 1, 1, 1, 1), mi.Float(1, 1, 1, 1, 1, 1))
    return Importances(squares, arcs, mi.UInt32(0, 1, 1), mi.Bool(True, True, True))


def test_arcs_see_the_light_of_this_and_of_later_vertices() -> None:
    expected = [6 / 2, 4 / 4] + [6 / 6] * (VERTICES - 2)
    np.testing.assert_allclose(importances().radiance(), expected)
    presence, importance = importances().weighed(mi.Float([3.0] + [1.0] * (VERTICES - 1)))
    assert not np.any(presence)
    assert dr.sum(importance)[0] == pytest.approx(1)
    arcs = np.array(importance)[3:]
    np.testing.assert_allclose(arcs / arcs[1], [3, 1, 1, 3, 1, 1], rtol=1e-5)


def test_vertices_are_selected_by_the_root_mean_square_of_their_importance() -> None:
    shares = importances().shares(mi.Float(3, 0, 2, 0, 0, 0, 4, 2, 0))
    worth = np.array([5, np.sqrt((2**2 + 2**2) / 2)])
    expected = [*(EVENLY + (1 - EVENLY) * worth / worth.max()), *[EVENLY] * (VERTICES - 2)]
    np.testing.assert_allclose(shares, expected, rtol=1e-5)


def test_nothing_found_leaves_all_vertices_equal() -> None:
    np.testing.assert_array_equal(importances().shares(dr.zeros(mi.Float, 9)), 1)
