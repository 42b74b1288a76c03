"""What a release needs: files that name one version, valid citations, and a command that ends where they differ."""

from __future__ import annotations

import importlib.util
import re
import shutil
import subprocess
from pathlib import Path
from types import ModuleType

import pytest
import yaml

import pathreplay
from places import ROOT

#: Keys that the schema of CFF 1.2.0 requires, of the file and of each reference.
REQUIRED = {"cff-version", "message", "title", "authors"}
REQUIRED_OF_A_REFERENCE = {"type", "title", "authors", "year"}


@pytest.fixture(scope="module")
def release() -> ModuleType:
    spec = importlib.util.spec_from_file_location("release", ROOT / ".ci/release.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_citation_is_complete_and_of_this_version() -> None:
    table = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert set(table) >= REQUIRED and table["cff-version"] == "1.2.0"
    assert str(table["version"]) == pathreplay.__version__
    assert f'license = "{table["license"]}"' in (ROOT / "pyproject.toml").read_text()
    titles = [entry["title"] for entry in table["references"]]
    assert len(titles) == len(set(titles))
    for entry in table["references"]:
        assert set(entry) >= REQUIRED_OF_A_REFERENCE, entry["title"]
        assert all(set(author) == {"family-names", "given-names"} for author in entry["authors"])
        assert "journal" in entry or entry["type"] != "article"
        assert re.fullmatch(r"10\.\d{4,}/\S+", entry.get("doi", "10.1000/x"))


def test_the_citation_has_the_papers_that_sources_and_pages_cite() -> None:
    """As they are cited: "Nicolet et al. 2021", "Ahmed and Wonka 2020", "Vicini, Speierer, Jakob (2021)"."""
    known: set[tuple[str, str]] = set()
    for entry in yaml.safe_load((ROOT / "CITATION.cff").read_text())["references"]:
        words = [*(author["family-names"] for author in entry["authors"]), *re.findall(r"\w+", entry["title"])]
        known |= {(word, str(entry["year"])) for word in words}
    cited: set[tuple[str, str]] = set()
    for path in [*(ROOT / "src").rglob("*.py"), *(ROOT / "docs").glob("*.md")]:
        text = " ".join(path.read_text().split())
        cited |= set(re.findall(r"\b([A-Z][\w-]*[a-z])(?: et al\.)?,? \(?((?:19|20)[0-2]\d)\b(?!-)", text))
    papers = {(name, year) for name, year in cited if int(year) < 2026}
    assert {("Nicolet", "2021"), ("Burley", "2020"), ("Jakob", "2021")} <= papers
    assert papers <= known, papers - known


def test_the_changelog_has_this_version_first() -> None:
    headings = re.findall(r"^## \[(.+?)\] - (.+)$", (ROOT / "CHANGELOG.md").read_text(), re.M)
    assert headings[0][0] == pathreplay.__version__
    assert re.fullmatch(r"Unreleased|\d{4}-\d\d-\d\d", headings[0][1])


def test_the_versions_of_a_release_agree(release: ModuleType) -> None:
    assert release.version() == pathreplay.__version__


@pytest.mark.parametrize("name", ["src/pathreplay/__init__.py", "CITATION.cff", "CHANGELOG.md"])
def test_a_version_that_differs_ends_a_release(
    release: ModuleType, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for file in release.VERSIONS:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        text = (ROOT / file).read_text()
        (tmp_path / file).write_text(text.replace(pathreplay.__version__, "9.8.7", 1) if file == name else text)
    with pytest.raises(SystemExit, match=f"versions differ: .*{name} has 9.8.7"):
        release.version(tmp_path)


def test_a_changed_tree_ends_a_release(release: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if shutil.which("git") is None:
        pytest.skip("needs git")
    subprocess.run(["git", "init", "--quiet", str(tmp_path)], check=True)
    monkeypatch.setattr(release, "ROOT", tmp_path)
    release.require_clean()
    (tmp_path / "new.txt").write_text("")
    with pytest.raises(SystemExit, match=r"(?s)commit or remove.*new.txt"):
        release.require_clean()


def test_a_step_that_fails_ends_a_release(release: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="status 3"):
        release.run(["/bin/sh", "-c", "exit 3"], tmp_path)


def test_issue_templates_ask_for_the_doctor() -> None:
    """In every template; where something is wrong, the answer is required."""
    templates = [path for path in (ROOT / ".github/ISSUE_TEMPLATE").glob("*.yml") if path.stem != "config"]
    assert len(templates) > 2
    for path in templates:
        fields = {field["id"]: field for field in yaml.safe_load(path.read_text())["body"]}
        assert "pathreplay doctor" in fields["doctor"]["attributes"]["label"]
        required = fields["doctor"].get("validations", {}).get("required", False)
        assert required == (path.stem != "feature")


@pytest.mark.parametrize("page", ["CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md"])
def test_links_and_paths_of_the_pages_exist(page: str) -> None:
    text = (ROOT / page).read_text()
    links = [link.split("#")[0] for link in re.findall(r"\]\(([^)]+)\)", text)]
    paths = re.findall(r"`((?:src|tests|docs|benchmarks)/[\w./-]+)`", text)
    named = [path for path in [*links, *paths] if path and "://" not in path]
    assert [path for path in named if not (ROOT / path).exists()] == []


def test_targets_that_contributors_are_told_exist() -> None:
    (rules,) = re.findall(r"^\.PHONY: (.+)$", (ROOT / "Makefile").read_text(), re.M)
    pages = (ROOT / "CONTRIBUTING.md").read_text() + (ROOT / "docs/install.md").read_text()
    assert set(re.findall(r"make ([a-z-]*test[a-z-]*|demo|release|lowest)\b", pages)) <= set(rules.split())
