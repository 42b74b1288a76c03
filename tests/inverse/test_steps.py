"""How a job steps: optimisers, learning rates and transforms, as Mitsuba's own tools would have it."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import drjit as dr
import drjit.opt
import mitsuba as mi
import numpy as np
import pytest

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.schedules import rate
from pathreplay.inverse.config.schema import ITERATION
from pathreplay.inverse.parameters.reparameterization import Transform
from pathreplay.jobs import make_config, optimize
from wall_job import JOB

pytestmark = pytest.mark.usefixtures("wall_room")

# Configs, and the optimiser of a script by hand.
OPTIMISERS = {
    "adam": ({}, lambda: dr.opt.Adam(0.02, beta_1=0.9, beta_2=0.99)),
    "adam, told": (
        {"type": "adam", "beta_1": 0.7, "beta_2": 0.9, "epsilon": 1e-3, "uniform": True},
        lambda: dr.opt.Adam(0.02, beta_1=0.7, beta_2=0.9, epsilon=1e-3, uniform=True),
    ),
    "adamw": ({"type": "adamw", "weight_decay": 0.3}, lambda: dr.opt.AdamW(0.02, beta_2=0.99, weight_decay=0.3)),
    "sgd": ({"type": "sgd", "momentum": 0.8}, lambda: dr.opt.SGD(0.02, momentum=0.8)),
    "rmsprop": ({"type": "rmsprop", "alpha": 0.8}, lambda: dr.opt.RMSProp(0.02, alpha=0.8)),
}

QUICK = ("adam, told", "adamw")
LAST = {"iterate_averaging": False}


def by_hand(opt: drjit.opt.Optimizer, rates: Any = None) -> np.ndarray:
    """The loop of Mitsuba's tutorials, on the job."""
    config, key = make_config(JOB), JOB["parameters"][0]["key"]
    scene = mi.load_file("room.xml")
    params = mi.traverse(scene)
    params[key] = mi.Color3f(JOB["target"]["values"][key])
    params.update()
    judge = mi.load_dict({"type": "path", "max_depth": 2})  # as the job renders
    target = mi.render(scene, integrator=judge, spp=16, seed=config.seeds(1, 0)[0])
    opt[key] = mi.Color3f(JOB["parameters"][0]["initial"])
    integrator = mi.load_dict({"type": "prb", "max_depth": 2})
    for i in range(JOB["iterations"]):
        params[key] = opt[key]
        params.update()
        image = mi.render(
            scene, params, integrator=integrator, spp=JOB["spp"], seed=mi.UInt32(config.seeds(ITERATION, 0, i)[0])
        )
        dr.backward(dr.mean(dr.square(image - target), axis=None))
        opt.set_learning_rate(0.02 * rates(i) if rates else 0.02)
        opt.step()
    return np.array(dr.detach(opt[key])).ravel()


@pytest.mark.parametrize("name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in OPTIMISERS])
def test_a_script_with_the_same_settings_reaches_the_same_values(name: str) -> None:
    options, make = OPTIMISERS[name]
    result = optimize(make_config({**JOB, "optimizer": {**options, **LAST}}), progress=False)
    found = result.parameters[JOB["parameters"][0]["key"]]
    assert np.ravel(found) == pytest.approx(by_hand(make()), abs=2e-6)
    assert np.abs(found - np.float32(JOB["parameters"][0]["initial"])).max() > 1e-3


def test_rates_follow_their_schedule() -> None:
    def all_of(*args: Any) -> list[float]:
        return [rate(args[0], i, 4, 0.1, *args[1:]) for i in range(5)]

    assert all_of("exponential") == pytest.approx([1, 0.1**0.25, 0.1**0.5, 0.1**0.75, 0.1])
    assert all_of("linear") == pytest.approx([1, 0.775, 0.55, 0.325, 0.1])
    half = 0.45 / math.sqrt(2)
    assert all_of("cosine") == pytest.approx([1, 0.55 + half, 0.55, 0.55 - half, 0.1])
    assert all_of("constant") == [1] * 5
    assert all_of("constant", 3) == pytest.approx([0.25, 0.5, 0.75, 1, 1])


def test_rates_are_constant_where_no_decay_is_given() -> None:
    decay = {"final_learning_rate_ratio": 0.01}
    plain, falling = (make_config({**JOB, **change}) for change in ({}, decay))
    named = make_config({**JOB, **decay, "learning_rate_schedule": "linear"})
    assert [each.learning_rate_schedule for each in (plain, falling, named)] == ["constant", "exponential", "linear"]
    again = json.loads(falling.model_dump_json(exclude_unset=True))  # as the run folder has it
    assert "learning_rate_schedule" not in again and make_config(again).learning_rate_schedule == "exponential"


@pytest.mark.slow
def test_a_schedule_is_that_of_the_job() -> None:
    changed = {"optimizer": {"type": "sgd", **LAST}, "learning_rate_schedule": "cosine", "warmup_steps": 2}
    result = optimize(make_config({**JOB, **changed}), progress=False)
    found = result.parameters[JOB["parameters"][0]["key"]]
    rates = [rate("cosine", i, JOB["iterations"], 0.1, 2) for i in range(JOB["iterations"])]
    assert np.ravel(found) == pytest.approx(by_hand(dr.opt.SGD(0.02), rates.__getitem__), abs=2e-6)


TRANSFORMS = {
    "log": Transform("log"),
    "softplus": Transform("softplus", -0.5),
    "logit": Transform("logit"),
    "logit of a range": Transform("logit", -1.0, 3.0),
}


@pytest.mark.parametrize("name", TRANSFORMS)
def test_a_transform_goes_there_and_back_and_gradients_follow(name: str) -> None:
    transform, v = TRANSFORMS[name], np.float32([1e-3, 0.1, 0.5, 0.9, 0.999])
    u = transform.latent(v)
    assert transform.values(u) == pytest.approx(v, rel=2e-6, abs=2e-6)
    step = 2**-6
    slopes = (transform.values(u + step).astype(float) - transform.values(u - step)) / (2 * step)
    assert transform.gradient(v, np.full_like(v, 3)) == pytest.approx(3 * slopes, rel=2e-3, abs=1e-4)


@pytest.mark.parametrize("name", TRANSFORMS)
def test_no_step_leaves_the_range_or_loses_the_number(name: str) -> None:
    transform, far = TRANSFORMS[name], np.float32([-1e30, -1e3, 1e3, 1e30])
    v = transform.values(far)
    assert np.isfinite(v).all() and (v > transform.lower).all() and (v[:2] < transform.upper).all()
    assert np.isfinite(transform.latent(v)).all()
    assert np.isfinite(transform.gradient(v, np.ones_like(v))).all()


def test_a_job_steps_in_the_logarithm() -> None:
    entry = {**JOB["parameters"][0], "parameterization": "log", "learning_rate": 0.1}
    result = optimize(
        make_config({**JOB, "parameters": [entry], "iterations": 1, "optimizer": {"type": "adam"}}), progress=False
    )
    # The first step of Adam's is the learning rate, up or down: here a factor of exp(0.1).
    shares = result.parameters[entry["key"]] / np.float32(entry["initial"])
    assert np.abs(np.log(shares)) == pytest.approx([0.1] * 3, abs=1e-5)


@pytest.mark.slow
def test_a_prior_keeps_values_between_start_and_truth() -> None:
    entry, rest = JOB["parameters"][0], {"optimizer": {"type": "sgd"}, "learning_rate_schedule": "constant"}
    job = {**JOB, **rest, "learning_rate": 5.0, "iterations": 30}
    free = optimize(make_config(job), output="free", progress=False)
    held = optimize(
        make_config({**job, "parameters": [{**entry, "l2_to_initial": 0.1}]}), output="held", progress=False
    )
    start, truth = np.float32(entry["initial"]), np.float32(JOB["target"]["values"][entry["key"]])
    for k in (0, 2):  # the second channel starts at the truth
        moved = [float((r.parameters[entry["key"]][k] - start[k]) / (truth[k] - start[k])) for r in (held, free)]
        assert 0.1 < moved[0] < 0.8 < 0.9 < moved[1] < 1.1
    assert held.history[0].penalty == 0 < held.history[-1].penalty and free.history[-1].penalty == 0


REFUSED = {
    "varying number": (
        {"parameters": [{"key": "wall.bsdf.reflectance.value", "total_variation": 0.1}]},
        "is not a texture or volume; remove 'total_variation'",
    ),
    "no option": ({"optimizer": {"type": "sgd", "beta_1": 0.5}}, "'beta_1' is not an option of type = 'sgd'"),
    "misspelt": ({"optimizer": {"typ": "sgd"}}, "unknown key 'optimizer.typ'; did you mean 'type'?"),
    "beyond": ({"optimizer": {"beta_2": 1.0}}, "optimizer.beta_2"),
    "nesterov alone": ({"optimizer": {"type": "sgd", "nesterov": True}}, "add momentum"),
    "constant decays": (
        {"learning_rate_schedule": "constant", "final_learning_rate_ratio": 0.5},
        "has no effect with learning_rate_schedule = 'constant'",
    ),
    "too long": ({"warmup_steps": 8}, "warmup_steps = 8 is not less than iterations = 8"),
    "at a bound": (
        {"parameters": [{"key": "wall.bsdf.reflectance.value", "initial": [0.1, 1, 0.5], "parameterization": "logit"}]},
        "starts at 1, but parameterization = 'logit' needs values below 1",
    ),
    "of nothing": (
        {"parameters": [{"key": "wall.bsdf.reflectance.value", "initial": 0.0, "parameterization": "log"}]},
        "starts at 0, but parameterization = 'log' needs values above 0",
    ),
    "twice": (
        {"parameters": [{"key": "wall.vertex_positions", "large_steps_lambda": 3.0, "parameterization": "log"}]},
        "'large_steps_lambda' and 'parameterization' exclude each other",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_makes_no_sense_is_refused_in_one_line(case: str, tmp_path: Path) -> None:
    change, words = REFUSED[case]
    with pytest.raises(PathreplayError) as told:
        optimize(make_config({**JOB, **change}), progress=False)
    assert words in str(told.value) and "\n" not in str(told.value)
    assert [path.name for path in tmp_path.iterdir()] == ["room.xml"]
