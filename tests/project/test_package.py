"""What is handed out: the wheel and the source archive carry the licence and what the package reads at run time."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from places import ROOT


def test_the_licence_is_the_one_that_pyproject_names() -> None:
    text = (ROOT / "LICENSE").read_text()
    assert text.startswith("BSD 3-Clause License\n") and "the pathreplay authors" in text
    assert 'license = "BSD-3-Clause"' in (ROOT / "pyproject.toml").read_text()


@pytest.mark.slow
def test_wheel_and_source_archive_hold_the_licence(tmp_path: Path) -> None:
    """Slow, and with a network: the builds set up setuptools in an environment of their own."""
    sources = tmp_path / "sources"
    sources.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, sources)
    shutil.copytree(ROOT / "src", sources / "src", ignore=shutil.ignore_patterns("*.egg-info", "__pycache__"))
    pip = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--quiet", "--wheel-dir", str(tmp_path), str(sources)]
    subprocess.run(pip, check=True, timeout=300)
    (wheel,) = tmp_path.glob("pathreplay-*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    (licence,) = [name for name in names if name.endswith("LICENSE")]
    assert zipfile.ZipFile(wheel).read(licence) == (ROOT / "LICENSE").read_bytes()
    wanted = ("py.typed", *(f"report/pages/page.{end}" for end in ("html.j2", "css", "js")))
    assert {f"pathreplay/{name}" for name in wanted} <= set(names)
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
    assert any(name.endswith("/LICENSE") for name in tarfile.open(archive).getnames())
