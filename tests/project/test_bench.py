"""The benchmarks' own machinery: going on after a break, methods that die, comparisons, plots, messages."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import asdict, replace
from importlib import import_module
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from pathreplay.errors import PathreplayError
from pathreplay.inverse.loop import checkpoint
from pathreplay.inverse.optim.adaptive import State
from pathreplay.runs.run_folder import CHECKPOINT
from places import ROOT

sys.path.insert(0, str(ROOT))  # the benchmarks run from the checkout and are not installed

from benchmarks import drafts, kills, pages, plots, records, runner, summaries, tables
from benchmarks.__main__ import TASKS, main
from benchmarks.compare import Row, compare
from benchmarks.measures.job import Job, Machine, Point, Record
from benchmarks.measures.methods import DIFFERENCE
from benchmarks.measures.replay_error import SWEEP
from benchmarks.measures.worker import MEASURES, told
from benchmarks.schedule import Costs, Trouble, built, simulated
from benchmarks.tasks import attached, depth, edges, iteration, media, noise, scale, surface, truth

MACHINE = Machine("a processor", 2, 2, "Linux", "3.11", "3.9.1", "1.5.0", "0.1.0", "23.1.4", "llvm_ad_rgb")
ROUNDS = 12


def point(method: str, slowness: float = 1.0, noise: float = 1.0, seed: int = 0, **more) -> Point:
    """A point with samples that spread by some per cent."""
    random = np.random.default_rng([seed, len(method)])
    seconds = 0.1 * slowness * random.lognormal(0, 0.03, ROUNDS)
    errors = noise * random.lognormal(0, 0.1, ROUNDS)
    known = {"scene": "box", "parameters": ("texture",), "max_depth": 8, "paths": 64, "peak_mib": None}
    return Point(
        method=method,
        seeds=tuple(range(ROUNDS)),
        seconds=tuple(seconds.tolist()),
        squared_errors=tuple(errors.tolist()),
        not_finite=(),
        **known | more,
    )


def record(*points: Point, task: str = "surface", machine: Machine = MACHINE) -> Record:
    return Record(
        task, f"pathreplay bench {task}", "2026-01-01T00:00:00", "0123456789ab", (0.1, 0.2), (machine,), points
    )


def rows(old: Record, new: Record, outcome: str) -> list[Row]:
    return [row for row in compare(old, new).rows if row.outcome == outcome]


# ------------------------------ The regression guard ------------------------------


def test_a_run_that_is_as_fast_and_as_noisy_is_not_flagged() -> None:
    old, new = (record(point("prb", seed=s), point("sweep", 0.7, seed=s)) for s in (1, 2))
    comparison = compare(old, new)
    assert [row.outcome for row in comparison.rows] == ["same", "same"]  # time and variance of the sweep
    assert not comparison.worse and "2 of 2" in comparison.table()


def test_benchmarks_can_be_imported_before_a_variant_is_set(run_python) -> None:
    done = run_python("import benchmarks.__main__")
    assert done.returncode == 0, done.stderr


def test_what_is_no_file_is_no_record() -> None:
    with pytest.raises(PathreplayError, match="/dev/zero cannot be read: it is a device"):
        records.read(Path("/dev/zero"))


def test_a_slower_method_is_flagged_relative_to_its_rival() -> None:
    old = record(point("prb", seed=1), point("sweep", 0.7, seed=1))
    new = record(point("prb", 3.0, seed=2), point("sweep", 0.7 * 3.0 * 1.3, seed=2))  # a machine three times slower
    (slow,) = compare(old, new).worse
    assert (slow.method, slow.quantity) == ("sweep", "time / prb")
    assert slow.told.startswith("1.3") or slow.told.startswith("1.2")
    assert [row.quantity for row in rows(new, old, "better")] == ["time / prb"]


def test_a_rival_that_gets_slower_is_no_regression() -> None:
    old, new = record(point("prb", seed=1)), record(point("prb", 2.0, seed=2))
    assert compare(old, new).rows == ()


def test_a_noisier_method_is_flagged() -> None:
    old, new = (record(point("prb", seed=s), point("sweep", noise=s, seed=s)) for s in (1, 2))
    assert [row.quantity for row in compare(old, new).worse] == ["variance"]


def test_seconds_without_a_rival_are_compared_on_the_same_machine_only() -> None:
    old, new = record(point("sweep", seed=1)), record(point("sweep", 1.5, seed=2))
    assert [row.quantity for row in compare(old, new).worse] == ["time"]
    other = replace(new, machines=(replace(MACHINE, processor="another processor"),))
    assert [row.quantity for row in rows(old, other, "not comparable")] == ["time"]


def test_memory_death_and_a_failed_truth_are_flagged() -> None:
    fine = point("sweep", peak_mib=100.0)
    assert [r.quantity for r in compare(record(fine), record(replace(fine, peak_mib=120.0))).worse] == ["memory"]
    dead = compare(record(fine), record(replace(fine, error="died: SIGKILL"))).worse
    assert [r.told for r in dead] == ["died: SIGKILL"]
    right, wrong = (replace(fine, verdict=verdict) for verdict in ("pass", "fail"))
    assert [r.told for r in compare(record(right), record(wrong)).worse] == ["fail, was pass"]
    assert [r.outcome for r in compare(record(wrong), record(right)).rows] == ["better"]


def test_rows_that_only_one_record_has_are_named() -> None:
    old, new = record(point("prb"), point("sweep")), record(point("prb"), point("replay"))
    assert [row.method for row in rows(old, new, "missing")] == ["sweep"]
    assert [row.method for row in rows(old, new, "new")] == ["replay"]
    assert "not in the new record" in compare(old, new).table()


def test_stages_are_compared_with_the_same_stage_of_the_rival() -> None:
    def start(slowness: float, seed: int) -> Record:
        stages = ("import", 0.1), ("first gradient", 1.0)
        baseline = [point(f"prb, {stage}", length, seed=seed) for stage, length in stages]
        return record(*baseline, *(point(f"sweep, {stage}", length * slowness, seed=seed) for stage, length in stages))

    times = [row for row in compare(start(1, 1), start(1.4, 2)).rows if "time" in row.quantity]
    assert [(row.method, row.quantity, row.outcome) for row in times] == [
        ("sweep, import", "time / prb, import", "worse"),
        ("sweep, first gradient", "time / prb, first gradient", "worse"),
    ]


def test_a_method_that_raised_has_no_memory_in_the_table() -> None:
    more = {"scene": "closed-box", "parameters": (attached.BALL,), "peak_mib": 100.0}
    raised = point("sweep", **more, error="raises: nothing")
    table = attached.table(record(point("prb", **more), raised, task="attached"))
    assert table.splitlines()[-1].split("|")[3:5] == [" 100 ", " raises: nothing "]


# ------------------------------ Runs that are killed ------------------------------


def saved_run(folder: Path, seconds: float = 0.5, loss: float = 1.0, value: float = 0.25) -> Path:
    """A run folder as far as it is compared, with the checkpoint that a run of one variable writes."""
    values = {"wall": np.full(3, value, np.float32)}
    run = checkpoint.Run(executor=Mock(), optimiser=Mock(state=lambda: State({"wall": 1}, {})), values=values)
    run.history = [checkpoint.Entry(0, loss, seconds, {"wall": 1.0})]
    (folder / "images").mkdir(parents=True)
    (folder / CHECKPOINT).write_bytes(b"".join(checkpoint.save(run)()))
    (folder / "history.jsonl").write_text(json.dumps(asdict(run.history[0])) + "\n")
    for name in ("parameters.safetensors", "parameters.json", "views.json"):
        (folder / name).write_bytes(b"the same")
    return folder


def test_runs_are_compared_without_their_seconds(tmp_path: Path) -> None:
    whole, late = (kills.outcome(saved_run(tmp_path / f"{t}", seconds=t)) for t in (0.5, 2.0))
    assert whole == late and whole["checkpoint: history"][0]["loss"] == 1.0
    other = kills.outcome(saved_run(tmp_path / "loss", loss=2.0))
    assert {key for key in whole if whole[key] != other[key]} == {"history", "checkpoint: history"}
    other = kills.outcome(saved_run(tmp_path / "value", value=0.5))
    assert {key for key in whole if whole[key] != other[key]} == {"checkpoint: value:wall"}


# ------------------------------ Going on after a break ------------------------------

JOB = Job(
    scene="closed-box",
    parameters=depth.WALLS,
    methods=("sweep",),
    max_depth=2,
    rr_depth=3,
    resolution=4,
    spp=1,
    rounds=2,
    warmup=0,
    threads=1,
)


def test_finished_jobs_are_not_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ran: list[Job] = []

    def run(job: Job, measured: runner.Measured, show: object) -> None:
        if len(ran) == 2:
            raise KeyboardInterrupt
        ran.append(job)
        measured.points.append(point("sweep", seed=len(ran), max_depth=job.max_depth))
        measured.machines.append(MACHINE)

    monkeypatch.setattr(runner, "_run_job", run)
    jobs = [JOB, replace(JOB, max_depth=3), JOB]  # the first one twice, in turn
    path = tmp_path / "depth.json"
    with pytest.raises(KeyboardInterrupt):
        runner.run_jobs("depth", jobs, drafts.Draft(path))
    first = list(ran)
    ran.clear()
    draft = drafts.Draft(path)
    measured = runner.run_jobs("depth", jobs, draft)
    assert first == jobs[:2] and ran == jobs[2:]
    assert [p.max_depth for p in measured.points] == [2, 3, 2] and measured.machines == [MACHINE]
    assert draft.sittings == 2 and "2 sittings" in tables.footnote(replace(record(*measured.points), sittings=2))
    draft.discard()
    assert not path.exists()


def test_a_draft_of_other_code_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "depth.json"
    drafts.Draft(path).add(drafts.Done(JOB, 0, (point("sweep"),), (MACHINE,)))
    draft = drafts.Draft(path)
    assert draft.find(JOB, 0) is not None and not draft.stale
    monkeypatch.setattr(drafts, "stamp", lambda: "of other code")
    assert draft.stale
    assert drafts.Draft(path).find(JOB, 0) is None
    path.write_text("half a file")
    assert drafts.Draft(path).find(JOB, 0) is None


# ------------------------------ Workers ------------------------------


@pytest.mark.parametrize("task", TASKS)
def test_a_worker_is_told_all_of_a_job_and_can_do_it(task: str) -> None:
    for job in TASKS[task].jobs(quick=False):
        assert Job.decode(job.encode()) == job
        module, name = MEASURES[job.measure]
        assert {"__call__", "forget", "conclude"} <= set(
            dir(import_module(f"benchmarks.measures.{module}").__dict__[name])
        )


def test_methods_that_raise_or_die_are_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In one job: a plugin that does not exist, and a process that is killed at its second method."""
    worker = tmp_path / "worker.py"
    worker.write_text(
        "import json, os, signal, sys\n"
        "def say(**facts): print(json.dumps(facts), flush=True)\n"
        "for method in json.loads(sys.argv[-1])['methods']:\n"
        "    say(event='start', method=method)\n"
        "    if method == 'refuses': say(event='error', method=method, message='no such plugin'); continue\n"
        "    if method == 'dies': os.kill(os.getpid(), signal.SIGKILL)\n"
        "    for seed in (0, 1):\n"
        "        say(event='sample', method=method, seed=seed, seconds=0.5, finite=True, kept=True)\n"
        "    say(event='facts', method=method, mean=1.0, values=[0.5, 1.5])\n"
    )
    monkeypatch.setattr(runner, "WORKER", (sys.executable, str(worker)))
    job = replace(JOB, methods=("refuses", "dies", "works"))
    found = {p.method: p for p in runner.run_jobs("depth", [job], drafts.Draft(tmp_path / "draft.json")).points}
    assert found["refuses"].error == "no such plugin"
    assert found["dies"].error == "died: SIGKILL"
    assert found["works"].error is None
    assert found["works"].seconds == (0.5, 0.5) and found["works"].values == (0.5, 1.5)
    assert "died: SIGKILL" in depth.table(record(*found.values(), task="depth"))


def test_a_worker_measures_and_stays_within_its_memory(tmp_path: Path) -> None:
    measured = runner.run_jobs("depth", [replace(JOB, methods=("sweep",))], drafts.Draft(tmp_path / "draft.json"))
    (found,) = measured.points
    assert found.error is None and len(found.seconds) == 2 and len(found.squared_errors) == 2
    assert found.peak_mib is not None and 20 < found.peak_mib < 1000
    assert measured.machines[0].threads == 1
    code = "from benchmarks.measures.worker import limit_memory; limit_memory(); bytearray(9 * 1024**3)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.stderr.strip().endswith("MemoryError")


@pytest.mark.slow
def test_recorded_steps_with_edges_are_measured(tmp_path: Path) -> None:
    """A call that is handed what it no longer takes is a row with an error, which nobody sees until the end."""
    job = TASKS["edges"].jobs(quick=True)[-1]
    measured = runner.run_jobs("edges", [job], drafts.Draft(tmp_path / "draft.json"))
    assert [point.method for point in measured.points] == list(job.methods)
    assert [point.error for point in measured.points] == [None] * len(job.methods)


@pytest.mark.slow
def test_a_number_is_measured_beside_a_central_difference(tmp_path: Path) -> None:
    job = next(job for job in TASKS["edges"].jobs(quick=True) if job.measure == "number")
    measured = runner.run_jobs("edges", [replace(job, rounds=2, spp=4)], drafts.Draft(tmp_path / "draft.json"))
    assert [point.error for point in measured.points] == [None, None]
    assert all(len(point.squared_errors) == 2 for point in measured.points)


def test_a_number_is_as_noisy_as_its_variance_over_that_of_a_difference() -> None:
    def found(method: str, *errors: float) -> Point:
        return replace(point(method), scene="head turns", measure="number", squared_errors=errors)

    pair = (found(DIFFERENCE, 1, 2, 3), found(edges.OURS, 1, 1, 10))
    row = edges.worth(record(*pair, task="edges")).splitlines()[-1]
    assert row.startswith("| head turns | 2.00 [") and row.endswith("| 0.50 | 83% |")
    failed = edges.worth(record(pair[0], replace(pair[1], squared_errors=(), error="died: SIGKILL"), task="edges"))
    assert "died: SIGKILL" in failed
    assert "head turns" not in edges.costs(edges.by_job(edges.timed(record(*pair, task="edges"))))


def test_a_cause_of_death_fits_into_a_table() -> None:
    crash = RuntimeError("dr.while_loop(): jit_malloc(): out of memory! Could not allocate 262144 bytes. " + "x" * 999)
    assert told(crash) == told(MemoryError()) == "out of memory (of 8 GiB)"
    assert len(told(RuntimeError("x" * 999))) == 200
    assert tables.markdown(["a", "b"], [["x|y", "z"]]).splitlines()[2] == r"| x\|y | z |"


# ------------------------------ Plots and the command line ------------------------------


def test_plots_are_drawn_from_records(tmp_path: Path) -> None:
    sizes = (4, 16, 64)
    by_depth = [
        point(method, n / 4, scene=scene, max_depth=n, peak_mib=100.0 + n)
        for scene in (depth.SURFACES, depth.MEDIA)
        for method in ("sweep", "prb", "RB")
        for n in sizes
    ]
    clouds = [point(m, 0.5 if m == "score" else 1, scene="cloud", parameters=(media.DENSITY,)) for m in media.METHODS]
    errors = [
        replace(point(name, scene="diffuse sheets", max_depth=n), values=(1e-3 * n, 2e-3 * n))
        for name in (SWEEP, *noise.NOISY)
        for n in (3, 6)
    ]
    known = {
        "depth": record(*by_depth, replace(by_depth[0], method="naive AD", error="died: SIGKILL"), task="depth"),
        "media": record(*clouds, task="media"),
        "noise": record(*errors, task="noise"),
    }
    drawn = plots.draw_all(tmp_path, known.get)
    names = {"depth-time", "depth-memory", "media-efficiency", "replay-noise"}
    assert {path.stem for path in drawn} == names and {path.suffix for path in drawn} == {".svg", ".png"}
    assert all(path.stat().st_size > 5000 for path in drawn)
    first = (tmp_path / "depth-time.svg").read_bytes()
    assert plots.draw_all(tmp_path / "again", {"depth": known["depth"]}.get)
    assert (tmp_path / "again" / "depth-time.svg").read_bytes() == first, "the same record draws the same picture"
    assert plots.draw_all(tmp_path, {}.get) == []


def test_the_page_shows_what_was_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = tmp_path / "evidence.md"
    page.write_text(
        "".join(f"<!-- begin {task} -->\nold\n<!-- end {task} -->\n" for task in ("depth", "media", "depth-summary"))
    )
    monkeypatch.setattr(records, "RESULTS", tmp_path)
    records.save(record(point("sweep", scene=depth.SURFACES), task="depth"), tmp_path)
    assert pages.fill({"depth": depth.table, "media": media.table}, [page]) == ["media"]
    told = page.read_text()
    assert "![Peak memory against path length](images/depth-memory.svg)" in told and "`pathreplay bench depth`" in told
    assert "<!-- begin media -->\n*Not measured yet.*\n<!-- end media -->\n" in told and "old" not in told
    assert "| closed-box | sweep | 8 to 8 | too few depths |" in told


def test_summaries_count_and_compare() -> None:
    names = truth.STEPS + truth.SURFACE
    points = [replace(point(name, scene="texture"), verdict=None if name in truth.STEPS else "pass") for name in names]
    points[-1] = replace(points[-1], verdict="fail")
    points[-2] = replace(points[-2], error="cannot")
    told = summaries.SUMMARIES["truth-summary"][1](record(*points))
    assert "| sweep | 1 | 1 | 0 | 0 | 0 |" in told and "| prb_basic | 1 | 0 | 1 | 0 | 0 |" in told
    assert "| prb | 1 | 0 | 0 | 0 | 1 |" in told
    told = summaries.SUMMARIES["surface-summary"][1](record(point("prb"), point("sweep", 0.5)))
    assert told.splitlines()[2].startswith(("| box, texture | scene | 0.5", "| box, texture | scene | 0.4"))
    steps = [point(name, 0.5 if "own" in name else 1, scene="cloud") for name in iteration.MEDIA]
    assert "| cloud | scene | 0." in summaries.SUMMARIES["iteration-summary"][1](record(*steps))
    clouds = [point(m, parameters=(media.DENSITY,)) for m in ("prbvolpath", "score")]
    assert "| density: box | " in summaries.SUMMARIES["media-summary"][1](record(*clouds))


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"tasks": ["nonsense"]}, "there is no task 'nonsense'; use "),
        ({"quick": True, "save": True}, "--save and --into need a full run"),
        ({"quick": True, "into": Path("folder")}, "--save and --into need a full run"),
        ({"against": Path("none.json")}, "none.json cannot be read"),
        ({"against": records.RESULTS / "surface.json", "tasks": ["depth"]}, "is a record of task 'surface'"),
        (
            {"against": records.RESULTS / "surface.json", "tasks": [str(records.RESULTS / "depth.json")]},
            "one of 'depth'",
        ),
    ],
)
def test_wrong_usage_says_what_would_be_right(arguments: dict, told: str) -> None:
    with pytest.raises(PathreplayError, match=told):
        main(**arguments)


@pytest.mark.slow
def test_two_records_are_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """By the command, which is run where the user is: exit status, table, and a mistake as one line."""
    for name, slowness in (("old", 0.7), ("new", 1.4)):
        path = records.save(record(point("prb", seed=1), point("sweep", slowness, seed=2)), tmp_path)
        path.rename(tmp_path / f"{name}.json")
    main(tasks=[str(tmp_path / "old.json")], against=tmp_path / "old.json")
    assert "2 of 2 quantities are the same" in capsys.readouterr().out
    command = [sys.executable, "-m", "pathreplay.cli", "bench", "--compare", "old.json", "new.json"]
    worse = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert worse.returncode == 1 and "| box | sweep | 8 | time / prb | worse | 2.00 [" in worse.stdout, worse.stderr
    (tmp_path / "new.json").write_text("{}")
    wrong = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert (wrong.returncode, wrong.stdout) == (2, "")
    assert "new.json is not a benchmark record" in wrong.stderr and wrong.stderr.count("\n") == 1


def test_actors_are_compared_with_one_of_them() -> None:
    more = {"scene": "cloud, 32 views", "parameters": (), "measure": "iterations"}
    found = [
        replace(point(method, **more), values=values)
        for method, values in (
            ("this process", (1.5, 1.7, 1.6)),
            ("1 actor", (1.8, 2.2, 2.0)),
            ("2 actors", (1.2, 1.0)),
        )
    ]
    failed = replace(point("2 actors", **{**more, "scene": "surfaces, 32 views"}), error="no Ray here", values=())
    lines = scale.table(record(*found, failed, task="scale")).splitlines()
    assert [line.split(" | ")[2:] for line in lines[2:5]] == [
        ["1.600", "0.80 |"],
        ["2.000", "1.00 |"],
        ["1.100", "0.55 |"],
    ]
    assert "no Ray here" in lines[5]


def test_saved_records_can_be_read_and_tabled() -> None:
    """Those in the repository, which the documentation shows."""
    found = {path.stem: records.read(path) for path in records.RESULTS.glob("*.json")}
    assert surface.TITLE in found and set(found) <= set(TASKS)
    for name, kept in found.items():
        assert kept.task == name and TASKS[name].table(kept).startswith("| ")
        assert not kept.command.endswith("--quick")


def test_the_numbers_of_the_readme_are_those_of_the_tables() -> None:
    estimates = r"\d+\.\d+ \[\d+\.\d+, \d+\.\d+\]"
    told = re.findall(estimates, (ROOT / "README.md").read_text(encoding="utf-8"))
    measured = set(re.findall(estimates, (ROOT / "docs" / "evidence.md").read_text(encoding="utf-8")))
    assert len(told) >= 5 and set(told) <= measured


def test_the_simulated_schedule_agrees_with_the_model_and_survives_the_loss_of_devices() -> None:
    costs, size = Costs(), (400, 10, 10**6)  # shards, devices, parameters
    undisturbed, lossy = (simulated(costs, *size, trouble) for trouble in (Trouble(), Trouble(lost_after=100.0)))
    assert undisturbed == pytest.approx(built(costs, *size), rel=0.05)
    assert 1.02 * undisturbed < lossy < 3 * undisturbed
