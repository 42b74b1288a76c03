"""Exposures beside what else a job may have: stages, halves of samples, line searches; gone on with bit for bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from exposed_job import JOB, KEY, LEVELS, folder  # noqa: F401 (folder: for every test)
from pathreplay.errors import PathreplayError
from pathreplay.inverse.parameters.exposures import EXPOSURE, Factors
from pathreplay.jobs import iterate, make_config, optimize
from small_job import checkpoint_bits

PLAIN = {key: value for key, value in JOB.items() if key not in ("iterations", "final_learning_rate_ratio")}
KINDS: dict[str, dict[str, Any]] = {
    "stages": {
        **PLAIN,
        "stages": [
            {"iterations": 3, "downscale": 2, "parameters": [KEY], "sensors": ["eye-0"]},
            {"iterations": 4, "parameters": [EXPOSURE]},
            {"iterations": 3},
        ],
    },
    "halves": {**PLAIN, "iterations": 8, "spp": 2, "measure_snr": True},
    "line search": {**PLAIN, "iterations": 30, "spp": 4, "optimizer": {"type": "l-bfgs-b"}},
}


def job(kind: str, output: str) -> Any:
    return make_config({**KINDS[kind], "deterministic": True, "output": output})


def saved(run: str) -> dict[str, bytes]:
    return checkpoint_bits(Path(run))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_what_was_left_goes_on_bit_for_bit(kind: str) -> None:
    whole = optimize(job(kind, "whole"), progress=False)
    assert whole.iterations >= 8
    for stop in (1, 4, whole.iterations - 2):
        for state in iterate(job(kind, f"cut{stop}")):
            if state.number == stop:
                break
        cut = optimize(resume=f"cut{stop}", progress=False)
        assert saved(f"cut{stop}") == saved("whole")
        assert {k: v.tobytes() for k, v in cut.parameters.items()} == {
            k: v.tobytes() for k, v in whole.parameters.items()
        }


@pytest.mark.slow
def test_stages_hold_exposures_and_what_they_are_exposures_of() -> None:
    states = list(iterate(job("stages", "run")))
    for state in states[:3]:
        assert (state.values[EXPOSURE] == 1).all() and (state.values[KEY] != 0.5).any()
    for state in states[3:7]:
        assert state.values[KEY].tobytes() == states[2].values[KEY].tobytes()
    assert (states[6].values[EXPOSURE][:3] != 1).all()


@pytest.mark.slow
def test_a_line_search_finds_exposures() -> None:
    """Reflectance times exposure is known of each view, and the geometric mean of the exposures is 1."""
    result = optimize(job("line search", "run"), progress=False)
    mean = float(np.exp(np.mean(np.log(LEVELS[:3]))))
    assert result.parameters[KEY] == pytest.approx(mean, rel=1e-2)
    assert result.parameters[EXPOSURE].ravel() == pytest.approx(np.array(LEVELS) / mean, rel=1e-2)


@pytest.mark.parametrize("fixed", [[], [1], [0, 1, 2]])
def test_a_gradient_is_that_of_the_steps_that_are_taken(fixed: list[int]) -> None:
    """Of a function of the values, by the logarithms that are stepped, and what is taken off them."""
    factors, weights = Factors(fixed), np.float32([[1.0], [-2.0], [0.5], [3.0]])
    u = factors.latent(factors.values(np.float32([[0.3], [-0.2], [0.4], [0.1]])))
    v = factors.values(u)
    found = factors.gradient(v, weights)
    for place in np.ndindex(u.shape):
        δ = np.zeros_like(u)
        δ[place] = 2**-6
        slope = (weights * (factors.values(u + δ).astype(float) - factors.values(u - δ))).sum() / 2**-5
        assert found[place] == pytest.approx(slope, rel=2e-3, abs=1e-4)


def test_a_loss_up_to_a_factor_leaves_no_exposure_to_be_found() -> None:
    with pytest.raises(PathreplayError, match="loss = 'scale-invariant' already fits a factor to each view"):
        make_config({**JOB, "loss": "scale-invariant"})
