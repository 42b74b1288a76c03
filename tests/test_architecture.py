"""docs/architecture.md: its skeletons run as they stand there, and do what the page says of them."""

from __future__ import annotations

import importlib.util
import inspect
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from pathreplay.adjoint.autodiff import NonFiniteCounter
from pathreplay.adjoint.driver import Driver, ForwardDriver
from pathreplay.adjoint.forward import forward
from pathreplay.adjoint.sweep import sweep
from pathreplay.integrators.camera_pass import Pass
from pathreplay.integrators.lifetimes import careful
from pathreplay.integrators.term import Term
from pathreplay.inverse.loop.loop import new_run
from pathreplay.inverse.losses import pixelwise as losses
from pathreplay.inverse.objective.evaluate import Evaluator, Executor, Local, Shard
from pathreplay.inverse.problem.problem import build_problem
from pathreplay.jobs import make_config, optimize
from pathreplay.platform.threads import one_thread
from pathreplay.scenes.parameters import get_array
from test_inverse_run import JOB, room  # noqa: F401 (room: its folder, for the tests that ask for it)

PAGE = Path(__file__).parents[1] / "docs/architecture.md"
SKELETONS = dict(re.findall(r"^## Where a new (\w+) goes$.*?^```python\n(.*?)^```$", PAGE.read_text(), re.M | re.S))
SIZE, SPP, SEED = 8, 16, 3
#: Two sums of the same numbers in 32 bits, added up in another order.
ROUNDING = 1e-5

Load = Callable[[str], Any]


@pytest.fixture
def skeleton(tmp_path: Path) -> Load:
    """The skeleton of a part as a module, from a file of its own, since Dr.Jit reads the source of loops."""

    def load(part: str) -> ModuleType:
        path = tmp_path / f"skeleton_{part}.py"
        path.write_text(SKELETONS[part])
        spec = importlib.util.spec_from_file_location(path.stem, path)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    return load


def rgb(*value: float) -> dict[str, Any]:
    return {"type": "rgb", "value": list(value)}


def world(bsdf: dict[str, Any] | None = None, lights: dict[str, Any] | None = None, **more: Any) -> mi.Scene:
    """A sphere on a floor, under a lamp and the sky if there are no other lights."""
    camera = mi.ScalarTransform4f().look_at([0, 1, 6], [0, 0, 0], [0, 1, 0])
    down = mi.ScalarTransform4f().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(4)
    lamp = mi.ScalarTransform4f().translate([0.5, 3, 1]).rotate([1, 0, 0], 90)
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    paint = {"type": "diffuse", "reflectance": rgb(0.5, 0.4, 0.3)}
    usual = {
        "lamp": {"type": "rectangle", "to_world": lamp, "emitter": {"type": "area", "radiance": rgb(6, 5, 4)}},
        "sky": {"type": "constant", "radiance": rgb(0.3, 0.4, 0.5)},
    }
    return mi.load_dict(
        {
            "type": "scene",
            "camera": {"type": "perspective", "fov": 40, "to_world": camera, "film": film},
            "floor": {"type": "rectangle", "to_world": down, "bsdf": paint},
            "ball": {"type": "sphere", "radius": 0.8, "bsdf": bsdf or dict(paint)},
            **(lights or usual),
            **more,
        },
        optimize=False,
    )


FLOOR, BALL, LAMP = "floor.bsdf.reflectance.value", "ball.bsdf.reflectance.value", "lamp.emitter.radiance.value"


@contextmanager
def attached(scene: mi.Scene, *keys: str) -> Iterator[mi.SceneParameters]:
    """The scene's parameters, of which these have gradients, for as long as the block.

    They are released in the end: Dr.Jit traces calls through every scene that is alive.
    """
    params = mi.traverse(scene)
    for key in keys:
        dr.enable_grad(params[key])
    params.update()
    try:
        yield params
    finally:
        release(params, keys)


@contextmanager
def moving(scene: mi.Scene, *keys: str) -> Iterator[mi.SceneParameters]:
    """The scene's parameters, of which these carry a tangent for as long as the block: they grow by their own size."""
    params = mi.traverse(scene)
    t = mi.Float(0)
    dr.enable_grad(t)
    for key in keys:
        params[key] = params[key] * (1 + t)
    params.update()
    try:
        dr.forward(t, dr.ADFlag.ClearEdges)
        yield params
    finally:
        release(params, keys)


def release(params: mi.SceneParameters, keys: tuple[str, ...]) -> None:
    for key in keys:
        params[key] = type(params[key])(dr.detach(params[key]))
    params.update()


def weights(scene: mi.Scene) -> mi.TensorXf:
    """The adjoint of an image; no two pixels can cancel by symmetry."""
    width, height = scene.sensors()[0].film().crop_size()
    return mi.TensorXf(np.random.default_rng(1).random((height, width, 3), np.float32))


def gradients(params: mi.SceneParameters, keys: tuple[str, ...]) -> np.ndarray:
    """Those by some keys, one behind the other."""
    return np.concatenate([np.ravel(get_array(dr.grad(params[key]))) for key in keys])


def backward(scene: mi.Scene, integrator: mi.Integrator, *keys: str) -> np.ndarray:
    """The gradients by some keys."""
    with attached(scene, *keys) as params:
        integrator.render_backward(scene, params, weights(scene), seed=SEED, spp=SPP)
        return gradients(params, keys)


def tangent(scene: mi.Scene, integrator: mi.Integrator, key: str) -> np.ndarray:
    """The tangent of the image."""
    with moving(scene, key) as params:
        return np.array(integrator.render_forward(scene, params, seed=SEED, spp=SPP))


def picture(scene: mi.Scene, integrator: mi.Integrator) -> np.ndarray:
    return np.array(integrator.render(scene, seed=SEED, spp=SPP))


def ours(max_depth: int = 4) -> mi.Integrator:
    return mi.load_dict({"type": "pathreplay", "max_depth": max_depth, "sampling": "scene"})


def close(found: Any, expected: Any) -> None:
    """Relative L1 distance below what rounding does, of something that is not zero."""
    found, expected = np.array(found, np.float64), np.array(expected, np.float64)
    assert found.shape == expected.shape and np.isfinite(expected).all() and np.abs(expected).sum() > 1e-3
    assert np.abs(found - expected).sum() < ROUNDING * np.abs(expected).sum()


def test_every_skeleton_is_tested() -> None:
    assert sorted(SKELETONS) == ["BSDF", "driver", "executor", "loss", "medium", "term"]
    assert PAGE.read_text().count("```python") == len(SKELETONS)


def conforms(given: Callable[..., Any], promised: Any) -> bool:
    """Whether a function takes what a protocol promises, by these names and in this order, and more only by default."""
    wanted = inspect.signature(promised.__call__ if isinstance(promised, type) else promised)
    has = inspect.signature(given)
    names = [parameter for parameter in wanted.parameters.values() if parameter.name != "self"]
    first, more = list(has.parameters.values())[: len(names)], list(has.parameters.values())[len(names) :]
    alike = [(p.name, p.kind) for p in first] == [(p.name, p.kind) for p in names]
    return alike and all(p.default is not p.empty for p in more)


# ------------------------------ Term, driver ------------------------------


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_terms_add_up(skeleton: Load, share: float) -> None:
    props = mi.Properties("with_share")
    props["max_depth"] = 4
    both = skeleton("term").WithShare(props)
    for term in both.terms:
        assert conforms(term.forward, Term.forward) and conforms(term.backward, Term.backward)
    both.share = dr.opaque(mi.Float, share)  # Dr.Jit would leave out what is multiplied with a known zero
    scene = world()
    close(backward(scene, both, FLOOR, LAMP), (1 + share) * backward(scene, ours(), FLOOR, LAMP))
    close(tangent(scene, both, FLOOR), (1 + share) * tangent(scene, ours(), FLOOR))


BULB = {"type": "point", "position": [0.5, 2, 2.5], "intensity": rgb(9, 9, 8)}


def driven(driver: Callable[..., Any], scene: mi.Scene, *keys: str, max_depth: int = 4) -> tuple[np.ndarray, bool]:
    """The gradients by a driver, which is called as the interior does, and whether it says that paths move."""
    with attached(scene, *keys) as params, careful():
        with dr.suspend_grad(), dr.isolate_grad():
            rays = Pass.of(scene, 0, SEED, SPP).rays()
            δL = mi.Spectrum(ray_weights(dr.width(rays.ray)))
            moves = driver(ours(max_depth)._walk(scene, scene.sensors()[0]), rays.start, δL, NonFiniteCounter())
            dr.eval()
        return gradients(params, keys), moves


def ray_weights(rays: int) -> np.ndarray:
    """The adjoint of the radiance along so many rays."""
    return np.random.default_rng(2).random((3, rays), np.float32)


def driven_forward(
    driver: Callable[..., Any], scene: mi.Scene, *keys: str, max_depth: int = 4
) -> tuple[np.ndarray, np.ndarray, bool]:
    """The tangents of all rays by a driver, which rays met anything, and whether it says that paths move."""
    with moving(scene, *keys), careful(), dr.suspend_grad():
        rays = Pass.of(scene, 0, SEED, SPP).rays()
        δL, valid, moves = driver(ours(max_depth)._walk(scene, scene.sensors()[0]), rays.start, NonFiniteCounter())
        dr.eval(δL, valid)
        return np.array(δL), np.array(valid), moves


@pytest.mark.parametrize(("key", "depth", "right"), [(LAMP, 4, True), (FLOOR, 2, True), (FLOOR, 4, False)])
def test_a_driver_of_emission(skeleton: Load, key: str, depth: int, right: bool) -> None:
    """It has the gradient of the sweep by a lamp, and by paint under a bulb seen from one bounce; not after more."""
    module = skeleton("driver")
    scene = world() if key == LAMP else world(lights={"bulb": BULB})
    assert conforms(module.emission, Driver) and conforms(module.emission_forward, ForwardDriver)
    of_driver, of_sweep = (driven(each, scene, key, max_depth=depth) for each in (module.emission, sweep))
    ahead, as_forward = (
        driven_forward(each, scene, key, max_depth=depth) for each in (module.emission_forward, forward)
    )
    for (found, *others), (expected, *as_others) in ((of_driver, of_sweep), (ahead, as_forward)):
        assert all(np.array_equal(a, b) for a, b in zip(others, as_others, strict=True))
        if right:
            close(found, expected)
        else:
            assert np.abs(found).sum() < 0.99 * np.abs(expected).sum()


# ------------------------------ BSDF, medium ------------------------------


def test_a_bsdf_is_diffuse(skeleton: Load) -> None:
    skeleton("BSDF")
    lambert = world({"type": "lambert", "reflectance": rgb(0.5, 0.4, 0.3)})
    assert "BSDF" in {shape.bsdf().class_name() for shape in lambert.shapes()}  # as Mitsuba calls what Python made
    close(picture(lambert, ours()), picture(world(), ours()))
    close(backward(lambert, ours(), BALL, FLOOR), backward(world(), ours(), BALL, FLOOR))
    close(tangent(lambert, ours(), BALL), tangent(world(), ours(), BALL))


def test_a_medium_is_homogeneous(skeleton: Load, monkeypatch: pytest.MonkeyPatch) -> None:
    haze, asked = skeleton("medium").Haze, set()

    def spied(name: str, method: Callable[..., Any]) -> Callable[..., Any]:
        def spy(*args: Any) -> Any:
            asked.add(name)
            return method(*args)

        return spy

    for name in ("free_flight", "transmittance"):
        monkeypatch.setattr(haze, name, spied(name, getattr(haze, name)))

    def foggy(kind: str) -> mi.Scene:
        medium = {"type": kind, "sigma_t": 0.9, "albedo": 0.7, "phase": {"type": "hg", "g": 0.4}}
        return world(fog={"type": "cube", "bsdf": {"type": "null"}, "interior": medium})

    inside = "fog.interior_medium."
    close(picture(foggy("haze"), ours()), picture(foggy("homogeneous"), ours()))
    assert asked == {"free_flight", "transmittance"}
    assert np.abs(picture(foggy("haze"), ours()) - picture(world(), ours())).mean() > 0.01
    keys = {"haze": ("sigma_t", "albedo"), "homogeneous": ("sigma_t.value.value", "albedo.value.value")}
    found, expected = (backward(foggy(kind), ours(), *(inside + key for key in keys[kind])) for kind in keys)
    close(found, expected)


# ------------------------------ Loss, executor ------------------------------


@pytest.mark.usefixtures("room")
def test_a_loss_drives_a_job(skeleton: Load, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(losses, "LOSSES", dict(losses.LOSSES))
    job = {**JOB, "iterations": 3, "spp": 16, "integrator": {"type": "pathreplay", "max_depth": 3}}
    assert skeleton("loss").LOSSES is losses.LOSSES
    first, *_, last = optimize(make_config({**job, "loss": "smooth-l1"}), progress=False).history
    assert 0 < last.loss < 0.9 * first.loss
    other = optimize(make_config({**job, "loss": "l2"}), progress=False).history[0]
    assert first.loss != pytest.approx(other.loss, rel=1e-3)


@pytest.mark.usefixtures("room")
def test_an_executor_gives_what_the_local_one_gives(skeleton: Load) -> None:
    def evaluator() -> tuple[Evaluator, dict[str, np.ndarray]]:
        config = make_config({**JOB, "integrator": {"type": "pathreplay", "max_depth": 3}})
        problem = build_problem(config, Path.cwd())
        return Evaluator(problem, problem.integrator, record=False), new_run(problem, problem.integrator).values

    shards = [Shard((0,), 4, (1,)), Shard((1,), 4, (2,)), Shard((0, 1), 4, (3, 4))]
    evaluators, values = zip(*(evaluator() for _ in range(2)), strict=True)
    turns = skeleton("executor").Turns(evaluators)
    assert conforms(turns.run, Executor.run)
    with one_thread(True):
        found = list(turns.run(values[0], shards, {}))
        expected = list(Local(evaluators[0]).run(values[0], shards, {}))
    assert [each.loss for each in found] == [each.loss for each in expected]
    for one, other in zip(found, expected, strict=True):
        for key, gradient in other.gradients.items():
            close(one.gradients[key], gradient)
    assert len({each.loss for each in found}) == len(shards)
