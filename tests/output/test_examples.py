"""`pathreplay examples`: what it writes is what the repository has, and each of its jobs can be loaded."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from pathreplay import cli
from pathreplay.errors import PathreplayError
from pathreplay.inverse.config.schema import load_config
from pathreplay.output import examples
from pathreplay.output.examples import example_files, write_examples
from places import ROOT


def of(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("written") / "examples"
    write_examples(folder)
    return folder


def test_all_examples_are_written_and_no_results(written: Path) -> None:
    """Against what git tracks, where there is a repository: results of examples are ignored by it."""
    listed = subprocess.run(["git", "ls-files", "examples"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("not a git repository")
    assert {f"examples/{name}" for name in of(written)} == set(listed.stdout.split())
    assert all((written / name).read_bytes() == (ROOT / "examples" / name).read_bytes() for name in of(written))


def test_results_of_examples_are_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a checkout has them after its examples were run; the package is then preferred, where it has examples."""
    package = tmp_path / "src/pathreplay"
    shutil.copytree(ROOT / "examples/one-photo", tmp_path / "examples/one-photo")
    for name in ("one-photo/photo.png", "one-photo/pictures/00.exr", "one-photo/pictures/transforms.json"):
        (tmp_path / "examples" / name).parent.mkdir(exist_ok=True)
        (tmp_path / "examples" / name).write_bytes(b"made")
    monkeypatch.setattr(examples, "_PACKAGE", package)
    assert {path.name for path in example_files()} == {"README.md", "config.toml", "make_photo.py", "scene.xml"}
    (package / "examples/other").mkdir(parents=True)
    (package / "examples/other/job.toml").write_text("")
    assert example_files() == [package / "examples/other/job.toml"]


def test_no_examples_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(examples, "_PACKAGE", tmp_path / "src/pathreplay")
    with pytest.raises(PathreplayError, match=r"no examples .* install pathreplay again"):
        example_files()


def test_every_job_can_be_loaded(written: Path) -> None:
    jobs = sorted(written.glob("*/*.toml"))
    assert len(jobs) == len(list((ROOT / "examples").glob("*/*.toml"))) > 10
    for job in jobs:
        assert load_config(job).parameters


def test_the_command_names_the_jobs_and_refuses_a_full_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["pathreplay", "examples"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    *jobs, last = capsys.readouterr().out.splitlines()
    assert not end.value.code and all((tmp_path / job).is_file() for job in jobs)
    assert last.endswith(": pathreplay optimize examples/cornell-photo/config.toml")
    with pytest.raises(SystemExit) as end:
        cli.main()
    (line,) = capsys.readouterr().err.splitlines()
    assert end.value.code == 2 and "examples exists already" in line and "FOLDER" in line
