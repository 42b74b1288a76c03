"""What is handed out: the wheel and the source archive carry the licence and what the package reads at run time."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from pathreplay.inverse.config.parsing import parsed
from pathreplay.output.examples import example_files
from places import ROOT

MANIFEST = (ROOT / "MANIFEST.in").read_text().removeprefix("include ").split()


def test_the_licence_is_the_one_that_pyproject_names() -> None:
    text = (ROOT / "LICENSE").read_text()
    assert text.startswith("BSD 3-Clause License\n") and "the pathreplay authors" in text
    assert 'license = "BSD-3-Clause"' in (ROOT / "pyproject.toml").read_text()


def test_the_lowest_versions_are_the_bounds_of_pyproject() -> None:
    """Of the oldest Python: `>=2.10` in pyproject.toml is `==2.10.0` in constraints-lowest.txt."""
    pyproject = parsed(ROOT / "pyproject.toml", (ROOT / "pyproject.toml").read_text())
    assert isinstance(pyproject, dict)
    table = pyproject["project"]
    tests = [word for word in table["optional-dependencies"]["dev"] if word.startswith("pytest>=")]
    bounds = dict(re.match(r"([\w-]+)>=([\d.]+)", word).groups() for word in [*table["dependencies"], *tests])
    pinned: dict[str, str] = {}
    for line in (ROOT / "constraints-lowest.txt").read_text().splitlines():
        if (pin := re.match(r"([\w-]+)==([\d.]+)", line)) is not None:
            pinned.setdefault(pin[1], pin[2])  # the first line of a dependency is for the oldest Python
    assert table["requires-python"] == ">=3.10"
    assert {name.lower() for name in pinned} == {name.lower() for name in bounds}
    lowered = {name.lower(): version for name, version in pinned.items()}
    for name, bound in bounds.items():
        assert lowered[name.lower()].startswith(bound), name


@pytest.mark.slow
def test_wheel_and_source_archive_hold_the_licence(tmp_path: Path) -> None:
    """Slow, and with a network: the builds set up setuptools in an environment of their own."""
    sources = tmp_path / "sources"
    sources.mkdir()
    for name in ("pyproject.toml", "setup.py", "MANIFEST.in", "README.md", "LICENSE", *MANIFEST):
        shutil.copy(ROOT / name, sources)
    for name in ("src", "examples"):
        shutil.copytree(ROOT / name, sources / name, ignore=shutil.ignore_patterns("*.egg-info", "__pycache__"))
    (sources / "examples/one-photo/photo.png").write_bytes(b"made by the example")
    pip = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--quiet", "--wheel-dir", str(tmp_path), str(sources)]
    subprocess.run(pip, check=True, timeout=300)
    (wheel,) = tmp_path.glob("pathreplay-*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    (licence,) = [name for name in names if name.endswith("LICENSE")]
    assert zipfile.ZipFile(wheel).read(licence) == (ROOT / "LICENSE").read_bytes()
    wanted = ("py.typed", *(f"report/pages/page.{end}" for end in ("html.j2", "css", "js")))
    assert {f"pathreplay/{name}" for name in wanted} <= set(names)
    examples = {str(path.relative_to(ROOT)) for path in example_files()}
    assert {name.removeprefix("pathreplay/") for name in names if name.startswith("pathreplay/examples/")} == examples
    metadata = next(name for name in names if name.endswith("METADATA"))
    told = zipfile.ZipFile(wheel).read(metadata).decode()
    assert "License-Expression: BSD-3-Clause\n" in told and "License-File: LICENSE\n" in told

    environment = tmp_path / "env"
    subprocess.run([sys.executable, "-m", "venv", str(environment)], check=True, timeout=120)
    python = str(environment / "bin" / "python")
    subprocess.run([python, "-m", "pip", "install", "--quiet", "setuptools>=77"], check=True, timeout=300)
    build = "from setuptools.build_meta import build_sdist as build; import sys; build(sys.argv[1])"
    subprocess.run([python, "-c", build, str(tmp_path)], cwd=sources, check=True, timeout=120)
    (archive,) = tmp_path.glob("pathreplay-*.tar.gz")
    held = {name.partition("/")[2] for name in tarfile.open(archive).getnames()}
    assert held >= {"LICENSE", "setup.py", *MANIFEST, *examples} and "examples/one-photo/photo.png" not in held
