"""Several scenes in one process: what a dropped scene leaves behind, recordings by users, and Python threads."""

from __future__ import annotations

import gc
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import pathreplay
from edge_scenes import cube8, lit_box
from pathreplay.integrators import lifetimes
from pathreplay.integrators.lifetimes import SceneMemory, careful
from pathreplay.integrators.scene_facts import facts_of
from pathreplay.transport.facts.nodes import nodes_of, with_gradients
from places import SUPPORT

RED = "red.reflectance.value"


@contextmanager
def without_collector() -> Iterator[None]:
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def holders(thing: Any) -> int:
    """Those of Mitsuba and Python together."""
    return sys.getrefcount(thing)


def cornell() -> mi.Scene:
    description = mi.cornell_box()
    description["sensor"]["film"] |= {"width": 8, "height": 8}
    return mi.load_dict(description, optimize=False)


def integrator(**options: Any) -> mi.Integrator:
    return mi.load_dict({"type": "pathreplay", "max_depth": 3, **options})


def gradient(scene: mi.Scene, by: mi.Integrator, key: str = RED, seed: int = 0) -> np.ndarray:
    params = mi.traverse(scene)
    value = dr.detach(params[key])
    dr.enable_grad(value)
    params[key] = value
    params.update()
    dr.backward(dr.mean(mi.render(scene, params, integrator=by, spp=4, seed=seed), axis=None))
    return np.array(dr.grad(value)).ravel()


def test_traversals_leave_nobody_who_holds_objects() -> None:
    scene = cornell()
    (emitter,) = scene.emitters()
    shape = next(shape for shape in scene.shapes() if shape.is_emitter())
    with without_collector():
        before = [holders(thing) for thing in (scene, shape, emitter)]
        assert emitter in nodes_of(shape) and shape in nodes_of(scene)
        with_gradients(emitter)
        assert [holders(thing) for thing in (scene, shape, emitter)] == before


def test_a_dropped_scene_goes_before_the_next_pass_without_the_collector() -> None:
    """Also while an integrator that knew it lives."""
    by = integrator()
    other = cornell()
    with without_collector():
        description = mi.cornell_box()
        description["sensor"]["film"] |= {"width": 8, "height": 8}
        description["white"] = {"type": "dielectric_ad"}  # in Python, and so it can tell when it goes
        scene = mi.load_dict(description)
        gradient(scene, by)
        facts = weakref.ref(facts_of(scene))
        (glass,) = {bsdf for bsdf in nodes_of(scene) if type(bsdf).__name__ == "DielectricAD"}
        bsdf = weakref.ref(glass)
        del scene, glass, description
        assert facts() is not None
        gradient(other, by)
        assert facts() is None and bsdf() is None


def test_a_scene_that_somebody_holds_is_remembered() -> None:
    memory: SceneMemory[str] = SceneMemory()
    scene, finds = cornell(), []

    def find() -> str:
        finds.append(1)
        return "facts"

    for right in (True, True, False):
        assert memory.about(scene, lambda _, right=right: right, find) == "facts"
        memory.release()
    assert len(finds) == 2
    held = [scene]
    del scene
    memory.release()
    assert memory.about(held[0], lambda _: True, find) and len(finds) == 2


def test_no_garbage_is_collected_during_a_pass() -> None:
    with careful(), careful():
        assert not gc.isenabled()
    assert gc.isenabled()
    with without_collector(), careful():
        pass
    gc.enable()


@pytest.mark.parametrize("order", ["gradient first", "recorded first", "recorded twice"])
def test_a_frozen_step_of_a_user_in_any_order(order: str) -> None:
    """Whether or not another scene was dropped before, and the scene was rendered before."""

    def recorded() -> list[float]:
        scene, by = cornell(), integrator()
        params = mi.traverse(scene)
        params.keep(RED)
        optimiser = mi.ad.Adam(lr=0.05, params={RED: params[RED]})
        params.update(optimiser)

        @dr.freeze
        def step(seed: mi.UInt32) -> mi.Float:
            image = mi.render(scene, params, integrator=by, spp=4, seed=seed)
            loss = dr.mean(dr.square(image - 0.2), axis=None)
            dr.backward(loss)
            optimiser.step()
            return loss

        first = np.array(optimiser[RED]).ravel()
        for k in range(4):
            params.update(optimiser)
            step(mi.UInt32(k))
        return np.abs(np.array(optimiser[RED]).ravel() - first).max()

    if order == "gradient first":
        gradient(cornell(), integrator())
    moved = recorded()
    assert 0.01 < moved < 0.5
    if order == "recorded twice":
        assert recorded() == pytest.approx(moved, rel=1e-3)


@pytest.mark.parametrize(
    ("rendered", "edges"), [(False, "none"), (True, "none"), pytest.param(False, "primary", marks=pytest.mark.slow)]
)
def test_a_frozen_step_of_a_user_in_which_geometry_moves(rendered: bool, edges: str) -> None:
    """Parameters are set outside, as with `prb`; the same gradients as without a recording."""
    key = "object.vertex_positions"

    def step(scene: mi.Scene, params: Any, by: mi.Integrator, seed: mi.UInt32) -> mi.Float:
        image = mi.render(scene, params, integrator=by, spp=4, seed=seed)
        dr.backward(dr.mean(image, axis=None))
        return dr.grad(params[key])

    def gradients(run: Any, first: bool) -> list[np.ndarray]:
        scene, by = mi.load_dict(lit_box(cube8)(), optimize=False), integrator(boundary=edges, max_depth=2)
        params = mi.traverse(scene)
        params.keep(key)
        start, found = mi.Float(params[key]), []
        if first:
            dr.eval(mi.render(scene, integrator=by, spp=1))
        for k in range(3):
            moved = start + 0.05 * k
            dr.enable_grad(moved)
            params[key] = moved
            params.update()
            found.append(np.array(run(scene, params, by, mi.UInt32(k))))
        return found

    expected, found = gradients(step, False), gradients(dr.freeze(step), rendered)
    for a, b in zip(expected, found, strict=True):
        np.testing.assert_allclose(b, a, rtol=1e-3, atol=1e-4 * np.abs(a).max())


def test_tables_of_a_moving_mesh_have_one_alignment() -> None:
    """A frozen function is recorded again if the alignment of an array changes."""
    scene = mi.load_dict(lit_box(cube8)(), optimize=False)
    params, found = mi.traverse(scene), set()
    positions = mi.Float(params["object.vertex_positions"])
    for k in range(8):
        params["object.vertex_positions"] = positions * (1 + 0.1 * k)
        params.update()
        tables = facts_of(scene).tables()
        arrays = tables.blend_lengths, tables.groups, tables.groups_at, tables.scene_bounds, tables.emitter_bounds
        found |= {np.from_dlpack(array).ctypes.data % 64 for array in arrays}
    assert found == {0}


class Collecting:
    """A variable of a frozen function. Every read except the first one triggers a garbage collection."""

    DRJIT_STRUCT: ClassVar = {"value": mi.Float}

    def __init__(self) -> None:
        self._value, self.reads = mi.Float(1), 0

    @property
    def value(self) -> mi.Float:
        self.reads += 1
        if self.reads > 1:
            gc.collect()
        return self._value

    @value.setter
    def value(self, value: mi.Float) -> None:
        self._value = value


def test_objects_that_others_have_hidden_are_counted_once_between_full_collections(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Counting a million of them takes a tenth of a second."""
    counts: list[int] = []
    monkeypatch.setattr(gc, "get_freeze_count", lambda: counts.append(1) or 7)
    monkeypatch.setattr(gc, "freeze", lambda: pytest.fail("objects of others were mixed with ours"))
    monkeypatch.setattr(lifetimes, "_hidden", False)
    gc.collect()
    with without_collector():
        for _ in range(3):
            lifetimes._hide_garbage()
    assert len(counts) == 1
    gc.collect()
    lifetimes._hide_garbage()
    assert len(counts) == 2
    gc.collect()


def test_no_scene_is_released_while_a_frozen_function_is_called() -> None:
    scene, by, collecting = cornell(), integrator(), Collecting()

    @dr.freeze
    def step(seed: mi.UInt32) -> mi.TensorXf:
        return mi.render(scene, integrator=by, spp=4, seed=seed) * collecting.value

    with without_collector():
        dropped = cornell()
        gradient(dropped, integrator())
        facts = weakref.ref(facts_of(dropped))
        del dropped
        assert np.array(step(mi.UInt32(0))).max() > 0
        assert collecting.reads > 1 and facts() is not None
        gc.collect()
        assert facts() is None


@pytest.mark.parametrize("tracing", ["loop", "other thread"])
def test_no_scene_is_released_while_other_code_traces(tracing: str) -> None:
    with without_collector():
        dropped = cornell()
        gradient(dropped, integrator())
        facts, alive = weakref.ref(facts_of(dropped)), []
        del dropped

        def body(i: mi.UInt32) -> tuple[mi.UInt32]:
            in_threads(lambda n: gc.collect(), 1) if tracing == "other thread" else gc.collect()
            alive.append(facts() is not None)
            return (i + 1,)

        dr.while_loop((mi.UInt32(0, 1),), lambda i: i < 3, body, mode="symbolic")
        assert alive and all(alive)
        gc.collect()
        assert facts() is None


def in_threads(work: Any, count: int = 3) -> None:
    threads = [threading.Thread(target=work, args=(n,)) for n in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def test_threads_that_take_turns_get_the_gradients_of_one() -> None:
    expected = [gradient(cornell(), integrator(), seed=n) for n in range(3)]
    found: dict[int, np.ndarray] = {}

    def work(n: int) -> None:
        for _ in range(2):
            with pathreplay.exclusive():
                found[n] = gradient(cornell(), integrator(), seed=n)

    in_threads(work)
    for n, one in enumerate(expected):
        np.testing.assert_allclose(found[n], one, rtol=1e-4)


def test_a_pass_beside_one_of_another_thread_is_refused() -> None:
    scene, by, told = cornell(), integrator(), []

    def work(n: int) -> None:
        try:
            by.render(scene, spp=1)
        except pathreplay.PathreplayError as error:
            told.append(str(error))

    with pathreplay.exclusive():
        in_threads(work, 1)
    assert len(told) == 1 and "pathreplay.exclusive()" in told[0]


def test_a_thread_that_collects_garbage_disturbs_no_pass() -> None:
    """It knows nothing of Mitsuba; Python collects in whatever thread makes objects.

    A collection takes long where many objects are alive, and the passes wait for it: they stop after some seconds.
    """
    done, until = threading.Event(), time.monotonic() + 4

    def litter() -> None:
        while not done.is_set():
            kept: list[Any] = []
            kept.extend([kept] for _ in range(2000))

    thread = threading.Thread(target=litter)
    thread.start()
    try:
        for _ in range(20000):
            with careful():
                pass
            if time.monotonic() > until:
                break
    finally:
        done.set()
        thread.join()


SEQUENCE = """
import sys
sys.path.insert(0, sys.argv[1])
from pathreplay.platform.backend import set_variant
from variant import VARIANT
set_variant(VARIANT)
import drjit as dr, mitsuba as mi
from edge_scenes import BY_NAME
for name in sys.argv[2:]:
    case = BY_NAME[name]
    scene = mi.load_dict(case.scene(), optimize=False)
    integrator = mi.load_dict({"type": "pathreplay", "max_depth": case.depth, "boundary": "all"})
    params, key = mi.traverse(scene), case.key
    for seed in range(3):
        t = mi.Float(0)
        dr.enable_grad(t)
        params[key] = case.move(params[key], t)
        params.update()
        dr.backward(dr.mean(mi.render(scene, params, integrator=integrator, spp=4, seed=seed), axis=None))
print("all of them")
"""


@pytest.mark.slow
def test_scenes_with_edges_one_after_the_other_in_one_process(run_python) -> None:
    """With collections only when Python happens to make them: the second edition ended the process at the fourth."""
    names = ("shadow_env", "sphere_lamp", "shadow_occluder", "shadow_sphere", "lamp_lights")
    done = run_python(SEQUENCE, args=(str(SUPPORT), *names))
    assert done.returncode == 0 and done.stdout.split("\n")[-2] == "all of them", done.stderr


@pytest.mark.hours
@pytest.mark.parametrize("options", [(), ("--no-gc",)])
def test_random_scenes_one_after_the_other_in_one_process(options: tuple[str, ...]) -> None:
    command = [sys.executable, str(SUPPORT / "random_scenes.py"), "300", *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    told = done.stdout.split("\n")
    assert done.returncode == 0 and told[-2] == "300 scenes", [*told[-5:], done.stderr[-2000:]]
