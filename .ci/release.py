"""`make release`: build the wheel and the source archive, and try the wheel where nothing else is installed.

The script stops at the first step that fails. It compares the versions that the repository names, builds both archives
in isolation, checks their metadata, installs the wheel in an empty environment with an empty home folder, and runs the
demo from the examples of the wheel. It uploads nothing.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import venv
from collections.abc import Mapping, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DIST = ROOT / "dist"
TOOLS = ("build", "twine")  # their versions are in constraints.txt
DEMO = "examples/cornell-photo/config.toml"
#: Where each version is written. Each pattern matches once.
VERSIONS = {
    "src/pathreplay/__init__.py": r'^__version__ = "(.+)"$',
    "CITATION.cff": r"^version: (\S+)$",
    "CHANGELOG.md": r"\A(?:(?!^## ).*\n)*## \[(.+)\]",
}


def version(root: Path = ROOT) -> str:
    """Return the version of the repository. Exits if its files name different versions."""
    found = {}
    for name, pattern in VERSIONS.items():
        match = re.search(pattern, (root / name).read_text(), re.M)
        found[name] = match[1] if match else "none"
    if len(set(found.values())) > 1:
        sys.exit("release: error: versions differ: " + ", ".join(f"{name} has {text}" for name, text in found.items()))
    return found["CITATION.cff"]


def require_clean() -> None:
    """Exit if the working tree differs from the commit: the archives would contain what no commit has."""
    changed = subprocess.run(["git", "status", "--porcelain"], cwd=ROOT, capture_output=True, text=True, check=False)
    if changed.stdout:
        sys.exit(f"release: error: commit or remove these first:\n{changed.stdout.rstrip()}")


def run(command: Sequence[str | Path], cwd: Path, variables: Mapping[str, str] | None = None) -> None:
    """Print a command and run it. Exits if it fails."""
    words = [str(word) for word in command]
    print(f"release: {Path(words[0]).name} {' '.join(words[1:])}", flush=True)
    status = subprocess.run(words, cwd=cwd, env=variables).returncode
    if status:
        sys.exit(f"release: error: the command above failed (status {status})")


def environment(folder: Path) -> Path:
    """Make an empty virtual environment, and return its folder of commands."""
    venv.create(folder, with_pip=True, clear=True)
    return folder / "bin"


def build(tools: Path, number: str) -> list[Path]:
    """Build source archive and wheel in isolation, the wheel from the archive. Returns both."""
    for old in DIST.glob(f"pathreplay-{number}*"):
        old.unlink()
    constraint = ["--constraint", ROOT / "constraints.txt"]
    run([tools / "python", "-m", "pip", "install", "--quiet", *constraint, *TOOLS], ROOT)
    run([tools / "python", "-m", "build", "--outdir", DIST, ROOT], ROOT)
    archives = sorted(DIST.glob(f"pathreplay-{number}*"))
    run([tools / "python", "-m", "twine", "check", "--strict", *archives], ROOT)
    return archives


def try_wheel(wheel: Path, place: Path) -> None:
    """Install the wheel in an empty environment, and run the demo with an empty home folder."""
    home, work = place / "home", place / "work"
    for folder in (home, work):
        folder.mkdir()
    commands = environment(place / "env")
    run([commands / "python", "-m", "pip", "install", "--quiet", wheel], work)
    bare = {"HOME": str(home), "PATH": f"{commands}{os.pathsep}{os.defpath}", "LANG": "C.UTF-8"}
    program = commands / "pathreplay"
    run([program, "doctor"], work, bare)
    run([program, "examples"], work, bare)
    run([program, "optimize", DEMO, "--quiet"], work, bare)
    run([program, "export", "runs/cornell-photo"], work, bare)


def main() -> None:
    """Make a release of the checked-out commit."""
    begun = time.monotonic()
    number = version()
    require_clean()
    place = Path(tempfile.mkdtemp(prefix="pathreplay-release-"))
    try:
        archives = build(environment(place / "tools"), number)
        built = time.monotonic()
        (wheel,) = (path for path in archives if path.suffix == ".whl")
        try_wheel(wheel, place)
    finally:
        shutil.rmtree(place, ignore_errors=True)
    ended = time.monotonic()
    print(f"\npathreplay {number}: built in {built - begun:.0f} s, installed and tried in {ended - built:.0f} s")
    for path in archives:
        data = path.read_bytes()
        print(f"  {path.relative_to(ROOT)}  {len(data) / 1024:.0f} KiB  sha256 {hashlib.sha256(data).hexdigest()}")


if __name__ == "__main__":
    main()
