"""The frame of the command line: exit statuses, one-line errors, quick help."""

from __future__ import annotations

import errno
import sys

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


@pytest.mark.parametrize("arguments", [("no-such-command",), ("doctor", "--no-such-option"), ("doctor", "surplus")])
def test_wrong_usage_ends_with_2(run, arguments: tuple[str, ...]) -> None:
    status, _, err = run(*arguments)
    assert status == 2
    assert "Usage" in err


@pytest.mark.parametrize(
    ("error", "line"),
    [
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


def test_other_errors_keep_their_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> None:
        raise OSError(errno.EIO, "disk on fire")

    monkeypatch.setattr("pathreplay.doctor.examine", fail)
    monkeypatch.setattr(sys, "argv", ["pathreplay", "doctor"])
    with pytest.raises(OSError, match="disk on fire"):
        cli.main()


@pytest.mark.parametrize(("works", "expected"), [(True, 0), (False, 1)])
def test_the_doctor_ends_with_what_it_found(run, monkeypatch: pytest.MonkeyPatch, works: bool, expected: int) -> None:
    from pathreplay.doctor import DoctorReport, VariantVerdict

    variant = VariantVerdict("llvm_ad_rgb", works, "" if works else "no libLLVM works")
    report = DoctorReport("0", "3", "here", "3.9.1", "1.5.0", (), (variant,), ("libLLVM: install one",))
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
    heavy = {"pathreplay.inverse", "pathreplay.check", "pathreplay.integrator", "matplotlib", "scipy", "pydantic"}
    print("imported:", sorted(heavy & set(sys.modules)))
"""
    assert run_python(code).stdout.splitlines()[-1] == "imported: []"


def test_importing_pathreplay_is_light_and_offers_its_public_names(run_python) -> None:
    code = """
import sys, pathreplay
assert "matplotlib" not in sys.modules and "pathreplay.inverse" not in sys.modules
print(*[name for name in pathreplay.__all__ if name not in dir(pathreplay)])
try:
    pathreplay.no_such_name
except AttributeError as error:
    print(error)
"""
    assert run_python(code).stdout.split("\n") == ["", "module 'pathreplay' has no attribute 'no_such_name'", ""]
