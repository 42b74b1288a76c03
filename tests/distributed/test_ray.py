"""Actors of Ray: the same bits whoever computes what, whatever is lost on the way, and nobody else who listens."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import psutil
import pytest

from places import ROOT

if sys.version_info < (3, 11):
    import tomli as tomllib
else:
    import tomllib

from pathreplay.distributed import cluster
from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.schema import AUTO
from pathreplay.inverse.loop.loop import new_run, take_step
from pathreplay.inverse.problem.problem import build_problem
from pathreplay.jobs import load_config, make_config, optimize
from pathreplay.platform.threads import one_thread
from room_job import CLOUD, JOB, room  # noqa: F401 (room: its folder, for every test)
from small_job import ERROR, TIMEOUT_S, checkpoint_bits, ended, hear_signals, start, wait_for, write_job

SWEEP = {"integrator": {"type": "pathreplay", "max_depth": 3}}
VIEWS = {"scene_parameters": {**CLOUD["scene_parameters"], "views": 3}}
JOBS: dict[str, dict[str, Any]] = {
    "surfaces": {**SWEEP, "spp_shards": 2, "measure_snr": True, "spp": 8},
    "medium": {**CLOUD, **VIEWS, "spp": 4},
    "stages": {**SWEEP, "stages": [{"iterations": 10, "max_depth": 2, "downscale": 2}, {"iterations": 10}]},
}
SLOW = pytest.mark.slow


def job_of(name: str, **changes: Any) -> dict[str, Any]:
    job = {**JOB, "iterations": 20, "deterministic": True, "eval_spp": 4, **JOBS[name], **changes}
    return {key: value for key, value in job.items() if not (key == "iterations" and "stages" in job)}


def bits(folder: Path) -> dict[str, bytes]:
    """Values, what the optimiser remembers, what was learned."""
    return checkpoint_bits(folder)


def run(name: str, **changes: Any) -> dict[str, bytes]:
    return bits(optimize(make_config(job_of(name, **changes)), progress=False).folder)


# ------------------------------ Without Ray ------------------------------


def test_where_ray_is_not_installed_a_line_says_so(
    monkeypatch: pytest.MonkeyPatch,
    room: Path,  # noqa: F811
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    before = set(room.iterdir())
    with pytest.raises(PathreplayError, match=r"executor = 'ray' needs Ray .*pip install 'pathreplay\[ray\]'"):
        run("surfaces", executor="ray")
    with pytest.raises(PathreplayError, match="needs Ray"):
        optimize(make_config(job_of("surfaces")), progress=False, executor="ray")
    assert set(room.iterdir()) == before


def test_an_executor_that_is_none_is_refused() -> None:
    with pytest.raises(PathreplayError, match="executor is 'dask'; use one of local, ray"):
        optimize(make_config(JOB), executor="dask")
    with pytest.raises(PathreplayError, match="'executor' is 'dask'"):
        make_config({**JOB, "executor": "dask"})
    with pytest.raises(PathreplayError, match=r"unknown key 'ray\.actor'; did you mean 'actors'"):
        make_config({**JOB, "ray": {"actor": 2}})


def test_the_page_shows_a_job_that_can_be() -> None:
    page = (ROOT / "docs/scale.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    config = make_config({**JOB, **tomllib.loads(block)})
    assert config.executor == "ray" and set(config.ray.model_fields_set) == set(type(config.ray).model_fields)


def test_the_example_has_many_views_and_the_token_is_for_its_owner() -> None:
    example = ROOT / "examples/cluster"
    config = load_config(example / "config.toml")
    assert config.executor == "ray" and config.deterministic
    script = (example / "slurm.sh").read_text(encoding="utf-8")
    assert subprocess.run(["bash", "-n", str(example / "slurm.sh")], check=False).returncode == 0
    assert "umask 077" in script and "symmetric-run" in script


def test_ranges_must_divide_the_samples() -> None:
    with pytest.raises(PathreplayError, match="spp = 4 cannot be split into spp_shards = 3 equal shards"):
        make_config({**JOB, "spp_shards": 3})
    with pytest.raises(PathreplayError, match="into spp_shards = 8 equal shards, each in two halves"):
        make_config({**JOB, "spp": AUTO, "spp_shards": 8})
    assert make_config({**JOB, "spp_shards": 4}).parts == 4


@pytest.mark.parametrize("noise", [False, True])
def test_ranges_of_samples_are_means_over_more_seeds(noise: bool) -> None:
    """The gradient of four ranges is that of four jobs with a fourth of the samples and those seeds, on average."""
    config = make_config({**JOB, **SWEEP, "spp": 16, "spp_shards": 4 - 2 * noise, "measure_snr": noise})
    problem = build_problem(config, Path.cwd())
    run, shards = new_run(problem, problem.integrator, record=False), []
    kept, evaluate = [], run.executor.evaluate  # type: ignore[attr-defined]

    def watched(values: Any, shard: Any, learned: Any) -> Any:
        shards.append(shard)
        found = evaluate(values, shard, learned)
        kept.append(deepcopy(found))  # what a step is given it adds up in place
        return found

    run.executor.evaluate = watched  # type: ignore[attr-defined]
    with one_thread(True):
        take_step(problem, run, 0)
    assert [shard.samples for shard in shards] == 8 * [4]
    assert len({shard.seeds for shard in shards}) == 8
    mean = {key: sum(each.gradients[key].astype(np.float64) for each in kept) / 4 for key in kept[0].gradients}
    for key, norm in run.history[0].gradient_norms.items():
        np.testing.assert_allclose(np.linalg.norm(mean[key]), norm, rtol=1e-5)
    assert run.history[0].loss == pytest.approx(sum(each.loss for each in kept) / 4)
    if noise:
        halves = [sum(each.gradients[key].astype(np.float64) for each in kept[half::2]) / 2 for half in (0, 1)]
        expected = np.linalg.norm(halves[0] - halves[1]) / 2
        assert run.history[0].noise_norms[key] == pytest.approx(expected, rel=1e-4)


# ------------------------------ With Ray ------------------------------


@pytest.fixture
def _ray() -> None:
    pytest.importorskip("ray")


with_ray = pytest.mark.usefixtures("_ray")


def listening() -> Iterator[tuple[str, str]]:
    """Processes below this one, and the addresses at which they listen."""
    for process in [psutil.Process(), *psutil.Process().children(recursive=True)]:
        try:
            for each in process.net_connections(kind="inet"):
                if each.status == psutil.CONN_LISTEN:
                    yield process.name(), each.laddr.ip
        except psutil.Error:
            continue


def actors() -> list[psutil.Process]:
    return [p for p in psutil.Process().children(recursive=True) if p.name().startswith("ray::RayActor")]


@SLOW
@with_ray
@pytest.mark.parametrize("name", JOBS)
def test_one_two_and_four_actors_give_the_bits_of_this_process(name: str) -> None:
    expected = run(name)
    assert all(run(name, executor="ray", ray={"actors": count}) == expected for count in (1, 2, 4))


@SLOW
@with_ray
def test_nobody_else_listens_and_nothing_stays(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Under way: addresses, and who may enter Ray's folder. When it is over: processes, files, environment."""
    others = set(Path("/tmp").glob("pathreplay-*"))
    monkeypatch.setattr("tempfile.tempdir", "/tmp")
    monkeypatch.setenv("HOME", str(tmp_path))
    before = {name: value for name, value in os.environ.items() if name != "RAY_AUTH_MODE"}
    seen: set[tuple[str, str]] = set()
    modes: set[int] = set()
    over = threading.Event()

    def look() -> None:
        while not over.is_set():
            seen.update(listening())
            modes.update(path.stat().st_mode & 0o777 for path in set(Path("/tmp").glob("pathreplay-*")) - others)
            time.sleep(0.2)

    watcher = threading.Thread(target=look)
    watcher.start()
    try:
        run("surfaces", executor="ray", ray={"actors": 2})
    finally:
        over.set()
        watcher.join()
    print(sorted(seen))
    assert any("RayActor" in name for name, _ in seen), "the test has seen actors"
    assert {address for _, address in seen} <= {"127.0.0.1", "::1", "::ffff:127.0.0.1"}
    assert modes == {0o700}
    assert set(Path("/tmp").glob("pathreplay-*")) <= others and not (tmp_path / ".ray").exists() and not actors()
    assert {name: value for name, value in os.environ.items() if name != "RAY_AUTH_MODE"}.items() >= before.items()
    assert "RAY_AUTH_TOKEN" not in os.environ


@SLOW
@with_ray
def test_actors_that_are_killed_change_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    many = 200  # iterations: the run goes on while actors are started again
    expected = run("surfaces", iterations=many)
    over, killed = threading.Event(), []

    def kill() -> None:
        while not over.wait(0.01) and len(killed) < 3:
            if there := [p for p in actors() if "evaluate" in p.name()]:
                there[0].kill()
                killed.append(there[0].pid)
                over.wait(1.5)

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        config = make_config(job_of("surfaces", iterations=many, executor="ray", ray={"actors": 2}))
        found = bits(optimize(config, progress=True).folder)
    finally:
        over.set()
        killer.join()
    out, told = capfd.readouterr()
    assert "raylet" not in out + told, "Ray's own words are not for users"
    assert killed and found == expected
    assert "was lost and is being restarted; its shards are computed again" in told
    (restarts,) = re.findall(r"(\d+) restarts", told)
    assert 1 <= int(restarts) <= len(killed), "one that is killed while it starts is started without a word"


@SLOW
@with_ray
@pytest.mark.parametrize("name", ["SIGTERM", "SIGINT", "SIGHUP"])
def test_a_signal_for_all_processes_ends_the_run_in_peace(name: str, tmp_path: Path) -> None:
    """As a terminal, a scheduler or `timeout` sends it: actors stay until all is written."""
    write_job(tmp_path, **{**job_of("surfaces"), "iterations": 2000, "checkpoint_every": 1})
    command = [sys.executable, "-m", "pathreplay.cli", "optimize", "job.json", "--quiet", "--executor", "ray"]
    process = subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        preexec_fn=hear_signals,
    )  # fmt: skip
    checkpoint = tmp_path / "run/checkpoint.safetensors"
    wait_for(checkpoint, process)
    wait_for(checkpoint, process, newer_than=checkpoint.stat().st_mtime)
    children = psutil.Process(process.pid).children(recursive=True)
    os.killpg(process.pid, getattr(signal, name))
    out, err = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 0 and "stopped early" in out, err
    assert (tmp_path / "run/report.html").exists()
    _, alive = psutil.wait_procs(children, timeout=20)
    assert not alive


@SLOW
@with_ray
def test_what_goes_wrong_in_an_actor_is_told_as_here(tmp_path: Path) -> None:
    """A loss of the user's that fails, in a job of the command line: one line, and no folder."""
    (tmp_path / "failing.py").write_text("def loss(image, target):\n    raise RuntimeError('no such colour')\n")
    lines = []
    for executor in ("local", "ray"):
        write_job(tmp_path, **SWEEP, loss="failing:loss", iterations=2)
        status, _, err = ended(start(tmp_path, "job.json", "--quiet", "--executor", executor))
        lines.append(err.splitlines()[-1])
        assert status == 2 and lines[-1].startswith(ERROR) and not (tmp_path / "run").exists(), err
    assert lines[0] == lines[1]


@SLOW
@with_ray
def test_a_cluster_without_a_token_or_at_no_address_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_job(tmp_path, **SWEEP, executor="ray", ray={"address": "127.0.0.1:1"}, iterations=2)
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    status, _, err = ended(start(tmp_path, "job.json", "--quiet"))
    assert status == 2 and "turns authentication off" in err and err.startswith(ERROR) and err.count("\n") == 1
    monkeypatch.delenv("RAY_AUTH_MODE")
    monkeypatch.setenv("HOME", str(tmp_path))
    status, _, err = ended(start(tmp_path, "job.json", "--quiet"))
    assert status == 2 and "no cluster at '127.0.0.1:1'" in err and err.startswith(ERROR) and err.count("\n") == 1


def test_another_version_of_ray_is_told_with_both_versions(monkeypatch: pytest.MonkeyPatch) -> None:
    text = (
        "Version mismatch: The cluster was started with:\n    Ray: 2.54.0\n    Python: 3.11.7\n"
        "This process on node 127.0.0.1 was started with:\n    Ray: 2.55.1\n    Python: 3.12.1\n"
    )
    ray = SimpleNamespace(init=Mock(side_effect=RuntimeError(text)), exceptions=SimpleNamespace(RayError=OSError))
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    with pytest.raises(PathreplayError) as told:
        cluster._connect(ray, "10.0.0.1:6379")
    line = str(told.value)
    assert all(version in line for version in ("2.54.0", "3.11.7", "2.55.1", "3.12.1")) and "\n" not in line
    assert "same versions of Ray and Python" in line and "token" not in line


@SLOW
@with_ray
def test_a_run_goes_on_by_another_executor(tmp_path: Path) -> None:
    whole = run("surfaces")
    write_job(tmp_path, **{**job_of("surfaces"), "iterations": 20, "checkpoint_every": 1})
    process = start(tmp_path, "job.json", "--quiet", "--executor", "ray")
    deadline = time.monotonic() + 120
    while not (tmp_path / "run/checkpoint.safetensors").exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    process.terminate()
    assert ended(process)[0] == 0
    status, _, err = ended(start(tmp_path, "--resume", "run", "--quiet"))
    assert status == 0 or "all its 20 iterations" in err
    assert bits(tmp_path / "run") == whole


def parts_of(process: subprocess.Popen[str], *names: str) -> list[psutil.Process]:
    """What is below a run, by the names of the processes; all without names."""
    found = psutil.Process(process.pid).children(recursive=True)
    return [each for each in found if not names or any(name in each.name() for name in names)]


def gone(processes: list[psutil.Process]) -> bool:
    _, alive = psutil.wait_procs(processes, timeout=30)
    return not alive


@SLOW
@with_ray
@pytest.mark.parametrize("who", ["all", "raylet", "driver"])
def test_what_is_left_of_a_cluster_ends_and_a_line_says_so(who: str, tmp_path: Path) -> None:
    before = set(Path("/tmp").glob("pathreplay-*"))
    write_job(tmp_path, **{**job_of("surfaces"), "iterations": 5000, "checkpoint_every": 1}, ray={"actors": 1})
    process = start(tmp_path, "job.json", "--quiet", "--executor", "ray")
    checkpoint = tmp_path / "run/checkpoint.safetensors"
    wait_for(checkpoint, process)
    wait_for(checkpoint, process, newer_than=checkpoint.stat().st_mtime)
    tree = parts_of(process)
    for each in {"all": tree, "raylet": parts_of(process, "raylet"), "driver": [psutil.Process(process.pid)]}[who]:
        each.kill()
    status, _, err = ended(process)
    if who == "driver":
        assert "the process ended during its run" in err
    else:
        assert status == 2 and err.count(ERROR) == 1, err
        assert f"{ERROR}ray: the cluster is lost" in err and "resume with: pathreplay optimize --resume run" in err
    assert gone(tree) and set(Path("/tmp").glob("pathreplay-*")) <= before


@SLOW
@with_ray
def test_a_cluster_that_is_killed_at_the_start_gets_a_line(tmp_path: Path) -> None:
    write_job(tmp_path, **{**job_of("surfaces"), "iterations": 5000}, ray={"actors": 1})
    process = start(tmp_path, "job.json", "--quiet", "--executor", "ray")
    while not (victims := parts_of(process, "RayActor")) and process.poll() is None:
        time.sleep(0.05)
    tree = parts_of(process)
    for each in [*victims, *parts_of(process, "DashboardAgent", "RuntimeEnvAgent")]:
        each.kill()
    status, _, err = ended(process)
    assert status != 0 and sum(line.startswith("pathreplay: ") for line in err.splitlines()) == 1, err
    folder = tmp_path / "run"
    assert not folder.exists() or len(list((folder / "images").glob("target-*.exr"))) == 2
    assert gone(tree)
