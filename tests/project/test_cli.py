"""The frame of the command line: exit statuses, one-line errors, quick help."""

from __future__ import annotations

import errno
import os
import shlex
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

import pathreplay
from pathreplay import cli
from pathreplay.errors import PathreplayError


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """Run the command line in this process: (exit status, stdout, stderr)."""

    def call(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["pathreplay", *arguments])
        with pytest.raises(SystemExit) as end:
            cli.main()
        captured = capsys.readouterr()
        code = end.value.code
        return (0 if code is None else int(code)), captured.out, captured.err

    return call


def test_version(run) -> None:
    assert run("--version") == (0, f"pathreplay {pathreplay.__version__}\n", "")


def test_help_lists_the_commands(run) -> None:
    status, out, _ = run("--help")
    assert status == 0
    assert "doctor" in out


@pytest.mark.parametrize("command", [(), ("doctor",), ("check",), ("optimize",), ("render",), ("export",)])
def test_flags_take_no_value_in_the_help(run, command: tuple[str, ...]) -> None:
    status, out, _ = run(*command, "--help")
    assert status == 0 and "--help" in out
    assert "<bool>" not in out
    assert all(len(line) <= 80 for line in out.splitlines())


def test_completion_can_be_installed_and_completes(run, run_python) -> None:
    assert "--install-completion" in run("--help")[1]
    words = {"COMP_WORDS": "pathreplay optimize --qu", "COMP_CWORD": "2", "_PATHREPLAY_COMPLETE": "complete_bash"}
    code = "import sys; from pathreplay import cli; sys.argv = ['pathreplay']; cli.main()"
    assert run_python(code, env=words).stdout.split() == ["--quiet"]


def test_bench_of_a_wheel_is_hidden_and_says_what_it_needs(run_python) -> None:
    """From a copy of the package without its repository."""
    code = """
import pathlib, shutil, sys
import pathreplay
here = pathlib.Path(sys.argv[1])
shutil.copytree(pathlib.Path(pathreplay.__file__).parent, here / "pathreplay")
for name in [name for name in sys.modules if name.split(".")[0] == "pathreplay"]:
    del sys.modules[name]
sys.path.insert(0, str(here))
from pathreplay import cli
for words in (["--help"], ["bench", "surface"]):
    sys.argv = ["pathreplay", *words]
    try:
        cli.main()
    except SystemExit as end:
        print("status", end.code)
"""
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        done = run_python(code, args=(folder,))
    assert done.stdout.split()[-1] == "2" and "bench" not in done.stdout
    assert "clone it" in done.stderr and "make bench" in done.stderr


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--seed", "-1"), ["seed is -1", "at least 0"]),
        (("--seeds", "1"), ["seeds is 1"]),
        (("--seeds", "99999999999"), ["seeds is 99999999999", "at most"]),
        (("--spp", "0"), ["spp is 0"]),
        (("--spp", "100000"), ["'spp' is 100000", "up to 65535"]),
        (("--fd-spp", "100000"), ["'fd_spp' is 100000", "up to 65535"]),
        (("--step", "nan"), ["Step nan", "positive"]),
        (("--step", "-1"), ["Step -1.0", "positive"]),
        (("--step", "0"), ["Step 0.0", "positive"]),
        (("--sensor", "-1"), ["Sensor -1"]),
        (("--step", "1e300"), ["Step 1e+300", "too long", "0.01"]),
        (("--step", "1e-320"), ["rounding of single precision", "0.01"]),
        (("--json", "/"), ["--json"]),
        (("--json", "/dev/full"), ["/dev/full is a device", "--json"]),
        (("--json", "x" * 300), ["File name too long", "--json"]),
    ],
)
def test_a_number_that_check_cannot_use_is_named(run, options: tuple[str, ...], words: list[str]) -> None:
    status, out, err = run("check", "cornell-box", "--param", "red.reflectance.value", *options)
    assert (status, out) == (2, "")
    assert err.count("\n") == 1 and all(word in err for word in words), err


def test_an_argument_that_is_not_utf8_is_named(run) -> None:
    status, out, err = run("optimize", "job\udcff.toml")
    assert (status, out) == (2, "")
    assert r"job\udcff.toml" in err and "UTF-8" in err and err.count("\n") == 1


def test_a_current_folder_that_was_removed_is_told(run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    status, out, err = run("check", "cornell-box", "--param", "x")
    assert (status, out) == (2, "")
    assert err == "pathreplay: error: the current folder was removed; change to another and start again\n"


@pytest.mark.parametrize("arguments", [("no-such-command",), ("doctor", "--no-such-option"), ("doctor", "surplus")])
def test_wrong_usage_ends_with_2(run, arguments: tuple[str, ...]) -> None:
    status, out, err = run(*arguments)
    assert (status, out) == (2, "")
    assert err.startswith("pathreplay: error: ") and err.endswith(" --help\n") and err.count("\n") == 1


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (
            PathreplayError("key \x1b[31m\0 " + "y" * 100_000 + " the remedy"),
            r"key \x1b[31m\x00 " + "y" * 50,
        ),
        (
            PathreplayError("key 'a[0]' in\n [bold]/x/y[/bold] " + "z" * 200),
            "key 'a[0]' in [bold]/x/y[/bold] " + "z" * 200,
        ),
        (MemoryError(), "out of memory"),
        (OSError(errno.ENOSPC, "No space left on device", "/runs/a.exr"), "no space left on the disk for /runs/a.exr"),
    ],
)
def test_a_mistake_that_can_be_mended_is_one_line_and_status_2(
    run, monkeypatch: pytest.MonkeyPatch, error: Exception, line: str
) -> None:
    def fail() -> None:
        raise error

    monkeypatch.setattr("pathreplay.doctor.examine", fail)
    status, out, err = run("doctor")
    assert (status, out) == (2, "")
    assert err.startswith(f"pathreplay: error: {line}") and err.count("\n") == 1
    assert len(err) < 1100


def test_other_errors_keep_their_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> None:
        raise OSError(errno.EIO, "disk on fire")

    monkeypatch.setattr("pathreplay.doctor.examine", fail)
    monkeypatch.setattr(sys, "argv", ["pathreplay", "doctor"])
    with pytest.raises(OSError, match="disk on fire"):
        cli.main()


@pytest.mark.parametrize(("option", "value"), [("--output", "x.json"), ("--variant", "llvm_ad_rgb")])
def test_the_doctor_refuses_options_that_need_a_gpu(run, option: str, value: str) -> None:
    assert run("doctor", option, value) == (
        2,
        "",
        f"pathreplay: error: {option} needs --gpu; add --gpu, or leave it out\n",
    )


@pytest.mark.parametrize(("works", "expected"), [(True, 0), (False, 1)])
def test_the_doctor_ends_with_what_it_found(run, monkeypatch: pytest.MonkeyPatch, works: bool, expected: int) -> None:
    from pathreplay.doctor import DoctorReport, VariantVerdict

    variant = VariantVerdict("llvm_ad_rgb", works, "" if works else "no libLLVM works")
    report = DoctorReport("3.9.1", "1.5.0", (), (variant,), ("libLLVM: install one",))
    monkeypatch.setattr("pathreplay.doctor.examine", lambda: report)
    status, out, _ = run("doctor")
    assert status == expected
    assert ("runs here (llvm_ad_rgb)" if works else "does not run here") in out
    assert "libLLVM: install one" in out


def test_help_leaves_the_rooms_alone(run_python) -> None:
    """What takes long to import is imported by the command that needs it."""
    code = """
import sys
from pathreplay import cli
sys.argv = ["pathreplay", "--help"]
try:
    cli.main()
except SystemExit:
    ours = {"pathreplay.jobs", "pathreplay.testing", "pathreplay.integrators.integrator"}
    heavy = ours | {"matplotlib", "scipy", "pydantic"}
    print("imported:", sorted(heavy & set(sys.modules)))
"""
    assert run_python(code).stdout.splitlines()[-1] == "imported: []"


def test_importing_pathreplay_is_light_and_offers_its_public_names(run_python) -> None:
    code = """
import sys, pathreplay
assert "matplotlib" not in sys.modules and "pathreplay.jobs" not in sys.modules
print(*[name for name in pathreplay.__all__ if name not in dir(pathreplay)])
try:
    pathreplay.no_such_name
except AttributeError as error:
    print(error)
"""
    assert run_python(code).stdout.split("\n") == ["", "module 'pathreplay' has no attribute 'no_such_name'", ""]


def test_output_to_a_full_disk_is_told() -> None:
    """With buffered output, which Python writes out at its end."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONUNBUFFERED"}
    command = [sys.executable, "-m", "pathreplay.cli", "--version"]
    with open("/dev/full", "w") as full:
        ended = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, env=environment, text=True, timeout=60)
    assert ended.returncode == 2
    (line,) = ended.stderr.splitlines()
    assert line.startswith("pathreplay: error: ") and "no space left" in line.lower()
    with open("/dev/full", "w") as full:
        command[-1] = "nothing"
        ended = subprocess.run(command, stdout=subprocess.PIPE, stderr=full, env=environment, text=True, timeout=60)
    assert ended.returncode == 2


def test_the_command_that_runs_a_written_job_can_be_pasted(
    run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "my photos"
    written = SimpleNamespace(job=folder / "job.toml", notes=())
    monkeypatch.setattr("pathreplay.jobs.from_photos", lambda *_, **__: written)
    status, out, _ = run("from-photos", str(tmp_path), "--output", str(folder), "--no-run")
    words = shlex.split(out.splitlines()[-1].removeprefix("run it with: "))
    assert status == 0
    assert words == ["pathreplay", "optimize", str(folder / "job.toml"), "--output", str(folder / "run")]
