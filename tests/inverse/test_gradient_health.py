"""Gradients that are no numbers, and gradients that are noise: named, counted, and stopped or sampled more."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.noise_options import AdaptiveSpp
from pathreplay.inverse.loop.checkpoint import Entry
from pathreplay.inverse.loop.events import LowSNR
from pathreplay.inverse.loop.loop import iterate, new_run
from pathreplay.inverse.loop.noise import WINDOW, next_spp, ratios
from pathreplay.inverse.objective.evaluate import Evaluation, Local, Shard
from pathreplay.inverse.problem.problem import build_problem
from pathreplay.jobs import load_config, make_config, optimize
from pathreplay.platform.interrupts import Stop
from pathreplay.report.progress import Progress
from wall_job import JOB

pytestmark = pytest.mark.usefixtures("wall_room")

KEY = JOB["parameters"][0]["key"]


class Spoilt(mi.ad.integrators.prb.PRBIntegrator):
    """Whose gradients are NaN from its third rendering on, in as many entries as `entries` says, for `passes`."""

    entries, passes, done = 3, 1000, 0

    def render_backward(self, scene: Any, params: Any, *arguments: Any, **options: Any) -> None:
        super().render_backward(scene, params, *arguments, **options)
        type(self).done += 1
        if 3 <= type(self).done < 3 + self.passes:
            grad = dr.grad(params[KEY])
            for k in range(self.entries):
                grad[k] = float("nan")
            dr.set_grad(params[KEY], grad)


@pytest.fixture
def spoilt() -> type[Spoilt]:
    mi.register_integrator("spoilt", Spoilt)
    Spoilt.entries, Spoilt.passes, Spoilt.done = 3, 1000, 0
    return Spoilt


def job(**changes: Any) -> dict[str, Any]:
    return {**JOB, "integrator": {"type": "spoilt", "max_depth": 2}, "output": "run", "iterations": 12, **changes}


def test_a_gradient_that_is_no_number_is_named_once_and_counted(
    spoilt: type[Spoilt], capsys: pytest.CaptureFixture[str]
) -> None:
    spoilt.passes = 4
    result = optimize(make_config(job(max_consecutive_nonfinite=5)))
    told = [line for line in capsys.readouterr().err.splitlines() if "NaN" in line]
    assert told == [
        f"pathreplay: 3 gradient entries of '{KEY}' were NaN or infinite in view 'view-0' at iteration 2 and count as "
        "zero; further ones are counted, but not reported"
    ]
    assert [entry.dropped for entry in result.history] == [0, 0, 3, 3, 3, 3, *6 * [0]]
    assert result.history[3].dropped_shares == {KEY: 1.0} and result.history[0].dropped_shares == {}
    assert "12 gradient entries were NaN or infinite" in result.report.read_text()


def test_a_row_of_them_ends_the_run_with_a_checkpoint(spoilt: type[Spoilt]) -> None:
    with pytest.raises(PathreplayError) as told:
        optimize(make_config(job(max_consecutive_nonfinite=3, checkpoint_every=100)), progress=False)
    line = str(told.value)
    assert f"At least half of the gradient of '{KEY}' was NaN or infinite in iterations 2 to 4" in line
    assert line.endswith("all completed iterations are saved, resume with: pathreplay optimize --resume run")
    spoilt.passes = 0
    again = optimize(resume="run", progress=False)
    assert again.iterations == 12 and sum(entry.dropped for entry in again.history) == 9


def test_a_few_bad_entries_end_nothing(spoilt: type[Spoilt]) -> None:
    spoilt.entries = 1
    result = optimize(make_config(job(max_consecutive_nonfinite=2)), progress=False)
    assert result.iterations == 12 and result.history[-1].dropped_shares == {KEY: pytest.approx(1 / 3)}


def test_a_loss_that_is_no_number_leaves_a_checkpoint(monkeypatch: pytest.MonkeyPatch) -> None:
    real = Local.run

    def run(self: Local, values: Any, shards: Any, learned: Any) -> Iterator[Evaluation]:
        calls.append(1)
        for found in real(self, values, shards, learned):
            yield found if len(calls) != 4 else replace(found, loss=float("nan"))

    calls: list[int] = []
    monkeypatch.setattr(Local, "run", run)
    with pytest.raises(PathreplayError, match=r"The loss is nan at iteration 3;.*resume with: pathreplay optimize"):
        optimize(make_config({**JOB, "output": "run"}), progress=False)
    result = optimize(resume="run", progress=False)
    assert result.iterations == 8 and len(calls) == 4 + 5
    whole = optimize(make_config(JOB), output="whole", progress=False)
    assert result.parameters[KEY].tobytes() == whole.parameters[KEY].tobytes()


# ------------------------------ Signal to noise ------------------------------


def noisy(signal: float, spread: float, dimensions: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Two halves of a gradient of that length, whose mean has noise of that length."""
    truth = np.full(dimensions, signal / np.sqrt(dimensions))
    sigma = spread / np.sqrt(dimensions) * np.sqrt(2)
    return truth + sigma * rng.standard_normal(dimensions), truth + sigma * rng.standard_normal(dimensions)


@pytest.mark.parametrize("dimensions", [1, 50])
@pytest.mark.parametrize("ratio", [0.5, 2.0, 8.0])
def test_the_ratio_is_that_of_signal_and_noise(ratio: float, dimensions: int) -> None:
    rng = np.random.default_rng(1)
    found = []
    for _ in range(200):
        history = []
        for i in range(WINDOW):
            a, b = noisy(ratio, 1.0, dimensions, rng)
            mean, half = np.linalg.norm(a + b) / 2, np.linalg.norm(a - b) / 2
            history.append(Entry(i, 1.0, 0.0, {"x": float(mean)}, spp=8, noise_norms={"x": float(half)}))
        found.append(ratios(history)["x"] ** 2)
    # The square is unbiased but for the division by an estimate of 16 n degrees of freedom, m: m / (m - 2) too large.
    m = WINDOW * dimensions
    expected = (ratio**2 + 1) * m / (m - 2) - 1
    error = np.std(found) / np.sqrt(len(found))
    assert abs(np.mean(found) - expected) < 4 * error + 0.02


def entries(count: int, spp: int, norm: float) -> list[Entry]:
    return [Entry(i, 1.0, 0.0, {"x": norm, "y": 9.0}, spp=spp, noise_norms={"x": 1.0, "y": 1.0}) for i in range(count)]


def test_samples_follow_the_ratio() -> None:
    auto = AdaptiveSpp(target_snr=1.0, min=4, max=32)
    norm = {ratio: float(np.sqrt(1 + ratio**2)) for ratio in (0.5, 1.5, 2.5)}
    assert next_spp(auto, []) == 4
    assert next_spp(auto, entries(WINDOW, 8, norm[0.5])) == 16
    assert next_spp(auto, entries(WINDOW, 8, norm[1.5])) == 8
    assert next_spp(auto, entries(WINDOW, 8, norm[2.5])) == 4
    assert next_spp(auto, entries(WINDOW, 4, norm[2.5])) == 4
    assert next_spp(auto, entries(WINDOW, 32, norm[0.5])) == 32
    assert [next_spp(auto, entries(WINDOW, spp, norm[0.5])) for spp in (1, 9, 31, 48)] == [4, 8, 16, 32]
    for n in (WINDOW - 1, WINDOW + 1, 2 * WINDOW - 1):
        assert next_spp(auto, entries(n, 8, norm[0.5])) == 8
    assert next_spp(auto, entries(WINDOW, 8, 9.0) + entries(WINDOW - 1, 16, norm[0.5])) == 16


def halved(**changes: Any) -> dict[str, Any]:
    return {**JOB, "measure_snr": True, "spp": 8, "iterations": 20, **changes}


def test_halves_are_two_shards_and_their_mean_is_stepped_by() -> None:
    config = make_config(halved(iterations=1))
    problem = build_problem(config, Path.cwd())
    run = new_run(problem, problem.integrator, record=False)
    start, evaluate = dict(run.values), run.executor.evaluate  # type: ignore[attr-defined]
    list(iterate(problem, run, Stop()))
    seeds = config.seeds(0, 0, 0)
    halves = [evaluate(start, Shard((0,), 4, (seed,)), {}) for seed in seeds]
    a, b = (each.gradients[KEY] for each in halves)
    (entry,) = run.history
    assert entry.loss == pytest.approx(sum(each.loss for each in halves) / 2, rel=1e-6)
    assert entry.gradient_norms[KEY] == pytest.approx(np.linalg.norm(a + b) / 2, rel=1e-5)
    assert entry.noise_norms[KEY] == pytest.approx(np.linalg.norm(a - b) / 2, rel=1e-4)
    assert entry.noise_norms[KEY] > 0 and entry.spp == 8


class Noise:
    """Halves that contradict each other."""

    def run(self, values: Any, shards: Any, learned: Any) -> list[Evaluation]:
        signs = np.resize([1.0, -1.0], len(shards))
        return [Evaluation(1.0, {KEY: np.full(3, sign, np.float32)}, {}, {}) for sign in signs]


def test_a_gradient_that_is_noise_is_told_of_once(capsys: pytest.CaptureFixture[str]) -> None:
    config = make_config(halved(iterations=WINDOW + 4))
    problem = build_problem(config, Path.cwd())
    run = replace(new_run(problem, problem.integrator), executor=Noise())
    heard = list(iterate(problem, run, Stop()))
    told = [event for event in heard if isinstance(event, LowSNR)]
    assert told == [LowSNR(KEY, 0.0, WINDOW - 1, 8)]
    with Progress(True) as bar:
        for event in (*told, *told):
            bar.observe(event)
    assert capsys.readouterr().err == (
        f"pathreplay: the gradient of '{KEY}' is dominated by noise since about iteration {WINDOW - 1}: its "
        "signal-to-noise ratio is 0 with spp = 8; raise spp unless the value has converged\n"
    )


@pytest.mark.slow
def test_automatic_samples_double_and_go_on_from_a_checkpoint() -> None:
    changes = {"spp": "auto", "adaptive_spp": {"target_snr": 1e6, "min": 2, "max": 8}, "iterations": 3 * WINDOW}
    whole = optimize(make_config({**JOB, **changes, "output": "whole"}), progress=False)
    assert [entry.spp for entry in whole.history] == [2] * WINDOW + [4] * WINDOW + [8] * WINDOW
    from pathreplay.jobs import iterate as states

    for state in states(make_config({**JOB, **changes, "output": "cut"})):
        if state.number == WINDOW + 2:
            break
    cut = optimize(resume="cut", progress=False)
    assert cut.parameters[KEY].tobytes() == whole.parameters[KEY].tobytes()
    lines = [json.loads(line) for line in (cut.folder / "history.jsonl").read_text().splitlines()]
    assert lines[WINDOW]["spp"] == 4 and lines[WINDOW]["noise_norms"][KEY] > 0


REFUSED = {
    "odd": ({"measure_snr": True, "spp": 5}, "spp is 5; make it even"),
    "unused": ({"adaptive_spp": {"target_snr": 2.0}}, "adaptive_spp requires spp = 'auto', but spp is 4"),
    "misspelt": ({"spp": "atuo"}, "'spp' is 'atuo': input should be a valid integer"),
    "true": ({"spp": True}, "'spp' is True: input should be a valid integer"),
    "none": ({"spp": 0}, "'spp' is 0: input should be greater than or equal to 1"),
    "no power": ({"spp": "auto", "adaptive_spp": {"min": 6}}, "min = 6 is not a power of two (2, 4, ...); use 4"),
    "one": ({"spp": "auto", "adaptive_spp": {"min": 1}}, "use 2"),
    "order": ({"spp": "auto", "adaptive_spp": {"min": 64, "max": 8}}, "min = 64 is above max = 8"),
    "key": (
        {"spp": "auto", "adaptive_spp": {"target_snd": 1.0}},
        "unknown key 'adaptive_spp.target_snd'; did you mean 'target_snr'?",
    ),
    "zero": ({"max_consecutive_nonfinite": 0}, "'max_consecutive_nonfinite' is 0"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_makes_no_sense_is_refused_in_one_line(case: str) -> None:
    change, words = REFUSED[case]
    Path("job.json").write_text(json.dumps({**JOB, **change}))
    with pytest.raises(PathreplayError) as told:
        load_config(Path("job.json"))
    assert words in str(told.value) and "\n" not in str(told.value)
