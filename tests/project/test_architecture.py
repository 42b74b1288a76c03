"""docs/architecture.md: its skeletons run as they stand there, and do what the page says of them."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from driven import (
    BALL,
    FLOOR,
    LAMP,
    SEED,
    SPP,
    backward,
    close,
    conforms,
    driven,
    driven_forward,
    moving,
    ours,
    rgb,
    world,
)
from pathreplay.adjoint.driver import Driver, ForwardDriver
from pathreplay.adjoint.forward import forward
from pathreplay.adjoint.sweep import sweep
from pathreplay.integrators.term import Term
from pathreplay.inverse.loop.loop import new_run
from pathreplay.inverse.losses import pixelwise as losses
from pathreplay.inverse.objective.evaluate import Evaluator, Executor, Local, Shard
from pathreplay.inverse.problem.problem import build_problem
from pathreplay.jobs import make_config, optimize
from pathreplay.platform.threads import one_thread
from places import ROOT
from room_job import JOB, room  # noqa: F401 (room: its folder, for the tests that ask for it)

PAGE = ROOT / "docs/architecture.md"
SKELETONS = dict(re.findall(r"^## Where a new (\w+) goes$.*?^```python\n(.*?)^```$", PAGE.read_text(), re.M | re.S))

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


def tangent(scene: mi.Scene, integrator: mi.Integrator, key: str) -> np.ndarray:
    """The tangent of the image."""
    with moving(scene, key) as params:
        return np.array(integrator.render_forward(scene, params, seed=SEED, spp=SPP))


def picture(scene: mi.Scene, integrator: mi.Integrator) -> np.ndarray:
    return np.array(integrator.render(scene, seed=SEED, spp=SPP))


def test_every_skeleton_is_tested() -> None:
    assert sorted(SKELETONS) == ["BSDF", "driver", "executor", "loss", "medium", "term"]
    assert PAGE.read_text().count("```python") == len(SKELETONS)


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
