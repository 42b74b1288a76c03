"""A baseline: the same job by another integrator in the same time, and pictures judged without their noise."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy

from pathreplay.errors import PathreplayError
from pathreplay.inverse.loop.checkpoint import Entry
from pathreplay.inverse.loop.loop import image_error, new_run, render_views
from pathreplay.inverse.loop.verdict import verdict_of
from pathreplay.inverse.parameters.grids import rmse
from pathreplay.inverse.problem.problem import build_problem
from pathreplay.jobs import make_config, optimize
from pathreplay.library.iterations import run_of
from pathreplay.report.result import outcome_of
from pathreplay.runs.run_folder import Job
from room_job import JOB, TEXTURE, interrupt_at, room, run  # noqa: F401 (room: its folder, for every test)

# What the job itself has: its kernels are compiled when the baseline's turn comes.
RIVAL = {"type": "prb", "max_depth": 3}
# Targets whose own noise is a sixteenth of that of 16 samples per pixel.
SHARP = {"scene": "room.xml", "spp": 4096, "integrator": {"type": "path", "max_depth": 3}}


def history(path: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


@pytest.mark.drawn
def test_rival_gets_the_same_time_and_both_are_shown() -> None:
    result = run(baseline=RIVAL)
    own, others = history(result.folder / "history.jsonl"), history(result.folder / "baseline/history.jsonl")
    spent = [sum(entry["seconds"] for entry in run) for run in (own, others)]
    # It stops with the first iteration that ends after the time is over.
    assert spent[1] - others[-1]["seconds"] < spent[0] <= spent[1]
    # While the job compiles its kernels the baseline takes many steps before the job's first judgement.
    first = own[0]["picture_error"]
    # It may take all its steps at that turn, since the job's later ones are launched and not traced.
    for entries, least in ((own, 2), (others, 1)):
        judgements = [entry["picture_error"] for entry in entries if entry["picture_error"] is not None]
        assert len(judgements) >= least and entries[-1]["picture_error"] == judgements[-1] < first
        assert entries[-1]["errors"][TEXTURE] < entries[0]["errors"][TEXTURE]
    # From the same start with the same seeds.
    assert others[0]["loss"] == pytest.approx(own[0]["loss"], rel=1e-5)
    values = safetensors.numpy.load_file(result.folder / "baseline/parameters.safetensors")
    assert values[TEXTURE].shape == result.parameters[TEXTURE].shape

    html = result.report.read_text()
    assert "Comparison with prb (baseline) at equal time" in html  # the job has prb as well
    assert len(re.findall(r"<figcaption>recovered by prb \(baseline\)</figcaption>", html)) == 2  # of both views
    assert (result.folder / "comparison.svg").exists() and (result.folder / "images/baseline-left.png").exists()


def test_errors_of_poses_are_those_of_the_results() -> None:
    """A result is a mean of iterates. Its errors differ from those of the last iterate."""
    key, plugin = "left.to_world", {"type": "pathreplay", "max_depth": 3, "boundary": "none"}
    entry = {"key": key, "pose": "translation"}
    config = make_config({**JOB, "integrator": plugin, "baseline": plugin, "parameters": [entry]})
    problem = build_problem(config, Path.cwd())
    run = run_of(problem)
    assert run.baseline is not None
    for each, shift in ((run, 0.25), (run.baseline, 0.5)):
        each.values = {f"{key}:translation": np.float32([0, shift, 0])}
        each.history = [Entry(0, 1.0, 1.0, {}, errors={f"{key}:position": 9.0, f"{key}:degrees": 9.0})]
    images = {view.name: view.target for view in problem.views}
    job = Job(config, None, Path.cwd())
    outcome = outcome_of(job, Path("run"), problem, run, images, images, images, verdict_of(problem, run, False))
    errors = [[side.errors[f"{key}:{part}"] for part in ("position", "degrees")] for side in outcome.comparison()]
    assert errors[0] == pytest.approx([0.25, 0], abs=1e-4) and errors[1] == pytest.approx([0.5, 0], abs=1e-4)


def test_without_a_rival_nothing_is_judged() -> None:
    result = run(iterations=1)
    assert result.history[0].picture_error is None
    assert not (result.folder / "baseline").exists() and "Next to" not in result.report.read_text()


@pytest.mark.slow
def test_a_stopped_rival_goes_on_with_its_job(monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        interrupt_at(3, patch)
        stopped = run(baseline=RIVAL)
    before = history(stopped.folder / "baseline/history.jsonl")
    assert stopped.stopped and len(before) >= 1
    after = history(optimize(resume=stopped.folder, progress=False).folder / "baseline/history.jsonl")
    assert (
        len(after) > len(before) and after[: len(before) - 1] == before[:-1]
    )  # the last one is judged when it is over


@pytest.mark.slow
def test_a_rival_goes_through_the_same_resolutions() -> None:
    grid = [{"key": TEXTURE, "initial": 0.5, "lower": 0.0, "upper": 1.0, "resolutions": [2, 5], "refine_at": [3]}]
    result = run(baseline=RIVAL, parameters=grid)
    values = safetensors.numpy.load_file(result.folder / "baseline/parameters.safetensors")
    assert values[TEXTURE].shape == result.parameters[TEXTURE].shape == (5, 5, 3)


def test_judgement_is_free_of_the_noise_of_rendering(tmp_path: Path) -> None:
    """At the truth pictures differ by noise only: the judgement is far below that, and sees the gap off the truth."""
    config = make_config({**JOB, "spp": 16, "baseline": RIVAL, "sensors": ["left"], "target": SHARP})
    problem = build_problem(config, Path.cwd())
    values = new_run(problem, problem.integrator).values
    gap = image_error(problem, values, 0)
    for variable in problem.variables:
        assert variable.truth is not None
        values[variable.key] = variable.truth
    noisy = rmse(render_views(problem, values)["left"], problem.views[0].target)
    left = max(image_error(problem, values, i) for i in range(4))
    assert left < 0.1 * gap and left < 0.3 * noisy


@pytest.mark.parametrize(
    ("baseline", "words"),
    [({"type": "path"}, "'path' computes no gradients"), ({"type": "prbb"}, "'prbb' cannot be created")],
)
def test_a_rival_that_cannot_run_is_told_before_anything_is_rendered(baseline: dict[str, object], words: str) -> None:
    with pytest.raises(PathreplayError, match=words):
        run(baseline=baseline)
    assert not Path("runs").exists()
