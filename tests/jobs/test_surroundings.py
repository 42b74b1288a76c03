"""What surrounds a run is not its own: settings of matplotlib, the current folder, streams that are not there."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import matplotlib
import pytest

import pathreplay
from pathreplay import cli
from pathreplay.jobs import make_config, optimize
from pathreplay.report import drawing
from pathreplay.report.watch.server import RunServer
from room_job import JOB
from small_job import ERROR, write_job

ONE = {"iterations": 2, "spp": 1, "eval_spp": 1, "target": {"scene": "room.xml", "spp": 1}}


@pytest.fixture(autouse=True)
def room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    write_job(tmp_path, **ONE)
    return tmp_path


def python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    own = {key: value for key, value in os.environ.items() if key != "DRJIT_LIBLLVM_PATH"}
    command = [sys.executable, "-c", code]
    return subprocess.run(command, env=own | environment, capture_output=True, text=True, timeout=120, check=False)


def drawn() -> bytes:
    with drawing.own_settings():
        figure = drawing.Figure(figsize=(2, 2))
        figure.add_subplot().plot([1, 2], label="a")
        from pathreplay.report.report import _plain

        _plain(figure.axes[0], "iteration")
        file = Path("drawn.png")
        figure.savefig(file)
    return file.read_bytes()


def test_the_user_s_settings_of_matplotlib_do_not_count_and_stay() -> None:
    plain = drawn()
    with matplotlib.rc_context({"text.usetex": True, "font.size": 40, "savefig.dpi": 30}):
        assert drawn() == plain
        assert matplotlib.rcParams["text.usetex"] and matplotlib.rcParams["font.size"] == 40


@pytest.mark.drawn
def test_a_report_needs_no_latex() -> None:
    with matplotlib.rc_context({"text.usetex": True}):
        assert optimize("job.json", progress=False).report.is_file()


def test_a_backend_that_is_none_does_not_count(room: Path) -> None:
    code = "import pathreplay.jobs, os; print(os.environ['MPLBACKEND'], os.environ.get('MATPLOTLIBRC'))"
    done = python(code, MPLBACKEND="nonsense")
    assert done.returncode == 0 and done.stdout == "nonsense None\n", done.stderr


def test_settings_that_cannot_be_read_get_one_line(room: Path) -> None:
    Path("matplotlibrc").write_bytes(b"\xff")
    done = python("import sys; sys.argv[1:] = ['optimize', 'job.json']; from pathreplay.cli import main; main()")
    assert done.returncode == 2 and done.stderr.splitlines()[-1].startswith(f"{ERROR}matplotlib cannot be imported")
    assert "Traceback" not in done.stderr


def test_a_run_stays_in_its_folder_wherever_the_user_goes(room: Path) -> None:
    """Between the call and the first iteration, within the loop, and where they were when it ends."""
    (room / "elsewhere").mkdir()
    session = pathreplay.iterate("job.json", output="runs/mine")
    os.chdir(room / "elsewhere")
    for state in session:
        assert state.folder == room / "runs/mine"
        os.chdir(room / f"elsewhere{'/..' * (state.number % 2)}")
    assert session.result is not None and session.result.folder.resolve() == room / "runs/mine"
    assert session.result.report.is_file() and not list((room / "elsewhere").iterdir())
    os.chdir(room)
    session = pathreplay.iterate(make_config({**JOB, **ONE}), output="runs/mine")
    next(session)
    os.chdir(room / "elsewhere")
    session.close()
    os.chdir(room)
    going_on = pathreplay.iterate(resume="runs/mine-2")
    os.chdir(room / "elsewhere")
    assert going_on.stop().iterations == 2
    assert (room / "runs/mine-2/report.html").is_file() and not list((room / "elsewhere").iterdir())


def test_a_program_without_a_console_has_its_runs(monkeypatch: pytest.MonkeyPatch, room: Path) -> None:
    with monkeypatch.context() as patch:
        for name in ("stdout", "stderr"):
            patch.setattr(sys, name, None)
        assert optimize("job.json", output="run", progress=True).iterations == 2
        check = ["check", "room.xml", "--param", "floor.reflectance.value", "--seeds", "2", "--spp", "1"]
        for arguments in (
            ["optimize", "job.json", "--output", "other"],
            check,
            ["compare", "run", "other"],
            ["--help"],
        ):
            patch.setattr(sys, "argv", ["pathreplay", *arguments])
            with pytest.raises(SystemExit) as end:
                cli.main()
            assert end.value.code in (None, 0, 1), arguments


def test_the_address_of_a_run_needs_no_console(monkeypatch: pytest.MonkeyPatch, room: Path) -> None:
    run = optimize("job.json", output="run", progress=False).folder
    served: list[RunServer] = []
    monkeypatch.setattr("pathreplay.report.watch.server.serve", served.append)
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", None)
        cli.watch(run, port=0, host="127.0.0.1")
    served[0].server_close()


@pytest.mark.parametrize("limit", [300_000, 450_000, 600_000])
def test_too_few_addresses_are_told(limit: int, room: Path) -> None:
    limited = f"import resource; resource.setrlimit(resource.RLIMIT_AS, 2 * [{limit * 1024}]); import sys; "
    done = python(limited + "sys.argv[1:] = ['optimize', 'job.json']; from pathreplay.cli import main; main()")
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
    assert done.stderr.startswith(f"{ERROR}{limit} kB of address space (ulimit -v) is too little")
    done = python(limited + "import pathreplay; pathreplay.optimize('job.json')")
    assert f"PathreplayError: {limit} kB of address space" in done.stderr.splitlines()[-1]


def test_a_library_that_is_not_loaded_for_want_of_addresses_is_told(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def lacking(*_: object, **__: object) -> None:
        raise ImportError("libLLVM.so: failed to map segment from shared object")

    monkeypatch.setattr(cli, "app", lacking)
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 2 and "libLLVM.so" in capsys.readouterr().err
