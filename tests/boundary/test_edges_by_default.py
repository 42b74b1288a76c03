"""By themselves edges are differentiated where something moves that can hide light, and nothing is traced elsewhere."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from pathreplay.integrators.boundary_term import Boundary
from pathreplay.integrators.camera_pass import Pass
from pathreplay.integrators.film.motion import FilmMotion
from pathreplay.integrators.integrator import EDGES
from pathreplay.platform.threads import one_thread
from pathreplay.testing import check_gradient

T = mi.ScalarTransform4f
FILM = {"type": "hdrfilm", "width": 8, "height": 8, "pixel_format": "rgb", "rfilter": {"type": "box"}}
SIZE = 8, 8, 3
#: A lit ball of glass and a card before a wall, under a sky.
ROOM: dict[str, Any] = {
    "type": "scene",
    "cam": {"type": "perspective", "fov": 40, "to_world": T().translate([0, 0, -4]), "film": FILM},
    "wall": {"type": "rectangle", "to_world": T().translate([0, 0, 1.5]).rotate([0, 1, 0], 180).scale(3)},
    "card": {"type": "cube", "to_world": T().translate([0.5, 0, 0]).scale([0.4, 0.6, 0.02])},
    "ball": {"type": "sphere", "center": [-0.6, 0, 0], "radius": 0.4, "bsdf": {"type": "dielectric_ad"}},
    "rough": {"type": "sphere", "center": [0, 1, 0], "radius": 0.2, "bsdf": {"type": "roughdielectric"}},
    "lamp": {"type": "point", "position": [0, 2, -3]},
    "sky": {"type": "envmap", "bitmap": mi.Bitmap(np.linspace(0.1, 1, 32, dtype=np.float32).reshape(4, 8, 1))},
}
MOVES = ["cam.to_world", "cam.x_fov", "card.vertex_positions", "ball.to_world", "ball.bsdf.eta", "lamp.position",
         "sky.to_world"]  # fmt: skip
STAYS = ["wall.bsdf.reflectance.value", "card.vertex_texcoords", "rough.bsdf.eta", "rough.bsdf.alpha.value",
         "lamp.intensity.value", "sky.data", "sky.scale"]  # fmt: skip


#: Where nothing has an outline, and rough lobes follow their samples.
BALL: dict[str, Any] = {
    "type": "scene",
    "cam": ROOM["cam"],
    "ball": {"type": "sphere", "bsdf": {"type": "roughconductor", "alpha": 0.2}},
    "sky": {"type": "constant"},
}


def test_roughness_moves_no_edge_where_lobes_follow_their_samples() -> None:
    scene = mi.load_dict(BALL, optimize=False)
    by = ours()
    for key, moves in (("ball.bsdf.alpha.value", False), ("ball.to_world", True)):
        with attached(scene, key):
            view = Pass.of(scene, 0, 0, 1)
            trace = by._trace_config(scene, view.sensor)
            assert trace.follows and Boundary.move(view, trace) is moves, key


@pytest.fixture(scope="module")
def room() -> mi.Scene:
    return mi.load_dict(ROOM, optimize=False)


@contextmanager
def attached(scene: mi.Scene, key: str) -> Iterator[Any]:
    """The parameter, with gradients as long as this lasts."""
    params = mi.traverse(scene)
    still = params[key]
    value = type(still)(still)
    dr.enable_grad(value)
    params[key] = value
    params.update()
    yield value
    params = mi.traverse(scene)
    params[key] = dr.detach(still)
    params.update()


def ours(**options: Any) -> Any:
    return mi.load_dict({"type": "pathreplay", "max_depth": 2, **options})


def gradient(scene: mi.Scene, key: str, integrator: Any) -> tuple[np.ndarray, int]:
    """By a pass in one thread, which adds in one order; and how many kernels that took."""
    with attached(scene, key) as value, one_thread(True), dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.eval()
        dr.kernel_history_clear()
        integrator.render_backward(scene, mi.traverse(scene), dr.ones(mi.TensorXf, SIZE), spp=4)
        found = dr.grad(value)
        array = np.array(found.matrix if hasattr(value, "matrix") and not dr.is_array_v(value) else found)
        kernels = sum(entry["type"] == dr.KernelType.JIT for entry in dr.kernel_history())
    return array, kernels


@pytest.fixture
def log() -> Iterator[list[str]]:
    lines: list[str] = []

    class Log(mi.Appender):  # type: ignore[misc]
        def append(self, level: Any, text: str) -> None:
            lines.append(text)

        def log_progress(self, *_: Any) -> None:
            pass

    kept = Log()
    mi.logger().add_appender(kept)
    yield lines
    mi.logger().remove_appender(kept)


def test_what_moves_edges_is_what_can_hide_light_or_is_seen_from(room: mi.Scene) -> None:
    integrator, found = ours(), {}
    for key in MOVES + STAYS:
        with attached(room, key), dr.suspend_grad():
            view = Pass.of(room, 0, 0, 1)
            found[key] = Boundary.move(view, integrator._trace_config(room, view.sensor))
            *_, terms = integrator._planned(view, integrator.begin(room))
            assert any(isinstance(term, Boundary | FilmMotion) for term in terms) == found[key]
    assert found == dict.fromkeys(MOVES, True) | dict.fromkeys(STAYS, False)


def test_all_edges_are_differentiated_where_one_moves(log: list[str]) -> None:
    """The same bits as with `all`, which are others than with `none`. What it costs is told once."""
    sky = {"type": "constant"}
    scene = mi.load_dict({"type": "scene", "cam": ROOM["cam"], "card": {"type": "rectangle"}, "sky": sky})
    by_itself, told = ours(), ours()
    told.silence([EDGES])  # as in a job, which says it in its report
    ways = by_itself, by_itself, told, ours(boundary="all"), ours(boundary="none")
    default, again, quiet, every, none = (gradient(scene, "card.to_world", way)[0] for way in ways)
    assert all(np.array_equal(default, same) for same in (again, quiet, every))
    assert not np.allclose(default, none, rtol=1e-2)
    assert len([line for line in log if "boundary = 'none' of the integrator leaves them out" in line]) == 1


def test_each_scene_is_warned_of_once(log: list[str]) -> None:
    integrator, sky = ours(), {"type": "constant"}
    scenes = [mi.load_dict({"type": "scene", "cam": ROOM["cam"], "card": {"type": "rectangle"}, "sky": sky})] * 2
    scenes[1] = mi.load_dict({"type": "scene", "cam": ROOM["cam"], "card": {"type": "disk"}, "sky": sky})
    for scene in (*scenes, *scenes):
        gradient(scene, "card.to_world", integrator)
    cost = [line for line in log if "boundary = 'none' of the integrator leaves them out" in line]
    assert len(cost) == 2
    integrator.silence(["a note"])
    assert "a note" in integrator.warned and len(integrator.warned) == 2
    integrator.begin(scenes[0])
    assert "a note" in integrator.warned


def test_nothing_is_traced_where_only_paint_moves(room: mi.Scene) -> None:
    """The same bits from as many kernels, for texture coordinates too, with which paths do move."""
    for key in ("wall.bsdf.reflectance.value", "card.vertex_texcoords"):
        (default, few), (none, as_few) = (gradient(room, key, way) for way in (ours(), ours(boundary="none")))
        assert np.array_equal(default, none) and few == as_few


@pytest.mark.parametrize("attach", ["all", "none"])
def test_other_ways_to_attach_have_no_edges(attach: str) -> None:
    integrator = mi.load_dict({"type": "pathreplay", "attach": attach})
    assert integrator.boundary == "none" and len(integrator.terms) == 1


def test_a_batch_of_sensors_goes_without_and_that_is_told_once(log: list[str]) -> None:
    cameras = {f"cam{n}": {**ROOM["cam"], "to_world": T().translate([n / 4, 0, -4])} for n in range(2)}
    batch = {"type": "batch", "film": {**FILM, "width": 16}, **cameras}
    scene = mi.load_dict({**ROOM, "cam": batch}, optimize=False)
    found = []
    for integrator in (ours(), ours(boundary="none")):
        with attached(scene, "card.vertex_positions") as value, one_thread(True):
            for _ in range(2):
                dr.clear_grad(value)
                integrator.render_backward(scene, mi.traverse(scene), dr.ones(mi.TensorXf, (8, 16, 3)), spp=4)
            found.append(np.array(dr.grad(value)))
    assert np.array_equal(*found)
    told = [line for line in log if "of type 'batch' cannot be differentiated" in line]
    assert len(told) == 1 and "left out" in told[0]


@pytest.mark.slow
def test_a_sky_that_turns_moves_edges() -> None:
    """Of what samples of it are hidden. Finite differences of `path`: .1344 ± .0004, and .1292 without edges."""
    x, y = np.meshgrid(np.arange(32), np.arange(16) + 0.5)
    light = 1 + np.sin(2 * np.pi * x / 32) * np.sin(np.pi * y / 16)
    look, down = T().look_at([0, 4, -4], [0, 0, 0], [0, 1, 0]), T().rotate([1, 0, 0], -90).scale(4)
    scene = mi.load_dict(
        {
            "type": "scene",
            "cam": {**ROOM["cam"], "to_world": look, "film": {**FILM, "width": 16, "height": 16}},
            "floor": {"type": "rectangle", "to_world": down},
            "post": {"type": "cube", "to_world": T().translate([0, 0.8, 0]).scale([0.3, 0.8, 0.3])},
            "sky": {"type": "envmap", "bitmap": mi.Bitmap(np.stack([light] * 3, axis=-1).astype(np.float32))},
        },
        optimize=False,
    )
    options = {"seeds": 8, "spp": 512, "fd_spp": 4096}
    ways = ours(), ours(boundary="none")
    found, without = (check_gradient(scene, "sky.to_world", integrator=way, **options) for way in ways)
    assert found.verdict == "pass" and without.verdict == "fail", (str(found), str(without))
